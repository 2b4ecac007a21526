"""One rendered view with its layers, and the same view in more or fewer pixels.

Symbols: H W pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.notices import Notice, NoticeCode

COARSE = "This picture is coarse, because a job trains and time is short. It becomes sharp when the view rests."
MOST = 0.5
"""A smaller picture's pixel is solid or unseen if more than this share of the pixels it covers is."""


@dataclass(frozen=True, eq=False)
class View:
    """One rendered view.

    rgb        [H, W, 3] uint8
    depth_mm   [H, W] float32, camera z; 0 where nothing is solid
    unseen     [H, W] bool: no training frame saw what is shown here; the other layers contain the model's guess
    unseen_share   share of unseen pixels, in [0, 1]
    detail_share   share of the solid pixels whose detail comes from recorded frames, in [0, 1]
    warnings   notices about this frame: what to distrust, and what to know

    Confidence, unseen_share and warnings do not depend on how many pixels show the view (docs/conventions.md, "Size of
    a picture").
    """

    rgb: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    unseen: NDArray[np.bool_]
    unseen_share: float
    detail_share: float
    warnings: tuple[Notice, ...]
    _confidence: Callable[[], NDArray[np.float32]]
    _smoke: Callable[[], NDArray[np.float32]]

    @cached_property
    def confidence(self) -> NDArray[np.float32]:
        """[H, W] float32 in [0, 1]: the probability that colour and depth are right (confidence.py); 0 where nothing
        is solid. Computed at the first access; for a pose other than the endoscope's it takes a second render.
        """
        return self._confidence()

    @cached_property
    def smoke(self) -> NDArray[np.float32]:
        """[H, W] float32 in [0, 1]: the share of the light that smoke took when the moment was recorded; 0 without
        any, and where nothing is solid.
        """
        return self._smoke()

    def enlarged(self, width: int, height: int) -> View:
        """The frame in more pixels, with a notice that says so."""
        size = (width, height)
        rgb = np.asarray(cv2.resize(self.rgb, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        depth_mm = np.asarray(cv2.resize(self.depth_mm, size, interpolation=cv2.INTER_NEAREST), np.float32)
        unseen = cv2.resize(self.unseen.view(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)

        def grown(layer: Callable[[], NDArray[np.float32]]) -> Callable[[], NDArray[np.float32]]:
            return lambda: np.asarray(cv2.resize(layer(), size, interpolation=cv2.INTER_LINEAR), np.float32)

        warnings = (*self.warnings, Notice.info(NoticeCode.COARSE, COARSE))
        likely, smoke = grown(self._confidence), grown(self._smoke)
        return View(rgb, depth_mm, unseen, self.unseen_share, self.detail_share, warnings, likely, smoke)

    def reduced(self, width: int, height: int) -> View:
        """The frame in fewer pixels: each is the mean of those it covers; the majority decides on solid and unseen."""

        def mean(layer: NDArray[np.floating] | NDArray[np.uint8]) -> NDArray[np.floating]:
            return np.asarray(cv2.resize(layer, (width, height), interpolation=cv2.INTER_AREA))

        solid = mean((self.depth_mm > 0).astype(np.float32))
        covered, safe = solid >= MOST, np.maximum(solid, MOST)
        depth_mm = np.where(covered, mean(self.depth_mm) / safe, 0).astype(np.float32)
        unseen = mean(self.unseen.astype(np.float32)) > MOST

        def shrunk(layer: Callable[[], NDArray[np.float32]]) -> Callable[[], NDArray[np.float32]]:
            return lambda: np.where(covered, mean(layer()), 0).astype(np.float32)

        rgb = np.asarray(mean(self.rgb), np.uint8)
        likely, smoke = shrunk(self._confidence), shrunk(self._smoke)
        return View(rgb, depth_mm, unseen, self.unseen_share, self.detail_share, self.warnings, likely, smoke)
