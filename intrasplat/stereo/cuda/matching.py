"""Dense disparity of many rectified pairs on the device, with a confidence: the steps of intrasplat/stereo/matching.py.

Symbols: F frames, H W pixels of one eye; h w pixels the matcher works on, D disparities; d disparity in px.

Reduced images are matched by census costs along four directions (kernels.py). The right eye's disparities come from the
same sums. An edge-aware least-squares filter (Min et al. 2014) smooths disparities on which both eyes agree and fills
the rest. One Lucas-Kanade step along the row at full resolution restores the sub-pixel part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import triton
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from triton import knobs

from intrasplat.stereo.cuda import kernels
from intrasplat.stereo.matching import (
    BESIDE_INSTRUMENTS_PX,
    BLACK_LEVEL,
    BLACK_PX,
    COLOUR_SIGMA,
    CONTRAST_PX,
    DEVIATION_EXPONENT,
    DEVIATION_FLOOR_PX,
    ENDS_PX,
    ERROR,
    ERROR_PX,
    EVIDENCE_EXPONENT,
    EVIDENCE_FLOOR,
    EVIDENCE_PX,
    EVIDENCE_TEXTURE,
    HIGH_PASS_PX,
    MATCHING_WIDTH,
    MAX_DEVIATION_PX,
    MAX_REFINEMENT_PX,
    MIN_CONFIDENCE,
    MIN_WEIGHT,
    NOISE_FLOOR,
    REFERENCE_WIDTH,
    REFINE_DAMPING,
    REFINE_WINDOW_PX,
    ROUGHNESS_PER_PX2,
    ROUGHNESS_PX,
    SATURATED_LEVEL,
    SATURATED_TRUST,
    SMOOTHNESS,
    SURE_TRUST,
    SURFACE_PERCENTILE,
    TEXTURE_FOR_TRUST,
    UNKNOWN_DEVIATION_PX,
    UNSURE_TRUST,
    MatchPlan,
)

Greys = NDArray[np.uint8]  # [F, H, W]

SMALL_STEP_PENALTY, LARGE_STEP_PENALTY = 12, 100
"""P1 and P2 against costs of up to 24 bits per pixel of the block: a half and four bits per pixel."""
FILTER_PASSES, FILTER_EASING = 3, 0.25
"""Number of passes over rows and columns; each pass has this share of the previous strength."""
AGREEMENT_PX = 1.5
"""Largest difference, px of the reduced image, between consistent disparities of both eyes."""
MIN_LANES = 32
VOLUME_BYTES = 1 << 30
"""Size of the cost volumes at a time: some seventy frames, whose lines are enough for a large GPU."""
PIXELS_AT_ONCE = 1 << 25
"""Pixels of full resolution at a time; refinement needs about a dozen float32 for each."""
BYTES_A_COST = 5
"""int16 for the cost and for the sum, and uint8 for column_costs."""


@dataclass(frozen=True)
class _Share:
    """The work of one kernel program: pixels, pixels with lanes, lines with lanes, lines without lanes."""

    pixels: int
    costs: int
    paths: int
    lines: int


ON_GPU = _Share(pixels=256, costs=16, paths=2, lines=32)
INTERPRETED = _Share(pixels=4096, costs=4096, paths=512, lines=512)  # its time grows with programs, hardly with size


def frames_at_once(height: int, width: int, plan: MatchPlan) -> int:
    """The number of pairs of H x W pixels that match_frames processes together."""
    (h, w), _, count = _reduced(height, width, plan)
    return max(1, min(VOLUME_BYTES // (BYTES_A_COST * h * w * count), PIXELS_AT_ONCE // (height * width)))


def depth_of(
    left: Greys, right: Greys, tissue: NDArray[np.bool_], plan: MatchPlan, focal_baseline: float, offset_px: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth in mm and confidence of pairs [F, H, W] in host memory; both are 0 at invalid pixels."""
    left_eye, right_eye, shown = (torch.from_numpy(each).to(_device()) for each in (left, right, tissue))
    disparity, confidence = match_frames(left_eye, right_eye, plan, shown)
    nearest_mm, farthest_mm = plan.depth_range_mm
    beyond_infinity_px = disparity - offset_px
    valid = (confidence >= MIN_CONFIDENCE) & (beyond_infinity_px >= focal_baseline / farthest_mm)
    valid &= beyond_infinity_px <= focal_baseline / nearest_mm
    depth_mm = torch.where(valid, focal_baseline / beyond_infinity_px, 0.0)
    return depth_mm.cpu().numpy(), torch.where(valid, confidence, 0).cpu().numpy()


def match_frames(left: Tensor, right: Tensor, plan: MatchPlan, tissue: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Disparity float32 in px and confidence uint8 of pairs uint8 [F, H, W], on their device; as stereo/matching.match.

    tissue: bool [F, H, W], of the left eye; None: all is tissue.
    """
    height, width = left.shape[1:]
    size, low, count = _reduced(height, width, plan)
    small_left, small_right = _resized(left, size), _resized(right, size)
    found, opposite = _semi_global(small_left, small_right, low, count)
    agreed = _consistency(found, opposite)
    trust = _evidence(found, agreed, small_left)
    trust.masked_fill_((found < low + ENDS_PX) | (found > low + count - 1 - ENDS_PX), 0)
    guide = (255 * small_left.float()).sqrt().round().to(torch.uint8)
    if tissue is None or bool(tissue.all()):
        coarse = filled(found, trust, guide)
    else:
        instrument = functional.adaptive_max_pool2d((~tissue).float(), size) > 0
        coarse = filled(found, trust * instrument, guide)
        trust.masked_fill_(~instrument & _beside_instruments(found, trust, instrument), 0)
        coarse = torch.where(instrument, coarse, filled(found, trust * ~instrument, guide))
    deviation = torch.where(agreed > 0, (found - coarse).abs().clamp_max(MAX_DEVIATION_PX), UNKNOWN_DEVIATION_PX)
    uncertainty = uncertainty_of(_box(deviation, ROUGHNESS_PX), _box(trust, EVIDENCE_PX))
    disparity = _enlarged(coarse, (height, width)) * (width / size[1])
    disparity, texture, residual = refine(disparity, left, right)
    confidence = confidence_of(_enlarged(uncertainty, (height, width)), texture, residual)
    x_right = torch.arange(width, device=left.device) - disparity
    unsure = (left >= SATURATED_LEVEL) | (x_right < 0) | (x_right > width - 1)
    least = confidence.clamp_max(MIN_CONFIDENCE)
    confidence = torch.where(unsure, (UNSURE_TRUST * confidence).maximum(least), confidence)
    black = _box(left.float(), BLACK_PX).round() <= BLACK_LEVEL
    return disparity, confidence.masked_fill(black, 0).round().to(torch.uint8)


def _evidence(found: Tensor, consistency: Tensor, image: Tensor) -> Tensor:
    """As matching.evidence, from a consistency that includes the disparities' roughness."""
    values = image.float()
    values = functional.pad(values - _box(values, CONTRAST_PX), (1, 1), mode="reflect")
    texture = _box((0.5 * (values[:, :, 2:] - values[:, :, :-2])).square(), EVIDENCE_PX)
    burnt_out = functional.max_pool2d((image >= SATURATED_LEVEL).float(), 3, 1, 1) > 0
    trust = consistency * (texture / (texture + EVIDENCE_TEXTURE)) * torch.where(burnt_out, SATURATED_TRUST, 1.0)
    unseen = found > torch.arange(found.shape[2], device=found.device)
    return trust.masked_fill((image <= BLACK_LEVEL) | unseen, 0)


def _beside_instruments(found: Tensor, trust: Tensor, instrument: Tensor) -> Tensor:
    """As matching.beside_instruments, for frames [F, h, w]."""
    reach = BESIDE_INSTRUMENTS_PX
    beside = functional.max_pool2d(instrument.float(), 2 * reach + 1, 1, reach) > 0
    surface = ~beside & (trust >= SURE_TRUST)
    matched = instrument & (trust > 0)
    behind = torch.full((len(found), 1, 1), math.inf, device=found.device)
    for each in torch.nonzero(surface.flatten(1).any(1)).flatten():
        behind[each] = torch.quantile(found[each][surface[each]], SURFACE_PERCENTILE / 100)
    hidden = torch.where(matched, (found - behind).clamp_min(0), 0)
    column = torch.arange(found.shape[2], device=found.device).expand_as(matched)
    start = (column - 1 - hidden.ceil().long()).clamp_min(0)
    starts = torch.zeros(found.shape, dtype=torch.int32, device=found.device)
    starts.scatter_add_(2, start, matched.int())
    return beside | ((starts - matched.int()).cumsum(2) > 0)


def uncertainty_of(deviation: Tensor, evidence: Tensor) -> Tensor:
    """As matching.uncertainty_of."""
    by_deviation = (deviation + DEVIATION_FLOOR_PX).pow(DEVIATION_EXPONENT)
    return by_deviation / (evidence + EVIDENCE_FLOOR).pow(EVIDENCE_EXPONENT)


def confidence_of(uncertainty: Tensor, texture: Tensor, residual: Tensor) -> Tensor:
    """As matching.confidence_of."""
    expected_px = ERROR * uncertainty * (residual / (texture + 1).sqrt() + NOISE_FLOOR).sqrt()
    confidence = 255 / (1 + (expected_px / ERROR_PX).square())
    return (confidence * (texture / TEXTURE_FOR_TRUST).clamp_max(1)).maximum(confidence.clamp_max(MIN_CONFIDENCE))


def agreed_disparities(
    left: Greys, right: Greys, low: int, count: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """As alignment.agreed_disparities."""
    device = _device()
    disparity, opposite = _semi_global(
        torch.from_numpy(left).to(device), torch.from_numpy(right).to(device), low, count
    )
    seen = torch.arange(left.shape[2], device=device) - disparity >= 0
    agreed = seen & (_disagreement(disparity, opposite)[0] <= 1)
    return disparity.cpu().numpy(), agreed.cpu().numpy()


def _device() -> str:
    return "cpu" if knobs.runtime.interpret else "cuda"


def _reduced(height: int, width: int, plan: MatchPlan) -> tuple[tuple[int, int], int, int]:
    """Size (h, w) of the reduced images, their minimum disparity and number of disparities."""
    factor = -(-width // MATCHING_WIDTH)
    size = (round(height / factor), round(width / factor))
    scale = size[1] / width
    low = math.floor(plan.min_disparity_px * scale)
    return size, low, math.ceil(plan.max_disparity_px * scale) - low + 1


def _resized(image: Tensor, size: tuple[int, int]) -> Tensor:
    if image.shape[1:] == size:
        return image
    return functional.interpolate(image[None].float(), size, mode="area")[0].round().to(torch.uint8)


def _enlarged(image: Tensor, size: tuple[int, int]) -> Tensor:
    return functional.interpolate(image[None], size, mode="bilinear")[0]


def _semi_global(left: Tensor, right: Tensor, low: int, count: int) -> tuple[Tensor, Tensor]:
    """Disparity float32 [F, h, w] of the left eyes' pixels and, in whole numbers, of the right eyes'."""
    return winners(path_sums(left, right, low, count), low)


def path_sums(left: Tensor, right: Tensor, low: int, count: int) -> Tensor:
    """S int16 [F, h, w, D] of pairs uint8 [F, h, w] (kernels.py)."""
    share = _share()
    frames, h, w = left.shape
    pixels, lanes = left.numel(), _lanes(count)
    words = [torch.empty(left.shape, dtype=torch.int32, device=left.device) for _ in range(2)]
    for image, word in zip((left.contiguous(), right.contiguous()), words, strict=True):
        kernels.census[(triton.cdiv(pixels, share.pixels),)](image, word, pixels, h, w, share.pixels)
    columns = torch.empty((frames, h, w, count), dtype=torch.uint8, device=left.device)
    costs, sums = (torch.empty(columns.shape, dtype=torch.int16, device=left.device) for _ in range(2))
    grid = (triton.cdiv(pixels, share.costs),)
    kernels.column_costs[grid](*words, columns, low, pixels, h, w, count, share.costs, lanes)
    kernels.block_costs[grid](columns, costs, pixels, h, w, count, share.costs, lanes)
    for add, (lines, length, line_stride, step_stride) in enumerate(((h, w, w, 1), (w, h, 1, w))):
        kernels.add_paths[(triton.cdiv(lines, share.paths), frames)](
            costs, sums, lines, length, line_stride, step_stride, h * w, count,
            SMALL_STEP_PENALTY, LARGE_STEP_PENALTY, bool(add), share.paths, lanes, num_warps=1,
        )  # fmt: skip
    return sums


def winners(sums: Tensor, low: int) -> tuple[Tensor, Tensor]:
    """Disparity float32 [F, h, w] of the left eyes' pixels and, in whole numbers, of the right eyes'."""
    share, (w, count) = _share(), sums.shape[2:]
    disparity, opposite = (torch.empty(sums.shape[:3], dtype=torch.float32, device=sums.device) for _ in range(2))
    pixels = disparity.numel()
    grid = (triton.cdiv(pixels, share.costs),)
    kernels.winners[grid](sums, disparity, opposite, low, pixels, w, count, share.costs, _lanes(count))
    return disparity, opposite


def _share() -> _Share:
    return INTERPRETED if knobs.runtime.interpret else ON_GPU


def _lanes(count: int) -> int:
    return max(MIN_LANES, 1 << (count - 1).bit_length())


def _disagreement(disparity: Tensor, opposite: Tensor) -> tuple[Tensor, Tensor]:
    """|d - the right eye's d at the match| in px, and the column of that match [F, h, w] int64."""
    width = disparity.shape[2]
    match = (torch.arange(width, device=disparity.device) - disparity).round().long().clamp(0, width - 1)
    return (disparity - opposite.gather(2, match)).abs(), match


def _consistency(disparity: Tensor, opposite: Tensor) -> Tensor:
    """Weight [F, h, w] in [0, 1]: 0 where the eyes disagree, low where the disparity is rough in either eye."""
    difference, match = _disagreement(disparity, opposite)
    smooth, opposite_smooth = _smoothness(disparity), _smoothness(opposite)
    return torch.where(difference < AGREEMENT_PX, torch.minimum(smooth, opposite_smooth.gather(2, match)), 0.0)


def _smoothness(disparity: Tensor) -> Tensor:
    mean = _box(disparity, ROUGHNESS_PX)
    variance = _box(disparity.square(), ROUGHNESS_PX) - mean.square()
    return (1 - ROUGHNESS_PER_PX2 * variance).clamp(0, 1)


def filled(disparity: Tensor, trust: Tensor, guide: Tensor) -> Tensor:
    """Edge-aware weighted mean of the trusted disparities, guided by guide uint8 [F, h, w]; it fills every pixel."""
    share = _share()
    frames, h, w = disparity.shape
    weighted, weight, gains = disparity * trust, trust.clone(), torch.empty_like(trust)
    strength = SMOOTHNESS
    for _ in range(FILTER_PASSES):
        for lines, length, line_stride, step_stride in ((h, w, w, 1), (w, h, 1, w)):
            kernels.smooth_lines[(triton.cdiv(lines, share.lines), frames)](
                guide, weighted, weight, gains, lines, length, line_stride, step_stride, h * w,
                strength, 1 / (COLOUR_SIGMA * math.log(2)), share.lines, num_warps=1,
            )  # fmt: skip
        strength *= FILTER_EASING
    return torch.where(weight > MIN_WEIGHT, weighted / weight.clamp_min(MIN_WEIGHT), disparity)


def refine(disparity: Tensor, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """As matching._refine: disparity after one Lucas-Kanade step, texture and residual, all [F, H, W]."""
    width = left.shape[2]
    fineness = max(1.0, width / REFERENCE_WIDTH)
    reference, searched = _high_pass(left, fineness), _high_pass(right, fineness)
    x = (torch.arange(width, device=left.device) - disparity).clamp(0, width - 1)
    before = x.long().clamp_max(width - 2)
    at = searched.gather(2, before)
    warped = at + (x - before) * (searched.gather(2, before + 1) - at)
    difference = warped - reference
    mean = functional.pad(0.5 * (warped + reference), (1, 1), mode="reflect")
    gradient = 0.5 * (mean[:, :, 2:] - mean[:, :, :-2])
    window = _window(REFINE_WINDOW_PX, fineness)
    texture = _box(gradient.square(), window) * fineness**2
    step = _box(gradient * difference, window) * fineness**2 / (texture + REFINE_DAMPING)
    residual = _box(difference.abs(), window)
    return disparity + step.clamp(-MAX_REFINEMENT_PX, MAX_REFINEMENT_PX), texture, residual


def _high_pass(image: Tensor, fineness: float) -> Tensor:
    values = image.float()
    return values - _box(values, _window(HIGH_PASS_PX, fineness))


def _window(size_px: int, fineness: float) -> int:
    return 2 * round(size_px * fineness / 2 - 0.5) + 1


def _box(image: Tensor, size: int) -> Tensor:
    """Means over squares with an odd side [F, H, W]; the image is mirrored at its border."""
    radius = size // 2
    wide = functional.pad(image, (radius, radius, radius, radius), mode="reflect")
    return functional.avg_pool2d(functional.avg_pool2d(wide, (1, size), 1), (size, 1), 1)
