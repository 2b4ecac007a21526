"""From a stereo clip's files on disk to depth: held-out frames reach no other frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from intrasplat.clip import DepthClip, held_out_frames
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.options import ReconstructionOptions
from intrasplat.pipeline import open_with_poses
from intrasplat.train.request import ReconstructionRequest
from lab.phantom import PhantomSettings, make_phantom, write_stereomis

FRAMES = 12


def poison(folder: Path, frames: list[int]) -> None:
    """Both eyes become another scene, nearer and with rows that differ by 6 px; the mask another mask."""
    for index in frames:
        wide = np.random.default_rng(index).integers(0, 256, (24, 40, 3), dtype=np.uint8)
        wide = cv2.resize(wide, (200, 120), interpolation=cv2.INTER_CUBIC)
        for name, pixels in (("l", wide[:80, 20:116]), ("r", wide[6:86, 50:146])):
            cv2.imwrite(str(folder / f"{index:06d}{name}.png"), pixels)
        tissue = np.full((80, 96), 255, np.uint8)
        tissue[:, :30] = 0
        cv2.imwrite(str(folder / f"masks/{index:06d}l.png"), tissue)


@pytest.mark.parametrize("holdout", ["every8", "0,5,6,11"])
def test_held_out_frames_of_a_stereo_clip_change_no_bit_of_the_others(holdout: str, tmp_path: Path) -> None:
    write_stereomis(make_phantom(PhantomSettings(width=96, height=80, frames=FRAMES, period_frames=12)), tmp_path)
    request = ReconstructionRequest(tmp_path, ReconstructionOptions(holdout=holdout))

    def depth_clip() -> DepthClip:
        return open_with_poses(request, Hooks(), Timings())

    clean = depth_clip()
    held_out = held_out_frames(FRAMES, holdout)
    poison(tmp_path, held_out)
    dirty = depth_clip()
    others = [index for index in range(FRAMES) if index not in held_out]
    for layer in ("rgb", "tissue", "depth_mm", "depth_confidence"):
        before, after = getattr(clean, layer), getattr(dirty, layer)
        assert np.array_equal(before[others], after[others]), layer
        assert not np.array_equal(before[held_out], after[held_out]), layer
