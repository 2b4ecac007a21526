"""The progress bar of every command: one line on a terminal, one line for each stage in a log file."""

from __future__ import annotations

import math
from types import TracebackType
from typing import Protocol, TextIO

BAR_CELLS = 24
LINE_COLUMNS = 78


class ShownProgress(Protocol):
    """Progress of a stage of this process (intrasplat/machine/hooks.py) or of a job on a service.

    fraction: the stage's completed share, in [0, 1]. psnr_db: the last held-out psnr_tissue.
    """

    @property
    def stage(self) -> str: ...
    @property
    def fraction(self) -> float: ...
    @property
    def psnr_db(self) -> float | None: ...
    @property
    def seconds_left(self) -> float | None: ...


def format_progress(progress: ShownProgress) -> str:
    """`train      [######..................]  25 %  31.24 dB  42 s left`, without unknown parts."""
    fraction = min(1.0, max(0.0, progress.fraction)) if math.isfinite(progress.fraction) else 0.0
    filled = round(fraction * BAR_CELLS)
    parts = [f"{progress.stage:<10} [{'#' * filled}{'.' * (BAR_CELLS - filled)}] {fraction:4.0%}"]
    if progress.psnr_db is not None and math.isfinite(progress.psnr_db):
        parts.append(f"{progress.psnr_db:.2f} dB")
    if progress.seconds_left is not None and math.isfinite(progress.seconds_left):
        parts.append(f"{progress.seconds_left:.0f} s left")
    return "  ".join(parts)


class ProgressBar:
    """Writes progress to `stream`. As a context manager it always ends the line."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._on_terminal = stream.isatty()
        self._last_stage: str | None = None
        self._line_open = False

    def show(self, progress: ShownProgress) -> None:
        """Redraw the line on a terminal; elsewhere write one line for each stage."""
        if self._on_terminal:
            self._stream.write(f"\r{format_progress(progress):<{LINE_COLUMNS}}")
            self._line_open = True
        elif progress.stage != self._last_stage:
            self._stream.write(f"{progress.stage}\n")
        self._last_stage = progress.stage
        self._stream.flush()

    def close(self) -> None:
        """End the line, if one is open."""
        if self._line_open:
            self._stream.write("\n")
            self._stream.flush()
            self._line_open = False

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
