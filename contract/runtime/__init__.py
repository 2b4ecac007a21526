"""Settings, logs, traces, locks and child processes: what every process of an installation needs.

`Settings.from_environment` reads the settings, `configure` sets up the log, `Supervised` runs a child process, and
`FolderLock` admits one process per data directory.
"""
