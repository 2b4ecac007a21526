"""The local commands, from the command line to the files they write."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from intrasplat.__main__ import main
from intrasplat.commands.exits import ExitCode
from intrasplat.names import CURVE, DETAIL, RECORDED, REPORT
from intrasplat.notices import NoticeCode
from intrasplat.report import Report
from intrasplat.scene.resume_file import RESUME_FILE, load_resume
from lab.__main__ import main as laboratory

WIDTH, HEIGHT, FRAMES = 96, 80, 10
TRAINING_S = 1.0
"""Hundreds of steps at this size."""


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phantom") / "clip"
    size = ["--width", str(WIDTH), "--height", str(HEIGHT), "--frames", str(FRAMES)]
    assert laboratory(["phantom", *size, "--format", "endonerf", "--out", str(folder)]) == ExitCode.OK
    return folder


@pytest.fixture(scope="module")
def scene(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scenes") / "scene"
    assert main(["reconstruct", str(clip), "--iterations", "10", "--out", str(out)]) == ExitCode.OK
    return out


@pytest.fixture(scope="module")
def scene_of_two_eyes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("two-eyes")
    size = ["--frames", "10", "--width", "128", "--height", "96"]
    assert laboratory(["phantom", "--format", "stereomis", *size, "--out", str(folder / "clip")]) == ExitCode.OK
    train = ["--eyes", "both", "--iterations", "10", "--out", str(folder / "scene")]
    assert main(["reconstruct", str(folder / "clip"), *train]) == ExitCode.OK
    return folder / "scene"


def test_reconstruct_writes_a_scene_with_its_report_and_curve(scene: Path) -> None:
    assert {"manifest.json", "scene.safetensors", "report.json", "curve.csv"} <= {path.name for path in scene.iterdir()}
    assert json.loads((scene / "report.json").read_text())["iterations"] == 10


def test_reconstruct_tells_the_right_eyes_score_of_a_clip_that_has_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn, out = tmp_path / "clip", tmp_path / "scene"
    size = ["--frames", "10", "--width", "128", "--height", "96"]
    assert laboratory(["phantom", "--format", "stereomis", *size, "--out", str(drawn)]) == ExitCode.OK
    capsys.readouterr()
    assert main(["reconstruct", str(drawn), "--eyes", "left", "--iterations", "5", "--out", str(out)]) == ExitCode.OK
    report = Report.model_validate_json((out / REPORT).read_text())
    told = capsys.readouterr().out
    (poses,) = (notice.text for notice in report.assumptions if notice.code == NoticeCode.POSES)
    assert f"{poses}\n" in told
    assert poses.startswith("poses: the camera ")
    assert f"psnr_right: {report.psnr_right_db:.2f} dB on held-out frames of the right eye (the left eye's" in told
    assert f"{report.baseline_warp_db:.2f} dB)" in told
    assert (out / CURVE).read_text().splitlines()[0].endswith(",psnr_right_db")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_an_error_with_a_remedy_and_leaves_nothing(
    clip: Path, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for command in (["reconstruct", str(clip)], ["render", str(scene), "--t", "0"]):
        assert main([*command, "--device", "cuda", "--out", str(out)]) == ExitCode.UNAVAILABLE
        assert "--device cpu" in capsys.readouterr().err
        assert not out.exists()


def test_render_writes_one_picture_a_frame(scene: Path, tmp_path: Path) -> None:
    assert main(["render", str(scene), "--frames", "1,9", "--out", str(tmp_path / "frames")]) == ExitCode.OK
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["000001.png", "000009.png"]
    picture = cv2.imread(str(tmp_path / "frames" / "000001.png"))
    assert picture is not None
    assert picture.shape == (HEIGHT, WIDTH, 3)


def test_render_says_a_warning_of_many_pictures_once_and_what_has_no_effect(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = ["--frames", "1,4,9", "--pose", "orbit:60,0,1", "--smoke", "show", "--light", "recorded"]
    assert main(["render", str(scene), *far, "--out", str(tmp_path / "frames")]) == ExitCode.OK
    said = capsys.readouterr().err.splitlines()
    (pose,) = (each for each in said if "degrees beside the endoscope" in each)
    assert pose.startswith("warning: ")
    assert pose.endswith("(3 images, the first is 000001.png, the last 000009.png)")
    assert len(said) == len(set(said))
    assert sum("changes nothing" in each for each in said) == 2


def test_render_writes_any_layer_from_any_pose(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "depth.npy"
    view = ["--t", "0.4", "--pose", "orbit:5,0,1", "--width", "48", "--layer", "depth", "--out", str(out)]
    assert main(["render", str(scene), *view]) == ExitCode.OK
    assert np.load(out).shape == (HEIGHT // 2, WIDTH // 2)


def test_render_colours_depth_between_the_ends_that_are_given(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth = ["--t", "0", "--layer", "depth", "--out"]

    def brightness(*ends: str) -> float:
        assert main(["render", str(scene), *ends, *depth, str(tmp_path / "depth.webp")]) == ExitCode.OK
        return float(cv2.imread(str(tmp_path / "depth.webp")).mean())

    assert (
        brightness("--near-mm", "1000", "--far-mm", "2000")
        > brightness()
        > brightness("--near-mm", "1", "--far-mm", "2")
    )
    capsys.readouterr()
    ends = ["--near-mm", "90", "--far-mm", "50"]
    assert main(["render", str(scene), *ends, *depth, str(tmp_path / "no.webp")]) == ExitCode.BAD_INPUT
    assert "--far-mm" in capsys.readouterr().err
    assert not (tmp_path / "no.webp").exists()
    colour = ["--t", "0", "--out", str(tmp_path / "colour.png")]
    assert main(["render", str(scene), *ends, *colour]) == ExitCode.BAD_INPUT
    assert "--far-mm" in capsys.readouterr().err
    assert main(["render", str(scene), "--near-mm", "50", "--far-mm", "90", *colour]) == ExitCode.OK
    assert "--far-mm change nothing" in capsys.readouterr().err


def test_render_leaves_out_highlights_that_two_eyes_told_apart(
    scene: Path, scene_of_two_eyes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def rendered(folder: Path, highlights: str) -> np.ndarray:
        view = ["--t", "0", "--highlights", highlights, "--out", str(tmp_path / "view.npy")]
        assert main(["render", str(folder), *view]) == ExitCode.OK
        return np.load(tmp_path / "view.npy").astype(int)

    on, off = (rendered(scene_of_two_eyes, highlights) for highlights in ("on", "off"))
    assert (off <= on).all()
    assert (off < on).any()
    assert "highlights" not in capsys.readouterr().err
    np.testing.assert_array_equal(rendered(scene, "on"), rendered(scene, "off"))
    assert "info: This scene was taught by one eye" in capsys.readouterr().err


def test_render_marks_what_was_not_seen_or_guesses(scene: Path, tmp_path: Path) -> None:
    pictures = []
    for unseen in ("mark", "guess"):
        out = tmp_path / f"{unseen}.png"
        view = ["--t", "0", "--pose", "orbit:30,0,1", "--unseen", unseen, "--out", str(out)]
        assert main(["render", str(scene), *view]) == ExitCode.OK
        pictures.append(cv2.imread(str(out), cv2.IMREAD_UNCHANGED))
    marked, guessed = pictures
    assert marked is not None
    assert guessed is not None
    assert (marked.shape[2], guessed.shape[2]) == (4, 3)
    hidden = marked[..., 3] == 0
    assert 0.05 < hidden.mean() < 0.9
    np.testing.assert_array_equal(marked[~hidden][:, :3], guessed[~hidden])


@pytest.mark.parametrize(
    "view",
    [
        ["--t", "0", "--out", "view.gif"],
        ["--t", "0", "--pose", "1,2,3", "--out", "view.png"],
        ["--t", "0", "--width", "1", "--out", "view.png"],
        ["--frames", "99", "--out", "frames"],
    ],
)
def test_a_view_that_cannot_be_meant_is_a_bad_input(
    scene: Path, view: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render", str(scene), *view]) == ExitCode.BAD_INPUT
    assert "intrasplat: " in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def interrupt_in_training(clip: Path, out: Path, number: signal.Signals) -> str:
    """Start a run that would take long, send it a signal once it trains; what it said at its end."""
    command = [
        sys.executable,
        "-m",
        "intrasplat",
        "reconstruct",
        str(clip),
        "--iterations",
        "100000",
        "--out",
        str(out),
    ]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert any(line.startswith("train") for line in process.stderr)
        time.sleep(TRAINING_S)
        process.send_signal(number)
        said = process.stderr.read()
        assert process.wait(timeout=60) == ExitCode.INTERRUPTED
    return said


def test_an_interrupted_run_goes_on_with_the_same_command(clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    assert "same command goes on" in interrupt_in_training(clip, out, signal.SIGINT)
    assert [path.name for path in out.iterdir()] == [RESUME_FILE]
    first = load_resume(out)[1]["iteration"]
    interrupt_in_training(clip, out, signal.SIGTERM)
    assert load_resume(out)[1]["iteration"] > first > 0


def test_a_run_killed_while_it_wrote_a_state_or_its_results_starts_again_in_its_folder(
    clip: Path, tmp_path: Path
) -> None:
    for name in (f".{RESUME_FILE}.new", REPORT, CURVE, f".{RECORDED}.new", ".manifest.json.new"):
        (tmp_path / name).write_bytes(b"cut off")
    assert main(["reconstruct", str(clip), "--iterations", "5", "--out", str(tmp_path)]) == ExitCode.OK
    assert {path.name for path in tmp_path.iterdir()} == {
        "manifest.json",
        "scene.safetensors",
        REPORT,
        CURVE,
        DETAIL,
        RECORDED,
    }


def test_a_finished_scene_is_not_replaced(clip: Path, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (scene / REPORT).read_bytes()
    assert main(["reconstruct", str(clip), "--iterations", "5", "--out", str(scene)]) == ExitCode.BAD_INPUT
    assert "new folder" in capsys.readouterr().err
    assert (scene / REPORT).read_bytes() == before


def test_an_interrupted_run_does_not_go_on_as_another(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / RESUME_FILE).write_bytes(b"of something else")
    assert main(["reconstruct", str(clip), "--iterations", "5", "--out", str(tmp_path)]) == ExitCode.BAD_INPUT
    assert "new folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    "wrong", [["--iterations", "0"], ["--seed", "-1"], ["--holdout", "99"], ["--holdout", "third"]]
)
def test_an_option_that_cannot_be_meant_is_a_bad_input(
    wrong: list[str], clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scene"
    assert main(["reconstruct", str(clip), "--out", str(out), *wrong]) == ExitCode.BAD_INPUT
    assert f"intrasplat: {wrong[0]}: " in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("t", ["nan", "inf", "now"])
def test_a_time_that_is_none_is_wrong_usage(t: str, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["render", str(scene), "--t", t, "--out", "view.png"])
    assert ended.value.code == ExitCode.USAGE
    assert f"--t: {t!r} is not a number." in capsys.readouterr().err


def test_a_clip_that_is_not_there_is_a_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", str(tmp_path / "no.mp4"), "--out", str(tmp_path / "scene")]) == ExitCode.BAD_INPUT
    assert "clip" in capsys.readouterr().err


def test_a_folder_with_something_in_it_is_not_written_over(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", str(clip), "--out", str(clip)]) == ExitCode.BAD_INPUT
    assert "--out" in capsys.readouterr().err


def test_a_folder_without_a_scene_is_a_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in (tmp_path, tmp_path / "nosuch"):
        assert main(["render", str(folder), "--t", "0", "--out", str(tmp_path / "a.png")]) == ExitCode.BAD_INPUT
        assert "that reconstruct wrote" in capsys.readouterr().err


def test_a_checkout_draws_synthetic_clips_by_the_same_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["phantom", "--help"])
    assert "synthetic stereo clip" in capsys.readouterr().out
