"""The text that stands beside the picture in Slicer: what is shown, how far to trust it, what went wrong."""

from __future__ import annotations

import time

from client.slicer.clip import Clip
from contract.wire.report import RESEARCH_USE
from intrasplat_client.models import Report, Severity
from intrasplat_client.views import Image


class Status:
    """What peers are told.

    trouble: why the picture is out of date. refused: what of the peers' wishes was not done, and why. surface: of which
    frame it is. ended: why nothing more comes. confidence: mean over the view, in [0, 1]; None: it shows nothing.
    """

    def __init__(self, clip: Clip, report: Report) -> None:
        self._clip = clip
        self._doubts = [each.text for each in report.warnings if each.severity == Severity.WARNING]
        self._view = "Nothing is shown yet."
        self._view_doubts: str | None = None
        self._unseen: float | None = None
        self._shown_at = ""
        self.trouble = self.refused = self.surface = self.ended = ""
        self.confidence: float | None = None

    def show(self, image: Image, frame: int, *, follows: bool, plays: bool) -> None:
        """Note what the picture shows, which is up to date."""
        pose = "the pose that Slicer sends" if follows else "the endoscope's own pose"
        state = "playing" if plays else "standing"
        last, seconds = self._clip.frame_count - 1, self._clip.times_s[frame]
        self._view = f"frame {frame} of 0 to {last}, {seconds:.2f} s, from {pose}, {state}"
        self._view_doubts, self._unseen = image.warning, image.unseen
        self._shown_at = time.strftime("%H:%M:%S")
        self.trouble = ""

    def words(self) -> str:
        """All of it, a line each."""
        if self.ended:
            head = f"ENDED: the picture is no longer kept up to date. {self.ended}"
        elif self.trouble:
            head = f"STALE: the picture is of {self._shown_at or 'no time'}. {self.trouble}"
        else:
            head = f"CURRENT: {self._view}"
        confidence = "not known" if self.confidence is None else f"{self.confidence:.0%} on average"
        unseen = "" if self._unseen is None else f"; {self._unseen:.0%} of the view was never seen"
        lines = [
            RESEARCH_USE,
            head,
            f"Confidence: {confidence}{unseen}.",
            *([f"This view: {self._view_doubts}"] if self._view_doubts else []),
            *(f"This scene: {each}" for each in self._doubts),
            *(each for each in (self.surface, self.refused) if each),
        ]
        return "\n".join(lines)
