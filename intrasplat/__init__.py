"""Differentiable splatting, and dynamic 3D Gaussians of deforming tissue from a stereo endoscope clip, without CUDA.

    import intrasplat as isp

    clip = isp.read_clip("stereo.webm", calibration="calibration.json", masks="masks.zip")
    scene = isp.reconstruct(clip, method="fast", budget_s=60, on_progress=print)
    view = scene.render(t=0.4, pose=isp.orbit(10, 0))  # view.rgb, view.depth_mm, view.confidence
    scene.save("scene")
    scene = isp.load("scene")
    scene.export("scene.ply", t=0.4)
    with isp.follow("rtsp://camera/stereo", calibration="calibration.json") as live:  # docs/live.md
        view = live.view("-2.5", pose=isp.orbit(10, 0))  # of 2.5 s ago

Units are mm, camera axes OpenCV's (x right, y down, z forward); model time t runs from 0 to 1 over the clip. A
module is imported when its name is first used: torch is not loaded before. Research use only, not a medical device.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from intrasplat.camera import Intrinsics
    from intrasplat.clip.types import DepthClip
    from intrasplat.errors import (
        Cancelled,
        InputError,
        IntrasplatError,
        LimitError,
        SceneError,
        TrainingDiverged,
        UnavailableError,
    )
    from intrasplat.live.followed import LiveScene, follow
    from intrasplat.machine.hooks import Progress
    from intrasplat.notices import Notice
    from intrasplat.pose import orbit, parse_pose
    from intrasplat.reconstruction import Scene, load, reconstruct
    from intrasplat.recording import Clip, read_clip
    from intrasplat.report import Report
    from intrasplat.splat.rasterize import Rasterized, rasterize
    from intrasplat.view.frame import View

    __version__: str

_MODULES = {
    "read_clip": "recording",
    "Clip": "recording",
    "DepthClip": "clip.types",
    "reconstruct": "reconstruction",
    "load": "reconstruction",
    "Scene": "reconstruction",
    "follow": "live.followed",
    "LiveScene": "live.followed",
    "View": "view.frame",
    "rasterize": "splat.rasterize",
    "Rasterized": "splat.rasterize",
    "orbit": "pose",
    "parse_pose": "pose",
    "Intrinsics": "camera",
    "Progress": "machine.hooks",
    "Report": "report",
    "Notice": "notices",
    "IntrasplatError": "errors",
    "InputError": "errors",
    "LimitError": "errors",
    "SceneError": "errors",
    "TrainingDiverged": "errors",
    "Cancelled": "errors",
    "UnavailableError": "errors",
}
"""The module of each public name."""

__all__ = [  # in the order in which they are used
    "Cancelled",
    "Clip",
    "DepthClip",
    "InputError",
    "IntrasplatError",
    "Intrinsics",
    "LimitError",
    "LiveScene",
    "Notice",
    "Progress",
    "Rasterized",
    "Report",
    "Scene",
    "SceneError",
    "TrainingDiverged",
    "UnavailableError",
    "View",
    "__version__",
    "follow",
    "load",
    "orbit",
    "parse_pose",
    "rasterize",
    "read_clip",
    "reconstruct",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from intrasplat.version import version

        return version()
    if name not in _MODULES:
        raise AttributeError(f"module 'intrasplat' has no attribute {name!r}")
    value = getattr(import_module(f"intrasplat.{_MODULES[name]}"), name)
    globals()[name] = value  # the next access does not call __getattr__
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
