"""`intrasplat measure` prints what the service would answer, and names the option at fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.store.store import Store
from intrasplat.__main__ import main
from intrasplat.commands.exits import ExitCode
from intrasplat.measuring import Measurement
from tests.worker.test_views import CLIP, UNITS_PER_MM, publish

JOB_ID = "0" * 32


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    store = Store(tmp_path)
    publish(store, JOB_ID)
    return store.scene_folder(JOB_ID, 1)


def test_depths_and_the_distance_of_two_points_are_printed(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    x, y = CLIP.width // 2, CLIP.height // 2
    assert main(["measure", str(scene), "--points", f"{x},{y};{x + 10},{y}", "--t", "0.25"]) == ExitCode.OK
    found = Measurement.model_validate_json(capsys.readouterr().out)
    assert found.t == 0.25
    assert [each.depth_mm for each in found.points] == pytest.approx([60 / UNITS_PER_MM] * 2, rel=0.05)
    assert found.distance is not None


@pytest.mark.parametrize(("points", "words"), [("1", "'1' is not a point"), ("-1,2", "outside the picture")])
def test_points_that_cannot_be_measured_are_told(
    scene: Path, capsys: pytest.CaptureFixture[str], points: str, words: str
) -> None:
    assert main(["measure", str(scene), f"--points={points}"]) == ExitCode.BAD_INPUT
    assert words in capsys.readouterr().err
