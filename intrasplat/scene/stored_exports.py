"""Export a scene's stored files, without loading the scene and without a worker."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from intrasplat.names import Keep
from intrasplat.scene.archive import archive_parts
from intrasplat.scene.player_page import page_parts
from intrasplat.server_parts import server_part

DASHBOARD_VARIABLE = "INTRASPLAT_DASHBOARD_DIR"


def stored_parts(
    name: str,
    folder: Path,
    scene_id: str | None,
    dashboard_dir: Path | None,
    label: str | None = None,
    recorded: Keep | None = None,
) -> Iterator[bytes]:
    """The file in a format of EXPORT_FORMATS that has is_stored set, piece by piece.

    Args:
        scene_id: None: the folder belongs to no service.
        dashboard_dir: the page's files; None: they are not known.
        label: what its callers call the scene.
        recorded: as ExportOptions.recorded, for html.

    Raises, before the first piece:
        InputError, LimitError, SceneError, UnavailableError: as archive_parts() and page_parts().
    """
    if name == "html":
        return page_parts(folder, scene_id, dashboard_dir, recorded)
    return archive_parts(folder, scene_id, label)


def installed_dashboard() -> Path | None:
    """The folder of the page's files, which come with the server; None: it is not installed."""
    folder = os.environ.get(DASHBOARD_VARIABLE) or server_part("dashboard")
    return Path(folder) if folder else None
