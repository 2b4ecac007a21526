"""What every process needs to run: settings, logs, exit codes, locks, signals, command-line arguments."""
