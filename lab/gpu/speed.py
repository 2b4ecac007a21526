"""Part of check.py: the durations of a step and a picture, and of their parts.

The standard scene is that of bm_raster.py: 640x512, a Gaussian every 2.86 pixels each way (40,096), with 17 shared
bases and moving colour, and with the paper's FDM of 17 bases. Durations are medians of the device's own events. Rows
with `clock` host use the host's clock, and contain everything that training waits for. Parts of a step are timed inside
whole steps, whose launches are all queued before the first one starts.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from intrasplat.splat.cpu import padded
from intrasplat.splat.cuda.model import CHECK_EVERY, CudaModel
from intrasplat.splat.deformation import Deformation, GaussianFdm, SharedBasis
from intrasplat.splat.loss import LossSettings
from intrasplat.splat.step import Target, TrainingFrame, camera_vector
from intrasplat.stereo.cuda import match_frames
from lab.benchmarks.bm_raster import BASES, GRID_STEP_PX, HEIGHT, RATES, WIDTH, grid_scene
from lab.gpu.rows import Part, Stamp, device_ms, synchronize, wall_ms
from lab.gpu.scenes import stereo_pairs

FIELDS = ("what", "scene", "frames", "value", "unit", "clock", "note")
SMALL = 8, 8, 4.0
"""Width, height and distance of Gaussians in the interpreter."""
QUEUED_TICKS = 6_000_000
"""The device sleeps so many ticks, about 3 ms, while the host queues the launches of a step."""
CAMERAS, PROFILED = 8, 8
"""Frames to choose from; steps the profiler sees."""
TIME = 0.4


def main() -> None:
    part = Part.begin("speed", FIELDS)
    speed = Speed(part)
    speed.compilation()
    motions = ("shared",) if part.interpret else ("shared", "fdm")
    for frames in (1, 2) if part.interpret else (1, 4, 2):
        for motion in motions:
            if part.has(0 if part.interpret else 10, f"steps of {motion} on {frames} frames"):
                speed.steps(motion, frames)
    if part.has(0 if part.interpret else 15, "pictures"):
        speed.pictures()
    if part.has(0 if part.interpret else 10, "stereo"):
        speed.stereo()


class Speed:
    """The measurements of this part, on the standard scene."""

    def __init__(self, part: Part) -> None:
        self._part, self._device = part, part.device
        self._width, self._height, step_px = SMALL if part.interpret else (WIDTH, HEIGHT, GRID_STEP_PX)
        self.gaussians, camera = grid_scene(self._width, self._height, step_px)
        self.camera = camera_vector(camera)
        self._rounds = 1 if part.interpret else 11
        self._block = 2 if part.interpret else CHECK_EVERY

    def add(self, what: str, value: float, unit: str, *, scene: str = "", frames: int = 1, **more: str) -> None:
        """Keep and print a figure."""
        print(f"  {what}{f', {scene}' if scene else ''}, {frames} frames: {value:.6g} {unit}", flush=True)
        self._part.add(what=what, scene=scene, frames=frames, value=value, unit=unit, **more)

    def model(self, motion: str) -> CudaModel:
        """The standard scene's, at its start."""
        return CudaModel(self.gaussians, self.motion(motion), self._width, self._height, self._device)

    def motion(self, name: str) -> Deformation:
        number = len(self.gaussians)
        if name == "fdm":
            return GaussianFdm.initial(number, bases=BASES)
        return SharedBasis.initial(number, bases=BASES, colour=True)

    def frame(self, t: float) -> TrainingFrame:
        """A frame of noise, so that every pixel has a gradient."""
        random, pixels = np.random.default_rng(int(1000 * t)), self._height * padded(self._width)
        target = Target(
            random.integers(0, 256, 3 * pixels, dtype=np.uint8),
            np.full(pixels, 255, np.uint8),
            np.full(pixels, 1 / 60, np.float32),
        )
        seen = self._width * self._height
        return TrainingFrame(self.camera, t, lambda: target, seen, seen)

    # Compilation

    def compilation(self) -> None:
        """Seconds until a first step and picture, with Triton's cache empty and in a process that finds it full."""
        if self._part.interpret:
            return
        self.add("compilation, cache empty", self.first_step_s(), "s", clock="host")
        self.add("compilation, cache full", _seconds_of_another_process(), "s", clock="host")

    def first_step_s(self) -> float:
        """Seconds of a step, a picture and an image gradient of a new model."""
        model, frame = self.model("shared"), self.frame(TIME)
        synchronize(self._device)
        start = time.perf_counter()
        model.step([frame], LossSettings(), RATES, 1)
        model.render(self.camera, TIME)
        model.image_gradient(self.camera, TIME, np.zeros((5, self._height, self._width), np.float32))
        synchronize(self._device)
        return time.perf_counter() - start

    # Steps

    def steps(self, motion: str, frames: int) -> None:
        """A step as training makes it, replayed as a graph, and launched one by one; its parts; its memory."""
        if self._device == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
        model = self.model(motion)
        place: dict[str, Any] = {"scene": motion, "frames": frames}
        seen = [self.frame(k / CAMERAS) for k in range(CAMERAS)]
        iteration = 0

        def block() -> None:
            nonlocal iteration
            for _ in range(self._block):
                iteration += 1
                chosen = [seen[(iteration + k) % CAMERAS] for k in range(frames)]
                model.step(chosen, LossSettings(), RATES, iteration)
            model.wait()

        block()
        trained_ms = wall_ms(block, self._device, calls=1, rounds=self._rounds) / self._block
        self.add("step, as trained", trained_ms, "ms", clock="host", **place)
        self.add("step, as trained, a frame", trained_ms / frames, "ms", clock="host", **place)
        launches = model._training.launches
        replayed_ms = device_ms(
            lambda: launches.run(("step", 0), lambda: model._launch(0)), self._device, calls=self._block,
            rounds=self._rounds,
        )  # fmt: skip
        self.add("step, graph replayed", replayed_ms, "ms", clock="device", **place)
        if frames == 1:
            alone_ms = wall_ms(lambda: model._launch(0), self._device, calls=self._block, rounds=self._rounds)
            self.add("step, without a graph", alone_ms, "ms", clock="host", **place)
        for name, ms in self._parts(model).items():
            self.add(f"part: {name}", ms, "ms", clock="device", **place)
        if frames == 1 and self._device == "cuda":
            self._kernels(model, place)
        if self._device == "cuda":
            self.add("peak memory", torch.cuda.max_memory_allocated() / 2**20, "MiB", **place)
        needed, capacity = int(model._training.rasterizer.needed), model._training.rasterizer.capacity
        self.add("instances", needed, "pairs", note=f"room for {capacity}", **place)

    def _parts(self, model: CudaModel) -> dict[str, float]:
        """Median ms on the device, by wrapping the model's own methods while it launches."""
        raster, stamps = model._training.rasterizer, []
        watched: list[tuple[Any, str]] = [(model.motion, "deform"), (raster, "project_and_sort"), (raster, "_bin")]
        watched += [(torch, "sort"), (raster, "_blend"), (raster, "_project_backward"), (model.motion, "update")]

        def wrapped(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
            def timed(*arguments: Any, **named: Any) -> Any:
                first = Stamp(self._device)
                result = method(*arguments, **named)
                stamps.append((name, first, Stamp(self._device)))
                return result

            return timed

        originals = [(owner, name, getattr(owner, name)) for owner, name in watched]
        found: dict[str, list[float]] = {}
        try:
            for owner, name, method in originals:
                setattr(owner, name, wrapped(name, method))
            for _ in range(self._rounds):
                stamps.clear()
                if self._device == "cuda":
                    torch.cuda._sleep(QUEUED_TICKS)  # type: ignore[no-untyped-call]
                model._launch(0)
                synchronize(self._device)
                ms: dict[str, float] = {}
                for name, first, last in stamps:
                    ms[name] = ms.get(name, 0.0) + first.ms_until(last)
                for name, value in ms.items():
                    found.setdefault(name, []).append(value)
        finally:
            for owner, name, method in originals:
                if owner is torch:
                    torch.sort = method
                else:
                    delattr(owner, name)
        model._report.zero_()
        return _nested({name: median(values) for name, values in found.items()})

    def _kernels(self, model: CudaModel, place: dict[str, Any]) -> None:
        """What the profiler sees of a step, kernel by kernel; nothing where it does not work."""
        try:
            with profile(activities=[ProfilerActivity.CUDA]) as seen:
                for _ in range(PROFILED):
                    model._launch(0)
                synchronize(self._device)
            found = [each for each in seen.key_averages() if each.self_device_time_total > 0]
        except Exception as error:  # of the profiler's own
            print(f"  the profiler gives nothing here: {type(error).__name__}: {error}", flush=True)
            return
        finally:
            model._report.zero_()
        for each in sorted(found, key=lambda each: -each.self_device_time_total):
            name = f"kernel: {each.key[:60]}"
            launches = f"{each.count / PROFILED:g} launches"
            self.add(name, each.self_device_time_total / PROFILED, "us", clock="device", note=launches, **place)

    # Pictures

    def pictures(self) -> None:
        """Time pictures of the standard scene: one for the host, one on the device, and several at once."""
        model = self.model("shared")
        times = iter(np.random.default_rng(0).uniform(0, 1, 100_000))
        calls = 1 if self._part.interpret else 20
        host_ms = wall_ms(
            lambda: model.render(self.camera, float(next(times))), self._device, calls=calls, rounds=self._rounds
        )
        self.add("picture on the host", 1e3 / host_ms, "a second", scene="shared", clock="host")
        for frames in (1, 2) if self._part.interpret else (1, 4, 16):

            def show(frames: int = frames) -> object:
                return model.render_times(self.camera, [float(next(times)) for _ in range(frames)])

            ms = wall_ms(show, self._device, calls=calls, rounds=self._rounds)
            self.add("pictures, waited for", 1e3 * frames / ms, "a second", scene="shared", frames=frames, clock="host")
            view = model._shown
            assert view is not None
            replayed = device_ms(
                lambda view=view: view.launches.run(("picture", 0, False), lambda: model._draw(view, False)),  # type: ignore[misc]
                self._device, calls=calls, rounds=self._rounds,
            )  # fmt: skip
            self.add(
                "pictures, replayed", 1e3 * frames / replayed, "a second", scene="shared", frames=frames, clock="device"
            )

    # Stereo

    def stereo(self) -> None:
        """Pairs that are matched a second, on the device already."""
        count, width, height = (1, 64, 24) if self._part.interpret else (64, WIDTH, HEIGHT)
        left, right, _, plan = stereo_pairs(count, width, height, self._part.seed)
        one, other = (torch.from_numpy(each).to(self._device) for each in (left, right))
        rounds = 1 if self._part.interpret else 5
        ms = device_ms(lambda: match_frames(one, other, plan), self._device, calls=1, rounds=rounds)
        self.add("stereo pairs", 1e3 * count / ms, "a second", scene=f"{width}x{height}", frames=count, clock="device")


def _seconds_of_another_process() -> float:
    """What compile_again prints there; NaN if it fails."""
    command = [sys.executable, "-c", "from lab.gpu.speed import compile_again; compile_again()", *sys.argv[1:]]
    try:
        found = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
        return float(found.stdout.split()[-1])
    except (subprocess.SubprocessError, ValueError, IndexError) as error:
        print(f"  no seconds of a process that finds the cache full: {error}", flush=True)
        return float("nan")


def compile_again() -> None:
    """Print the seconds of a first step, for a process that finds the cache full."""
    print(Speed(Part.begin("speed", FIELDS)).first_step_s())


def _nested(ms: dict[str, float]) -> dict[str, float]:
    """Subtract nested timings from those that contain them."""
    return {
        "deform": ms["deform"],
        "project": ms["project_and_sort"] - ms["_bin"],
        "sort": ms["sort"],
        "bin": ms["_bin"] - ms["sort"],
        "blend": ms["_blend"],
        "project backward": ms["_project_backward"],
        "update": ms["update"],
    }


if __name__ == "__main__":
    main()
