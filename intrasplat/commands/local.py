"""The list of the library's commands. This module imports nothing, so that the command line starts at once."""

from __future__ import annotations

LOCAL_COMMANDS = {
    "reconstruct": "train a scene from a clip, on this machine",
    "render": "render images of a scene that is on this machine",
    "export": "write a scene that is on this machine as a file for other programs",
    "measure": "measure depths and distances in a scene that is on this machine, for research only",
    "live": "follow a live stereo source, on this machine, and keep its past",
    "evaluate": "compare methods on a clip of your own: rows, curves, one chart of speed against accuracy",
    "poses": "estimate the path of a stereo clip's camera, and compare it with a known one",
    "doctor": "say what is installed, what would be used, what is missing",
}
"""Summaries by command. Each command is a module of this folder with add_cli_arguments and run_cli."""
