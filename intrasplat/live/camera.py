"""The pose of a moving endoscope, frame by frame, from keyframes that earlier frames have become.

A frame is placed by its matches with the keyframe that shows most of its tissue, the oldest of several: errors of poses
then do not add up while the camera stays or returns. A frame that shares too little with that one is looked up among
all keyframes by features. The tissue's main part is taken as rigid from a keyframe to the frame.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.poses import placed
from intrasplat.poses.chain import MIN_AGREEING, MIN_OVERLAP
from intrasplat.poses.links import Frames
from intrasplat.poses.rigid import Reals, align, exp, inverse, log

KEY_OVERLAP = 0.7
"""A frame becomes a keyframe if less of the best keyframe than this is found in it."""
ENOUGH = 0.8
"""An older keyframe is preferred to a newer one if this share of it is in view."""
MAX_KEYS = 64
"""Keyframes that are remembered. The one whose view its neighbours cover best is forgotten."""
MAX_LOOKS = 8
"""Keyframes among which a lost frame is looked up, beside the last one."""


class Placer:
    """Places the frames of one feed, in order. The world is the first frame's camera."""

    def __init__(self, first: DepthClip) -> None:
        self._frames = Frames(first)
        self._frames.take(0, first)
        self._keys: dict[int, Reals] = {0: np.eye(4)}
        self._next = 1
        self._last, self._before = np.eye(4), np.eye(4)

    def placed(self, clip: DepthClip) -> DepthClip | None:
        """The clip of one frame at its pose; None: no keyframe shows enough of its tissue."""
        frames, index = self._frames, self._next
        frames.take(index, clip)
        expected = exp(log(self._last @ inverse(self._before))) @ self._last
        key = self._best_key(expected)
        pose, share, overlap = self._from_key(key, index, expected)
        if share < MIN_OVERLAP:
            pose, share, overlap = self._looked_up(index, (pose, share, overlap))
        if share < MIN_AGREEING:
            frames.forget(index)
            self._before = self._last  # it may stand still meanwhile
            return None
        self._before, self._last = self._last, pose
        if overlap < KEY_OVERLAP:
            self._keys[index] = pose
            self._next += 1
            self._forget_one()
        else:
            frames.forget(index)
        return placed(clip, pose[None])

    def _best_key(self, pose: Reals) -> int:
        """The oldest keyframe of which ENOUGH is in view from a pose, else the one of which most is."""
        shares = {key: self._frames.predicted(key, inverse(pose) @ own)[1] for key, own in self._keys.items()}
        for key, share in shares.items():
            if share >= ENOUGH:
                return key
        return max(shares, key=lambda key: shares[key])

    def _from_key(self, key: int, index: int, expected: Reals) -> tuple[Reals, float, float]:
        """A frame's pose by its matches with a keyframe; the share of that one that agrees, and that is found."""
        frames, own = self._frames, self._keys[key]
        start = inverse(expected) @ own
        link = frames.link(key, index, frames.predicted(key, start)[0])
        if not len(link.cells):
            return expected, 0.0, 0.0
        aligned = align(frames.camera, link.before, link.after, link.trust, start)
        return own @ inverse(aligned.motion), link.agreeing(aligned.residual_px), link.overlap

    def _looked_up(self, index: int, found: tuple[Reals, float, float]) -> tuple[Reals, float, float]:
        """The same by features, with the keyframe that agrees most; `found` if none agrees more."""
        recent = list(self._keys)[-MAX_LOOKS:]
        for key in {next(iter(self._keys)), *recent}:
            far = self._frames.far_motion(key, index)
            if far is None:
                continue
            link, aligned = self._frames.far_link(key, index, far)
            share = link.agreeing(aligned.residual_px)
            if share > found[1]:
                found = self._keys[key] @ inverse(aligned.motion), share, link.overlap
        return found

    def _forget_one(self) -> None:
        """Forget a keyframe if there are too many: not the first or the newest, but one that another one resembles."""
        if len(self._keys) <= MAX_KEYS:
            return
        resembles = {
            key: self._frames.predicted(key, inverse(self._keys[after]) @ self._keys[key])[1]
            for key, after in pairwise(list(self._keys)[1:])
        }
        key = max(resembles, key=lambda each: resembles[each])
        del self._keys[key]
        self._frames.forget(key)
