"""Light of the picture as a whole: exposure, white balance, and a lamp that comes nearer. Symbols: T frames.

A gain of light acts before the camera's tone curve, which is about the power 1 / TONE_POWER. with_drift() and
with_tint() take any clip, of one eye or two.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.types import DepthClip, Eye
from lab.conditions.clean import CleanClip, Given, clean_of, given, to_bytes
from lab.conditions.hiding import beyond, with_instrument
from lab.phantom import Phantom
from lab.phantom.settings import MEAN_DEPTH_MM
from lab.phantom.shading import Lamp

TONE_POWER = 2.2
DRIFT_PERIODS = 1.5
LAG_FRAMES, AT_ONCE = 6.0, 1.0  # time constant of the camera's automatic exposure: a quarter of a second; none
BRIGHT, DARK = (232, 235, 238), (20, 21, 23)  # steel that mirrors the lamp, and a black shaft
MAX_COVERED = 0.35  # share of the picture that an instrument covers at its largest

Gains = NDArray[np.float64]
"""[T, 3] factors of the recorded R G B of each frame."""


def with_drift(clip: DepthClip, level: float, random: np.random.Generator) -> DepthClip:
    """Any clip whose exposure oscillates over `level` stops (a factor of two each), one and a half times."""
    phase = random.uniform(0, 2 * np.pi) + 2 * np.pi * DRIFT_PERIODS * np.arange(clip.frame_count) / clip.frame_count
    return _with_gains(clip, _gains(level / 2 * np.sin(phase)))


def with_tint(clip: DepthClip, level: float, random: np.random.Generator) -> DepthClip:
    """Any clip by whose end red is `level` times as strong and blue as weak; green stays."""
    del random
    red = level ** np.linspace(0, 1, clip.frame_count)
    return _with_gains(clip, np.stack([red, np.ones_like(red), 1 / red], axis=-1))


def exposure_drift(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Exposure oscillates over `level` stops."""
    return given(clean, with_drift(clean.clip, level, random))


def white_balance_drift(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """White balance drifts by `level` times."""
    return given(clean, with_tint(clean.clip, level, random))


def auto_exposure(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """A bright instrument comes and goes, then a dark one; both have masks. Exposure keeps the picture's mean
    brightness, with a lag, so that tissue is darker, then brighter: `level` stops from one to the other.

    Scored outside these instruments.
    """
    frames, height, width = clean.clip.tissue.shape
    share = MAX_COVERED * np.sin(2 * np.pi * np.arange(frames) / frames)
    angles, clip = random.uniform(0, 2 * np.pi, 2), clean.clip
    covered = np.zeros(clip.tissue.shape, np.bool_)
    for angle, colour, shares in ((angles[0], BRIGHT, share), (angles[1], DARK, -share)):
        here = np.stack([beyond(angle, max(each, 0.0), height, width) for each in shares])
        clip = with_instrument(clip, here, colour, random)
        covered |= here
    light = ((clip.rgb / np.float32(255)) ** TONE_POWER).mean(axis=(1, 2, 3), dtype=np.float64)
    stops = lagging(-np.log2(light / light[0]))
    gains = _gains(level * stops / max(float(np.ptp(stops)), 1e-9))
    return given(clean, _with_gains(clip, gains), scored=clean.seen & ~covered)


def advancing_lamp(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """The endoscope advances until its lamp's light on the tissue has grown by `level` stops, and returns; poses are
    correct. Exposure makes up for that, with a lag; the truth is the tissue without that lag.
    """
    del random
    phantom, advance_mm = clean.phantom, MEAN_DEPTH_MM * (1 - 2 ** (-level / 2))
    recorded, steady = (
        AdvancingPhantom(phantom.settings, phantom.surface, phantom.paint, advance_mm, lag)
        for lag in (LAG_FRAMES, AT_ONCE)
    )
    rgb = np.stack([steady.render(index)[0] for index in range(phantom.settings.frames)])
    return given(clean_of(recorded), rgb=rgb)


@dataclass(frozen=True)
class AdvancingPhantom(Phantom):
    """A phantom whose endoscope advances by advance_mm and returns.

    Its lamp's light falls off with the squared distance; exposure makes up for that at mean depth, with a lag.
    """

    advance_mm: float
    lag_frames: float

    def world_from_camera(self, frame: float) -> NDArray[np.float64]:
        """Pose [4, 4] of the left eye, mm; the identity at frame 0."""
        pose = np.eye(4)
        pose[2, 3] = self.advance_mm * np.sin(np.pi * frame / max(self.settings.frames - 1, 1)) ** 2
        return pose

    def _lamp(self, frame: float) -> Lamp:
        moments = np.arange(self.settings.frames)
        depth_mm = MEAN_DEPTH_MM - np.array([self.world_from_camera(int(each))[2, 3] for each in moments])
        stops = lagging(2 * np.log2(depth_mm / MEAN_DEPTH_MM), self.lag_frames)
        return dataclasses.replace(super()._lamp(frame), strength=2 ** float(np.interp(frame, moments, stops)))


def lagging(values: NDArray[np.float64], lag_frames: float = LAG_FRAMES) -> NDArray[np.float64]:
    """What follows the values [T] with a lag; AT_ONCE gives the values."""
    followed = values.copy()
    for index in range(1, len(values)):
        followed[index] = followed[index - 1] + (values[index] - followed[index - 1]) / lag_frames
    return followed


def _gains(stops: NDArray[np.float64]) -> Gains:
    return np.repeat((2**stops) ** (1 / TONE_POWER), 3).reshape(-1, 3)


def _with_gains(clip: DepthClip, gains: Gains) -> DepthClip:
    """The clip as recorded with these gains, both eyes if it has them."""
    right = None if clip.right is None else dataclasses.replace(clip.right, rgb=_times(clip.right, gains))
    return dataclasses.replace(clip, rgb=_times(clip, gains), right=right)


def _times(eye: Eye, gains: Gains) -> NDArray[np.uint8]:
    return np.stack([to_bytes(rgb * gain) for rgb, gain in zip(eye.rgb, gains, strict=True)])
