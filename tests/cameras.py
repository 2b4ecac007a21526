"""The cameras of a scene that is only painted: an endoscope that rests 60 mm before the tissue, of two eyes."""

from __future__ import annotations

from contract.wire.cameras import CamerasRequest, ClipCamera, SceneCameras
from worker.daemon.reply import Reply

FRAMES, RATE_HZ = 40, 20
STILL = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
CAMERAS = SceneCameras(
    intrinsics=ClipCamera(width=60, height=48, fx=60.0, fy=60.0, cx=30.0, cy=24.0),
    frame_times_s=tuple(frame / RATE_HZ for frame in range(FRAMES)),
    world_from_camera=(STILL,) * FRAMES,
    trained_t=tuple(frame / FRAMES for frame in range(FRAMES) if frame % 8),
    units_per_mm=1.0,
    right_eye_mm=(4.0, 0.0, 0.0),
)
FIRST_CAMERAS = CAMERAS.model_copy(
    update={"frame_times_s": (0.0,), "world_from_camera": (STILL,), "trained_t": (0.0,), "right_eye_mm": None}
)
"""Of a first picture: one moment, one eye."""


def cameras_reply(request: CamerasRequest, cameras: SceneCameras = CAMERAS) -> Reply:
    """As a worker tells them."""
    iteration = 0 if request.attempt is None else None
    return Reply(cameras.model_dump_json().encode(), "application/json", 0.0, iteration=iteration)
