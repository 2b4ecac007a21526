"""Exports of a scene's stored files: no scene is read, and no worker is needed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from intrasplat.scene.archive import archive_parts
from intrasplat.scene.player_page import page_parts


def stored_parts(name: str, folder: Path, scene_id: str | None, dashboard_dir: Path | None) -> Iterator[bytes]:
    """The file of a format of EXPORT_FORMATS whose is_stored is set, piece by piece.

    Args:
        scene_id: None: of a folder that is no service's.
        dashboard_dir: the page's files; None: they are not known.

    Raises, before the first piece:
        InputError, SceneError, UnavailableError: as archive_parts() and page_parts().
    """
    return page_parts(folder, scene_id, dashboard_dir) if name == "html" else archive_parts(folder, scene_id)
