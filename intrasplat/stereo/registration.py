"""Rotation, zoom and colours of the right eye relative to its calibration, measured against the left eye.

A calibration is never exact. A small rotation or zoom of the right eye shifts points to other rows, which is measured
and corrected. Its effect along the rows looks like depth and cannot be corrected. The colours of the eyes differ by a
gain and an offset per channel.

Symbols: H W pixels of one eye; M matches; x y = normalised coordinates in the right eye; dy = rows by which a point
lies lower in the recorded right picture than in the rectified one, px.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip.features import FEATURE_WIDTH
from intrasplat.clip.sampling import Mapping
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import RightEye
from intrasplat.stereo.alignment import RowShift
from intrasplat.stereo.matching import SATURATED_LEVEL, Image, MatchPlan, match
from intrasplat.stereo.turn import AnyImage, EyeRotation, Rgb

USUAL_TURN_RAD = 0.01
"""Prior standard deviation of a rotation or zoom: limits parameters that the matches hardly determine."""
COARSE_WITHIN_PX = (6.0, 6.0, 6.0, 3.0, 3.0, 3.0, 3.0)
"""For each step, the row error beyond which a match counts as wrong."""
MIN_TURN_MATCHES = 150
"""With fewer matches, as on flat tissue, only the row shift is estimated: many of them share the same error."""
FINE_STEPS, COLOUR_STEPS = 3, 6
MAX_FINE_PX = 1.0
"""At FEATURE_WIDTH. The fine measurement, which linearises pictures, is rejected if it differs by more from the coarse
one."""
SURE = 128  # of 255: minimum confidence of a match that counts
BORDER_PX, HIGH_PASS_PX, COLOUR_PX, HIGHLIGHT_PX = 8, 15, 5, 9
MIN_SAMPLE = 500  # minimum number of usable pixels
CENTRAL_SHARE = 0.7  # of the picture's half width and height
BRIGHTEST = 240  # levels; above, colours may be clipped
MIN_GAIN = 0.5  # of a channel; at most 1 / MIN_GAIN: no camera setting is beyond
MIN_COLOUR_LEVELS = 5.0  # of 255: smaller differences are not corrected; highlights alone can cause as much
WARN_MOVED_PX, WARN_COLOUR_LEVELS = 0.5, 8.0
MAX_RESIDUAL_PX, MIN_CORRELATION = 0.25, 0.965
"""The first at FEATURE_WIDTH. Sound recordings have 0.06 to 0.20 px, and 0.98 or more."""


@dataclass(frozen=True)
class Colours:
    """The right eye's colour = gain * the left eye's + offset, per channel R, G, B; offset in levels of 255.

    correlation is the lowest of three channels, over matching pixels. None: too few match; 0: the matching pixels are
    saturated.
    """

    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    correlation: float | None = None

    def corrected(self, right: Rgb) -> Rgb:
        """The right eye's picture in the left eye's colours."""
        levels = np.arange(256)[:, None]
        table = np.clip(np.rint((levels - np.array(self.offset)) / np.array(self.gain)), 0, 255).astype(np.uint8)
        redrawn: Rgb = cv2.LUT(right, table[:, None])
        return redrawn

    @property
    def largest_levels(self) -> float:
        """The largest colour difference, in levels, for colours between a quarter and three quarters of white."""
        levels = np.array([[64.0], [192.0]])
        return float(np.abs((np.array(self.gain) - 1) * levels + np.array(self.offset)).max())


@dataclass(frozen=True)
class Registration:
    """How the right eye differs from its calibration.

    calibrated   its camera as calibrated, without `turn`
    baseline_mm  distance from the left eye
    matches      number of feature matches in the measurement of rows
    residual_px  median |dy| of matching features after the correction
    """

    calibrated: Intrinsics
    baseline_mm: float
    turn: EyeRotation = field(default_factory=EyeRotation)
    colours: Colours = field(default_factory=Colours)
    matches: int = 0
    residual_px: float = 0.0

    @classmethod
    def of_matches(
        cls, matches: NDArray[np.float64], shift: RowShift, calibrated: Intrinsics, baseline_mm: float
    ) -> Registration:
        """The coarse rotation, from feature matches [M, 4]; none where measure_row_shift found too few."""
        if shift.matches == 0:
            return cls(calibrated, baseline_mm)
        turn = EyeRotation(shift.shift_px)
        if shift.matches >= MIN_TURN_MATCHES:
            turn = turn_of_matches(matches, shift.shift_px, calibrated)
        return cls(calibrated, baseline_mm, turn, Colours(), shift.matches, _residual_px(matches, turn, calibrated))

    def refined(self, pairs: Sequence[MatchedPair], matches: NDArray[np.float64], each: Mapping = map) -> Registration:
        """The refined rotation, and the colours, from pairs that this registration rectified.

        each: a thread pool's map processes pairs in parallel.
        """
        turn = self.turn
        if self.matches >= MIN_TURN_MATCHES:
            turn = turn_of_pictures(pairs, self.turn, self.calibrated, each)
        residual_px = _residual_px(matches, turn, self.calibrated) if self.matches else 0.0
        return replace(self, turn=turn, colours=colours_of(pairs, each), residual_px=residual_px)

    @property
    def camera(self) -> Intrinsics:
        """The right eye's camera."""
        return self.turn.camera(self.calibrated)

    @property
    def left_from_right(self) -> NDArray[np.float64]:
        """The right eye's pose [4, 4] in the left eye's camera axes, mm."""
        pose = np.eye(4)
        pose[:3, :3], pose[0, 3] = self.turn.rotation, self.baseline_mm
        return pose

    def rectified(self, image: Rgb) -> Rgb:
        """The recorded right picture as the calibrated eye would show it (EyeRotation.rectified)."""
        return self.turn.rectified(image, self.calibrated)

    def recorded(self, image: AnyImage) -> AnyImage:
        """An image in the calibrated eye's pixels, resampled to the recorded picture's (EyeRotation.recorded)."""
        return self.turn.recorded(image, self.calibrated)

    def recorded_depth(self, depth_mm: Image) -> Image:
        """Depth [H, W] mm of the calibrated eye, converted to the rotated eye: its axes, its pixels."""
        factor = self.turn.depth_factor(self.calibrated)
        return self.recorded(depth_mm * factor)

    @property
    def recolours(self) -> bool:
        """Whether the colour difference is large enough to correct, and small enough to be a camera's setting."""
        colours = self.colours
        is_line = colours.correlation is not None and colours.correlation >= MIN_CORRELATION
        is_usual = all(MIN_GAIN <= gain <= 1 / MIN_GAIN for gain in colours.gain)
        return is_line and is_usual and colours.largest_levels >= MIN_COLOUR_LEVELS

    def recoloured(self, right: Rgb) -> Rgb:
        """The right picture [H, W, 3] in the left eye's colours; unchanged if they hardly differ."""
        return self.colours.corrected(right) if self.recolours else right

    @property
    def report_entry(self) -> RightEye:
        """The report's entry on the right eye."""
        turn, camera, colours = self.turn, self.camera, self.colours if self.recolours else Colours()
        return RightEye(
            moved_px=turn.moved_px(self.calibrated),
            lower_px=turn.lower_px,
            pitch_deg=math.degrees(turn.pitch_rad),
            yaw_deg=math.degrees(turn.yaw_rad),
            roll_deg=math.degrees(turn.roll_rad),
            zoom=turn.zoom,
            left_from_right=tuple(self.left_from_right.ravel().tolist()),
            fx_px=camera.fx,
            fy_px=camera.fy,
            cx_px=camera.cx,
            cy_px=camera.cy,
            matches=self.matches,
            residual_px=self.residual_px,
            gain=colours.gain,
            offset=colours.offset,
            colour_correlation=self.colours.correlation,
        )

    def notices(self, *, drops: bool = False) -> tuple[Notice, ...]:
        """Warnings about calibration and colours. drops: whether drops on a lens may be why colours differ."""
        found, moved_px = [], self.turn.moved_px(self.calibrated)
        if self.matches == 0:
            text = (
                "too few matching features to measure how the right eye is turned: the calibration is taken as it is; "
                "check focus, and that both eyes show the same"
            )
            found.append(Notice.warning(NoticeCode.ALIGNMENT_UNKNOWN, text))
        elif moved_px >= WARN_MOVED_PX:
            text = (
                f"rows of left and right differed by {self.turn.lower_px:+.2f} px in the middle; the right eye was "
                f"moved by up to {moved_px:.1f} px ({self.residual_px:.2f} px remain): the calibration does not fit "
                "this recording exactly"
            )
            found.append(Notice.warning(NoticeCode.ROWS_MISALIGNED, text))
        if self.colours.correlation is None:
            text = "too few pixels of the eyes match to compare their colours: taken as equal"
            found.append(Notice.warning(NoticeCode.COLOURS_UNKNOWN, text))
        if self.recolours and self.colours.largest_levels >= WARN_COLOUR_LEVELS:
            gains, offsets = (
                ", ".join(f"{each:.2f}" for each in numbers) for numbers in (self.colours.gain, self.colours.offset)
            )
            text = (
                f"the right eye's colours differ from the left one's (gain {gains}, offset {offsets} of 255) and were "
                "corrected"
            )
            found.append(Notice.warning(NoticeCode.EYES_COLOURED_APART, text))
        return (*found, *self._disagreement(drops=drops))

    def _disagreement(self, *, drops: bool) -> tuple[Notice, ...]:
        """Warnings about differences that neither rotation nor colours correct."""
        found, correlation = [], self.colours.correlation
        if self.residual_px > MAX_RESIDUAL_PX * max(self.calibrated.width / FEATURE_WIDTH, 1.0):
            found.append(
                f"matching features still lie {self.residual_px:.2f} px off their rows after the right eye was moved: "
                "check that the frames of the eyes are of the same moment, that both are in focus, and that the "
                "calibration's distortion is that of this endoscope"
            )
        if correlation is not None and correlation < MIN_CORRELATION and not drops:
            found.append(
                f"the eyes' colours correlate by {correlation:.2f} where they match: check that both have the same "
                "channels, and that neither is burnt out, fogged, or behind smoke or drops"
            )
        return tuple(Notice.warning(NoticeCode.EYES_DISAGREE, text) for text in found)


def turn_of_matches(matches: NDArray[np.float64], lower_px: float, camera: Intrinsics) -> EyeRotation:
    """The rotation that puts matches [M, 4] on equal rows (as of match_features); lower_px: the initial row shift."""
    numbers = np.array([lower_px, 0.0, 0.0, 0.0, 0.0])
    for within_px in COARSE_WITHIN_PX:
        x, y = _rectified_places(matches, EyeRotation(*numbers.tolist()), camera).T
        dy = y - matches[:, 1]
        kept = np.abs(dy) < within_px
        if kept.any():
            numbers = numbers + _step(_slopes(x, y, camera)[:, kept], dy[kept], numbers)
    return EyeRotation(*numbers.tolist())


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """A left picture and the rectified right one, both [H, W, 3]; x [H, W] is the column of each left pixel in the
    right picture; sure [H, W] marks the matches that count."""

    left: Rgb
    right: Rgb
    x: Image
    sure: NDArray[np.bool_]

    @classmethod
    def of(cls, left: Rgb, right: Rgb, tissue: NDArray[np.bool_], plan: MatchPlan) -> MatchedPair:
        """The pair with its matches; tissue [H, W] is the left eye's."""
        greys = [cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY) for eye in (left, right)]
        disparity, confidence = match(greys[0], greys[1], plan, tissue)
        height, width = disparity.shape
        x = np.arange(width, dtype=np.float32) - disparity
        sure = tissue & (confidence >= SURE) & (x > BORDER_PX) & (x < width - 1 - BORDER_PX)
        sure[:BORDER_PX] = sure[height - BORDER_PX :] = False
        return cls(left, right, x, sure)

    def right_as_left(self, image: NDArray[np.float32], lower_px: Image | float = 0.0) -> NDArray[np.float32]:
        """An image of the right eye warped to the left eye's pixels, read lower_px rows lower."""
        rows = np.arange(len(self.x), dtype=np.float32)[:, None] + np.zeros_like(self.x) + np.float32(lower_px)
        moved = cv2.remap(image, self.x, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(moved, np.float32)


def turn_of_pictures(
    pairs: Sequence[MatchedPair], turn: EyeRotation, camera: Intrinsics, each: Mapping = map
) -> EyeRotation:
    """A refined rotation, from pairs that `turn` rectified: they are matched along rows, so the row error remains.

    FINE_STEPS Gauss-Newton steps on high-pass filtered pictures.
    """
    numbers = np.zeros(len(astuple(turn)))
    details = list(each(partial(_RowDetail.of, camera=camera), pairs))
    for _ in range(FINE_STEPS):
        found = each(partial(_RowDetail.errors, numbers=numbers), details)
        slopes, missing = (np.concatenate(parts, axis=-1) for parts in zip(*found, strict=True))
        if len(missing) < MIN_SAMPLE:
            return turn
        numbers = numbers + _step(slopes, missing, numbers)
    if EyeRotation(*numbers.tolist()).moved_px(camera) > MAX_FINE_PX * max(camera.width / FEATURE_WIDTH, 1.0):
        return turn
    return EyeRotation(*(np.array(astuple(turn)) + numbers).tolist())


def colours_of(pairs: Sequence[MatchedPair], each: Mapping = map) -> Colours:
    """Gain and offset between the eyes over matching pixels, without highlights; identity if too few match."""
    found = each(_colour_samples, pairs)
    left, right = (np.concatenate(parts).astype(np.float64) for parts in zip(*found, strict=True))
    if len(left) < MIN_SAMPLE:
        matched = sum(int((pair.sure & _central(pair.x)).sum()) for pair in pairs)
        return Colours(correlation=0.0 if matched > 40 * MIN_SAMPLE else None)
    lines = each(lambda channels: _line(*channels), zip(left.T, right.T, strict=True))
    gain, offset, correlation = zip(*lines, strict=True)
    return Colours(gain, offset, min(correlation))


def _rectified_places(matches: NDArray[np.float64], turn: EyeRotation, camera: Intrinsics) -> NDArray[np.float64]:
    """Positions [M, 2] (x, y) of the right eye's features in the rectified picture."""
    places = cv2.perspectiveTransform(matches[:, None, 2:] - 0.5, np.linalg.inv(turn.from_rectified(camera)))
    return np.asarray(places[:, 0] + 0.5, np.float64)


def _residual_px(matches: NDArray[np.float64], turn: EyeRotation, camera: Intrinsics) -> float:
    """Median |dy| of the matches [M, 4], without outliers."""
    off_px = np.abs(_rectified_places(matches, turn, camera)[:, 1] - matches[:, 1])
    near = off_px[off_px < COARSE_WITHIN_PX[-1]]
    return float(np.median(near)) if near.size else 0.0


def _slopes(x: NDArray[np.floating], y: NDArray[np.floating], camera: Intrinsics) -> NDArray[np.floating]:
    """Derivatives [5, M] of dy by an EyeRotation's numbers near 0; x, y [M] in the picture."""
    across, down = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    turns = np.stack([down * down, -across * down, -across, down])
    return np.concatenate([np.ones_like(turns[:1]), camera.fy * turns])


def _step(
    slopes: NDArray[np.floating], missing: NDArray[np.floating], numbers: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Robust Gauss-Newton step of the numbers for derivatives `slopes` [5, M] and residuals `missing` [M]."""
    scale = 1.48 * float(np.median(np.abs(missing))) + 1e-6
    weighted = slopes * (1 / (scale**2 + missing**2))
    prior = np.array([0.0, *[USUAL_TURN_RAD**-2] * 4])
    normal = weighted @ slopes.T + np.diag(prior + 1e-9)
    return np.asarray(np.linalg.solve(normal, weighted @ missing - prior * numbers), np.float64)


@dataclass(frozen=True, eq=False)
class _RowDetail:
    """A matched pair for comparing rows: grey levels [H, W] of the left picture and of the right one, and derivatives
    [5, H, W] of the right picture's rows by an EyeRotation's numbers."""

    pair: MatchedPair
    left: Image
    left_detail: Image
    right: Image
    slopes: NDArray[np.float32]

    @classmethod
    def of(cls, pair: MatchedPair, camera: Intrinsics) -> _RowDetail:
        left, right = (cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY).astype(np.float32) for eye in (pair.left, pair.right))
        y = np.arange(len(pair.x), dtype=np.float32)[:, None] + np.zeros_like(pair.x)
        return cls(pair, left, _detail(left), right, _slopes(pair.x + 0.5, y + 0.5, camera).astype(np.float32))

    def errors(self, numbers: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Derivatives [5, M] of the right picture's levels by the numbers, and residuals [M], at sure pixels."""
        lower_px = np.tensordot(numbers.astype(np.float32), self.slopes, 1)
        seen = self.pair.right_as_left(self.right, lower_px)
        brightest = cv2.dilate(np.maximum(self.left, seen), np.ones((3, 3), np.uint8))
        detail, sure = _detail(seen), self.pair.sure & (brightest < SATURATED_LEVEL)
        gradient = cv2.Sobel((self.left_detail + detail) / 2, cv2.CV_32F, 0, 1, scale=1 / 8)
        chosen = np.flatnonzero(sure)
        slopes = self.slopes.reshape(5, -1).take(chosen, axis=1) * gradient.ravel()[chosen]
        return slopes, (self.left_detail - detail).ravel()[chosen]


def _detail(levels: Image) -> Image:
    """A high-pass filtered picture [H, W]."""
    detail: Image = levels - cv2.blur(levels, (HIGH_PASS_PX,) * 2)
    return detail


def _colour_samples(pair: MatchedPair) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colours [M, 3] of left and right at matching, unclipped pixels, each the mean over a small window."""
    left, right = pair.left.astype(np.float32), pair.right_as_left(pair.right.astype(np.float32))
    brightest = np.maximum(left, right).max(axis=2)
    lit = cv2.dilate((brightest > BRIGHTEST).astype(np.uint8), np.ones((HIGHLIGHT_PX, HIGHLIGHT_PX), np.uint8)) > 0
    left, right = (cv2.blur(each, (COLOUR_PX, COLOUR_PX)) for each in (left, right))
    sure = (pair.sure & ~lit & _central(pair.x))[::2, ::2]
    return left[::2, ::2][sure], right[::2, ::2][sure]


def _central(x_right: Image) -> NDArray[np.bool_]:
    """Pixels [H, W] in the middle of both pictures: vignetting affects different pixels of each eye."""
    height, width = x_right.shape
    down = (2 * np.arange(height)[:, None] / height - 1) ** 2
    return np.asarray(
        np.maximum(*((2 * x / width - 1) ** 2 for x in (np.arange(width), x_right))) + down < CENTRAL_SHARE**2
    )


def _line(left: NDArray[np.float64], right: NDArray[np.float64]) -> tuple[float, float, float]:
    """Gain, offset and correlation of one channel [M], by a robust line fit that treats both eyes alike."""
    weight, gain, offset = np.ones_like(left), 1.0, 0.0
    correlation = float(np.corrcoef(left, right)[0, 1]) if left.std() > 0 and right.std() > 0 else 0.0
    for _ in range(COLOUR_STEPS):
        means = [float(np.average(each, weights=weight)) for each in (left, right)]
        spread = [
            np.sqrt(np.average((each - m) ** 2, weights=weight)) for each, m in zip((left, right), means, strict=True)
        ]
        gain = float(spread[1] / max(spread[0], 1e-6))
        offset = means[1] - gain * means[0]
        error = right - gain * left - offset
        scale = 1.48 * float(np.median(np.abs(error))) + 0.1
        weight = 1 / (1 + (error / scale) ** 2)
    return gain, offset, correlation
