"""The unit, direction and axes in which given camera poses explain the pictures.

Tracked points with depth (intrasplat/poses/links.py) are moved by the relative pose of two frames, and compared with
where they are found.

Symbols: T frames, M matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from intrasplat.clip import DepthClip, spread
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.poses.links import FrameLink, Frames
from intrasplat.poses.rigid import Reals, StereoCamera, align, inverse, weighted_median

Axes = Literal["opencv", "opengl", "llff"]
Unit = Literal["mm", "m"]

MM: dict[Unit, float] = {"mm": 1.0, "m": 1000.0}
OPENCV_AXES: dict[Axes, Reals] = {
    "opencv": np.eye(4),
    "opengl": np.diag([1.0, -1.0, -1.0, 1.0]),  # stored: right, up, back
    "llff": np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]]),  # stored: down, right, back
}
"""[4, 4] camera with these axes from a camera with OpenCV's: the columns are x (right), y (down), z (forward)."""
STARTS = 8
STEPS = (1, 2, 4, 8)
"""Pairs of frames that are compared: from STARTS frames to those so many frames later."""
MIN_AGREEING, MIN_MATCHES = 0.25, 12
"""Pairs count from this share of a frame's tissue that moves rigidly, and from so many matches."""
FAR_PX = 20.0
"""Matches that two readings put farther apart count less, px of the coarse grid."""
MAX_OFF_PX = 40.0
"""Limit of a match's residual."""
MIN_APART_PX = 0.5
"""Readings that put matches less far apart cannot be distinguished."""
MIN_SUPPORT = 0.7
"""A reading replaces the one declared if the matches lie this share of the way from the one's prediction to its own."""
CONTRADICTED, LARGE = 0.4, 0.5
"""Poses contradict the pictures if less than this share of their motion is found, and if that motion is at least this
share of the pictures' motion."""
MAX_EXTENT_M = 1.0
"""No endoscope moves farther within a clip."""


@dataclass(frozen=True)
class Convention:
    """The reading of a stored matrix: unit of its translation, direction, and axes of the camera."""

    unit: Unit = "mm"
    to_world: bool = True
    axes: Axes = "opencv"

    def world_from_camera(self, stored: Reals) -> Reals:
        """Stored matrices [T, 4, 4] as world_from_camera in mm with OpenCV axes; the world is the first camera."""
        poses = stored.copy()
        poses[:, :3, 3] *= MM[self.unit]
        poses = (poses if self.to_world else inverse(poses)) @ OPENCV_AXES[self.axes]
        return np.asarray(inverse(poses[0]) @ poses)

    def __str__(self) -> str:
        direction = "camera-to-world" if self.to_world else "world-to-camera"
        axes = {"opencv": "OpenCV", "opengl": "OpenGL", "llff": "LLFF"}[self.axes]
        return f"{direction} in {self.unit}, {axes} axes"


@dataclass(frozen=True)
class Agreement:
    """What the pictures say about poses.

    convention   the reading that they support; the declared one where they support no other
    determined   whether they distinguish readings; not if the camera hardly moves
    contradicts  whether they contradict the poses in every reading
    """

    convention: Convention
    determined: bool = False
    contradicts: bool = False


def likely_unit(stored: Reals) -> Unit:
    """The unit of stored poses [T, 4, 4] of a TUM file: metres, unless the camera would move too far."""
    places = stored[:, :3, 3]
    return "m" if float(np.linalg.norm(places - places[0], axis=1).max()) <= MAX_EXTENT_M else "mm"


def agreement(clip: DepthClip, train: Sequence[int], stored: Reals, declared: Convention) -> Agreement:
    """The reading of stored poses [T, 4, 4] that the training frames support.

    The matches are regressed on the difference of two readings' predictions: the slope is 1 if the second is true, and
    0 if the first is. The tissue's own motion hardly changes it, for it does not follow the difference.
    """
    with one_opencv_thread():
        frames = Frames(clip)
        links = _links(frames, train)
    if not links:
        return Agreement(declared)
    camera, still = frames.camera, [np.eye(4)] * len(links)
    readings = (Convention(*each) for each in product(MM, (True, False), OPENCV_AXES))
    motions = {each: _motions(each, stored, links) for each in dict.fromkeys((declared, *readings))}
    best = min(motions, key=lambda each: _off_px(camera, links, motions[each]))
    support, apart_px = _support(camera, links, motions[declared], motions[best])
    if apart_px < MIN_APART_PX or support < MIN_SUPPORT:
        best = declared
    found, moved_px = _support(camera, links, still, motions[best])
    large = moved_px > max(MIN_APART_PX, LARGE * _off_px(camera, links, still))
    return Agreement(best, moved_px > MIN_APART_PX, large and found < CONTRADICTED)


def _links(frames: Frames, train: Sequence[int]) -> list[FrameLink]:
    """Matches between frames a few frames apart, all over the clip."""
    found: list[FrameLink] = []
    for start in spread(range(len(train) - 1), STARTS):
        for step in STEPS:
            if start + step >= len(train):
                break
            link = frames.link(train[start], train[start + step], found[-1].flow if step > 1 and found else None)
            if len(link.cells) < MIN_MATCHES:
                break
            fit = align(frames.camera, link.before, link.after, link.trust, np.eye(4))
            if link.agreeing(fit.residual_px) < MIN_AGREEING:
                break
            found.append(link)
        frames.forget(train[start])
    return found


def _motions(convention: Convention, stored: Reals, links: Sequence[FrameLink]) -> list[Reals]:
    poses = convention.world_from_camera(stored)
    return [np.asarray(inverse(poses[link.b]) @ poses[link.a]) for link in links]


def _predicted(camera: StereoCamera, link: FrameLink, motion: Reals) -> Reals:
    """Measurements [M, 3] in the second frame of a link, if the tissue is rigid and the camera moves so."""
    return camera.seen(camera.points_mm(link.before) @ motion[:3, :3].T + motion[:3, 3])


def _off_px(camera: StereoCamera, links: Sequence[FrameLink], motions: Sequence[Reals]) -> float:
    """Median residual of a link's matches under its motion [4, 4], mean over the links."""
    medians = []
    for link, motion in zip(links, motions, strict=True):
        off_px = np.linalg.norm(_predicted(camera, link, motion) - link.after, axis=1)
        medians.append(min(weighted_median(off_px, link.trust), MAX_OFF_PX))
    return float(np.mean(medians))


def _support(
    camera: StereoCamera, links: Sequence[FrameLink], one: Sequence[Reals], two: Sequence[Reals]
) -> tuple[float, float]:
    """Slope of the matches along the way from one motions' predictions to the others', and its length in px."""
    over, under, apart_px = 0.0, 0.0, []
    for link, first, second in zip(links, one, two, strict=True):
        predicted = _predicted(camera, link, first)
        way = _predicted(camera, link, second) - predicted
        length_px = np.linalg.norm(way, axis=1)
        weight = (link.trust / (1 + (length_px / FAR_PX) ** 4))[:, None]
        over += float((weight * way * (link.after - predicted)).sum())
        under += float((weight * way * way).sum())
        apart_px.append(min(weighted_median(length_px, link.trust), MAX_OFF_PX))
    return over / max(under, 1e-9), float(np.mean(apart_px))
