"""The text beside the picture in Slicer: what is shown, how far to trust it, what went wrong."""

from __future__ import annotations

import time

from client.slicer.playback import Playback
from intrasplat.report import RESEARCH_USE
from intrasplat_client.models import Report, Severity
from intrasplat_client.views import Image


class Status:
    """The status that peers show.

    trouble: why the picture is out of date. refused: which request of a peer was refused, and why. surface: the frame
    of the surface. ended: why the bridge has ended. confidence: mean over the view, in [0, 1]; None: it shows nothing.
    """

    def __init__(self, playback: Playback, report: Report) -> None:
        self._playback = playback
        self._warnings = [each.text for each in report.warnings if each.severity == Severity.WARNING]
        self._shown: tuple[Image, int, bool] | None = None
        self._shown_at = ""
        self.trouble = self.refused = self.surface = self.ended = ""
        self.confidence: float | None = None

    def show(self, image: Image, frame: int, *, follows: bool) -> None:
        """Note what the picture shows, which is up to date. follows: its pose came from a peer."""
        self._shown = image, frame, follows
        self._shown_at = time.strftime("%H:%M:%S")
        self.trouble = ""

    def words(self) -> str:
        """The whole text, one line for each part."""
        confidence = "not known" if self.confidence is None else f"{self.confidence:.0%} on average"
        image = None if self._shown is None else self._shown[0]
        unseen = "" if image is None or image.unseen is None else f"; {image.unseen:.0%} of the view was never seen"
        lines = [
            RESEARCH_USE,
            self._head(),
            f"Confidence: {confidence}{unseen}.",
            *([f"This view: {image.warning}"] if image is not None and image.warning else []),
            *(f"This scene: {each}" for each in self._warnings),
            *(each for each in (self.surface, self.refused) if each),
        ]
        return "\n".join(lines)

    def _head(self) -> str:
        """Whether the picture is up to date, and what it shows."""
        if self.ended:
            return f"ENDED: the picture is no longer kept up to date. {self.ended}"
        if self._shown is None:
            return f"STALE: nothing is shown yet. {self.trouble}".rstrip()
        if self.trouble:
            return f"STALE: the picture is of {self._shown_at}. {self.trouble}"
        _, frame, follows = self._shown
        pose = "the pose that Slicer sends" if follows else "the endoscope's own pose"
        state = "playing" if self._playback.plays else "standing"
        last, seconds = self._playback.frame_count - 1, self._playback.times_s[frame]
        return f"CURRENT: frame {frame} of 0 to {last}, {seconds:.2f} s, from {pose}, {state}"
