"""A run on the GPU goes the way of one on the CPU: prepared, trained, stopped, resumed on the other, kept, shown.

Without a GPU its kernels run in Triton's interpreter, so the clip is tiny and the steps are few.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("triton", reason="Triton is not installed: there is no CUDA backend on this platform")

from contract.wire.options import ReconstructionOptions
from tests.helpers import assert_close
from tests.worker.clips import plane_clip
from tests.worker.phantoms import keep, kept
from worker.input.clip import DepthClip, FrameSplit, split_frames
from worker.methods.registry import PRESETS
from worker.outcome import scene_of
from worker.raster.backend import CPU, Device
from worker.raster.cuda.model import CudaModel
from worker.render.view import render_frame
from worker.train.loop import step
from worker.train.prepare import prepare
from worker.train.run import Run
from worker.train.setup import Setup

WIDTH, HEIGHT, FRAMES, ITERATIONS = 24, 16, 2, 3
SMALL = dataclasses.replace(
    PRESETS["fast"],
    tracks=False,
    points_per_image=40,
    bases=2,
    rates=dataclasses.replace(PRESETS["fast"].rates, eps=1e-5),
)
"""eps is far above rounding, so that gradients that are nothing but rounding do not become whole steps."""


@pytest.fixture(scope="module")
def gpu(device: str) -> Device:
    """The GPU, or where there is none the interpreter of its kernels."""
    return Device("cuda", "GPU", "cuda") if device == "cuda" else Device("cuda", "interpreter", "cpu")


@pytest.fixture(scope="module")
def clip() -> DepthClip:
    """A corner of the plane."""
    whole = plane_clip(FRAMES)
    layers = ("rgb", "tissue", "depth_mm", "depth_confidence")
    cut = {layer: np.ascontiguousarray(getattr(whole, layer)[:, :HEIGHT, -WIDTH:]) for layer in layers}
    intrinsics = dataclasses.replace(whole.intrinsics, width=WIDTH, height=HEIGHT, cx=0.0)
    return dataclasses.replace(whole, intrinsics=intrinsics, **cut)


@pytest.fixture(scope="module")
def split(clip: DepthClip) -> FrameSplit:
    return split_frames(clip, "none")


def prepared(clip: DepthClip, split: FrameSplit, device: Device) -> Run:
    options = ReconstructionOptions(iterations=ITERATIONS)
    run = prepare(Setup(clip, split, SMALL, options, device))
    assert ("compile_s" in run.setup.timings.seconds) == (device != CPU)
    return run


def go_on(run: Run, until: int) -> Run:
    while run.iteration < until:
        run.iteration += 1
        step(run, run.iteration)
    run.model.wait()
    return run


def assert_alike(run: Run, expected: Run) -> None:
    found = {name: each.cpu() for name, each in run.model.arrays().items()}
    for name, each in expected.model.arrays().items():
        assert_close(found[name], each.cpu(), relative=1e-3, name=name)


@pytest.fixture(scope="module")
def runs(clip: DepthClip, split: FrameSplit, gpu: Device) -> dict[Device, Run]:
    """A run on each device after two steps."""
    return {device: go_on(prepared(clip, split, device), 2) for device in (CPU, gpu)}


def test_a_run_on_the_gpu_takes_the_steps_of_one_on_the_cpu(runs: dict[Device, Run], gpu: Device) -> None:
    assert isinstance(runs[gpu].model, CudaModel)
    assert_alike(runs[gpu], runs[CPU])


def test_a_run_that_was_stopped_goes_on_on_the_other_device(
    runs: dict[Device, Run], gpu: Device, clip: DepthClip, split: FrameSplit, tmp_path: Path
) -> None:
    for device, run in runs.items():
        run.average.add(run.model.parameters())
        keep(tmp_path / device.kind, run)
    resumed = {}
    for device, other in ((CPU, gpu), (gpu, CPU)):
        run = resumed[device] = kept(tmp_path / other.kind, prepared(clip, split, device))
        assert run.iteration == 2
        assert_alike(run, runs[CPU])
        go_on(run, ITERATIONS)
        run.average.add(run.model.parameters())
        run.average.put(run.model.parameters())
    assert_alike(resumed[gpu], resumed[CPU])


def test_a_scene_looks_the_same_from_both_devices(
    runs: dict[Device, Run], gpu: Device, clip: DepthClip, split: FrameSplit
) -> None:
    """Also in another size, and to the confidence layer."""
    run = runs[gpu]
    scene = scene_of(run)
    assert float(scene.seen.max()) > 0.3
    for size in ((WIDTH, HEIGHT), (15, 10), (WIDTH, HEIGHT)):
        views = [
            render_frame(scene, 0.3, None, scene.intrinsics.resized(*size), device).confidence for device in (CPU, gpu)
        ]
        assert views[0].shape == (size[1], size[0])
        assert_close(views[1], views[0], relative=1e-3)
    expected, shown = (render_frame(scene, 0.3, device=device) for device in (CPU, gpu))
    assert np.abs(shown.rgb.astype(int) - expected.rgb.astype(int)).max() <= 1
    assert_close(shown.depth_mm, expected.depth_mm, relative=1e-3)
