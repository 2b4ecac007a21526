"""`intrasplat poses` on files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from intrasplat.__main__ import main
from intrasplat.commands.exits import ExitCode
from intrasplat.poses.pose_file import read_tum
from intrasplat.poses.rigid import between
from intrasplat.poses.trajectory import trajectory_error, write_tum
from lab.phantom import PhantomSettings, make_phantom, write_stereo_video, write_stereomis

SETTINGS = PhantomSettings(
    width=160, height=128, frames=16, motion="still", tools=(), camera=("turn",), frame_rate_hz=8.0
)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip in StereoMIS layout, whose camera turns and whose path is in groundtruth.txt."""
    folder = tmp_path_factory.mktemp("clips") / "clip"
    write_stereomis(make_phantom(SETTINGS), folder, masks=False)
    return folder


def of(clip: Path, *arguments: str | Path) -> int:
    """What `intrasplat poses` of the clip returns."""
    named = ["poses", clip, "--calibration", clip / "StereoCalibration.ini", *arguments]
    return main([str(each) for each in named])


def test_the_path_of_files_is_compared_with_a_known_one(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, out = clip / "groundtruth.txt", tmp_path / "found.tum"
    assert of(clip, "--against", truth, "--out", out) == ExitCode.OK
    error = trajectory_error(read_tum(out)[1], read_tum(truth)[1])
    assert f"absolute trajectory error: {error.mm:.2f} mm, {error.deg:.2f} degrees" in capsys.readouterr().out
    assert error.deg < 0.6


def test_a_path_with_more_poses_than_frames_is_compared_by_its_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    video = tmp_path / "video"
    write_stereo_video(make_phantom(replace(SETTINGS, frame_rate_hz=25.0)), video)
    times_s, poses = read_tum(video / "truth" / "poses.tum")
    among = np.arange(2 * len(poses) - 1) / 2
    twice = np.stack([between(range(len(poses)), poses, each) for each in among])
    write_tum(tmp_path / "twice.tum", np.interp(among, np.arange(len(poses)), times_s) + 1000.0, twice)
    for known in (video / "truth" / "poses.tum", tmp_path / "twice.tum"):
        arguments = ["--calibration", video / "calibration.json", "--poses", "fixed", "--against", known]
        assert main([str(each) for each in ("poses", video / "stereo.webm", *arguments)]) == ExitCode.OK
    once, again = (line for line in capsys.readouterr().out.splitlines() if "trajectory" in line)
    assert once == again


def test_a_path_of_other_length_than_frames_without_times_is_refused_before_poses_are_sought(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times_s, poses = read_tum(clip / "groundtruth.txt")
    write_tum(tmp_path / "short.tum", times_s[:12], poses[:12])
    assert of(clip, "--against", tmp_path / "short.tum") == ExitCode.BAD_INPUT
    told = capsys.readouterr()
    assert "12 poses" in told.err
    assert "poses:" not in told.out


def test_a_file_that_cannot_be_written_is_told_at_once(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert of(clip, "--out", tmp_path / "missing" / "found.tum") == ExitCode.BAD_INPUT
    told = capsys.readouterr().err
    assert "--out" in told
    assert "decode" not in told


def test_what_is_no_path_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.tum").write_text("no path\n")
    arguments = ["poses", str(tmp_path), "--against", str(tmp_path / "bad.tum")]
    assert main(arguments) == ExitCode.BAD_INPUT
    assert "--against" in capsys.readouterr().err


def test_a_true_path_in_mm_is_told_and_compared_as_such(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times_s, poses = read_tum(clip / "groundtruth.txt")
    poses[:, :3, 3] *= 1000
    poses[-1, 0, 3] += 3e3  # 3 mm in a file in mm
    write_tum(tmp_path / "mm.tum", times_s, poses)
    assert of(clip, "--poses", "fixed", "--against", tmp_path / "mm.tum") == ExitCode.OK
    told = capsys.readouterr().out
    assert "in mm, not in metres: a factor of 1000" in told
    assert float(told.rsplit("error: ", 1)[1].split(" mm")[0]) < 50


def test_poses_of_a_file_are_read_and_used(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = clip / "groundtruth.txt"
    assert of(clip, "--poses-file", truth, "--poses", "given", "--against", truth) == ExitCode.OK
    told = capsys.readouterr().out
    assert "poses: as given, read as camera-to-world in m, OpenCV axes" in told
    assert "absolute trajectory error: 0.00 mm, 0.00 degrees" in told
    (tmp_path / "short.txt").write_text("".join(truth.read_text().splitlines(keepends=True)[:9]))
    assert of(clip, "--poses-file", tmp_path / "short.txt") == ExitCode.BAD_INPUT
    assert "poses_file" in capsys.readouterr().err
