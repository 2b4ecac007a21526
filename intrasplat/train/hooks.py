"""The callbacks of a whole reconstruction, and the rendered frame that one of them receives.

Symbols: H W pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.machine.hooks import Hooks, ignore, never
from intrasplat.scene.scene import TrainedScene


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A frame as the model renders it from the endoscope's own pose.

    rgb [H, W, 3] float32, unclamped; depth_mm [H, W] float32, 0 where alpha < 0.5; alpha [H, W] float32
    """

    rgb: NDArray[np.float32]
    depth_mm: NDArray[np.float32]
    alpha: NDArray[np.float32]


@dataclass(frozen=True)
class TrainingHooks(Hooks):
    """Hooks of a whole reconstruction. None of them changes the trained model.

    wants_snapshot is called between training steps. If it returns True, on_snapshot receives the scene as it is then
    and the number of iterations so far. on_first_picture receives a scene of one moment while the clip is still being
    prepared; None skips it. on_clip receives the prepared clip. on_held_out receives the index and the render of each
    held-out frame that is scored during training; the training clock is paused meanwhile.
    """

    wants_snapshot: Callable[[], bool] = never
    on_snapshot: Callable[[TrainedScene, int], None] = ignore
    on_first_picture: Callable[[TrainedScene], None] | None = None
    on_clip: Callable[[DepthClip], None] = ignore
    on_held_out: Callable[[int, RenderedFrame], None] = ignore
