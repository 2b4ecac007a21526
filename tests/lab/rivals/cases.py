"""Small clips, and the checks that every rival has to pass."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from types import ModuleType

import numpy as np
import pytest
import torch

from intrasplat.clip import DepthClip, FrameSplit
from intrasplat.machine.timing import Stopwatch
from intrasplat.splat.backend import choose_device
from intrasplat.splat.metrics import psnr_tissue
from intrasplat.train.hooks import RenderedFrame, TrainingHooks
from lab.evaluate.thinned import thinned
from lab.rivals.fields import drawn_pixels
from lab.rivals.rival import Rival, Seen
from lab.rivals.run import Length, Make, run_rival, train_rival
from tests.intrasplat.phantoms import phantom_clip


def small_clip(frames: int) -> DepthClip:
    """Frames of 64x48 that an instrument crosses."""
    return phantom_clip("breathing", frames=frames, width=64, height=48, noise=False)


def plain() -> Seen:
    """Two frames of colour 0.5, all of them tissue 50 mm away, of which every other column is measured: each pixel that
    has a depth has the same loss."""
    depth_mm = torch.full((2, 48, 64), 50.0)
    depth_mm[..., ::2] = 0
    return Seen(
        rgb=torch.full((2, 48, 64, 3), 0.5),
        tissue=torch.ones(2, 48, 64, dtype=torch.bool),
        depth_mm=depth_mm,
        t=torch.tensor([0.0, 1.0]),
        world_from_camera=torch.eye(4).expand(2, 4, 4),
        intrinsics=small_clip(2).intrinsics,
    )


def weights_drawn_by(monkeypatch: pytest.MonkeyPatch, module: ModuleType, rival: Rival) -> torch.Tensor:
    """The flat weights by which the rival of a module draws the pixels of a step."""
    totals: list[torch.Tensor] = []

    def drawn(total: torch.Tensor, count: int, random: torch.Generator) -> torch.Tensor:
        totals.append(total)
        return drawn_pixels(total, count, random)

    monkeypatch.setattr(module, "drawn_pixels", drawn)
    rival.loss(1, 0.0)
    return totals[0].diff(prepend=torch.zeros(1))


def fitted(make: Make, clip: DepthClip, train: Sequence[int], iterations: int, seed: int = 0) -> Rival:
    """A rival after so many iterations on these frames."""
    rival = make(Seen.of(clip, train), seed)
    made = train_rival(rival, Length(iterations, None), Stopwatch(), TrainingHooks(), lambda _: math.nan)
    assert made == iterations
    return rival


def frame_of(rival: Rival, clip: DepthClip, index: int) -> RenderedFrame:
    """A frame as the rival shows it from the endoscope."""
    return rival.render(float(clip.t[index]), clip.world_from_camera[index], clip.intrinsics)


def score_db(rival: Rival, clip: DepthClip, index: int) -> float:
    return psnr_tissue(frame_of(rival, clip, index).rgb, clip.rgb[index], clip.tissue[index])


def depth_error_mm(rival: Rival, clip: DepthClip, index: int) -> float:
    """Median over tissue."""
    error = np.abs(frame_of(rival, clip, index).depth_mm - clip.depth_mm[index])
    return float(np.median(error[clip.tissue[index]]))


def spoilt_where_unseen(clip: DepthClip, held_out: int) -> DepthClip:
    """The clip with another picture, mask and depth in the frame that is held out, and with other instruments."""
    rgb, tissue, depth_mm = (each.copy() for each in (clip.rgb, clip.tissue, clip.depth_mm))
    rgb[~tissue], depth_mm[~tissue] = 255 - rgb[~tissue], 20.0
    rgb[held_out], tissue[held_out], depth_mm[held_out] = 255 - rgb[held_out], True, 20.0
    return dataclasses.replace(clip, rgb=rgb, tissue=tissue, depth_mm=depth_mm)


def numbers_of(rival: Rival) -> list[bytes]:
    """All that is trained, bit by bit."""
    return [each.detach().numpy().tobytes() for each in rival.parameters()]


def check_gradient(rival: Rival, parameters: Iterable[torch.Tensor], step: float = 1e-6, progress: float = 0.0) -> None:
    """Along a random direction of each parameter the loss falls as autograd says, by central differences (float64)."""
    moved = list(parameters)
    random = torch.Generator().manual_seed(5)
    for each, gradient in zip(moved, torch.autograd.grad(rival.loss(1, progress), moved), strict=True):
        assert bool((gradient != 0).any()), "each parameter has a part in the loss"
        direction = torch.randn(each.shape, generator=random, dtype=torch.float64)
        kept, losses = each.detach().clone(), []
        for distance in (step, -step):
            with torch.no_grad():
                each.copy_(kept + distance * direction)
                losses.append(float(rival.loss(1, progress)))
                each.copy_(kept)
        slope, measured = float((gradient * direction).sum()), (losses[0] - losses[1]) / (2 * step)
        assert math.isclose(measured, slope, rel_tol=1e-4), (tuple(each.shape), measured, slope)


def check_overfit(make: Make, iterations: int, *, step_px: int = 1) -> None:
    """After so many iterations on one frame, or on every step_px-th pixel of it, it is learnt above 30 dB, its depth to
    1 mm."""
    clip = thinned(small_clip(2), step_px)
    rival = fitted(make, clip, [1], iterations)
    assert score_db(rival, clip, 1) > 30
    assert depth_error_mm(rival, clip, 1) < 1


def check_step(rival: Rival) -> None:
    """A step changes the numbers that have a gradient, and no others."""
    before = [each.detach().clone() for each in rival.parameters()]
    rival.step(1, 0.9)
    for each, old in zip(rival.parameters(), before, strict=True):
        assert each.grad is not None
        has_gradient, changed = each.grad != 0, each.detach() != old
        assert not bool((changed & ~has_gradient).any())
        assert int(changed.sum()) >= 0.9 * int(has_gradient.sum())


def check_what_counts(make: Make, iterations: int = 40, *, step_px: int = 1) -> None:
    """Time and the seed change what is learnt; a frame that is held out and pixels of instruments do not."""
    clip, split, device = thinned(small_clip(9), step_px), FrameSplit([0, 8], [4], []), choose_device("cpu")
    assert not clip.tissue[[0, 8]].all()

    def rival_of(clip: DepthClip, seed: int) -> Rival:
        return run_rival(
            "rival",
            make,
            clip,
            split,
            Length(iterations, None),
            seed=seed,
            device=device,
            waited_s=0,
            hooks=TrainingHooks(),
        ).rival

    first, spoilt = rival_of(clip, 0), rival_of(spoilt_where_unseen(clip, 4), 0)
    assert numbers_of(first) == numbers_of(spoilt)
    np.testing.assert_array_equal(frame_of(first, clip, 4).rgb, frame_of(spoilt, clip, 4).rgb)
    own, other = (frame_of(first, clip, index).rgb for index in (8, 0))
    tissue = clip.tissue[8] & clip.tissue[0]
    assert psnr_tissue(own, clip.rgb[8], tissue) > psnr_tissue(other, clip.rgb[8], tissue) + 0.1
    assert numbers_of(rival_of(clip, 1)) != numbers_of(first)


def check_moving_camera(make: Make, iterations: int, *, step_px: int = 1) -> None:
    """What it learns from an endoscope that moves, a tenth of its depth missing, fits the pose it is seen from."""
    clip = phantom_clip("still", frames=9, width=64, height=48, moving_camera=True, tools=False, noise=False)
    clip = thinned(clip, step_px)
    depth_mm = clip.depth_mm.copy()
    depth_mm[np.random.default_rng(0).random(depth_mm.shape) < 0.1] = 0
    rival = fitted(make, dataclasses.replace(clip, depth_mm=depth_mm), [0, 2, 4, 6, 8], iterations)
    away = max(range(1, 9, 2), key=lambda frame: float(np.abs(clip.world_from_camera[frame, :3, 3]).max()))
    unmoved = rival.render(float(clip.t[away]), clip.world_from_camera[0], clip.intrinsics)
    own_db, other_db = score_db(rival, clip, away), psnr_tissue(unmoved.rgb, clip.rgb[away], clip.tissue[away])
    assert own_db > other_db + 0.5, (own_db, other_db)
    assert depth_error_mm(rival, clip, away) < 1
