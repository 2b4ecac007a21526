"""Is a view that enlarges the recording, or makes it smaller, as good as its pixels allow?

    python -m lab.benchmarks.bm_magnify SCENE [SCENE ...] [--phantom MOTION] [--scales 0.25 0.5 1 2 4]

For each scene's folder and scale, over views of the endoscope and beside it: `again` is the PSNR of the render of that
size, resized to the recording's by area averages (or by cubic interpolation, from below), against the render of the
recording's size; `levels` its mean brightness less that one's; unseen and confidence are the layers' means; ms the
milliseconds of the picture and of its layer confidence. With --phantom, the scenes are of `intrasplat phantom --motion
MOTION` of any size with its other settings as they are: `truth` is the PSNR against the phantom's own picture of that
size, of views no more than 10 degrees away.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.pose import OrbitPose, world_from_camera
from intrasplat.scene.checkpoint import load_scene
from intrasplat.scene.scene import TrainedScene
from intrasplat.train.targets import MEDIAN_DEPTH_UNITS
from intrasplat.view.render import Frame, render_frame
from lab.phantom.scene import Phantom, make_phantom
from lab.phantom.settings import MOTIONS, PhantomSettings

T = 0.5
ORBITS: tuple[tuple[float, float, float] | None, ...] = (None, (10, 0, 1), (-8, 6, 1), (0, 0, 2), (10, -5, 3))
"""Yaw and pitch in degrees, zoom; None: the endoscope itself."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--phantom", choices=MOTIONS)
    parser.add_argument("--scales", type=float, nargs="+", default=(0.25, 0.5, 1.0, 2.0, 4.0))
    options = parser.parse_args()
    for folder in options.scenes:
        scene = load_scene(folder)
        k = scene.intrinsics
        phantom = None
        if options.phantom:
            settings = PhantomSettings(k.width, k.height, scene.frame_count, options.phantom, noise=False)
            phantom = make_phantom(settings)
        print(f"{folder}: {k.width} x {k.height}, {len(scene.gaussians)} Gaussians")
        for orbit in ORBITS:
            print(f"  {'endoscope' if orbit is None else 'orbit:{:g},{:g},{:g}'.format(*orbit)}")
            own = _frame(scene, orbit, k)[0]
            for scale in options.scales:
                camera = k.resized(round(k.width * scale), round(k.height * scale))
                truth = _truth(phantom, scene, orbit, camera)
                print(f"    x{scale:g}: {_line(own, *_frame(scene, orbit, camera), truth)}", flush=True)


def _frame(
    scene: TrainedScene, orbit: tuple[float, float, float] | None, camera: Intrinsics
) -> tuple[Frame, float, float]:
    """The view, and the milliseconds of the picture and of its confidence; the second time, with buffers made."""
    pose = _pose(scene, orbit)
    render_frame(scene, T, pose, camera)
    start = time.process_time()
    frame = render_frame(scene, T, pose, camera)
    drawn = time.process_time()
    assert frame.confidence.shape == frame.depth_mm.shape
    return frame, (drawn - start) * 1e3, (time.process_time() - drawn) * 1e3


def _pose(scene: TrainedScene, orbit: tuple[float, float, float] | None) -> NDArray[np.float64] | None:
    if orbit is None:
        return None
    asked = OrbitPose(yaw_deg=orbit[0], pitch_deg=orbit[1], zoom=orbit[2])
    return np.array(world_from_camera(asked, MEDIAN_DEPTH_UNITS / scene.units_per_mm), np.float64)


def _truth(
    phantom: Phantom | None, scene: TrainedScene, orbit: tuple[float, float, float] | None, camera: Intrinsics
) -> NDArray[np.float32] | None:
    if phantom is None:
        return None
    return phantom.render(T * scene.frame_count, _pose(scene, orbit), camera)[0]


def _line(own: Frame, frame: Frame, picture_ms: float, layer_ms: float, truth: NDArray[np.float32] | None) -> str:
    size = own.depth_mm.shape[::-1]
    smaller = frame.rgb.shape[0] < own.rgb.shape[0]
    again = cv2.resize(frame.rgb.astype(np.float32), size, interpolation=cv2.INTER_CUBIC if smaller else cv2.INTER_AREA)
    parts = [
        f"again {_psnr_db(again, own.rgb):5.2f} dB, {float(again.mean() - own.rgb.mean()):+.2f} levels",
        f"unseen {frame.unseen_share:.4f}, confidence {float(frame.confidence.mean()):.3f}",
        f"{picture_ms:.0f} + {layer_ms:.0f} ms",
        " ".join(each.code.value for each in frame.warnings),
    ]
    if truth is not None:
        seen = (truth.sum(-1) > 0) & ~frame.unseen
        parts.insert(0, f"truth {_psnr_db(frame.rgb[seen].astype(np.float32), truth[seen] * 255):5.2f} dB")
    return "; ".join(parts)


def _psnr_db(first: NDArray[np.floating], second: NDArray[np.generic]) -> float:
    return float(10 * np.log10(255**2 / max(np.square(first - second.astype(np.float64)).mean(), 1e-9)))


if __name__ == "__main__":
    main()
