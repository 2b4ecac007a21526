"""Matching on the device: each kernel does what its equation says, and the whole is as good as the CPU's.

F frames of h w pixels, D disparities.
"""

from __future__ import annotations

import itertools
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

from intrasplat.clip import DepthClip
from intrasplat.machine.hooks import Hooks, Progress
from intrasplat.stereo import cuda, estimate_depth, matching
from intrasplat.stereo.cuda import matching as on_device
from intrasplat.stereo.matching import MatchPlan
from tests.helpers import assert_close
from tests.intrasplat.probes import kernels_compiled_by
from tests.intrasplat.stereo.test_stereo import clip_of, draw_pair, errors_px, slanted

WIDTH, HEIGHT = 88, 48
SMALL_WIDTH, SMALL_HEIGHT = 40, 40
"""Where matching is compared with itself; of fewer rows no frame counts as a repeated one."""
Pair = tuple[NDArray[np.uint8], NDArray[np.uint8]]


@pytest.fixture
def memory(device: str) -> str:
    """Where tensors lie: on the GPU, or beside the interpreter."""
    return device


def differing_bits(left: NDArray[np.uint8], right: NDArray[np.uint8], low: int, count: int) -> NDArray[np.int64]:
    """[h, w, D] costs by their definition: comparisons with 24 neighbours that differ, over 5 x 5 pixels."""
    height, width = left.shape

    def comparisons(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
        wide = np.pad(image, 2, mode="edge")
        around = [wide[dy : dy + height, dx : dx + width] < image for dy in range(5) for dx in range(5)]
        return np.stack(around, -1)

    one, other = comparisons(left), comparisons(right)
    columns = np.arange(width)
    matches = [np.clip(columns - d, 0, width - 1) for d in range(low, low + count)]
    single = np.stack([(one != other[:, match]).sum(-1) for match in matches], -1)
    wide = np.pad(single, ((2, 2), (2, 2), (0, 0)), mode="edge")
    return np.asarray(sum(wide[dy : dy + height, dx : dx + width] for dy in range(5) for dx in range(5)))


def path_sums(costs: NDArray[np.int64], small: int, large: int) -> NDArray[np.int64]:
    """[h, w, D] sums of L over the four directions, by the recurrence."""
    total = np.zeros_like(costs)
    for axis in (0, 1):
        for order in (1, -1):
            lines = np.moveaxis(costs, axis, 0)[::order]
            path = np.zeros_like(lines)
            path[0] = lines[0]
            for k in range(1, len(lines)):
                before, least = path[k - 1], path[k - 1].min(-1, keepdims=True)
                farther = np.pad(before, ((0, 0), (1, 1)), constant_values=10**6)
                options = [
                    before,
                    farther[:, :-2] + small,
                    farther[:, 2:] + small,
                    np.broadcast_to(least + large, before.shape),
                ]
                path[k] = lines[k] + np.min(options, 0) - least
            total += np.moveaxis(path[::order], 0, axis)
    return total


@pytest.mark.parametrize(("low", "count"), [(-2, 5), (1, 40)])
def test_sums_of_costs_along_paths_are_those_of_the_equations(
    rng: np.random.Generator, memory: str, low: int, count: int
) -> None:
    pair = rng.integers(0, 255, (2, 2, 7, 19), dtype=np.uint8)
    left, right = torch.from_numpy(pair).to(memory)
    sums = on_device.path_sums(left, right, low, count).cpu().numpy()
    for f in range(2):
        costs = differing_bits(pair[0, f], pair[1, f], low, count)
        expected = path_sums(costs, on_device.SMALL_STEP_PENALTY, on_device.LARGE_STEP_PENALTY)
        np.testing.assert_array_equal(sums[f], expected)


def test_the_winner_has_the_least_sum_and_a_fraction_between_its_neighbours(
    rng: np.random.Generator, memory: str
) -> None:
    low, count, (h, w) = -3, 7, (5, 11)
    sums = rng.integers(0, 2000, (2, h, w, count)).astype(np.int16)
    sums[:, 0, 0] = 500  # all alike: the first
    left, right = (each.cpu().numpy() for each in on_device.winners(torch.from_numpy(sums).to(memory), low))
    best = sums.argmin(-1)
    np.testing.assert_array_equal(np.abs(left - low - best) <= 0.5, True)
    np.testing.assert_array_equal(left[:, 0, 0], low)
    x = np.arange(w)
    seen = np.clip(x[:, None] + low + np.arange(count), 0, w - 1)
    along = sums[:, :, seen, np.arange(count)]
    np.testing.assert_array_equal(right, low + along.argmin(-1))


@pytest.mark.parametrize(
    ("around", "fraction"), [((400, 200, 300), 0.25), ((300, 200, 400), -0.25), ((210, 200, 210), 0)]
)
def test_the_fraction_is_where_lines_of_equal_slope_meet(
    memory: str, around: tuple[int, int, int], fraction: float
) -> None:
    sums = torch.full((1, 1, 1, 5), 1000, dtype=torch.int16, device=memory)
    sums[0, 0, 0, 1:4] = torch.tensor(around, dtype=torch.int16)
    assert on_device.winners(sums, 10)[0].item() == 12 + fraction


def chain(values: NDArray[np.float64], guide: NDArray[np.uint8], strength: float) -> NDArray[np.float64]:
    """The same for one line, by a dense solve."""
    links = strength * np.exp(-np.abs(np.diff(guide.astype(np.float64))) / matching.COLOUR_SIGMA)
    difference = np.diff(np.eye(len(guide)), axis=0)
    return np.asarray(np.linalg.solve(np.eye(len(guide)) + difference.T @ (links[:, None] * difference), values))


def test_the_filter_is_the_solution_of_its_linear_systems(rng: np.random.Generator, memory: str) -> None:
    guide = rng.integers(0, 6, (2, 9, 13), dtype=np.uint8)
    disparity, trust = rng.normal(5, 2, guide.shape), rng.random(guide.shape)
    given, weight = (torch.from_numpy(each.astype(np.float32)).to(memory) for each in (disparity, trust))
    filled = on_device.filled(given, weight, torch.from_numpy(guide).to(memory)).cpu().numpy()
    for f in range(2):
        both, strength = np.stack([disparity[f] * trust[f], trust[f]]), matching.SMOOTHNESS
        for _ in range(on_device.FILTER_PASSES):
            for image in both:
                image[:] = [chain(line, guide[f, y], strength) for y, line in enumerate(image)]
                image[:] = np.transpose([chain(line, guide[f, :, x], strength) for x, line in enumerate(image.T)])
            strength *= on_device.FILTER_EASING
        assert_close(filled[f], both[0] / both[1], relative=1e-4)


def test_a_disparity_nobody_trusts_stays_as_it_is(memory: str) -> None:
    disparity = torch.arange(12.0, device=memory).reshape(1, 3, 4)
    trust, guide = torch.zeros_like(disparity), torch.zeros_like(disparity, dtype=torch.uint8)
    assert torch.equal(on_device.filled(disparity, trust, guide), disparity)


def test_full_resolution_is_restored_as_on_the_cpu(rng: np.random.Generator, memory: str) -> None:
    truth = slanted(width=WIDTH, height=HEIGHT)
    left, right = (cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY) for eye in draw_pair(truth))
    start = truth + np.float32(0.4)
    given = [torch.from_numpy(each)[None].to(memory) for each in (start, left, right)]
    for ours, theirs in zip(on_device.refine(*given), matching._refine(start, left, right), strict=True):
        # cv2.remap counts in 32nds of a pixel
        assert_close(ours[0].cpu().numpy(), theirs, relative=0.02)


def test_a_pair_is_matched_the_same_alone_and_among_others(rng: np.random.Generator, memory: str) -> None:
    left, right = torch.from_numpy(rng.integers(0, 255, (2, 2, 12, 16), dtype=np.uint8)).to(memory)
    plan = MatchPlan(-2.0, 3.0)
    together, alone = cuda.match_frames(left, right, plan), cuda.match_frames(left[1:], right[1:], plan)
    for both, one in zip(together, alone, strict=True):
        assert torch.equal(both[1], one[0])


def test_large_frames_go_through_by_few_and_small_ones_by_many() -> None:
    plan = MatchPlan(15.0, 48.0)
    assert 1 <= cuda.frames_at_once(2160, 4096, plan) <= 8
    assert cuda.frames_at_once(512, 640, plan) > 32
    assert cuda.frames_at_once(512, 640, MatchPlan(0.0, 600.0)) < 32


def test_depth_is_as_true_as_on_the_cpu() -> None:
    truth = slanted(10.0, 7.0, WIDTH, HEIGHT)
    truth[12:34, 36:66] += 4
    pair = draw_pair(truth)
    for eye in pair:
        eye[40:] = 2  # black
    seen: list[Progress] = []
    ours = estimate_depth(clip_of([pair]), Hooks(on_progress=seen.append), device="cuda")
    theirs = estimate_depth(clip_of([pair]))
    assert seen[-1].fraction == 1.0
    stages = [stage for stage, _ in itertools.groupby(each.stage for each in seen)]
    assert stages == ["stereo", "compile", "stereo"], "kernels have the time that compiling is given"
    error_px, their_error_px = np.abs(errors_px(ours, truth)), np.abs(errors_px(theirs, truth))
    for percentile in (50, 90):
        assert np.percentile(error_px, percentile) < 1.1 * np.percentile(their_error_px, percentile) + 0.02
    valid, confidence = ours.depth_mm[0] > 0, ours.depth_confidence[0]
    by_both = np.arange(WIDTH) - truth > 1
    assert valid[by_both].mean() > (theirs.depth_mm[0] > 0)[by_both].mean() - 0.01
    assert np.array_equal(confidence > 0, valid)
    assert (error_px[confidence[valid] >= 200] < 1).mean() > 0.98
    assert (confidence[np.arange(WIDTH) - truth < -1] < 64).mean() > 0.95  # what the right eye does not see
    assert not confidence[42:].any()
    assert ours.measurements["min_disparity_px"] < 7 < 14 < ours.measurements["max_disparity_px"] < 26


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    """Four frames, of which the second and the last show nothing new."""
    return [draw_pair(slanted(10.0, 7.0, SMALL_WIDTH, SMALL_HEIGHT), seed=seed) for seed in (0, 0, 1, 1)]


@pytest.fixture(scope="module")
def whole(pairs: list[Pair]) -> DepthClip:
    """Their depth, none left out and all but the first at once."""
    return estimate_depth(clip_of(pairs), device="cuda", measured_frames=[1, 2])


def test_frames_that_are_left_out_are_not_matched_and_the_others_have_the_same_depth(
    pairs: list[Pair], whole: DepthClip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("intrasplat.clip.sampling.MIN_USED_FRAMES", 2)
    sampled = estimate_depth(clip_of(pairs), skip_redundant=True, device="cuda")
    assert (whole.skipped, sampled.skipped) == ((), (1, 3))
    assert np.array_equal(sampled.depth_mm[::2], whole.depth_mm[::2])
    assert np.array_equal(sampled.depth_confidence[::2], whole.depth_confidence[::2])
    assert not sampled.depth_mm[1::2].any()


def test_the_first_frame_is_shown_before_the_others_are_matched_and_batches_change_nothing(
    pairs: list[Pair], whole: DepthClip, monkeypatch: pytest.MonkeyPatch
) -> None:
    matched: list[int] = []
    at_first: list[tuple[list[int], NDArray[np.float32]]] = []
    depth_of = cuda.depth_of

    def counted(left: NDArray[np.uint8], *others: Any) -> Any:
        matched.append(len(left))
        return depth_of(left, *others)

    monkeypatch.setattr(cuda, "depth_of", counted)
    monkeypatch.setattr(cuda, "frames_at_once", lambda *size: 2)
    hooks = Hooks(on_first_moment=lambda moment: at_first.append((list(matched), moment.depth_mm.copy())))
    batched = estimate_depth(clip_of(pairs), hooks, device="cuda", measured_frames=[1, 2])
    assert matched == [1, 2, 1]
    assert np.array_equal(batched.depth_mm, whole.depth_mm)
    assert np.array_equal(batched.depth_confidence, whole.depth_confidence)
    [(before, first_mm)] = at_first
    assert before == [1]
    assert np.array_equal(first_mm[0], whole.depth_mm[1])


def test_kernels_compile_for_sm_90_within_its_registers_once_for_clips_of_every_size(triton_cache: Path) -> None:
    found = kernels_compiled_by("tests.intrasplat.stereo.stereo_probe", triton_cache)
    lanes = 2
    forms = {"census": 1, "smooth_lines": 1, "add_paths": 2 * lanes}
    forms |= dict.fromkeys(("column_costs", "block_costs", "winners"), lanes)
    assert Counter(each["kernel"] for each in found) == forms
    for each in found:
        assert each["stack"] == each["local"] == 0, f"spills: {each}"
