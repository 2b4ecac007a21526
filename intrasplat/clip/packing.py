"""Pairs of left and right frames, from one sequence of pictures or two.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import RgbFrame
from intrasplat.errors import InputError
from intrasplat.notices import Notice, Severity

Packing = Literal["sbs", "tb"]
Pixel = TypeVar("Pixel", np.uint8, np.bool_)

PACKING_WORDS: dict[Packing, str] = {"sbs": "side by side, left eye left", "tb": "top-bottom, left eye on top"}

MAX_RATE_RATIO = 1.1  # Matroska's milliseconds change a rate of 120 Hz by 4 %

_EYE_ASPECTS = (0.8, 2.4)  # plausible width / height of an endoscope's eye; 5:4 and 16:9 are well inside
CLEAR_MARGIN = 0.15  # of correlation; with a larger one, content overrides the shape
MIN_LIKENESS = 0.35  # two eyes on the same tissue correlate above this, different parts of one picture below
_LIKENESS_WIDTH_PX = 160  # halves are compared at this width: disparities are a few pixels, and it takes 1 ms
_MIN_DETAIL_STD = 1.0  # grey levels; a frame with less detail is ignored
_MAX_FRAMES_COMPARED = 30  # clips may start black


class FrameSequence(Protocol):
    """T RGB frames of one size: a video or images. Each call of frames() starts again from frame 0.

    damaged: indices of frames from which nothing must be learnt. pixel_aspect: width / height of a pixel.
    """

    @property
    def frame_count(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def width(self) -> int: ...
    @property
    def label(self) -> str: ...
    @property
    def frame_times_s(self) -> NDArray[np.float64] | None: ...
    @property
    def notices(self) -> tuple[Notice, ...]: ...
    @property
    def damaged(self) -> tuple[int, ...]: ...
    @property
    def pixel_aspect(self) -> float: ...
    def frames(self) -> Iterator[RgbFrame]: ...


@dataclass(frozen=True)
class PackedPairs:
    """Left and right halves of each picture, without an odd middle row or column."""

    sequence: FrameSequence
    packing: Packing

    @property
    def sequences(self) -> tuple[FrameSequence, ...]:
        return (self.sequence,)

    @property
    def eye_size(self) -> tuple[int, int]:
        """(height, width) of one eye."""
        height, width = self.sequence.height, self.sequence.width
        return (height, width // 2) if self.packing == "sbs" else (height // 2, width)

    def __call__(self) -> Iterator[tuple[RgbFrame, RgbFrame]]:
        for frame in self.sequence.frames():
            yield halves(frame, self.packing)


@dataclass(frozen=True)
class TwoSequences:
    """Left and right frames from two sequences of equal length and size."""

    left: FrameSequence
    right: FrameSequence

    @property
    def sequences(self) -> tuple[FrameSequence, ...]:
        return (self.left, self.right)

    def __call__(self) -> Iterator[tuple[RgbFrame, RgbFrame]]:
        return zip(self.left.frames(), self.right.frames(), strict=True)


def by_severity(sequences: Iterable[FrameSequence]) -> tuple[tuple[Notice, ...], tuple[Notice, ...]]:
    """The sequences' notices: those that are good to know, and warnings."""
    notices = [notice for each in sequences for notice in each.notices]
    infos = tuple(each for each in notices if each.severity is Severity.INFO)
    return infos, tuple(each for each in notices if each.severity is Severity.WARNING)


def pair_sequences(left: FrameSequence, right: FrameSequence) -> TwoSequences:
    """The frame pairs of a left and a right sequence. InputError if their lengths, rates or sizes differ."""
    if left.frame_count != right.frame_count:
        raise InputError(
            "right",
            f"the right eye has {right.frame_count} frames, the left {left.frame_count}.",
            "Give both the same number of frames; frames that are missing within one of them are found.",
        )
    rates_hz = [_rate_hz(each) for each in (left, right)]
    if 0 < min(rates_hz) * MAX_RATE_RATIO < max(rates_hz):
        raise InputError(
            "right",
            f"the right eye has {rates_hz[1]:.4g} frames a second, the left {rates_hz[0]:.4g}.",
            "Give both eyes at one rate, so that frame i of both shows one moment.",
        )
    if (left.height, left.width) != (right.height, right.width):
        raise InputError(
            "right",
            f"the right eye is {right.width}x{right.height} pixels, the left {left.width}x{left.height}.",
            "Give both eyes in one size.",
        )
    return TwoSequences(left, right)


def _rate_hz(sequence: FrameSequence) -> float:
    """Frames a second by the median step between them; 0 if there are no times."""
    times_s = sequence.frame_times_s
    return 0.0 if times_s is None or len(times_s) < 2 else 1 / float(np.median(np.diff(times_s)))


def halves(frame: NDArray[Pixel], packing: Packing) -> tuple[NDArray[Pixel], NDArray[Pixel]]:
    """(left, right) eye of a packed picture [H, W, 3] or mask [H, W], each contiguous."""
    height, width = frame.shape[:2]
    if packing == "sbs":
        first, second = frame[:, : width // 2], frame[:, width - width // 2 :]
    else:
        first, second = frame[: height // 2], frame[height - height // 2 :]
    return np.ascontiguousarray(first), np.ascontiguousarray(second)


def packing_by_size(packed: tuple[int, int], eye: tuple[int, int]) -> Packing | None:
    """How pictures (height, width) contain two eyes of size `eye`, apart from an odd middle line; None: they do not."""
    height, width = packed
    if (height, width // 2) == eye:
        return "sbs"
    return "tb" if (height // 2, width) == eye else None


def detect_packing(sequence: FrameSequence) -> Packing:
    """Side by side or top-bottom, by the likeness of the halves and the plausibility of an eye's shape.

    InputError if neither pair of halves looks alike, or if content and shape disagree.
    """
    by_shape = _packing_by_shape(sequence)
    likeness = _likeness_in(sequence)
    if likeness is None:
        if by_shape is not None:
            return by_shape
        raise _undecided(sequence, "the frames show too little detail")
    by_content: Packing = "sbs" if likeness["sbs"] >= likeness["tb"] else "tb"
    figures = f"likeness of the halves: side by side {likeness['sbs']:.2f}, top-bottom {likeness['tb']:.2f}"
    if likeness[by_content] < MIN_LIKENESS:
        raise InputError(
            "clip",
            f"{sequence.label} does not look like two eyes in one picture ({figures}).",
            'Give the right eye as a second file, or both in folders left/ and right/, or say layout "sbs" or "tb" '
            "if the clip is stereo.",
        )
    if by_shape in (None, by_content) or abs(likeness["sbs"] - likeness["tb"]) >= CLEAR_MARGIN:
        return by_content
    raise _undecided(sequence, figures)


def _packing_by_shape(sequence: FrameSequence) -> Packing | None:
    low, high = _EYE_ASPECTS
    if low <= sequence.width / 2 / sequence.height <= high:
        return "sbs"
    return "tb" if low <= sequence.width / (sequence.height / 2) <= high else None


def _likeness_in(sequence: FrameSequence) -> dict[Packing, float] | None:
    """Likeness of the halves for both packings, in the first frame with detail; None without such a frame."""
    for frame in itertools.islice(sequence.frames(), _MAX_FRAMES_COMPARED):
        likeness = packing_likeness(frame)
        if likeness is not None:
            return likeness
    return None


def packing_likeness(frame: RgbFrame) -> dict[Packing, float] | None:
    """Likeness of a picture's halves for both packings, in [-1, 1]; None if it shows too little detail."""
    sbs, tb = _likeness(*halves(frame, "sbs")), _likeness(*halves(frame, "tb"))
    return None if sbs is None or tb is None else {"sbs": sbs, "tb": tb}


def _likeness(first: RgbFrame, second: RgbFrame) -> float | None:
    """Best normalised correlation of detail over small shifts, in [-1, 1]; None if a half is flat."""
    detail = [_detail(first), _detail(second)]
    if min(float(image.std()) for image in detail) < _MIN_DETAIL_STD:
        return None
    height, width = detail[0].shape
    rows, columns = max(1, height // 12), width // 5  # search range: vertical misalignment, disparity
    core = detail[0][rows : height - rows, columns : width - columns]
    return float(cv2.matchTemplate(detail[1], core, cv2.TM_CCOEFF_NORMED).max())


def _detail(eye: RgbFrame) -> NDArray[np.float32]:
    """A small grey picture, high-pass filtered: any two halves share slow shading."""
    height, width = eye.shape[:2]
    small_width = min(width, _LIKENESS_WIDTH_PX)
    small_height = max(4, round(height * small_width / width))
    grey = cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY).astype(np.float32)
    grey = cv2.resize(grey, (small_width, small_height), interpolation=cv2.INTER_AREA)
    return np.asarray(grey - cv2.GaussianBlur(grey, (0, 0), small_width / 20), dtype=np.float32)


def _undecided(sequence: FrameSequence, reason: str) -> InputError:
    return InputError(
        "options.layout",
        f"cannot tell whether {sequence.label} ({sequence.width}x{sequence.height}) "
        f"is side by side or top-bottom: {reason}.",
        'Say layout "sbs" or "tb".',
    )
