"""Settings of a phantom. T frames, H W pixels of one eye."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from intrasplat.camera import Intrinsics
from intrasplat.errors import InputError
from intrasplat.intake.calibration.types import RectifiedCalibration

Motion = Literal["still", "breathing", "pull", "cut"]
MOTIONS: tuple[Motion, ...] = get_args(Motion)
CameraPath = Literal["swing", "pan", "advance", "retreat", "roll", "turn", "shake"]
CAMERA_PATHS: tuple[CameraPath, ...] = get_args(CameraPath)
Tool = Literal["grasper", "steel", "yellow", "dark"]
TOOLS: tuple[Tool, ...] = get_args(Tool)
MAX_TOOLS = 3  # each has a port of its own

MEAN_DEPTH_MM = 80.0
FOCAL_PER_WIDTH = 0.89  # a da Vinci endoscope's field of view, about 59 degrees across
MIN_WIDTH_PX, MIN_HEIGHT_PX = 64, 48  # below this vessels and instrument are a pixel wide
MAX_SIDE_PX = 4096  # the tissue's texture is up to six times as wide, and OpenCV's limit is 32767
MAX_ASPECT = 4  # of the longer side to the shorter
MAX_FRAMES = 100_000


@dataclass(frozen=True)
class PhantomSettings:
    """A synthetic clip. The same settings give the same bits on the same machine.

    Attributes:
        width, height: pixels of one eye, at least 64x48.
        frames: length of the clip, T.
        motion: still | breathing (periodic heave and sway) | pull (a grasper lifts a fold, which falls back) |
            cut (the surface splits along a line and opens).
        tools: the instruments in front of the tissue, up to three: grasper (steel, with a dark grey shaft) | steel (its
            shaft, too) | yellow (wrist and collar, with a black shaft) | dark (all of it). The first pulls or cuts in
            those motions; the others come into view and leave it.
        noise: whether frames carry sensor noise; depth, hidden surface and free viewpoints never do.
        camera: the paths that the endoscope follows, all at once (lab/phantom/camera.py); none if it is fixed.
        recorded_path: a TUM file (metres), which the endoscope follows as well, a line a frame, from the first line's
            place on; it rests after the last line.
        period_frames: frames of one breath, of one pull, or of half a cut.

    Raises InputError (field options.<name>) for a setting out of range.
    """

    width: int = 640
    height: int = 512
    frames: int = 64
    motion: Motion = "breathing"
    seed: int = 0
    tools: tuple[Tool, ...] = ("grasper",)
    noise: bool = True
    camera: tuple[CameraPath, ...] = ()
    recorded_path: Path | None = None
    baseline_mm: float = 4.3
    period_frames: float = 36.0
    frame_rate_hz: float = 25.0

    def __post_init__(self) -> None:
        _require_range("width", self.width, MIN_WIDTH_PX, MAX_SIDE_PX)
        _require_range("height", self.height, MIN_HEIGHT_PX, MAX_SIDE_PX)
        _require_range("frames", self.frames, 1, MAX_FRAMES)
        _require_range("seed", self.seed, 0, 2**63 - 1)
        _require_range("baseline_mm", self.baseline_mm, 0.1, 50)
        _require_range("period_frames", self.period_frames, 2, 1e6)
        _require_range("frame_rate_hz", self.frame_rate_hz, 0.1, 1000)
        if max(self.width, self.height) > MAX_ASPECT * min(self.width, self.height):
            raise InputError(
                "options.height",
                f"{self.width}x{self.height} is more than {MAX_ASPECT} times as long as wide.",
                "Give a less extreme shape.",
            )
        for name, values, known in (
            ("motion", (self.motion,), MOTIONS),
            ("tools", self.tools, TOOLS),
            ("camera", self.camera, CAMERA_PATHS),
        ):
            _require_known(name, values, known)
        if len(self.tools) > MAX_TOOLS:
            problem = f"{len(self.tools)} instruments are too many."
            raise InputError("options.tools", problem, f"Give up to {MAX_TOOLS}.")
        if len(set(self.camera)) < len(self.camera):
            problem = f"{' '.join(self.camera)} has a path twice."
            raise InputError("options.camera", problem, "Give each path once.")

    @property
    def moves(self) -> str:
        """How tissue and endoscope move, as the command line spells it: MOTION[+PATH...]."""
        recorded = () if self.recorded_path is None else (self.recorded_path.stem,)
        return "+".join((self.motion, *self.camera, *recorded))

    @property
    def intrinsics(self) -> Intrinsics:
        """The pinhole camera of either eye; the eyes are rectified, so they share it."""
        focal = FOCAL_PER_WIDTH * self.width
        return Intrinsics(
            width=self.width, height=self.height, fx=focal, fy=focal, cx=self.width / 2, cy=self.height / 2
        )

    @property
    def calibration(self) -> RectifiedCalibration:
        """The calibration of both eyes."""
        camera = self.intrinsics
        return RectifiedCalibration(
            model="rectified",
            width=camera.width,
            height=camera.height,
            fx_px=camera.fx,
            fy_px=camera.fy,
            cx_px=camera.cx,
            cy_px=camera.cy,
            baseline_mm=self.baseline_mm,
        )


def _require_known(name: str, values: tuple[str, ...], known: tuple[str, ...]) -> None:
    for value in values:
        if value not in known:
            raise InputError(f"options.{name}", f'"{value}" is unknown.', f"Give one of {', '.join(known)}.")


def _require_range(name: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise InputError(f"options.{name}", f"{value} is out of range.", f"Give {low:g} to {high:g}.")
