"""One rendered view: its layers, in more pixels or in fewer.

H W pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from contract.wire.notices import Notice, NoticeCode

COARSE = "This picture is coarse, because a job trains and time is short. It becomes sharp when the view rests."
MOST = 0.5
"""Of a pixel: more of it decides."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One rendered view.

    rgb        [H, W, 3] uint8
    depth_mm   [H, W] float32, camera z, 0 where nothing solid is
    unseen     [H, W] bool: no training frame saw what is shown here; the other layers hold the model's guess
    unseen_share   of the view, in [0, 1]
    warnings   what to distrust about this frame, and what to know of it

    Confidence, unseen_share and warnings do not depend on how many pixels show the view (docs/conventions.md, "Size of
    a picture").
    """

    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    unseen: NDArray[np.bool_]
    unseen_share: float
    warnings: tuple[Notice, ...]
    _confidence: Callable[[], NDArray[np.float32]]

    @cached_property
    def confidence(self) -> NDArray[np.float32]:
        """[H, W] float32 in [0, 1]: how likely colour and depth are right (confidence.py); 0 where nothing solid is.

        Computed when it is first asked for: from another pose than the endoscope's it takes a second render.
        """
        return self._confidence()

    def enlarged(self, width: int, height: int) -> Frame:
        """The frame in more pixels, with a notice that says so."""
        size = (width, height)
        rgb = np.asarray(cv2.resize(self.rgb, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        depth_mm = np.asarray(cv2.resize(self.depth_mm, size, interpolation=cv2.INTER_NEAREST), np.float32)
        unseen = cv2.resize(self.unseen.view(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
        likely = self._confidence

        def confidence() -> NDArray[np.float32]:
            return np.asarray(cv2.resize(likely(), size, interpolation=cv2.INTER_LINEAR), np.float32)

        warnings = (*self.warnings, Notice.info(NoticeCode.COARSE, COARSE))
        return Frame(rgb, depth_mm, unseen, self.unseen_share, warnings, confidence)

    def reduced(self, width: int, height: int) -> Frame:
        """The frame in fewer pixels: each is the mean of those it covers, as most of them are solid and seen or not."""

        def mean(layer: NDArray[np.floating] | NDArray[np.uint8]) -> NDArray[np.floating]:
            return np.asarray(cv2.resize(layer, (width, height), interpolation=cv2.INTER_AREA))

        solid = mean((self.depth_mm > 0).astype(np.float32))
        covered, safe = solid >= MOST, np.maximum(solid, MOST)
        depth_mm = np.where(covered, mean(self.depth_mm) / safe, 0).astype(np.float32)
        unseen, likely = mean(self.unseen.astype(np.float32)) > MOST, self._confidence

        def confidence() -> NDArray[np.float32]:
            return np.where(covered, mean(likely()), 0).astype(np.float32)

        rgb = np.asarray(mean(self.rgb), np.uint8)
        return Frame(rgb, depth_mm, unseen, self.unseen_share, self.warnings, confidence)
