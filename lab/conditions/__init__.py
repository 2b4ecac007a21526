"""What goes wrong in an operating theatre, each as a function of the clean clip, a severity and a seed.

CONDITIONS is the table: the five severities of each in its own unit. The functions lie in hiding (instruments and
masks), light (the picture), exposure (its light as a whole), smoke, lens (drops), depth, timing (frames) and scenes
(motion, camera, size, stereo); clean.py has what they take and give, recording.py what is written as files.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lab.conditions import depth, exposure, hiding, lens, light, scenes, smoke, timing
from lab.conditions.clean import CleanClip, Given, clean_clip, given
from lab.conditions.recording import Recording, recording_of, write_recording

CLEAN, CLEAN_STEREO = "clean", "clean_stereo"
SEVERITIES = (1, 2, 3, 4, 5)

Spoiler = Callable[[CleanClip, float, np.random.Generator], Given]


@dataclass(frozen=True)
class Condition:
    """One adverse condition.

    title      its name, with the unit of its levels
    levels     the levels of severity 1 to 5
    stereo     whether it is written as stereo files and read, rectified and matched; so is its clean cell then
    any_light  whether the clip does not tell which light the truth has: that of which frame, or that below the smoke
    calm       for a condition with its own tissue motion: the harmless level of severity 0, because scores of different
               motions cannot be compared. Else None: severity 0 is the clean clip
    """

    name: str
    title: str
    spoil: Spoiler
    levels: tuple[float, ...]
    stereo: bool = False
    any_light: bool = False
    calm: float | None = None

    @property
    def clean_name(self) -> str:
        """The name of the condition whose severity 0 it is compared with."""
        if self.calm is not None:
            return self.name
        return CLEAN_STEREO if self.stereo else CLEAN

    def level(self, severity: int) -> float:
        """The level of a severity from 1 to 5, or of 0 for a condition with a calm level."""
        if severity == 0:
            assert self.calm is not None
            return self.calm
        return self.levels[severity - 1]

    def apply(self, clean: CleanClip, severity: int, seed: int) -> Given:
        """The clip of a severity, as level() has them; the same arguments give the same clip.

        The generator is seeded by the condition's name and the seed, not by the severity. If the level is a size, a
        share or a strength, a higher level is the same event, but worse. If it is a number of objects (highlights),
        those of a lower level start at the same points but move differently, because they share one generator.
        """
        random = np.random.default_rng([seed, zlib.crc32(self.name.encode())])
        return self.spoil(clean, self.level(severity), random)


def clean_given(clean: CleanClip, *, stereo: bool) -> Given:
    """Severity 0: the clean clip, unchanged or through stereo files."""
    return given(clean, recording_of(clean.phantom) if stereo else None)


def _conditions() -> dict[str, Condition]:
    table = (
        Condition("tools", "instruments, share of picture", hiding.tools_over_frame, (0.1, 0.25, 0.4, 0.55, 0.7)),
        Condition("hidden_at_start", "hidden in frame 0, share", hiding.hidden_at_start, (0.1, 0.2, 0.3, 0.45, 0.6)),
        Condition("highlights", "moving highlights, number", light.highlights, (4, 8, 16, 32, 64)),
        Condition("smoke", "smoke, share of light", smoke.smoke, (0.1, 0.25, 0.4, 0.6, 0.8), any_light=True),
        Condition(
            "smoke_stereo", "smoke before both eyes, share of light", smoke.smoke_stereo, (0.1, 0.25, 0.4, 0.6, 0.8),
            True, any_light=True,
        ),
        Condition("splash", "drops on the lens, share of picture", lens.splash, (0.02, 0.05, 0.1, 0.2, 0.35)),
        Condition(
            "splash_stereo", "drops on both lenses, share of picture", lens.splash_stereo, (0.02, 0.05, 0.1, 0.2, 0.35),
            True,
        ),
        Condition("blood", "flooded by blood, share", light.blood, (0.1, 0.25, 0.4, 0.6, 0.8)),
        Condition("motion_blur", "motion blur in half the frames, px", light.motion_blur, (8, 16, 24, 32, 48)),
        Condition("defocus", "defocus, sigma px", light.defocus, (2, 4, 6, 8, 12)),
        Condition(
            "exposure_drift", "exposure drift, stops", exposure.exposure_drift, (0.25, 0.5, 1, 1.5, 2), any_light=True
        ),
        Condition(
            "auto_exposure", "exposure follows instruments, stops", exposure.auto_exposure, (0.25, 0.5, 1, 1.5, 2),
            any_light=True,
        ),
        Condition(
            "white_balance", "white balance drift, times", exposure.white_balance_drift, (1.05, 1.1, 1.2, 1.4, 1.8),
            any_light=True,
        ),
        Condition(
            "advancing_lamp", "lamp comes nearer, stops", exposure.advancing_lamp, (0.25, 0.5, 1, 1.5, 2),
            any_light=True,
        ),
        Condition("black_border", "black border, share", light.black_border, (0.05, 0.1, 0.2, 0.3, 0.4)),
        Condition("grey_scale", "colour lost, share", light.grey_scale, (0.2, 0.4, 0.6, 0.8, 1)),
        Condition("depth_noise", "depth noise, share of depth", depth.depth_noise, (0.01, 0.02, 0.05, 0.1, 0.2)),
        Condition("depth_holes", "depth missing, share", depth.depth_holes, (0.1, 0.25, 0.4, 0.6, 0.8)),
        Condition("depth_outliers", "depth grossly wrong, share", depth.depth_outliers, (0.01, 0.05, 0.1, 0.2, 0.4)),
        Condition("mask_shift", "masks shifted, px", hiding.mask_shift, (4, 8, 16, 32, 64)),
        Condition("masks_missing", "masks missing, share of frames", hiding.masks_missing, (0.1, 0.25, 0.5, 0.75, 1)),
        Condition("no_masks", "no masks, of instruments ever harder to find", hiding.no_masks, (1, 2, 3, 4, 5), True),
        Condition(
            "inverted_masks", "masks inverted, tools' share", hiding.inverted_masks, (0.1, 0.2, 0.3, 0.45, 0.6), True
        ),
        Condition("few_frames", "few frames, number", timing.few_frames, (16, 8, 4, 2, 1)),
        Condition("dropped_frames", "frames lost, share", timing.dropped_frames, (0.1, 0.25, 0.4, 0.55, 0.7)),
        Condition("duplicated_frames", "frames repeated, share", timing.duplicated_frames, (0.1, 0.25, 0.4, 0.55, 0.7)),
        Condition("fast_pull", "fast pull, px a frame", scenes.fast_pull, (10, 20, 40, 60, 80), calm=2),
        Condition("cutting", "cut opens within frames", scenes.cutting, (128, 64, 32, 16, 8), calm=1024),
        Condition(
            "fast_pull_stereo", "fast pull seen by both eyes, px a frame", scenes.fast_pull_stereo,
            (10, 20, 40, 60, 80), True, calm=2,
        ),
        Condition(
            "cutting_stereo", "cut seen by both eyes, within frames", scenes.cutting_stereo, (128, 64, 32, 16, 8), True,
            calm=1024,
        ),
        Condition("moving_camera", "camera swings, poses right, degrees", scenes.moving_camera, (2, 5, 10, 15, 20)),
        Condition("noisy_poses", "camera swings, poses wrong, mm", scenes.noisy_poses, (0.1, 0.25, 0.5, 1, 2)),
        Condition(
            "camera_unknown", "camera turns, poses unknown, degrees", scenes.camera_unknown, (1, 3, 6, 12, 24), True
        ),
        Condition("no_texture", "texture lost, share", scenes.no_texture, (0.5, 0.75, 0.9, 0.97, 1), True),
        Condition("misrectified", "rows of the eyes differ, px", scenes.misrectified, (1, 2, 4, 6, 8), True),
        Condition("wrong_baseline", "baseline wrong, times", scenes.wrong_baseline, (1.02, 1.05, 1.1, 1.25, 1.5), True),
        Condition("tiny", "tiny picture, px wide", scenes.other_size, (144, 128, 112, 96, 64)),
        Condition("large", "large picture, px wide", scenes.other_size, (320, 480, 640, 1280, 1920)),
    )  # fmt: skip
    return {each.name: each for each in table}


CONDITIONS = _conditions()
"""Every condition by its name."""

__all__ = [
    "CLEAN",
    "CLEAN_STEREO",
    "CONDITIONS",
    "SEVERITIES",
    "CleanClip",
    "Condition",
    "Given",
    "Recording",
    "clean_clip",
    "clean_given",
    "write_recording",
]
