"""`intrasplat evaluate` trains methods on one clip, writes a row and a scene for each, and draws one chart."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from intrasplat.__main__ import main
from intrasplat.commands.exits import ExitCode
from lab.__main__ import main as laboratory


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phantom") / "clip"
    size = ["--frames", "10", "--width", "96", "--height", "80", "--format", "endonerf"]
    assert laboratory(["phantom", *size, "--out", str(folder)]) == ExitCode.OK
    return folder


def test_each_method_gets_a_row_and_a_scene_and_is_not_trained_twice(clip: Path, tmp_path: Path) -> None:
    asked = ["evaluate", str(clip), "--methods", "instant", "small", "--budget-s", "0.5", "--out", str(tmp_path)]
    assert main([*asked, "--device", "cpu"]) == ExitCode.OK
    with (tmp_path / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == ["instant", "small"]
    assert all(float(row["psnr_tissue_db"]) > 10 and float(row["copy_blend_db"]) > 10 for row in rows)
    assert (tmp_path / "chart.png").read_bytes().startswith(b"\x89PNG")
    made = (tmp_path / "instant" / "scene.safetensors").stat().st_mtime_ns
    assert main([*asked, "--device", "cpu"]) == ExitCode.OK
    assert (tmp_path / "instant" / "scene.safetensors").stat().st_mtime_ns == made


def test_a_clip_that_is_not_there_is_a_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "nowhere.webm", "--out", str(tmp_path)]) == ExitCode.BAD_INPUT
    assert "nowhere.webm" in capsys.readouterr().err
