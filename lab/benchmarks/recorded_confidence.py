"""The errors of views of a recording, at held-out frames of both eyes, for the reliability diagram.

The truth is the recorded picture, and the depth that stereo matching measures in the held-out frames, which training
never reads. Pixels count that show tissue with reliable stereo depth.
"""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np

import intrasplat as isp
from lab.evaluate.ranking import PixelErrors, pixel_errors, together
from lab.evaluate.sources import DATA_VARIABLE, source_of

RECORDINGS = ("d4d_stereo", "hamlyn20")
ITERATIONS = 300
MIN_CONFIDENCE = 128
"""Minimum confidence of stereo depth, of 255, that counts as the truth."""


def recorded_errors() -> Iterator[tuple[str, str, PixelErrors]]:
    """The recording, the eye, and the errors of its views, of each recording that is at hand."""
    for source in map(source_of, RECORDINGS if os.environ.get(DATA_VARIABLE) else ()):
        recording = isp.read_clip(source.clip, calibration=source.files["calibration"], masks=source.files.get("masks"))
        matched = recording.with_depth(holdout="every8")
        scene = isp.reconstruct(matched, method="fast", iterations=ITERATIONS, holdout="every8")
        frames = [frame.frame for frame in scene.report.frames]
        for views, eye in zip(("held-out left", "held-out right"), matched.eyes, strict=True):
            found = []
            for index in frames:
                t, pose = index / matched.frame_count, eye.world_from_camera[index]
                view = scene.render(t, pose, intrinsics=eye.intrinsics, light="recorded", smoke="show")
                shown, true = (np.asarray(each, np.float32) / np.float32(255) for each in (view.rgb, eye.rgb[index]))
                judged = eye.tissue[index] & (eye.depth_confidence[index] >= MIN_CONFIDENCE)
                depths_mm = (view.depth_mm, eye.depth_mm[index])
                found.append(pixel_errors(view.confidence, (shown, true), depths_mm, judged))
            yield source.name, views, together(found)
