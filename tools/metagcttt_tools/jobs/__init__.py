"""Runs of programs as jobs: on this machine, or on a Ray cluster."""
