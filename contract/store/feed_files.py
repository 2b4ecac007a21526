"""The files of live feeds on this machine: data_dir/feeds/<id>/. Their worker alone writes them; no bucket has them."""

from __future__ import annotations

import os
from pathlib import Path

from contract.store.local import remove_tree
from contract.store.shelf import is_job_id
from intrasplat.files.disk_errors import disk_errors
from intrasplat.files.durable import flush, replace_file

FEEDS = "feeds"
OPENED = "opened"
"""A file in a feed's folder: when the feed was opened."""


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
    def make(self, feed_id: str, created_at_s: float) -> Path:
        """The folder of a feed that was opened at a UNIX time, which exists from now on.

        What an earlier feed has left in it is removed: an Idempotency-Key that is used again gives the same id.
        """
        folder = self.folder(feed_id)
        opened, text = folder / OPENED, repr(created_at_s).encode()
        if folder.exists() and not (opened.is_file() and opened.read_bytes() == text):
            self.remove(feed_id)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not opened.exists():
            replace_file(opened, text)
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
