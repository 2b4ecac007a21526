"""The commands of the library, which work on this machine without a service.

In: command-line options. Out: a scene, pictures or other files. Verbs: add_cli_arguments and run_cli of each command.
Nothing here imports torch before a command runs, so --help answers at once.
"""
