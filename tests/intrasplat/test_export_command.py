"""`intrasplat export` writes what the worker sends, and names the option at fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from intrasplat.__main__ import main
from intrasplat.commands.exits import ExitCode
from intrasplat.export import export_parts
from intrasplat.formats import EXPORT_FORMATS, ExportOptions
from intrasplat.scene.archive import read_archive
from intrasplat.scene.checkpoint import save_scene
from tests.archives import stored
from tests.intrasplat.scenes import random_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save_scene(tmp_path / "scene", random_scene())
    return tmp_path / "scene"


def test_a_file_is_written_beside_the_scene_or_where_it_is_wanted(scene: Path, tmp_path: Path) -> None:
    assert main(["export", str(scene), "--format", "points", "--t", "0.4"]) == 0
    expected = b"".join(export_parts(random_scene(), "points", ExportOptions(t=0.4)))
    assert (tmp_path / f"scene{EXPORT_FORMATS['points'].suffix}").read_bytes() == expected
    assert main(["export", str(scene), "--format", "tracks", "--every", "2", "--out", str(tmp_path / "a.npz")]) == 0
    assert (tmp_path / "a.npz").read_bytes().startswith(b"PK")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "scene", "scene-points.ply"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--format", "splatz"], "--format: 'splatz' is not an export format. Did you mean splat?"),
        (["--every", "2"], "--every: every does not fit the format ply"),
        (["--out", "missing/a.ply"], "--out: "),
    ],
)
def test_what_cannot_be_written_is_told(
    scene: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    if "--out" in arguments:
        arguments = ["--out", str(scene / arguments[1])]
    assert main(["export", str(scene), *arguments]) == ExitCode.BAD_INPUT
    assert words in capsys.readouterr().err


def test_the_scene_itself_is_written_for_another_installation(tmp_path: Path) -> None:
    stored(tmp_path / "scene", random_scene())
    assert main(["export", str(tmp_path / "scene"), "--format", "scene"]) == 0
    archive = read_archive(tmp_path / "scene.scene.zip", 1 << 24)
    assert archive.head.scene_id is None
    assert archive.report.gaussians == 11
