"""A stereo pair of a feed, as a source hands it over. Symbols: H W pixels of one eye."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class FeedPair:
    """A decoded, unpacked pair that is not rectified.

    left, right  [H, W, 3] RGB uint8
    source_s     seconds of the source's clock since the feed's first frame; never falls, and a gap stays a gap
    arrived_at   UNIX time, s, at which the last byte of the pair's packet came in
    sequence     number of the pair in the feed, rising
    pixel_aspect width / height of a pixel
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    source_s: float
    arrived_at: float
    sequence: int
    pixel_aspect: float = 1.0
