"""Does confidence rank the errors of a recorded right eye? Its depth is not known, so colour alone is judged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.scoring import judged_pixels, sample_frames
from intrasplat.view.render import render_frame
from lab.evaluate.ranking import PixelErrors, pixel_errors, rank_scores, together

JUDGED_FRAMES = 8
"""Held-out frames looked at, evenly spread."""


def right_eye_ranks(scene: TrainedScene, clip: DepthClip, held_out: Sequence[int]) -> dict[str, float]:
    """The columns rank_right_colour and rank_right_colour_8px of a clip with two eyes; {} of any other."""
    if clip.right is None or not held_out:
        return {}
    views = [_errors(scene, clip, frame) for frame in sample_frames(held_out, JUDGED_FRAMES)]
    return {name: value for name, value in rank_scores(together(views), "rank_right").items() if "colour" in name}


def _errors(scene: TrainedScene, clip: DepthClip, frame: int) -> PixelErrors:
    """Errors of the right eye's tissue that the left eye sees too. True depth is unknown, so rendered depth is used."""
    assert clip.right is not None
    right = clip.right
    t, pose = frame / scene.frame_count, right.world_from_camera[frame]
    shown = render_frame(scene, t, pose, right.intrinsics, light="recorded", smoke="show")
    rgb, true = (each.astype(np.float32) / np.float32(255) for each in (shown.rgb, right.rgb[frame]))
    confidence = shown.confidence * ~shown.unseen
    return pixel_errors(confidence, (rgb, true), (shown.depth_mm, shown.depth_mm), judged_pixels(right, frame))
