"""Helpers of the programs: command lines, runs, logs, presets, tables and plots."""
