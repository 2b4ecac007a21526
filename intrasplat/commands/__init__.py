"""Command-line options in; a scene or pictures in files out, on this machine and without a service.

Verbs: run_cli of reconstruct and render. Nothing here imports torch before a command runs, so --help answers at once.
"""
