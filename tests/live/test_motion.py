"""The start of a frame's motion: flow, where the model shows wrong depth, too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intrasplat.clip import DepthClip
from intrasplat.live.eyes import EyesSettings
from intrasplat.live.follow import Follower, FollowSettings
from intrasplat.live.motion import FlowStart
from intrasplat.live.pair import FeedPair
from lab.phantom import PhantomSettings, make_phantom

PHANTOM = make_phantom(PhantomSettings(128, 96, 24, "breathing", 0, tools=(), period_frames=24, frame_rate_hz=5.0))
WILD = np.s_[:, 40:56, 48:64]


def _moments() -> tuple[DepthClip, DepthClip]:
    follower = Follower(PHANTOM.settings.calibration, FollowSettings(EyesSettings(finds_instruments=False)))
    frames = (PHANTOM.frame(index) for index in range(2))
    read = [follower.read(FeedPair(each.left, each.right, 0.2 * i, 0.2 * i, i)) for i, each in enumerate(frames)]
    follower.close()
    first, second = read
    assert first is not None
    assert second is not None
    return first, second


def _shown(clip: DepthClip, times: float) -> DepthClip:
    """The frame as a model shows it whose depth is wrong in a square."""
    depth_mm = clip.depth_mm.copy()
    depth_mm[WILD] *= np.float32(times)
    solid = depth_mm > 0
    return replace(clip, depth_mm=depth_mm, tissue=solid, depth_confidence=np.where(solid, np.uint8(255), np.uint8(0)))


def test_a_wrong_depth_of_the_model_flings_nothing_away() -> None:
    first, second = _moments()
    longest_mm = []
    for times in (1.0, 0.1, 6.0):
        start = FlowStart(first)
        start.look_at(_shown(first, times))
        longest_mm.append(np.linalg.norm(start.to(second).displacement_mm, axis=-1).max())
    assert max(longest_mm[1:]) < 1.2 * longest_mm[0]


def test_what_lies_far_from_the_surface_stays() -> None:
    first, second = _moments()
    start = FlowStart(first)
    start.look_at(_shown(first, 1.0))
    carried = start.to(second)
    rays = (start._grid.rays * carried.start.depth_mm[..., None]).reshape(-1, 3)
    on_it, _ = carried.of(rays)
    behind, _ = carried.of(1.5 * rays)
    assert np.abs(on_it).max() > 0.5
    assert not behind.any()
