"""The command, from clips to rows and charts; what is done stays done."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from intrasplat.commands.exits import ExitCode
from intrasplat.errors import Cancelled, InputError, UnavailableError
from intrasplat.machine.hooks import Hooks, Progress
from intrasplat.train.hooks import RenderedFrame, TrainingHooks
from lab.__main__ import main
from lab.evaluate.cells import Cell, plan
from lab.evaluate.command import SUMMARY, measure_all
from lab.evaluate.measure import Bench, Values, _OnTheWay, command_of, seconds_of
from lab.evaluate.rows import CURVES, KEY, LOCK, RUN_FIELDS, RUNS, Results, adding_alone, read_rows
from lab.evaluate.sources import DATA_VARIABLE, open_source, source_of
from lab.phantom import PhantomSettings, make_phantom, write_endonerf
from tests.intrasplat.phantoms import phantom_clip

CLIP = "phantom:pull:96x80:12frames"
DRAWN = Figure.savefig
NAME = "phantom-pull-96x80-12frames"


def evaluate(out: Path, *options: str) -> int:
    return main(["evaluate", CLIP, "--out", str(out), "--iterations", "12", "--holdout", "every8", *options])


@pytest.fixture(scope="module", autouse=True)
def _not_drawn() -> Iterator[None]:
    """Charts are put together, but not drawn into their files, which takes longer than a run here."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Figure, "savefig", lambda _, path, **__: Path(path).touch())
        yield


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluate")
    assert evaluate(out, "--series", "fast", "hexplane") == ExitCode.OK
    return out


def test_a_run_becomes_a_row_with_every_figure(measured: Path) -> None:
    fast, hexplane = read_rows(measured / RUNS)
    assert (fast["clip"], fast["series"], fast["limit"], hexplane["series"]) == (
        NAME,
        "fast",
        "12 iterations",
        "hexplane",
    )
    empty = {name for name in RUN_FIELDS if not fast[name]}
    of_the_right_eye = {"psnr_right_db", "psnr_right_clear_db", "warp_db", "warp_clear_db"}
    assert empty == {"error", "not_measured", *of_the_right_eye}, "it has one eye"
    assert abs(float(fast["stored_loss_held_out_db"])) < 0.3
    assert float(fast["psnr_tissue_db"]) > 15
    seconds = json.loads(fast["seconds"])
    assert [float(fast[name]) for name in ("t_train_s", "t_post_s")] == pytest.approx(
        [seconds["t_train_s"], seconds["t_post_s"]], abs=1e-3
    )
    assert 0 < seconds["t_train_s"] <= seconds["t_post_s"]
    assert 0 <= float(fast["motion_error_mm"]) < 20
    again = f"python -m lab evaluate {CLIP} --series fast --holdout every8 --seeds 0 --iterations 12 --out DIR"
    assert fast["command"] == again


@pytest.fixture(scope="module")
def both_eyes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("stereo")
    asked = ["evaluate", f"{CLIP}:stereo", "--series", "fast", "--iterations", "12", "--holdout", "every8"]
    assert main([*asked, "--eyes", "both", "left", "--out", str(out)]) == ExitCode.OK
    return out


def test_a_phantom_is_also_a_stereo_clip_with_its_truth_beside_it(both_eyes: Path) -> None:
    row = read_rows(both_eyes / RUNS)[0]
    assert (row["clip"], row["error"]) == (f"{NAME}-stereo", "")
    assert "stereo_s" in json.loads(row["seconds"]), "its depth was matched"
    assert 0 < float(row["depth_error_mm"]) < 20
    for share in ("empty_ok", "seen_ok"):
        assert 0 < float(row[share]) <= 1
    assert f"{CLIP}:stereo" in row["command"]


def test_a_phantom_s_name_tells_paths_instruments_and_missing_masks() -> None:
    usual = source_of("phantom:breathing")
    assert (usual.name, usual.phantom, usual.masks) == ("phantom-breathing", PhantomSettings(320, 256), True)
    source = source_of("phantom:pull+pan+shake:96x80:3frames:steel+dark:nomasks:stereo")
    assert source.name == "phantom-pull-pan-shake-96x80-3frames-steel-dark-nomasks-stereo"
    assert source.phantom is not None
    assert (source.phantom.camera, source.phantom.tools) == (("pan", "shake"), ("steel", "dark"))
    assert source_of("phantom:cut:none").phantom == PhantomSettings(320, 256, motion="cut", tools=())


def test_a_phantom_without_masks_is_judged_by_the_true_ones() -> None:
    for spelling in ("phantom:breathing:96x80:3frames", "phantom:breathing:96x80:3frames:stereo"):
        given, bare = (open_source(source_of(each), "none", Hooks()) for each in (spelling, f"{spelling}:nomasks"))
        np.testing.assert_array_equal(given.clip.tissue, given.tissue)
        np.testing.assert_array_equal(bare.tissue, given.tissue)
        assert bare.clip.tissue.mean() > given.tissue.mean() + 0.01


def test_a_moving_phantom_gives_its_poses_with_true_depth_and_none_with_stereo() -> None:
    one, both = (
        open_source(source_of(f"phantom:breathing+pan:96x80:9frames{end}"), "none", Hooks()) for end in ("", ":stereo")
    )
    assert one.phantom is not None
    np.testing.assert_array_equal(one.clip.world_from_camera[8], one.phantom.world_from_camera(8))
    np.testing.assert_array_equal(both.clip.world_from_camera, np.tile(np.eye(4), (9, 1, 1)))


def test_the_right_eye_judges_what_either_number_of_eyes_taught(both_eyes: Path) -> None:
    both, left = read_rows(both_eyes / RUNS)
    assert (both["series"], left["series"]) == ("fast", "fast:eyes=left")
    assert "--series fast:eyes=left" in left["command"]
    assert float(both["psnr_right_db"]) != float(left["psnr_right_db"])
    assert both["warp_db"] == left["warp_db"], "no model takes part in it"
    for name in ("psnr_clear_db", "psnr_right_clear_db", "warp_clear_db"):
        assert float(both[name]) > 5
    ends = {row["series"]: row for row in read_rows(both_eyes / CURVES)}
    assert float(ends["fast"]["psnr_right_db"]) == pytest.approx(float(both["psnr_right_db"]), abs=1e-3)
    assert {"curves-eyes.png", "pareto-right.png"} <= {path.name for path in both_eyes.iterdir()}
    summary = {row["series"]: row for row in read_rows(both_eyes / SUMMARY)}
    assert summary["fast:eyes=left"]["psnr_right_db"] == left["psnr_right_db"]


def test_a_clip_of_one_eye_has_no_row_of_the_left_eye_alone(tmp_path: Path) -> None:
    assert evaluate(tmp_path, "--series", "fast", "--eyes", "left") == ExitCode.FAILED
    (row,) = read_rows(tmp_path / RUNS)
    assert row["error"].startswith(f"InputError: --eyes: {NAME} has one eye")


def test_the_command_of_a_file_has_what_it_was_read_with(tmp_path: Path) -> None:
    clip = tmp_path / "my clip.mp4"
    clip.touch()
    source = source_of(str(clip), {"layout": "sbs", "mask_polarity": "auto"})
    (cell,) = plan([source.name], ["fast"], ["every8"], [3], budgets_s=[6])
    asked = f"evaluate '{clip}' --layout sbs --mask-polarity auto --series fast --holdout every8 --seeds 3 --budget-s 6"
    assert command_of(cell, source) == f"python -m lab {asked} --out DIR"
    assert command_of(cell, source, "cuda") == f"python -m lab {asked} --out DIR --device cuda"


def test_the_seconds_of_a_row_are_those_of_a_run_that_nobody_evaluates() -> None:
    run, opening = {"t_train_s": 15.0, "score_s": 1.0, "t_post_s": 22.0}, {"decode_s": 2.0}
    assert seconds_of(run, opening, judging_s=3.0) == {**run, **opening, "t_post_s": 19.0}


def test_the_curve_of_a_row_has_the_clock_of_a_run_that_nobody_evaluates() -> None:
    clip = phantom_clip()
    view = RenderedFrame(np.zeros(clip.rgb[1].shape, np.float32), clip.depth_mm[1], np.ones_like(clip.depth_mm[1]))
    on_the_way = _OnTheWay(clip)
    on_the_way.judge(1, view)
    on_the_way.took_s = 2.0
    on_the_way.judge(1, view)
    curve: list[Values] = [{"t_post_s": "10.000"}, {"t_post_s": "16.000"}]
    assert [point["t_post_s"] for point in on_the_way.completed(curve)] == [10.0, 14.0]


def test_a_recording_is_shrunk_by_a_whole_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_endonerf(make_phantom(PhantomSettings(width=64, height=48, frames=9)), tmp_path / "d4d_endonerf")
    monkeypatch.setenv("INTRASPLAT_DATA", str(tmp_path))
    whole, half = (open_source(source_of(f"d4d_endonerf{size}"), "every8", TrainingHooks()) for size in ("", ":32x24"))
    assert source_of("d4d_endonerf:32x24").name == "d4d-a-32x24"
    np.testing.assert_allclose(half.clip.rgb[0, 0, 0], whole.clip.rgb[0, :2, :2].mean((0, 1)), atol=0.51)
    assert half.tissue[0, 5, 5] == whole.tissue[0, 10:12, 10:12].all()
    assert half.clip.depth_mm[0, 5, 5] == whole.clip.depth_mm[0, 11, 11]
    assert half.clip.intrinsics == whole.clip.intrinsics.resized(32, 24)
    for size in (":30x24", ":640x480"):
        with pytest.raises(InputError, match="no whole number"):
            open_source(source_of(f"d4d_endonerf{size}"), "every8", TrainingHooks())
    for unknown in ("d4d_endonerf:half", "d4d_stereo:337x256"):
        with pytest.raises(InputError, match="is not known"):
            source_of(unknown)


def test_a_recording_is_looked_for_where_the_environment_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(DATA_VARIABLE, raising=False)
    with pytest.raises(InputError, match=f"{DATA_VARIABLE} says, and that is not set"):
        source_of("d4d_endonerf")
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path))
    with pytest.raises(InputError, match=f"d4d_endonerf is not under {tmp_path}"):
        source_of("d4d_endonerf")
    (tmp_path / "d4d_endonerf").mkdir()
    assert source_of("d4d_endonerf").clip == tmp_path / "d4d_endonerf"


def test_a_curve_ends_where_its_run_does(measured: Path) -> None:
    fast, _ = read_rows(measured / RUNS)
    last = [row for row in read_rows(measured / CURVES) if row["series"] == "fast"][-1]
    assert float(last["t_train_s"]) < float(last["t_post_s"]) < float(fast["t_post_s"])
    assert (last["iteration"], fast["iterations"]) == ("12", "12")
    for score in ("psnr_tissue_db", "ssim", "depth_agreement_mm"):
        assert float(last[score]) == pytest.approx(float(fast[score]), abs=1e-3)


def test_what_has_its_row_is_not_measured_again(measured: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (measured / RUNS).read_bytes()
    assert evaluate(measured, "--series", "fast", "hexplane") == ExitCode.OK
    assert "2 of them have their rows already" in capsys.readouterr().out
    assert (measured / RUNS).read_bytes() == before


def test_rows_alone_are_enough_to_draw_also_while_others_are_added(
    measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Figure, "savefig", DRAWN)
    for name in (RUNS, CURVES):
        (tmp_path / name).write_bytes((measured / name).read_bytes())
    with adding_alone(tmp_path):
        assert main(["evaluate", "--redraw", "--out", str(tmp_path)]) == ExitCode.OK
    for name in ("pareto.png", "curves.svg", "frames.png", SUMMARY):
        assert (tmp_path / name).stat().st_size > 0


def test_a_cell_that_fails_is_a_row_that_says_why(tmp_path: Path) -> None:
    assert main(["evaluate", CLIP, "--series", "fast", "--holdout", "99", "--out", str(tmp_path)]) == ExitCode.FAILED
    (row,) = read_rows(tmp_path / RUNS)
    assert row["error"].startswith("InputError: options.holdout: frame 99 is not in a clip of 12 frames")
    assert read_rows(tmp_path / CURVES) == []


def test_the_last_lines_count_what_failed_and_only_a_call_without_any_result_has_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["evaluate", CLIP, "--series", "fast", "--iterations", "3", "--out", str(tmp_path), "--holdout"]
    says = "cells failed, the first because of InputError: options.holdout: frame 99 is not in a clip of 12 frames"
    for _ in range(2):  # the second call finds the row
        assert main([*asked, "99"]) == ExitCode.FAILED
        counted, remedy = capsys.readouterr().out.splitlines()[-2:]
        assert counted.startswith(f"1 of 1 {says}")
        assert "--again" in remedy
    assert main([*asked, "99", "every8"]) == ExitCode.OK
    assert f"1 of 2 {says}" in capsys.readouterr().out
    assert main([*asked, "every8"]) == ExitCode.OK
    assert "--again" not in capsys.readouterr().out


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_said_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate(tmp_path / "out", "--series", "fast", "--device", "cuda") == ExitCode.UNAVAILABLE
    assert "--device cpu" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "lacking", [UnavailableError("The disk is full.", "Make room."), ModuleNotFoundError("No module named 'triton'")]
)
def test_what_this_machine_lacks_ends_measuring_and_is_no_row(tmp_path: Path, lacking: Exception) -> None:
    def fail(_: Progress) -> None:
        raise lacking

    source = source_of(CLIP)
    (cell,) = plan([source.name], ["fast"], ["every8"], [0], iterations=[3])
    with pytest.raises(type(lacking), match=str(lacking)):
        Bench({source.name: source}).measure(cell, TrainingHooks(on_progress=fail))


def test_what_failed_is_measured_again_only_if_asked_to(tmp_path: Path) -> None:
    source = source_of(CLIP)
    (cell,) = plan([source.name], ["fast"], ["every8"], [0], iterations=[12])
    failed = {**dict(zip(KEY, cell.key, strict=True)), "error": "RuntimeError: the disk was full"}
    Results(tmp_path).add(failed, [])
    assert evaluate(tmp_path, "--series", "fast") == ExitCode.FAILED
    assert [row["error"] for row in read_rows(tmp_path / RUNS)] == ["RuntimeError: the disk was full"]
    assert evaluate(tmp_path, "--series", "fast", "--again") == ExitCode.OK
    assert [row["error"] for row in read_rows(tmp_path / RUNS)] == [""]


@pytest.mark.parametrize(
    "command", [["evaluate", CLIP, "--iterations", "1"], ["stability", "--conditions", "smoke", "--iterations", "1"]]
)
def test_a_second_process_that_would_add_rows_to_a_folder_is_refused(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with adding_alone(tmp_path):
        assert main([*command, "--out", str(tmp_path)]) == ExitCode.BAD_INPUT
    assert "another process is adding rows" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [LOCK]


def test_a_process_that_was_killed_leaves_the_folder_to_the_next(tmp_path: Path) -> None:
    program = (
        "import sys, time; from pathlib import Path; from lab.evaluate.rows import adding_alone\n"
        "with adding_alone(Path(sys.argv[1])): print(flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(InputError, match="another process"), adding_alone(tmp_path):
            pass
        other.kill()
    with adding_alone(tmp_path):
        pass


class InterruptedAfterOne(Bench):
    """Ctrl-C comes when the first cell has been measured."""

    def measure(self, cell: Cell, hooks: TrainingHooks) -> tuple[Values, list[Values]]:
        found = super().measure(cell, hooks)
        signal.raise_signal(signal.SIGINT)
        return found


def test_what_was_measured_before_an_interruption_is_kept_and_the_rest_goes_on(tmp_path: Path) -> None:
    source = source_of(CLIP)
    cells: Sequence[Cell] = plan([source.name], ["fast"], ["every8"], [0, 1], iterations=[3])
    with pytest.raises(Cancelled):
        measure_all(InterruptedAfterOne({source.name: source}), cells, Results(tmp_path))
    kept = Results(tmp_path)
    assert [kept.has(cell.key) for cell in cells] == [True, False]
    measure_all(Bench({source.name: source}), [cell for cell in cells if not kept.has(cell.key)], kept)
    assert [row["seed"] for row in Results(tmp_path).runs] == ["0", "1"]


def test_a_curve_whose_run_has_no_row_is_forgotten(measured: Path, tmp_path: Path) -> None:
    lines = (measured / RUNS).read_text().splitlines(keepends=True)
    (tmp_path / RUNS).write_text("".join(lines[:2]))
    (tmp_path / CURVES).write_bytes((measured / CURVES).read_bytes())
    assert {row["series"] for row in Results(tmp_path).curves} == {"fast"}


@pytest.mark.parametrize(
    "arguments",
    [
        ["phantom:dancing"],
        ["phantom:pull:huge"],
        ["phantom:pull+fly"],
        ["phantom:pull:spoon"],
        ["nowhere.mp4"],
        [CLIP, "--series", "slow"],
        [CLIP, CLIP],
        [CLIP, "--redraw"],
        [],
        ["--redraw"],
    ],
    ids=" ".join,
)
def test_what_cannot_be_meant_is_refused_before_anything_is_measured(arguments: list[str], tmp_path: Path) -> None:
    assert main(["evaluate", *arguments, "--out", str(tmp_path)]) == ExitCode.BAD_INPUT
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("clip", ["phantom:dancing", "phantom:pull+fly", "phantom:pull:9x9", "phantom:pull:spoon"])
def test_a_clip_that_cannot_be_drawn_is_named_by_the_argument_that_spells_it(clip: str) -> None:
    with pytest.raises(InputError) as refused:
        source_of(clip)
    assert refused.value.field == "CLIP"
    assert clip in refused.value.problem
