"""Find what an installed server (the distribution intrasplat-server) adds to the commands of the library."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

GROUP = "intrasplat.server"
"""Entry points: `commands` runs the server's commands, `doctor` examines it, `dashboard` names the page's folder."""


def server_part(name: str) -> Any | None:
    """The object that the server registers under this name in GROUP; None: no server is installed."""
    for each in entry_points(group=GROUP, name=name):
        return each.load()
    return None
