"""How the decoding process tells its parent how far it is: lines of JSON, of which child.py says what they hold."""

from __future__ import annotations

import json
import threading
import time
from typing import Any, BinaryIO

REPORT_PERIOD_S = 0.05


class Reports:
    """Tells the parent how far it is, not too often; any thread may call it."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._pictures = 0
        self._next_s = 0.0
        self.field = "clip"
        self.share = 0.0

    def picture(self) -> None:
        """Another picture was decoded."""
        with self._lock:
            self._pictures += 1
            if time.monotonic() >= self._next_s:
                self._next_s = time.monotonic() + REPORT_PERIOD_S
                self._send({"pictures": self._pictures, "share": self.share, "field": self.field})

    def reading(self, field: str) -> None:
        """From now on it is this input that is read."""
        with self._lock:
            self.field = field
            self._send({"pictures": self._pictures, "share": self.share, "field": field})

    def end(self, answer: dict[str, Any]) -> None:
        """The last line."""
        with self._lock:
            self._send(answer)

    def _send(self, line: dict[str, Any]) -> None:
        self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._stream.flush()
