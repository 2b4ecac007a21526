"""Exports in progress: each is computed part by part, as its caller asks for the parts."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass

from contract.wire.rendering import CutRequest, ExportRequest
from intrasplat.errors import SceneError, UnavailableError

MAX_OPEN = 8
IDLE_S = 120.0
"""An export ends this long after its last part if its caller asks for no other."""


@dataclass(eq=False)
class _Open:
    key: tuple[str, int | None]
    parts: Generator[bytes]
    next_part: int
    used_s: float


class OpenExports:
    """The exports in progress, by their ids; for use in one thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._open: dict[str, _Open] = {}

    def part(self, request: ExportRequest | CutRequest, begin: Callable[[], Generator[bytes]]) -> tuple[bytes, bool]:
        """The requested part, and whether more follow. The first part starts the export: begin() yields its parts.

        Raises:
            UnavailableError: too many exports are in progress.
            SceneError: this export is not in progress here.
        """
        if request.part == 0:
            self.forget()
            if len(self._open) >= MAX_OPEN:
                problem = f"This worker makes {MAX_OPEN} exports already, its most at once."
                raise UnavailableError(problem, "Ask again when one of them has ended.")
            key = (request.scene_id, request.attempt)
            self._open[request.export_id] = _Open(key, begin(), 0, self._clock())
        export = self._open.get(request.export_id)
        if export is None or export.next_part != request.part:
            raise SceneError(f"The export of scene {request.scene_id} has ended, or belongs to another worker.")
        try:
            content = next(export.parts, None)
        except BaseException:
            self._end(request.export_id)
            raise
        if content is None:
            self._end(request.export_id)
            return b"", False
        export.next_part, export.used_s = request.part + 1, self._clock()
        return content, True

    def is_open(self, export_id: str) -> bool:
        """Whether this export is in progress."""
        return export_id in self._open

    def forget(self, is_gone: Callable[[str, int | None], bool] = lambda scene_id, attempt: False) -> None:
        """End the exports of scenes that were removed, and those that their callers abandoned."""
        now_s = self._clock()
        for export_id, each in list(self._open.items()):
            if now_s - each.used_s > IDLE_S or is_gone(*each.key):
                self._end(export_id)

    def _end(self, export_id: str) -> None:
        export = self._open.pop(export_id, None)
        if export is not None:
            export.parts.close()  # removes its temporary files
