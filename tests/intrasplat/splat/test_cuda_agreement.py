"""A device is asked whether it splats rightly before it is used."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not installed")

from intrasplat.errors import UnavailableError
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.pipeline import open_with_poses
from intrasplat.splat.backend import Device, examine
from intrasplat.splat.camera import Rendered
from intrasplat.splat.cuda import agreement, rasterize
from intrasplat.train.request import ReconstructionRequest
from lab.phantom import PhantomSettings, make_phantom, write_stereomis


def test_the_device_agrees_with_the_reference(device: str) -> None:
    worst, _ = agreement.disagreement(torch.device(device))
    assert worst < 1e-4
    agreement.check(device, "a GPU")


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_the_device_is_checked_in_a_caller_without_gradients(
    mode: Callable[[], AbstractContextManager[None]], device: str
) -> None:
    with mode():
        agreement.check(device, f"a GPU in {mode.__name__}")


def render_brighter(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    """Have the device splat wrongly from here to the test's end."""

    def wrong(*arguments: object) -> Rendered:
        found = rasterize(*arguments)  # type: ignore[arg-type]
        return Rendered(found.rgb * factor, found.depth, found.alpha)

    monkeypatch.setattr(agreement, "rasterize", wrong)


@pytest.mark.parametrize("factor", [1.05, float("nan")])
def test_one_that_does_not_is_refused_by_its_name_with_a_remedy(
    factor: float, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    render_brighter(monkeypatch, factor)
    with pytest.raises(
        UnavailableError, match=r"GPU 9000 .* is not to be trusted: its .* of a test scene is"
    ) as raised:
        agreement.check(device, f"GPU 9000 {factor}")
    assert "INTRASPLAT_DEVICE=cpu" in raised.value.remedy


@pytest.mark.parametrize("error", [RuntimeError("no kernel image"), torch.OutOfMemoryError("none left")])
def test_one_that_cannot_be_used_is_refused_by_its_name_with_a_remedy(
    error: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> Rendered:
        raise error

    monkeypatch.setattr(agreement, "rasterize", fail)
    with pytest.raises(UnavailableError) as refused:
        examine(Device("cuda", "GPU 9002", "cpu"))
    assert refused.value.problem == f"cuda (GPU 9002) cannot be used ({type(error).__name__})."
    assert "--device cpu, INTRASPLAT_DEVICE=cpu" in refused.value.remedy
    assert str(error) in caplog.text


def test_one_that_does_not_matches_no_stereo_clip_either(
    device: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    write_stereomis(make_phantom(PhantomSettings(width=96, height=80, frames=2, period_frames=2)), tmp_path)
    render_brighter(monkeypatch, 1.05)
    stages: list[str] = []
    hooks = Hooks(on_progress=lambda progress: stages.append(progress.stage))
    with pytest.raises(UnavailableError, match="GPU 9001 is not to be trusted"):
        open_with_poses(ReconstructionRequest(clip=tmp_path), hooks, Timings(), Device("cuda", "GPU 9001", device))
    assert stages[-1] == "compile"
    assert "stereo" not in stages
