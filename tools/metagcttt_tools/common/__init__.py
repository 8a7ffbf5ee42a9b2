"""What several programs share: command lines, runs, logs, presets, tables and plots."""
