"""A device is asked whether it splats rightly before it is used."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("triton", reason="Triton is not installed")

from contract.errors import UnavailableError
from worker.raster import Rendered
from worker.raster.cuda import agreement, rasterize


def test_the_device_agrees_with_the_reference(device: str) -> None:
    worst, _ = agreement.disagreement(torch.device(device))
    assert worst < 1e-4
    agreement.check(device, "a GPU")


@pytest.mark.parametrize("factor", [1.05, float("nan")])
def test_one_that_does_not_is_refused_by_its_name_with_a_remedy(
    factor: float, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(*arguments: object) -> Rendered:
        found = rasterize(*arguments)  # type: ignore[arg-type]
        return Rendered(found.rgb * factor, found.depth, found.alpha)

    monkeypatch.setattr(agreement, "rasterize", wrong)
    with pytest.raises(
        UnavailableError, match=r"GPU 9000 .* is not to be trusted: its .* of a test scene is"
    ) as raised:
        agreement.check(device, f"GPU 9000 {factor}")
    assert "INTRASPLAT_DEVICE=cpu" in raised.value.remedy
