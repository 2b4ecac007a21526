"""The environment in, a running process out: what every process of an installation needs besides its own work.

`Settings.from_environment` reads what a deployment may set, `configure` sets up its log, `Supervised` runs a child,
`told_to_end` hears signals, `FolderLock` keeps a second process out, `end_by` turns an error into an exit code, and
`add_command` and `ProgressBar` shape the command line.
"""
