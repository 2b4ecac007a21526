"""Progress reports of the decoding process to its parent: lines of JSON, which child.py describes."""

from __future__ import annotations

import json
import threading
import time
from typing import Any, BinaryIO

REPORT_PERIOD_S = 0.02


class Reports:
    """Reports progress to the parent, at most once every REPORT_PERIOD_S. Any thread may call it."""

    def __init__(self, stream: BinaryIO, granted: list[str]) -> None:
        """granted: the active protections, which are reported with the clip."""
        self._stream, self._granted = stream, granted
        self._lock = threading.Lock()
        self._pictures = 0
        self._next_s = 0.0
        self.field = "clip"
        self.share = 0.0
        self.frames = 0
        """Number of frames of both eyes that are complete in the files."""

    def picture(self) -> None:
        """Count another decoded picture."""
        with self._lock:
            self._pictures += 1
            if time.monotonic() >= self._next_s:
                self._next_s = time.monotonic() + REPORT_PERIOD_S
                self._report()

    def reading(self, field: str) -> None:
        """Set the input that is read from now on."""
        with self._lock:
            self.field = field
            self._report()

    def opened(self, description: dict[str, Any]) -> None:
        """Report the clip before its first frame."""
        with self._lock:
            self._send({"opened": description | {"granted": self._granted}})

    def end(self, result: dict[str, Any]) -> None:
        """Send the last line: the result."""
        with self._lock:
            self._send({"result": result | {"granted": self._granted}})

    def fail(self, error: dict[str, Any]) -> None:
        """Send the last line: the error."""
        with self._lock:
            self._send({"error": error})

    def _report(self) -> None:
        progress = {"pictures": self._pictures, "frames": self.frames, "share": self.share, "field": self.field}
        self._send(progress)

    def _send(self, line: dict[str, Any]) -> None:
        self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._stream.flush()
