"""Part of gpu_check.py: gsplat on the same Gaussians in the same run, where it is installed; else a word and no rows.

Both render the standard scene of bm_raster.py with depth, and carry the same cotangents back to means, quaternions,
scales, opacities and colours. gsplat has no motion and no optimiser in it, so only rasterisation is compared: ours by
torch's autograd too, which is slower than in a training step.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import numpy as np
import torch
from bm_raster import GRID_STEP_PX, HEIGHT, WIDTH, grid_scene
from gpu_rows import Part, wall_ms
from torch import Tensor

from worker.model.gaussians import SH_C0
from worker.raster import Camera
from worker.raster.cuda import rasterize

FIELDS = ("what", "version", "forward_ms", "forward_backward_ms", "gaussians", "note")
Render = Callable[[list[Tensor]], Tensor]


def main() -> None:
    part = Part.begin("rival", FIELDS)
    if part.interpret or importlib.util.find_spec("gsplat") is None:
        print("  gsplat is not installed here: nothing to compare with", flush=True)
        return
    import gsplat

    gaussians, camera = grid_scene(WIDTH, HEIGHT, GRID_STEP_PX)
    colour = (gaussians.sh[:, 0] * SH_C0 + 0.5).clamp(min=0)
    given = [gaussians.mean, gaussians.quaternion, gaussians.log_scale.exp(), torch.sigmoid(gaussians.opacity_logit)]
    leaves = [each.cuda().requires_grad_() for each in (*given, colour)]
    for name, version, render in (
        ("gsplat", gsplat.__version__, _gsplat(gsplat, camera)),
        ("ours", "", lambda arguments: _ours(arguments, camera)),
    ):
        cotangent = torch.randn_like(render(leaves))

        def both(render: Render = render, cotangent: Tensor = cotangent) -> None:
            torch.autograd.grad((render(leaves) * cotangent).sum(), leaves)

        with torch.no_grad():
            forward_ms = wall_ms(lambda render=render: render(leaves), "cuda", calls=20, rounds=11)  # type: ignore[misc]
        both_ms = wall_ms(both, "cuda", calls=20, rounds=11)
        print(f"  {name} {version}: forward {forward_ms:.3f} ms, with gradients {both_ms:.3f} ms", flush=True)
        part.add(
            what=name, version=version, forward_ms=forward_ms, forward_backward_ms=both_ms, gaussians=len(gaussians)
        )


def _ours(arguments: list[Tensor], camera: Camera) -> Tensor:
    mean, quaternion, scale, opacity, colour = arguments
    seen = rasterize(mean, quaternion, scale, opacity, colour, camera)
    return torch.cat([seen.rgb, seen.depth[..., None]], dim=-1)


def _gsplat(module: object, camera: Camera) -> Render:
    """gsplat.rasterization, version 1.5: colour and the sum of w z."""
    intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]).float().cuda()
    view = torch.from_numpy(np.asarray(camera.camera_from_world)).float().cuda()

    def render(arguments: list[Tensor]) -> Tensor:
        image, _, _ = module.rasterization(  # type: ignore[attr-defined]
            *arguments, view[None], intrinsics[None], camera.width, camera.height, render_mode="RGB+D", packed=False
        )
        result: Tensor = image[0]
        return result

    return render


if __name__ == "__main__":
    main()
