"""How much darker the pictures of an endoscope are towards their border, where lamp and lens give less light.

Symbols: H W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.notices import Notice, NoticeCode

Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Vignetting:
    """Recorded values are cos(angle to the optical axis)^power / level of those in even light.

    level is that of the tissue's median, which keeps its brightness.
    """

    power: float
    level: float

    def brightness(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Factor [...] of recorded values at points [..., 3] in the endoscope's axes, of any length."""
        return np.asarray(np.exp(self.power * log_cosine(points) - np.log(self.level)), np.float32)

    def picture(self, intrinsics: Intrinsics) -> NDArray[np.float32]:
        """The factors [H, W] of an eye's pixels."""
        return self.brightness(rays(intrinsics))

    def notice(self, intrinsics: Intrinsics, tissue: NDArray[np.bool_]) -> Notice:
        """The report's sentence on the darkening; tissue [H, W] of some frame."""
        shown = self.picture(intrinsics)[tissue]
        text = f"light: tissue darkens towards the border to {shown.min() / shown.max():.0%}; the model is evenly lit"
        return Notice.info(NoticeCode.VIGNETTING, text)


def rays(intrinsics: Intrinsics) -> Reals:
    """[H, W, 3] points at depth 1 that the pixels show, camera axes."""
    k = intrinsics
    x, y = (np.arange(k.width) + 0.5 - k.cx) / k.fx, (np.arange(k.height) + 0.5 - k.cy) / k.fy
    return np.stack([*np.meshgrid(x, y), np.ones((k.height, k.width))], axis=-1)


def log_cosine(points: NDArray[np.floating]) -> Reals:
    """Logarithms [...] of the cosines of the angles between points [..., 3] and the z axis, at least -3."""
    cosine = points[..., 2] / np.maximum(np.linalg.norm(points, axis=-1), 1e-9)
    return np.asarray(np.log(np.maximum(cosine, np.exp(-3.0))), np.float64)
