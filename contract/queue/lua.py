"""Loads the scripts that change the queue on Redis: contract/queue/scripts/*.lua, one for each atomic change.

Each script goes by the server's clock. When it runs again because its answer was lost, it answers as before and changes
nothing more. Its first line says whether it may run while the server's memory is full, which those may that bring work
to its end; its header lists its arguments, the keys it touches, and its answer.
"""

from __future__ import annotations

from importlib.resources import files


def load_script(name: str) -> str:
    """The text that the server runs for scripts/<name>.lua: its first line, common.lua, and the rest of it."""
    folder = files("contract.queue") / "scripts"
    first_line, rest = (folder / f"{name}.lua").read_text(encoding="utf-8").split("\n", 1)
    return "\n".join([first_line, (folder / "common.lua").read_text(encoding="utf-8"), rest])
