"""How the decoding process reports its progress to its parent: lines of JSON, which child.py describes."""

from __future__ import annotations

import json
import threading
import time
from typing import Any, BinaryIO

REPORT_PERIOD_S = 0.05


class Reports:
    """Reports progress to the parent, at most once every REPORT_PERIOD_S. Any thread may call it."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._pictures = 0
        self._next_s = 0.0
        self.field = "clip"
        self.share = 0.0

    def picture(self) -> None:
        """Count another decoded picture."""
        with self._lock:
            self._pictures += 1
            if time.monotonic() >= self._next_s:
                self._next_s = time.monotonic() + REPORT_PERIOD_S
                self._send({"pictures": self._pictures, "share": self.share, "field": self.field})

    def reading(self, field: str) -> None:
        """Say that this input is read from now on."""
        with self._lock:
            self.field = field
            self._send({"pictures": self._pictures, "share": self.share, "field": field})

    def end(self, answer: dict[str, Any]) -> None:
        """Send the last line."""
        with self._lock:
            self._send(answer)

    def _send(self, line: dict[str, Any]) -> None:
        self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._stream.flush()
