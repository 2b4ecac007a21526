"""Places a frame beside the fitted ones, and changes nothing else.

The pose is that of the fit: the tissue's part of it is not split off (common_motion.py).

Symbols: K fitted frames, S time courses of the tissue's deformation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intrasplat.clip import spread
from intrasplat.poses.chain import MAX_LOOKS, MIN_AGREEING, MIN_OVERLAP
from intrasplat.poses.fitting import FINE_PX, Fit
from intrasplat.poses.grams import DAMPED, LinkGram, link_gram
from intrasplat.poses.links import FrameLink, Frames
from intrasplat.poses.rigid import Reals, StereoCamera, align, between, exp, inverse

GOOD = 0.4
"""From this share of a fitted frame's tissue on that is found where the fit expects it, no other frame is tried."""
NEAR_TRIED, FAR_TRIED = 2, 4
"""Fitted frames that are tried: the nearest; and if the courses are unsure, or of those whose features match."""
UNSURE_COURSE = 0.1
"""From this expected error of a course on, a frame is placed by several fitted frames."""
MIN_COURSE, MAX_COURSE = 0.003, 1.0
"""Limits of a course's expected error."""


@dataclass(frozen=True, eq=False)
class Beside:
    """A frame's camera pose [4, 4], the tissue's courses [S] there, and the share of the tissue that agrees."""

    pose: Reals
    course: Reals
    share: float


def place_beside(frames: Frames, used: Sequence[int], fit: Fit, index: int) -> Beside:
    """A frame, aligned with fitted frames.

    The nearest fitted frames are tried first. Where the flow from those finds too little, features say which fitted
    frames show the same tissue. used: the K fitted frames, rising.
    """
    guess = between(used, fit.poses, index)
    expected, error = _expected(fit, used, index)
    nearest = np.argsort(np.abs(np.asarray(used) - index), kind="stable")
    found: list[_Aligned] = []
    surely = bool((error < UNSURE_COURSE).all())
    for number in nearest[: NEAR_TRIED if surely else FAR_TRIED]:
        link = frames.link(used[number], index, frames.predicted(used[number], inverse(guess) @ fit.poses[number])[0])
        found.append(_aligned(frames.camera, fit, number, link, expected, np.eye(4)))
        if found[-1].share > GOOD and surely:
            break
    if max(each.share for each in found) < MIN_OVERLAP:
        looks = sorted({*nearest[: MAX_LOOKS // 2].tolist(), *spread(range(len(used)), MAX_LOOKS // 2)})
        far = [(number, each) for number in looks if (each := frames.far_motion(used[number], index)) is not None]
        for number, motion in sorted(far, key=lambda each: -len(each[1].before))[:FAR_TRIED]:
            link, _ = frames.far_link(used[number], index, motion)
            found.append(_aligned(frames.camera, fit, number, link, expected, motion.motion))
    best = max(found, key=lambda each: each.share)
    if not len(expected):
        return Beside(best.pose, expected, best.share)
    agreeing = [each for each in found if each.share > MIN_AGREEING] or [best]
    return _refined(frames.camera, fit, agreeing, best, expected, error)


@dataclass(frozen=True, eq=False)
class _Aligned:
    """A pose [4, 4] by a link from a fitted frame, and the share of that frame's tissue that agrees."""

    number: int
    link: FrameLink
    pose: Reals
    share: float


def _aligned(camera: StereoCamera, fit: Fit, number: int, link: FrameLink, course: Reals, start: Reals) -> _Aligned:
    """The pose by a link from a fitted frame, if the tissue's courses [S] are known.

    start [4, 4]: the motion to the frame's camera axes from which the alignment starts.
    """
    field, pose = fit.field, fit.poses[number]
    points = camera.points_mm(link.before) @ pose[:3, :3].T + pose[:3, 3]
    moved = points + field.displacement(points, course - field.courses[number])
    seen = camera.seen((moved - pose[:3, 3]) @ pose[:3, :3])  # measurements if the camera stayed at `pose`
    aligned = align(camera, seen, link.after, link.trust, start)
    return _Aligned(number, link, pose @ inverse(aligned.motion), link.agreeing(aligned.residual_px))


def _refined(
    camera: StereoCamera,
    fit: Fit,
    found: Sequence[_Aligned],
    best: _Aligned,
    expected: Reals,
    error: Reals,
) -> Beside:
    """The pose by all links, fitted together with the frame's own courses.

    expected, error [S]: the courses that the frame probably has.
    """
    kinds, pose, course = len(expected), best.pose, expected
    columns = np.zeros((7 + kinds, 7 + fit.field.weight.shape[1]))
    columns[:6, :6], columns[6:-1, 6:-1], columns[-1, -1] = -np.eye(6), fit.field.weight, 1
    usual = np.concatenate([np.full(6, DAMPED), 1 / np.square(error)])

    def measured(each: _Aligned, scale_px: float) -> LinkGram:
        poses, change = (fit.poses[each.number], pose), course - fit.field.courses[each.number]
        return link_gram(camera, each.link, poses, fit.field, change, scale_px, None)

    for scale_px in FINE_PX:
        gram = columns @ sum(measured(each, scale_px).gram for each in found) @ columns.T
        right = -gram[:-1, -1]
        right[6:] -= usual[6:] * (course - expected)
        step = np.linalg.solve(gram[:-1, :-1] + np.diag(usual), right)
        pose, course = exp(np.asarray(step[:6])) @ pose, course + step[6:]
    share = max(each.link.agreeing(measured(each, FINE_PX[-1]).residual_px) for each in found)
    return Beside(pose, course, share)


def _expected(fit: Fit, used: Sequence[int], index: int) -> tuple[Reals, Reals]:
    """[S] the courses at a frame by interpolation, and their expected errors.

    The error of interpolation grows with the square of the step between neighbours, whose size is about 1.
    """
    after = min(max(int(np.searchsorted(used, index)), 1), len(used) - 1)
    step = np.abs(fit.field.courses[after] - fit.field.courses[after - 1])
    beyond = index < used[0] or index > used[-1]
    return fit.field.course_at(index, used), np.clip(step if beyond else step**2 / 4, MIN_COURSE, MAX_COURSE)
