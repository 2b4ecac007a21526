"""The commands that run on this machine without a service. It imports nothing, so that they start at once."""

from __future__ import annotations

LOCAL_COMMANDS = {
    "reconstruct": "train a scene from a clip, on this machine",
    "render": "render images of a scene that is on this machine",
    "export": "write a scene that is on this machine as a file for other programs",
    "measure": "measure depths and distances in a scene that is on this machine, for research only",
    "phantom": "make a synthetic stereo clip of tissue, with its truth",
    "evaluate": "measure presets on clips, and draw speed against accuracy",
    "stability": "spoil synthetic clips in many ways, and draw where presets break and whether they say so",
    "poses": "estimate the path of a stereo clip's camera, and compare it with a known one",
    "doctor": "say what is installed, what would be used, what is missing",
}
"""What `intrasplat` and `python -m worker` do without a service: summaries by command."""

WORKER_SUMMARY = "claim jobs from the queue of REDIS_URL and serve renders, until a signal ends it"
"""What `intrasplat worker` does, which is `python -m worker consume`."""
