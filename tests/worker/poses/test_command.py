"""`intrasplat poses` on files."""

from __future__ import annotations

from pathlib import Path

import pytest

from contract.runtime.exits import ExitCode
from worker.__main__ import main
from worker.phantom import PhantomSettings, make_phantom, write_stereomis
from worker.poses.trajectory import read_tum, trajectory_error


def test_the_path_of_files_is_compared_with_a_known_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = PhantomSettings(
        width=160, height=128, frames=16, motion="still", tools=(), camera=("turn",), frame_rate_hz=8.0
    )
    write_stereomis(make_phantom(settings), tmp_path / "clip", masks=False)
    truth, out = tmp_path / "clip" / "groundtruth.txt", tmp_path / "found.tum"
    calibration = tmp_path / "clip" / "StereoCalibration.ini"
    arguments = ["poses", tmp_path / "clip", "--calibration", calibration, "--against", truth, "--out", out]
    assert main([str(each) for each in arguments]) == ExitCode.OK
    error = trajectory_error(read_tum(out)[1], read_tum(truth)[1])
    assert f"absolute trajectory error: {error.mm:.2f} mm, {error.deg:.2f} degrees" in capsys.readouterr().out
    assert error.deg < 0.6


def test_what_is_no_path_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.tum").write_text("no path\n")
    arguments = ["poses", str(tmp_path), "--against", str(tmp_path / "bad.tum")]
    assert main(arguments) == ExitCode.BAD_INPUT
    assert "--against" in capsys.readouterr().err
