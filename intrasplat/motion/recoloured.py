"""An eye of a clip with other colours."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, Eye
from intrasplat.machine.cores import cores
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.machine.opencv import one_opencv_thread

EyeOrClip = TypeVar("EyeOrClip", Eye, DepthClip)


def recoloured(eye: EyeOrClip, picture: Callable[[int], NDArray[np.uint8]]) -> EyeOrClip:
    """The eye with the colours [H, W, 3] that picture(index) gives for each frame. Threads call it in parallel.

    Raises:
        StoreFullError: the disk is full.
    """
    rgb = mapped_zeros(eye.rgb.shape, np.uint8)

    def draw(index: int) -> None:
        rgb[index] = picture(index)
        eye.let_go(index)
        let_go(rgb[index])

    with one_opencv_thread(), ThreadPoolExecutor(cores()) as pool:
        list(pool.map(draw, range(eye.frame_count)))
    return replace(eye, rgb=rgb)
