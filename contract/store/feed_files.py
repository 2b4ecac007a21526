"""The files of live feeds on this machine: data_dir/feeds/<id>/. Their worker alone writes them; no bucket has them."""

from __future__ import annotations

import os
from pathlib import Path

from contract.store.local import remove_tree
from contract.store.shelf import is_job_id
from intrasplat.files.disk_errors import disk_errors
from intrasplat.files.durable import flush

FEEDS = "feeds"


class FeedFiles:
    """Every method raises UnavailableError when the disk refuses."""

    def __init__(self, data_dir: Path) -> None:
        self._folder = data_dir.expanduser().resolve() / FEEDS

    def folder(self, feed_id: str) -> Path:
        """The folder of a feed, which need not exist.

        Raises:
            ValueError: it is not the id of a feed.
        """
        if not is_job_id(feed_id):
            raise ValueError("this is not the id of a feed")
        return self._folder / feed_id

    @disk_errors()
    def make(self, feed_id: str) -> Path:
        """The folder of a feed, which exists from now on."""
        folder = self.folder(feed_id)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder

    @disk_errors()
    def ids(self) -> list[str]:
        """The feeds that have files here."""
        if not self._folder.is_dir():
            return []
        return sorted(each.name for each in os.scandir(self._folder) if is_job_id(each.name))

    @disk_errors()
    def remove(self, feed_id: str) -> None:
        """Remove all files of a feed, for good when this returns."""
        folder = self.folder(feed_id)
        if folder.exists():
            remove_tree(folder)
            flush(self._folder)
