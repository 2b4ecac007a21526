"""Compile the CPU's kernels and make the clip, while the first parts of check.py use the GPU.

Both take tens of seconds and need no GPU. The clip is a recording in the EndoNeRF layout, or synthetic tissue.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from intrasplat.camera import Intrinsics
from intrasplat.clip import DepthClip, open_clip
from intrasplat.errors import InputError
from intrasplat.splat.cpu import compile_kernels
from lab.gpu.rows import CLIP, CLIP_READY, KERNELS_READY, Part
from lab.phantom import PhantomSettings, make_phantom

ARRAYS = ("rgb", "tissue", "depth_mm", "depth_confidence", "world_from_camera", "frame_times_s")
PHANTOM = PhantomSettings(width=640, height=512, frames=56, motion="breathing", seed=3)
SMALL_PHANTOM = PhantomSettings(width=64, height=48, frames=9, motion="breathing", seed=3)


def main() -> None:
    part = Part.begin("prepare", ())
    works: list[tuple[str, Callable[[], dict[str, object]]]] = [
        (KERNELS_READY, lambda: {"seconds": compile_kernels()}),
        (CLIP_READY, lambda: _clip(part)),
    ]
    if part.clip:
        works.reverse()  # what is wrong with a recording is said at once
    succeeded = [_said(part.work / name, work) for name, work in works]
    sys.exit(0 if all(succeeded) else 1)


def _said(path: Path, work: Callable[[], dict[str, object]]) -> bool:
    """Write what work says, or what it failed with; whether it succeeded."""
    told: dict[str, object]
    try:
        told = work()
    except InputError as error:
        told = {"error": str(error)}
        print(f"gpu-check: {error}", file=sys.stderr, flush=True)
    except Exception as error:
        traceback.print_exc()
        told = {"error": f"{type(error).__name__}: {error}"}
    aside = path.with_suffix(".part")
    aside.write_text(json.dumps(told))
    aside.replace(path)
    return "error" not in told


def _clip(part: Part) -> dict[str, object]:
    start = time.perf_counter()
    if part.clip:
        clip = open_clip(Path(part.clip))
        if not isinstance(clip, DepthClip):
            raise InputError("clip", f"{part.clip} has no depth.", "Name a folder in the EndoNeRF layout.")
        name = Path(part.clip).name
    else:
        settings = SMALL_PHANTOM if part.interpret else PHANTOM
        clip, name = make_phantom(settings).depth_clip(), f"phantom-{settings.motion}"
        clip = _corner(clip, 8) if part.interpret else clip
    save_clip(part.work / CLIP, clip)
    return {"name": name, "seconds": time.perf_counter() - start, "camera": clip.intrinsics.numbers()}


def _corner(clip: DepthClip, size: int) -> DepthClip:
    """The middle of the clip's frames, so few pixels that the interpreter can train on them."""
    camera = clip.intrinsics
    top, left = (camera.height - size) // 2, (camera.width - size) // 2
    area = slice(None), slice(top, top + size), slice(left, left + size)
    pictures = {name: getattr(clip, name)[area] for name in ("rgb", "tissue", "depth_mm", "depth_confidence")}
    small = Intrinsics(width=size, height=size, fx=camera.fx, fy=camera.fy, cx=camera.cx - left, cy=camera.cy - top)
    return dataclasses.replace(clip, intrinsics=small, **pictures)


def save_clip(path: Path, clip: DepthClip) -> None:
    """The clip's arrays; its camera goes with what is said of it."""
    arrays: dict[str, Any] = {name: np.asarray(getattr(clip, name)) for name in ARRAYS}
    np.savez(path, **arrays)


def load_clip(path: Path, camera: dict[str, float]) -> DepthClip:
    """What save_clip wrote."""
    with np.load(path) as stored:
        return DepthClip(**{name: stored[name] for name in ARRAYS}, intrinsics=Intrinsics.parsed(camera))


if __name__ == "__main__":
    main()
