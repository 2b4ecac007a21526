"""Other scenes: faster pulls, cuts, a moving camera, tissue without texture, other sizes; and wrong stereo geometry.

Each function uses the clean clip's settings, changed by `level`; lengths in pixels refer to a picture 640 wide unless
stated otherwise.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.conditions.clean import CleanClip, Given, clean_clip, clean_of, given
from lab.conditions.recording import recording_of
from lab.phantom import Phantom, PhantomFrame, PhantomSettings, make_phantom, orbit_pose
from lab.phantom.camera import PORT_BEHIND_MM
from lab.phantom.motion import Pull
from lab.phantom.settings import MEAN_DEPTH_MM
from lab.phantom.surface import Surface

PULL_FRAMES = 24.0  # from one pull to the next
POSE_SWING_DEG = 5.0  # swing of the camera with noisy poses


@dataclass(frozen=True)
class SwingingPhantom(Phantom):
    """A phantom whose endoscope swings about the tissue once in the clip, by swing_deg to either side."""

    swing_deg: float

    def world_from_camera(self, frame: float) -> NDArray[np.float64]:
        """Pose [4, 4] of the left eye, mm; the identity at frame 0."""
        angle = 2 * np.pi * frame / self.settings.frames
        return orbit_pose(self.swing_deg * np.sin(angle), 0.5 * self.swing_deg * np.sin(2 * angle))


@dataclass(frozen=True)
class TurningPhantom(Phantom):
    """A phantom whose endoscope turns to the right about its port, by turn_deg from the first frame to the last."""

    turn_deg: float

    def world_from_camera(self, frame: float) -> NDArray[np.float64]:
        """Pose [4, 4] of the left eye, mm; the identity at frame 0."""
        share = frame / max(self.settings.frames - 1, 1)
        angle = np.deg2rad(self.turn_deg) * (3 - 2 * share) * share**2
        pose = np.eye(4)
        pose[:3, :3], _ = cv2.Rodrigues(np.array([0.0, angle, 0.0]))
        pose[:3, 3] = PORT_BEHIND_MM * (pose[:3, 2] - [0.0, 0.0, 1.0])
        return pose


@dataclass(frozen=True)
class ScaledPull(Pull):
    """A pull over `gain` times the distance."""

    gain: float

    def strength(self, frame: float) -> float:
        """Progress of the pull: 0 at rest, `gain` when held."""
        return self.gain * super().strength(frame)


def fast_pull(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """A grasper pulls a fold and lets it go; its fastest point moves about `level` px from one frame to the next."""
    del random
    return given(clean_of(_fast_pull(clean, level)))


def fast_pull_stereo(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files of the same."""
    del random
    pulled = clean_of(_fast_pull(clean, level))
    return given(pulled, recording_of(pulled.phantom))


def cutting(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """The surface splits and opens to 13 mm within `level` frames."""
    del random
    return given(clean_clip(_cut(clean, level)))


def cutting_stereo(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files of the same."""
    del random
    cut = clean_clip(_cut(clean, level))
    return given(cut, recording_of(cut.phantom))


def _fast_pull(clean: CleanClip, level: float) -> Phantom:
    phantom = make_phantom(dataclasses.replace(clean.phantom.settings, motion="pull", period_frames=PULL_FRAMES))
    whole = dataclasses.replace(phantom, surface=_pulled(phantom.surface, 1.0))
    gain = level * clean.px / max(_fastest_px(whole), 1e-9)
    return dataclasses.replace(phantom, surface=_pulled(phantom.surface, gain))


def _cut(clean: CleanClip, level: float) -> PhantomSettings:
    return dataclasses.replace(clean.phantom.settings, motion="cut", period_frames=level / 2)


def moving_camera(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """The endoscope swings once by `level` degrees to either side; its poses are correct."""
    del random
    return given(clean_of(_swinging(clean.phantom, level)))


def camera_unknown(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files of an endoscope that rotates about its port by `level` degrees in the clip, without poses."""
    del random
    # a pan has tissue as far as the widest turn looks
    phantom = make_phantom(dataclasses.replace(clean.phantom.settings, camera=("pan",)))
    turning = clean_of(TurningPhantom(phantom.settings, phantom.surface, phantom.paint, level))
    return dataclasses.replace(given(turning, recording_of(turning.phantom)), path=turning.clip.world_from_camera)


def noisy_poses(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """The endoscope swings by 5 degrees; poses err by `level` mm (one sigma per axis), and their angles by as much
    again at the tissue. Frame 0, which defines the world, is right.
    """
    swinging = clean_of(_swinging(clean.phantom, POSE_SWING_DEG))
    poses = noisy(swinging.clip.world_from_camera, level, random)
    return given(swinging, dataclasses.replace(swinging.clip, world_from_camera=poses))


def noisy(world_from_camera: NDArray[np.float64], level_mm: float, random: np.random.Generator) -> NDArray[np.float64]:
    """Poses [T, 4, 4], each but the first off by level_mm (one sigma per axis), and as much at the tissue by angle."""
    poses = world_from_camera.copy()
    for pose in poses[1:]:
        rotation, _ = cv2.Rodrigues(random.normal(0, level_mm / MEAN_DEPTH_MM, 3))
        pose[:3, :3] = rotation @ pose[:3, :3]
        pose[:3, 3] += random.normal(0, level_mm, 3)
    return poses


def no_texture(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files of tissue that has lost `level` of its contrast in colour and of its wet film's relief."""
    del random
    paint = clean.phantom.paint
    albedo = (1 - level) * paint.albedo + level * paint.albedo.mean(axis=(0, 1))
    film = paint.film * np.array([1 - level, 1 - level, 1.0])
    bare = dataclasses.replace(paint, albedo=albedo.astype(np.float32), film=film.astype(np.float32))
    plain = clean_of(dataclasses.replace(clean.phantom, paint=bare))
    return given(plain, recording_of(plain.phantom))


def other_size(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """The same tissue in pictures `level` pixels wide, 5:4, or 16:9 from 1280 on."""
    del random
    width = round(level)
    height = width * 9 // 16 if width >= 1280 else width * 4 // 5
    return given(clean_clip(dataclasses.replace(clean.phantom.settings, width=width, height=height)))


def misrectified(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files whose right eye lies `level` px of the clip itself too low."""
    del random
    matrix = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, level]])

    def spoil(frame: PhantomFrame, index: int) -> PhantomFrame:
        del index
        size = (frame.right.shape[1], frame.right.shape[0])
        low = cv2.warpAffine(frame.right, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return dataclasses.replace(frame, right=np.asarray(low, dtype=np.uint8))

    return given(clean, recording_of(clean.phantom, spoil))


def wrong_baseline(clean: CleanClip, level: float, random: np.random.Generator) -> Given:
    """Stereo files whose calibration states `level` times their true baseline."""
    del random
    return given(clean, recording_of(clean.phantom, baseline_mm=level * clean.phantom.settings.baseline_mm))


def _swinging(phantom: Phantom, swing_deg: float) -> SwingingPhantom:
    return SwingingPhantom(phantom.settings, phantom.surface, phantom.paint, swing_deg)


def _pulled(surface: Surface, gain: float) -> Surface:
    return dataclasses.replace(surface, motion=ScaledPull(PULL_FRAMES, gain))


def _fastest_px(phantom: Phantom) -> float:
    """The longest step in px of any tissue point from one frame to the next; the camera is at rest."""
    points_mm = phantom.trajectories().points_mm
    places_px = phantom.settings.intrinsics.fx * points_mm[..., :2] / points_mm[..., 2:]
    return float(np.linalg.norm(np.diff(places_px, axis=0), axis=-1).max(initial=0.0))
