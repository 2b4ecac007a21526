"""Part of check.py: are the kernels right? Fresh random inputs, poisoned buffers, every kernel.

Values and gradients of the rasteriser are compared with the reference in float64, training steps with every form of
motion with the CPU's. Like the tests, the checks skip pixels where a Gaussian is so near a cut that rounding decides.
`worst` is the largest difference over the largest value; for steps, the norm of the difference over the norm of the
change; for bits, the share that differ.
"""

from __future__ import annotations

import dataclasses
import sys
import time
import traceback
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from intrasplat.splat import reference
from intrasplat.splat.cpu.model import CpuModel
from intrasplat.splat.cuda import rasterize
from intrasplat.splat.cuda.model import CudaModel
from intrasplat.splat.cuda.rasterizer import CudaRasterizer
from intrasplat.splat.deformation import Deformation, SharedBasis
from intrasplat.splat.gaussians import Gaussians
from intrasplat.splat.optimize import StepRates
from intrasplat.splat.step import TrainingFrame, camera_vector
from intrasplat.stereo.cuda import match_frames
from lab.benchmarks.bm_raster import BASES, GRID_STEP_PX, HEIGHT, WIDTH, grid_scene
from lab.gpu.rows import KERNELS_READY, Part
from lab.gpu.scenes import LOSS, Noise, poison, stereo_pairs, stirred_motion
from tests.intrasplat.splat.interpreter import hasten
from tests.intrasplat.splat.scenes import SplatScene, pixels_near_a_cut, random_scene

FIELDS = ("check", "worst", "limit", "ok", "seconds", "detail")
LIMIT = 1e-3
"""Maximum relative error of a correct kernel; tests limit small cases to 1e-4."""
EIGHT_BITS = 1 / 255
RATES = StepRates(2e-3, 3e-3, 4e-3, 5e-3, 6e-3, 8e-3, 1e-3, 7e-3, 7e-3, 7e-3, 7e-3, 7e-3, 1e-8)
"""eps is far above rounding, so that gradients that are nothing but rounding do not become whole steps."""
Differences = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of the checks: Gaussians and pixels of the reference's scenes and of the models, steps of training; pixels
    of stereo pairs, and their maximum error in px."""

    count: int
    width: int
    height: int
    model_count: int
    model_width: int
    model_height: int
    steps: int
    stereo_width: int
    stereo_height: int
    stereo_px: float


REAL = Sizes(1500, 96, 80, 4000, 160, 128, 70, 640, 512, 0.1)
SMALL = Sizes(16, 9, 7, 12, 9, 8, 2, 48, 16, 0.25)
"""Sizes for Triton's interpreter; the width ends within a tile."""


def main() -> None:
    part = Part.begin("correct", FIELDS)
    if part.interpret:
        hasten(setattr)
    checks = Checks(part, SMALL if part.interpret else REAL)
    kinds = ("shared", "fdm-gaussian") if part.interpret else ("shared", "pfs", "fdm-gaussian", "fdm-quartic")
    failed = [
        checks.make("values and gradients, open scene", LIMIT, lambda: checks.autograd(2.0, (0.05, 0.4, 0.999))),
        checks.make("values and gradients, opaque scene", LIMIT, lambda: checks.autograd(9.0, (0.9,))),
        checks.make("the built-in loss", LIMIT, checks.loss),
        checks.make("deformation", LIMIT, lambda: checks.deformed(kinds)),
        checks.make("the same steps give the same bits", 0.0, checks.same_bits),
        checks.make("with little room as with ample room", 0.0, checks.little_room),
        checks.make("disparity of textured planes, px", checks.sizes.stereo_px, checks.stereo),
    ]
    part.wait_for(KERNELS_READY)
    for kind in kinds:
        name = f"steps of {kind} beside the CPU's"
        failed.append(checks.make(name, LIMIT, lambda kind=kind: checks.steps(kind)))  # type: ignore[misc]
    if not part.interpret:
        failed.append(checks.make("steps with harmonics beside the CPU's", LIMIT, lambda: checks.steps("shared", 3)))
        failed.append(checks.make("at full size beside the CPU's", LIMIT, checks.full_size))
    failed.append(checks.make("trained here, rendered on the CPU, of white", EIGHT_BITS, checks.trained))
    print(f"  {failed.count(False)} of {len(failed)} checks passed", flush=True)
    sys.exit(1 if any(failed) else 0)


class Checks:
    """The checks; each returns the worst difference of everything it compares, by name."""

    def __init__(self, part: Part, sizes: Sizes) -> None:
        self._part, self.sizes, self._device = part, sizes, part.device
        self._made = 0

    def make(self, name: str, limit: float, check: Callable[[], Differences]) -> bool:
        """Run one check and write its row. Returns whether it failed; an exception is a failure too."""
        start = time.perf_counter()
        try:
            found = check()
            worst = max(found.values(), key=lambda value: value if value == value else np.inf)
            detail = "  ".join(f"{each} {value:.1e}" for each, value in found.items())
            ok = bool(worst <= limit)  # not of NaN
        except Exception as error:
            traceback.print_exc()
            worst, ok, detail = np.nan, False, f"{type(error).__name__}: {error}"[:300]
        took_s = time.perf_counter() - start
        print(
            f"  {'ok   ' if ok else 'WRONG'} {name}: worst {worst:.1e}, limit {limit:.1e} ({took_s:.1f} s)", flush=True
        )
        self._part.add(check=name, worst=worst, limit=limit, ok=ok, seconds=round(took_s, 2), detail=detail)
        return not ok

    def _random(self) -> int:
        """Another seed each time, derived from the run's seed."""
        self._made += 1
        return self._part.seed + self._made

    # The rasteriser

    def _scene(self, pixels: float = 2.0, opacities: tuple[float, ...] = (0.05, 0.4, 0.999)) -> SplatScene:
        size = self.sizes
        made = random_scene(
            size.count, width=size.width, height=size.height, seed=self._random(), pixels=pixels, opacities=opacities
        )
        return made.to(torch.float32)

    def autograd(self, pixels: float, opacities: tuple[float, ...]) -> Differences:
        """rasterize and its gradients under random cotangents."""
        scene = self._scene(pixels, opacities)
        left_out = pixels_near_a_cut(scene)
        random = np.random.default_rng(self._random())
        cotangents = [random.normal(size=(*left_out.shape, *last)) for last in ((3,), (), ())]
        for each in cotangents:
            each[left_out] = 0.0
        wanted = _rendered(scene.to(torch.float64), reference.rasterize, cotangents, "cpu")
        got = _rendered(scene, rasterize, cotangents, self._device)
        keep = torch.from_numpy(~left_out)
        for name in ("rgb", "depth", "alpha"):
            wanted[name], got[name] = wanted[name][keep], got[name][keep]
        return {name: _relative(got[name], wanted[name]) for name in wanted}

    def loss(self) -> Differences:
        """Image, statistics and gradients of the loss, of two frames at once, in buffers that were poisoned."""
        scenes = [self._scene(), self._scene()]
        scenes[1] = dataclasses.replace(scenes[1], opacity=scenes[0].opacity)
        frames = [Noise(scene, self._random()) for scene in scenes]
        moved = [_arguments(scenes, self._device)]
        rasterizer = CudaRasterizer(self.sizes.width, self.sizes.height, self._device, frames=2)
        rasterizer.project_and_sort(*moved[0])
        poison(rasterizer)
        rasterizer.project_and_sort(*moved[0])
        pictures = zip(*(frame.on_device for frame in frames), strict=True)
        rgb, weight, inverse_depth = (torch.stack(each).to(self._device) for each in pictures)
        settings = torch.stack([frame.settings for frame in frames]).to(self._device)
        rows = torch.arange(2, dtype=torch.int32, device=self._device)
        found = rasterizer.loss_backward(rgb, weight, inverse_depth, settings, rows)
        worst: Differences = {}
        for f, (scene, frame) in enumerate(zip(scenes, frames, strict=True)):
            wanted = frame.gradients(scene)
            got = {
                "mean": found.state[f, 0:3].T, "quaternion": found.state[f, 3:7].T, "log-scale": found.state[f, 7:10].T,
                "opacity": found.opacity_logit[f], "colour": found.colour[f].T,
            }  # fmt: skip
            for name, each in got.items():
                worst[name] = max(worst.get(name, 0.0), _relative(each, wanted[name]))
        return worst

    # The model

    def _model(self, kind: str, sh_degree: int = 0) -> CudaModel:
        made = self._parts(kind, sh_degree)
        return CudaModel(*made, self.sizes.model_width, self.sizes.model_height, self._device)

    def _parts(self, kind: str, sh_degree: int = 0) -> tuple[Gaussians, Deformation]:
        """The same for the same run, and another in the next."""
        size, random = self.sizes, torch.Generator().manual_seed(self._part.seed)
        count = size.model_count
        scene = random_scene(
            count, width=size.model_width, height=size.model_height, seed=self._part.seed, opacities=(0.05, 0.4, 0.95)
        )
        sh = 0.1 * torch.randn(count, (sh_degree + 1) ** 2, 3, generator=random)
        sh[:, 0] += 0.8
        gaussians = Gaussians(
            scene.mean.float(), scene.quaternion.float(), scene.scale.log().float(),
            torch.logit(scene.opacity).float(), sh,
        )  # fmt: skip
        return gaussians, stirred_motion(kind, count, random)

    def _frames(self, count: int) -> list[TrainingFrame]:
        size = self.sizes
        scene = random_scene(1, width=size.model_width, height=size.model_height)
        return [
            Noise(scene, self._part.seed + k).frame(0.2 + 0.6 * k / count, camera_vector(scene.camera))
            for k in range(count)
        ]

    def deformed(self, kinds: Sequence[str]) -> Differences:
        """Compare deformed Gaussians with float64."""
        worst = {}
        for kind in kinds:
            gaussians, deformation = self._parts(kind)
            model = self._model(kind)
            exact = dataclasses.replace(gaussians, mean=gaussians.mean.double())
            wanted = deformation.deform(exact, 0.37).mean
            got = torch.from_numpy(model.deformed_mean(0.37)).T
            worst[kind] = _relative(got - gaussians.mean, wanted - exact.mean)
        return worst

    def _train(self, model: CudaModel | CpuModel, steps: int, sh_degree: int = 0) -> None:
        frames = self._frames(4)
        for iteration in range(1, 1 + steps):
            if isinstance(model, CudaModel) and 1 < iteration < 4:  # while the launches are captured, and replayed
                model.wait()
                poison(model._training.rasterizer)
            degree = min(sh_degree, iteration)
            model.step([frames[iteration % len(frames)]], LOSS, RATES, iteration, degree)
        model.wait()

    def steps(self, kind: str, sh_degree: int = 0) -> Differences:
        """Compare the changes of every parameter in a few steps, the last on two frames, with the CPU's."""
        size = self.sizes
        cpu = CpuModel(*self._parts(kind, sh_degree), size.model_width, size.model_height)
        cuda = self._model(kind, sh_degree)
        before = {name: each.clone() for name, each in cpu.parameters().items()}
        for model in (cpu, cuda):
            self._train(model, 4, sh_degree)
            model.step(self._frames(2), LOSS, RATES, 5, sh_degree)
        got, wanted = cuda.parameters(), cpu.parameters()
        return {
            name: _moved(got[name].cpu() - start, wanted[name] - start)
            for name, start in before.items()
            if start.numel()
        }

    def full_size(self, width: int = WIDTH, height: int = HEIGHT, frames: int = 16) -> Differences:
        """Check steps and pictures of the timed scene: the largest sizes, several frames at once."""
        gaussians, camera = grid_scene(width, height, GRID_STEP_PX)
        view, shared = camera_vector(camera), SharedBasis.initial(len(gaussians), bases=BASES, colour=True)
        noise = Noise(random_scene(1, width=width, height=height), self._random())
        seen = [noise.frame(t, view) for t in (0.2, 0.25, 0.3)]
        cpu = CpuModel(gaussians, shared, width, height)
        cuda = CudaModel(gaussians, shared, width, height, self._device)
        before = {name: each.clone() for name, each in cpu.parameters().items()}
        for model in (cpu, cuda):
            for iteration, frame in enumerate(seen, start=1):
                model.step([frame], LOSS, dataclasses.replace(RATES, eps=1e-6), iteration)
        got, wanted = cuda.parameters(), cpu.parameters()
        worst = {
            name: _moved(got[name].cpu() - start, wanted[name] - start)
            for name, start in before.items()
            if start.numel()
        }
        images = cuda.render_times(view, [0.2 + 0.1 * k / frames for k in range(frames)]).cpu()
        last = torch.from_numpy(cpu.render(view, 0.2 + 0.1 * (frames - 1) / frames).copy())
        return worst | {"picture": _moved(images[-1], last)}

    def same_bits(self) -> Differences:
        """Two models after the same steps, some of them replayed as a graph."""
        first, second = self._model("shared"), self._model("shared")
        for model in (first, second):
            self._train(model, self.sizes.steps)
        return _different(first, second)

    def little_room(self) -> Differences:
        """Compare a model whose buffers are too small for the first step with one whose buffers are large enough."""
        ample, tight = self._model("shared"), self._model("shared")
        tight._training.rasterizer.reserve(tight._training.state.shape[2], 8)
        for model in (ample, tight):
            self._train(model, 3)
        if tight._training.rasterizer.capacity <= 8:
            raise ValueError("the buffers never had to grow")
        return _different(ample, tight)

    def stereo(self) -> Differences:
        """Compare disparities with the planes' own, and count those that differ when the pairs are matched again."""
        size = self.sizes
        left, right, disparity, plan = stereo_pairs(2, size.stereo_width, size.stereo_height, self._random())
        one, other = (torch.from_numpy(each).to(self._device) for each in (left, right))
        found, confidence = match_frames(one, other, plan)
        again = found if self._part.interpret else match_frames(one, other, plan)[0]  # nothing there happens at once
        error = np.abs(found.cpu().numpy() - disparity)
        seen = (confidence.cpu().numpy() > 0) & (np.arange(size.stereo_width) > disparity)
        if seen.mean() < 0.5:
            raise ValueError(f"only {seen.mean():.0%} of the pixels have a disparity")
        return {"median error": float(np.median(error[seen])), "differ": float((found != again).double().mean())}

    def trained(self) -> Differences:
        """Pictures of a model that was trained here, on the CPU and here, alone and several at once."""
        size, model = self.sizes, self._model("shared")
        self._train(model, size.steps)
        cpu = CpuModel(*model.export(), size.model_width, size.model_height)
        camera = camera_vector(random_scene(1, width=size.model_width, height=size.model_height).camera)
        times = [0.25, 0.7]
        at_once = model.render_times(camera, times).cpu().numpy().copy()
        worst = {"alone": 0.0, "at once": 0.0}
        for k, t in enumerate(times):
            wanted = np.clip(cpu.render(camera, t)[:3], 0, 1)
            alone = np.clip(model.render(camera, t)[:3], 0, 1)
            worst["alone"] = max(worst["alone"], float(np.abs(alone - wanted).max()))
            worst["at once"] = max(worst["at once"], float(np.abs(np.clip(at_once[k, :3], 0, 1) - wanted).max()))
        return worst


def _rendered(
    scene: SplatScene, render: Callable[..., object], cotangents: Sequence[NDArray[np.float64]], device: str
) -> dict[str, Tensor]:
    """Layers and gradients, on the host."""
    live = scene.differentiable()
    moved = [each.to(device) for each in live.tensors()]
    seen = render(*moved, live.camera)
    layers = {name: getattr(seen, name) for name in ("rgb", "depth", "alpha")}
    weighted = [
        (layer * torch.from_numpy(cotangent).to(layer)).sum()
        for layer, cotangent in zip(layers.values(), cotangents, strict=True)
    ]
    leaves = live.leaves()
    gradients = torch.autograd.grad(sum(weighted), list(leaves.values()))
    found = {name: layer.detach() for name, layer in layers.items()}
    found |= {f"d {name}": each for name, each in zip(leaves, gradients, strict=True)}
    return {name: each.cpu().double() for name, each in found.items()}


def _arguments(scenes: Sequence[SplatScene], device: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """camera, state, opacity_logit, colour of a rasteriser with a frame a scene; opacities are the first one's."""
    cameras = torch.from_numpy(np.stack([camera_vector(each.camera) for each in scenes]))
    states = torch.stack([torch.cat([each.mean, each.quaternion, each.scale.log()], 1).T for each in scenes]).float()
    colours = torch.stack([each.colour.T for each in scenes]).float()
    logit = torch.logit(scenes[0].opacity).float()
    camera, state, logit, colour = (each.contiguous().to(device) for each in (cameras, states, logit, colours))
    return camera, state, logit, colour


def _relative(got: Tensor, wanted: Tensor) -> float:
    """Largest difference over the largest value; infinite where something is not finite."""
    got, wanted = got.detach().cpu().double(), wanted.detach().cpu().double()
    if got.shape != wanted.shape or not bool(torch.isfinite(got).all()):
        return float("inf")
    if got.numel() == 0:
        return 0.0
    return float((got - wanted).abs().max() / wanted.abs().max().clamp(min=1e-30))


def _moved(got: Tensor, wanted: Tensor) -> float:
    """Norm of the difference of what steps changed over the norm of the change; of a parameter that moved.

    Not the largest difference: where a Gaussian ends at a pixel, rounding decides, and Adam makes any gradient large.
    """
    got, wanted = got.double(), wanted.double()
    if not bool(wanted.any()):
        raise ValueError("a parameter did not move")
    return float((got - wanted).norm() / wanted.norm())


def _different(first: CudaModel, second: CudaModel) -> Differences:
    """Share of the numbers, by array, that differ in a bit or are not finite."""
    others = second.arrays()
    return {
        name: float(((each != others[name]) | ~torch.isfinite(each)).double().mean()) if each.numel() else 0.0
        for name, each in first.arrays().items()
    }


if __name__ == "__main__":
    main()
