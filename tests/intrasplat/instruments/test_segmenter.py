"""A network of one's own finds the instruments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intrasplat.errors import UnavailableError
from intrasplat.instruments import load_segmenter
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.notices import NoticeCode
from intrasplat.options import ReconstructionOptions
from intrasplat.stereo import ClipPaths, open_with_depth
from lab.phantom import PhantomSettings, make_phantom, write_endonerf
from tests.intrasplat.instruments.onnx_file import colour_network

BLUE, BLUE_BIAS = (-20.0, -20.0, 40.0), -5.0


@pytest.fixture
def blue(tmp_path: Path) -> Path:
    """Takes what is blue for an instrument."""
    path = tmp_path / "blue.onnx"
    path.write_bytes(colour_network(BLUE, BLUE_BIAS))
    return path


def picture() -> np.ndarray:
    """Red tissue; the left half of its columns is blue."""
    rgb = np.zeros((64, 96, 3), np.uint8)
    rgb[..., 0], rgb[:, :48] = 200, (0, 0, 250)
    return rgb


def test_the_network_decides(blue: Path) -> None:
    found = load_segmenter(blue)(picture())
    assert found.tool[:, :48].all()
    assert not found.tool[:, 48:].any()
    assert found.seen == pytest.approx(0.5)
    assert found.clear == pytest.approx(0.5, abs=0.01)


def test_a_network_of_one_size_gets_that_size(tmp_path: Path) -> None:
    path = tmp_path / "small.onnx"
    path.write_bytes(colour_network(BLUE, BLUE_BIAS, size=(32, 48)))
    found = load_segmenter(path)(picture())
    assert found.tool.shape == (64, 96)
    assert found.tool[:, :47].all()
    assert not found.tool[:, 49:].any()


def test_a_clip_without_masks_asks_the_segmenter(blue: Path, tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    write_endonerf(make_phantom(PhantomSettings(width=64, height=48, frames=3)), folder, masks=False)
    options = ReconstructionOptions(holdout="none")
    clip = open_with_depth(ClipPaths(folder), options, Hooks(), Timings(), segmenter=blue)
    assert clip.masks is not None
    assert clip.masks.source == "segmenter"
    assert NoticeCode.MASKS in {each.code for each in clip.assumptions}


@pytest.mark.parametrize(
    "content", [b"no network", colour_network((1.0, 1.0), 0.0, planes=2)], ids=["damaged", "planes"]
)
def test_what_is_no_such_network_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other.onnx"
    path.write_bytes(content)
    with pytest.raises(UnavailableError, match=r"other\.onnx") as refused:
        load_segmenter(path)
    assert str(tmp_path) not in str(refused.value)
    assert "INTRASPLAT_SEGMENTER" in refused.value.remedy


def test_a_clip_with_masks_of_its_own_needs_no_segmenter(tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    write_endonerf(make_phantom(PhantomSettings(width=64, height=48, frames=3)), folder)
    options = ReconstructionOptions(holdout="none")
    clip = open_with_depth(ClipPaths(folder), options, Hooks(), Timings(), segmenter=tmp_path / "missing.onnx")
    assert clip.masks is not None
    assert clip.masks.source == "given"
