"""In how many pixels a frame is drawn and judged, and the endoscope's own view that it is compared with."""

from __future__ import annotations

import math
from dataclasses import dataclass

from contract.wire.rendering import MAX_JUDGED_PIXELS
from worker.input.camera import Intrinsics
from worker.render.camera import as_recorded

MAX_JUDGED_SIDE = 8192
"""If they are so many, at most so many along a side: as many as a caller may ask for."""
AS_FINE = 0.02
"""A picture whose pixels are by no more larger or smaller than the recording's is judged in its own."""


@dataclass(frozen=True)
class Lenses:
    """The cameras behind one frame.

    asked      the caller's
    judged     in whose pixels confidence is computed (judged_camera)
    drawn      whose picture is made: the one of asked and judged that has more pixels
    endoscope  the endoscope's lens, in pixels as fine as those of judged: confidence compares with its view
    """

    asked: Intrinsics
    judged: Intrinsics
    drawn: Intrinsics
    endoscope: Intrinsics

    @classmethod
    def of(cls, asked: Intrinsics, own: Intrinsics, max_pixels: int, *, is_coarse: bool = False) -> Lenses:
        """Those of a frame of a scene whose lens is `own`; max_pixels and is_coarse as of a View (view.py)."""
        judged = asked if is_coarse else judged_camera(asked, own, max_pixels)
        drawn = max(asked, judged, key=pixel_count)
        if pixel_count(judged) == pixel_count(drawn):
            judged = drawn
        most = pixel_count(asked) if is_coarse else max_pixels
        return cls(asked, judged, drawn, _compared_camera(judged, own, most))

    def pixels_drawn(self, *, confidence: bool, from_endoscope: bool) -> list[int]:
        """Pixels of each picture that is rendered for the frame.

        confidence: it is asked for, too.
        from_endoscope: the view is from the endoscope's own pose.
        """
        drawn = [self.drawn]
        if confidence and self.judged != self.drawn:
            drawn.append(self.judged)
        if confidence and not (from_endoscope and self.endoscope == self.judged):
            drawn.append(self.endoscope)
        return [pixel_count(each) for each in drawn]


def pixel_count(camera: Intrinsics) -> int:
    """Of its picture."""
    return camera.width * camera.height


def judged_camera(asked: Intrinsics, own: Intrinsics, max_pixels: int = MAX_JUDGED_PIXELS) -> Intrinsics:
    """The view in the pixels in which it is judged: the recording's, as far as they are not too many. A smaller picture
    is drawn in them, too.

    The right eye's lens, and sizes rounded to whole pixels, count as the recording's.
    """
    fine = as_recorded(asked, own)
    if abs(pixel_count(fine) / pixel_count(asked) - 1) <= AS_FINE:
        return asked
    most = max(min(MAX_JUDGED_PIXELS, max_pixels), pixel_count(asked))
    return asked if pixel_count(fine) > most == pixel_count(asked) else _at_most(fine, most)


def _compared_camera(judged: Intrinsics, own: Intrinsics, max_pixels: int) -> Intrinsics:
    """The endoscope's lens, in pixels as fine as those of a view that is compared with it, and no more than allowed."""
    across, down = min(judged.fx / own.fx, 1.0), min(judged.fy / own.fy, 1.0)
    as_fine = own
    if across * down < 1 - AS_FINE:
        as_fine = own.resized(max(1, round(own.width * across)), max(1, round(own.height * down)))
    return _at_most(as_fine, max(max_pixels, pixel_count(judged)))


def _at_most(camera: Intrinsics, most: int) -> Intrinsics:
    """The same view in at most so many pixels."""
    if pixel_count(camera) <= most:
        return camera
    share = math.sqrt(most / pixel_count(camera))
    width = min(max(1, int(camera.width * share)), MAX_JUDGED_SIDE, most)
    return camera.resized(width, min(max(1, int(camera.height * share)), MAX_JUDGED_SIDE, most // width))
