"""Frame times of a video from its time stamps, which recorders write in many ways.

Symbols: T frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from intrasplat.notices import Notice, NoticeCode

FALLBACK_RATE_HZ = 30.0
"""Frames a second where a clip carries no times."""
MAX_GAP_S = 10.0
"""A longer step between two frames is a jump of the clock, not a pause: no clip that is trained on rests for longer."""
MAX_JUMPS = 0.25
"""With a larger share of steps that jump or do not rise, the time stamps are not used."""


def frame_times(
    stamps_s: Sequence[float | None], rate_hz: float | None, field: str
) -> tuple[NDArray[np.float64] | None, tuple[Notice, ...]]:
    """Seconds from the first frame [T], rising, and what was assumed; None if there are neither times nor a rate.

    Time stamps may start anywhere, as recorders' clocks do. A step that falls, or is longer than MAX_GAP_S, counts as
    the median step.

    Args:
        stamps_s: time stamps of the frames in order of display; None: the container gives none.
        rate_hz: the container's frame rate, used if the time stamps are not usable.
        field: the input, for the notice.
    """
    known = np.array([np.nan if each is None else each for each in stamps_s])
    steps = np.diff(known)
    sound = np.isfinite(steps) & (steps > 0) & (steps <= MAX_GAP_S)
    if len(steps) and sound.mean() >= 1 - MAX_JUMPS:
        times_s = np.concatenate([[0.0], np.cumsum(np.where(sound, steps, np.median(steps[sound])))])
        if sound.all():
            return known - known[0], ()
        jumps = np.flatnonzero(~sound)
        text = f"time: {field}: the time stamps jump {len(jumps)} times, first after frame {jumps[0]}: these steps "
        text += "were replaced by the median one"
        return times_s, (Notice.info(NoticeCode.FRAME_TIMES, text),)
    if rate_hz is None or not 0 < rate_hz <= 1000:
        return None, ()
    text = f"time: {field}: the time stamps do not rise or are missing, {rate_hz:g} frames a second are assumed"
    notices = (Notice.info(NoticeCode.FRAME_TIMES, text),) if len(steps) else ()
    return np.arange(len(stamps_s)) / rate_hz, notices


def assumed_times(frame_count: int) -> tuple[NDArray[np.float64], Notice]:
    """Times [T] in seconds of frames that come without any, and the notice that says so."""
    text = f"time: {FALLBACK_RATE_HZ:g} frames a second, the clip carries none"
    return np.arange(frame_count) / FALLBACK_RATE_HZ, Notice.info(NoticeCode.FRAME_TIMES, text)
