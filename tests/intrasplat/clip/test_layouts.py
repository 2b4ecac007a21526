"""The registry of input layouts: what callers may choose, and a layout from outside from its files to a scene."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from intrasplat.clip import DepthClip, layouts, open_clip
from intrasplat.clip.layouts import LAYOUTS, register_layout, registered_files
from intrasplat.decode import decode_clip
from intrasplat.errors import InputError
from intrasplat.names import Layout
from intrasplat.options import ClipOptions, Options, ReconstructionOptions
from intrasplat.pipeline import reconstruct
from intrasplat.scene.checkpoint import load_scene
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from tests.intrasplat.clip import toy_layout
from tests.intrasplat.clips import plane_clip

TOY = Path(toy_layout.__file__)


def in_layout(options: Options, name: str) -> Options:
    """Options with a layout that the contract does not name."""
    return options.model_copy(update={"layout": name})


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in the toy layout, which is registered."""
    monkeypatch.setattr(layouts, "_outside", {})
    register_layout(TOY)
    clip = plane_clip()
    folder = tmp_path / "toy"
    folder.mkdir()
    np.savez(folder / toy_layout.FILE, rgb=clip.rgb, depth_mm=clip.depth_mm, focal_px=clip.intrinsics.fx)
    return folder


def test_callers_may_choose_every_layout_there_is() -> None:
    assert get_args(Layout) == ("auto", *(each.name for each in LAYOUTS))


def test_a_layout_from_outside_is_found_by_its_files_and_by_its_name(toy: Path) -> None:
    for layout in ("auto", "toy"):
        clip = open_clip(toy, options=in_layout(ClipOptions(), layout))
        assert isinstance(clip, DepthClip)
        np.testing.assert_array_equal(clip.rgb, plane_clip().rgb)


def test_the_decoding_process_knows_layouts_from_outside(toy: Path) -> None:
    clip = decode_clip(toy, options=in_layout(ClipOptions(), "toy"))
    assert isinstance(clip, DepthClip)
    np.testing.assert_array_equal(clip.depth_mm, plane_clip().depth_mm)


def test_a_clip_in_a_layout_from_outside_becomes_a_scene(toy: Path, tmp_path: Path) -> None:
    request = ReconstructionRequest(toy, in_layout(ReconstructionOptions(iterations=3), "toy"))
    report = reconstruct(request, tmp_path / "scene", TrainingHooks())
    assert load_scene(tmp_path / "scene").intrinsics == plane_clip().intrinsics
    assert report.iterations == 3


def test_a_layout_must_have_a_name_of_its_own(toy: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'toy' already"):
        register_layout(TOY)
    assert registered_files() == [TOY]


def test_a_file_without_a_layout_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.py").write_text("")
    with pytest.raises(ValueError, match="defines no InputLayout"):
        register_layout(tmp_path / "empty.py")


def test_an_unknown_layout_is_refused_and_the_known_ones_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'diagonal' is not known") as caught:
        open_clip(tmp_path, options=in_layout(ClipOptions(), "diagonal"))
    assert caught.value.remedy == "Choose one of auto, endonerf, stereomis, sbs, tb, frames."
