"""Whether a feed shows tissue: outside the body, nothing of it may be learnt, shown or stored.

Blood absorbs green light, so tissue is red, and not yellow as skin, wood and warm light are.
"""

from __future__ import annotations

import threading

import cv2
import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.clip.types import RgbFrame

LOOKED_AT = 64, 48
"""Width and height, px, of the picture whose colours count."""
RED_TO_GREEN, RED_TO_BLUE, BLUE_TO_GREEN = 1.3, 1.1, 0.85
"""Least ratios of the colours of a pixel of tissue."""
DARK, BRIGHT = 25, 220
"""A pixel has a colour if its largest value is above DARK and its smallest one below BRIGHT."""
MIN_SHARE = 0.2
"""Least share of tissue among pixels with a colour."""
MIN_COLOURED_SHARE = 0.3
"""Of a darker picture the share counts as if so many had a colour."""
MAX_TISSUE_MM = 200.0
"""What has a larger median depth lies outside: the endoscope works at 30 to 150 mm."""
OUT_S = 2.0
"""Without tissue for longer, the endoscope is out."""
BACK_PAIRS = 2
"""Pairs with the colours of tissue in turn, after which the endoscope may be back."""
NEAR_S = 0.5
"""What is recorded so soon after tissue was seen is stored; it is deleted if the endoscope proves to be out."""
REMEMBERED = 64
"""Stretches without tissue that are remembered: as long as parts may wait to be judged."""


def has_colours_of_tissue(rgb: RgbFrame) -> bool:
    """Whether a picture [H, W, 3] has the colours of tissue."""
    small = np.asarray(cv2.resize(rgb, LOOKED_AT, interpolation=cv2.INTER_AREA), np.float32)
    red, green, blue = small[..., 0], small[..., 1], small[..., 2]
    coloured = (small.max(-1) > DARK) & (small.min(-1) < BRIGHT)
    tissue = coloured & (red > RED_TO_GREEN * green) & (red > RED_TO_BLUE * blue) & (blue > BLUE_TO_GREEN * green)
    return float(tissue.mean()) >= MIN_SHARE * max(float(coloured.mean()), MIN_COLOURED_SHARE)


def is_near(clip: DepthClip) -> bool:
    """Whether the measured depths of a clip of one frame are those of an endoscope inside the body."""
    depths = clip.depth_mm[0][clip.depth_mm[0] > 0]
    return not len(depths) or float(np.median(depths)) <= MAX_TISSUE_MM


class TissueWatch:
    """When a feed showed tissue. Any thread may call it.

    is_out  whether the endoscope is outside
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last_s: float | None = None
        """Source time of the last pair with tissue; before the first one, that of the first pair."""
        self._had_tissue = self._is_doubtful = self._has_ended = self.is_out = False
        self._out: list[tuple[float, float]] = []
        self._back = 0

    def see(self, source_s: float, *, is_tissue: bool) -> bool:
        """Note what the pair of a source time, s, shows. True: it is the one at which the endoscope counts as out."""
        with self._lock:
            self._has_ended = False
            if is_tissue:
                if self.is_out:
                    self._out = [*self._out, (self._last_s or 0.0, source_s)][-REMEMBERED:]
                self._last_s, self._had_tissue = source_s, True
                self.is_out = self._is_doubtful = False
                return False
            if self._last_s is None:
                self._last_s = source_s
            self._is_doubtful, self._back = True, 0
            goes_out = not self.is_out and source_s - self._last_s >= OUT_S
            self.is_out = self.is_out or goes_out
            return goes_out

    def may_be_back(self) -> bool:
        """Whether a pair with the colours of tissue, which is there now, may be learnt."""
        self._back += 1
        return not self.is_out or self._back >= BACK_PAIRS

    @property
    def tissue_until_s(self) -> float:
        """Source time of the last pair with tissue; -inf without one."""
        with self._lock:
            return self._last_s if self._had_tissue and self._last_s is not None else -np.inf

    def end(self) -> None:
        """No more pairs come: what was recorded after the last one is as that was."""
        self._has_ended = True

    def keeps(self, from_s: float, to_s: float) -> bool | None:
        """Whether what was recorded in a range of source times may be stored; None: not known yet."""
        with self._lock:
            if any(begins_s < to_s and from_s < ends_s for begins_s, ends_s in self._out):
                return False
            known_s = self._last_s if self._had_tissue and self._last_s is not None else -np.inf
            if to_s <= known_s:
                return True
            if self.is_out:
                return False
            if self._is_doubtful:
                return None
            return True if to_s <= known_s + NEAR_S or (self._has_ended and self._had_tissue) else None
