"""The stability atlas: what counts as silent, rows that are kept, and maps that show what is missing as missing."""

from __future__ import annotations

from pathlib import Path

import pytest

from intrasplat.commands.exits import ExitCode
from intrasplat.errors import Cancelled, InputError, LimitError, TrainingDiverged, UnavailableError
from intrasplat.machine.hooks import Progress
from intrasplat.notices import Notice, NoticeCode
from intrasplat.train.hooks import TrainingHooks
from intrasplat.train.request import ReconstructionRequest
from lab.__main__ import main
from lab.conditions import CLEAN, CLEAN_STEREO, CONDITIONS, clean_clip
from lab.evaluate.atlas import count_outcomes, draw_map, places_of, told_table
from lab.evaluate.rows import Row, read_rows, write_rows
from lab.evaluate.stability import (
    FIELDS,
    KEY,
    STABILITY,
    Grid,
    StabilityBench,
    StabilityCell,
    measured,
    plan,
    stability_rows,
)
from lab.evaluate.verdict import SEPARATOR, failure, new_warnings, verdict
from lab.pages.stability import stability_sections
from tests.test_repository import REPOSITORY

pytestmark = pytest.mark.usefixtures("each_phantom_once")

SMALL = Grid(width=96, height=80, frames=12, iterations=15)


def row(
    psnr_db: float = 30.0, depth_error_mm: float = 0.5, *notices: Notice, error: str = "", outcome: str = ""
) -> Row:
    """What measuring a cell gives."""
    empty = dict.fromkeys(FIELDS, "")
    figures = {"psnr_db": f"{psnr_db:.3f}", "depth_error_mm": f"{depth_error_mm:.3f}"} if not error else {}
    told = {
        "warnings": SEPARATOR.join(each.text for each in notices),
        "codes": " ".join(f"{each.severity}:{each.code}" for each in notices),
    }
    return {**empty, **figures, **told, "error": error, "outcome": outcome}


PALE = Notice.warning(NoticeCode.VEILED, "the tissue is pale")
COPYING = Notice.info(NoticeCode.COPYING_SCORES_MORE, "copying scores more")


def few_frames(count: int) -> Notice:
    return Notice.warning(NoticeCode.FEW_FRAMES, f"only {count} frames")


@pytest.mark.parametrize(
    ("measured_row", "outcome"),
    [
        (row(), "held"),
        (row(27.2), "held"),
        (row(26.0), "silent"),
        (row(26.0, 0.5, PALE), "told"),
        (row(26.0, 0.5, few_frames(5)), "silent"),
        (row(26.0, 0.5, COPYING), "silent"),
        (row(30.0, 3.0), "silent"),
        (row(30.0, 3.0, Notice.warning(NoticeCode.DEPTH_DISAGREES, "depth differs by 3.1 mm")), "told"),
        (row(40.0, 0.5, PALE), "held"),
        (row(error="InputError: masks: they look inverted.", outcome="refused"), "refused"),
    ],
)
def test_silent_is_harm_without_a_warning_that_the_clean_clip_has_not(measured_row: Row, outcome: str) -> None:
    clean = row(30.0, 0.5, few_frames(28))
    assert verdict(measured_row, clean)["outcome"] == outcome


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (InputError("masks", "they look inverted.", "Turn them."), "refused"),
        (LimitError("clip", "too large.", "Cut it."), "refused"),
        (TrainingDiverged("the loss is no number"), "diverged"),
        (ZeroDivisionError("division by zero"), "crashed"),
    ],
)
def test_the_type_of_an_error_decides_how_a_cell_failed(error: Exception, outcome: str) -> None:
    assert failure(error) == outcome


def lit(condition: str, psnr_db: float, fitted: float | None) -> Row:
    return row(psnr_db) | {"condition": condition, "fitted_db": "" if fitted is None else f"{fitted:.3f}"}


def test_where_light_is_ambiguous_the_score_after_a_fit_decides_and_elsewhere_the_plain_one() -> None:
    clean = lit(CLEAN, 30.0, 30.5)
    drifted = verdict(lit("exposure_drift", 20.0, 29.0), clean)
    assert (drifted["outcome"], drifted["loss_db"], drifted["fitted_loss_db"]) == ("held", "10.00", "1.50")
    assert verdict(lit("exposure_drift", 20.0, 26.0), clean)["outcome"] == "silent"
    assert verdict(lit("splash", 20.0, 29.0), clean)["outcome"] == "silent"
    assert verdict(lit("exposure_drift", 20.0, 29.0), lit(CLEAN, 30.0, None))["outcome"] == "unknown"
    before = verdict(lit("splash", 29.0, 29.0), lit(CLEAN, 30.0, None))
    assert (before["outcome"], before["fitted_loss_db"]) == ("held", "")


def test_rows_from_before_a_fit_was_measured_have_no_figure_of_it(tmp_path: Path) -> None:
    older = [name for name in FIELDS if not name.startswith("fitted")]
    write_rows(tmp_path / STABILITY, older, ROWS)
    assert {each["fitted_db"] for each in StabilityBench(tmp_path, SMALL).rows} == {""}
    assert "/" not in told_table(places_of(stability_rows(tmp_path), "fast"), "fast").replace("| /", "")
    assert "after one fit" not in "".join(stability_sections(tmp_path, tmp_path))


def test_without_a_clean_score_nothing_is_known() -> None:
    assert verdict(row(), None)["outcome"] == "unknown"
    assert verdict(row(), row(error="InputError: no", outcome="refused"))["outcome"] == "unknown"


def test_a_clean_row_whose_warnings_have_no_codes_tells_nothing() -> None:
    before_codes = row(30.0, 0.5, few_frames(28)) | {"codes": ""}
    assert verdict(row(26.0), before_codes)["outcome"] == "unknown"


def test_warnings_of_one_code_are_of_one_kind() -> None:
    assert new_warnings(row(30.0, 0.5, few_frames(5), PALE, COPYING), row(30.0, 0.5, few_frames(28))) == [PALE.text]


def test_the_stored_rows_keep_their_outcomes() -> None:
    stored = read_rows(REPOSITORY / "lab" / "rows" / STABILITY)
    assert stored
    assert {each["outcome"] for each in stored} <= {
        "held",
        "told",
        "silent",
        "refused",
        "diverged",
        "crashed",
        "unknown",
    }


def test_the_plan_puts_each_clean_clip_before_what_is_compared_with_it() -> None:
    cells = plan(["smoke", "misrectified"], [1, 3], ["fast", "paper"], [0, 1])
    assert len(cells) == len(set(cells)) == 2 * 2 * (2 + 4)
    for cell in cells:
        assert cells.index(cell.clean) <= cells.index(cell)
    assert {cell.clean.condition for cell in cells if cell.condition == "misrectified"} == {CLEAN_STEREO}
    calm, pulled = plan(["fast_pull"], [3], ["fast"], [0])
    assert (calm.condition, calm.severity, calm.clean, pulled.clean) == ("fast_pull", 0, calm, calm)
    with pytest.raises(InputError, match="fog"):
        plan(["fog"], [1], ["fast"], [0])
    with pytest.raises(InputError, match="faster"):
        plan(["smoke"], [1], ["faster"], [0])


def test_a_few_cells_are_measured_judged_kept_and_not_measured_again(tmp_path: Path) -> None:
    cells = plan(["smoke", "few_frames"], [5], ["fast"], [0])
    atlas = StabilityBench(tmp_path, SMALL)
    assert atlas.missing(cells) == cells
    found = {cell.condition: atlas.measure(cell, TrainingHooks()) for cell in cells[:2]}
    assert found[CLEAN]["outcome"] == "held"
    assert float(found[CLEAN]["loss_db"]) == 0.0
    assert found["smoke"]["outcome"] == "told"
    assert float(found["smoke"]["loss_db"]) > 3
    assert "smoke" in found["smoke"]["new_warnings"]
    again = StabilityBench(tmp_path, SMALL)
    assert again.missing(cells) == cells[2:]
    few = again.measure(cells[2], TrainingHooks())
    assert few["outcome"] in ("held", "told")
    assert few["reported_db"] == ""
    assert "Only 1 frames" in few["warnings"]
    kept = read_rows(tmp_path / STABILITY)
    assert [tuple(each[name] for name in KEY) for each in kept] == [cell.key(SMALL) for cell in cells]
    assert StabilityBench(tmp_path, Grid(96, 80, 12, 16)).missing(cells) == cells


def test_a_recording_is_read_as_any_other_and_its_checks_speak() -> None:
    found = measured(
        StabilityCell("inverted_masks", 2, "fast", 0), clean_clip(SMALL.settings(0)), SMALL, TrainingHooks()
    )
    assert found["error"].startswith("InputError: masks")
    assert verdict(found, None)["outcome"] == "refused"


def test_a_cell_that_is_interrupted_leaves_no_row(tmp_path: Path) -> None:
    atlas = StabilityBench(tmp_path, SMALL)
    with pytest.raises(Cancelled):
        atlas.measure(StabilityCell(CLEAN, 0, "fast", 0), TrainingHooks(should_stop=lambda: True))
    assert not (tmp_path / STABILITY).exists()


def test_what_this_machine_lacks_ends_measuring_and_is_no_row(tmp_path: Path) -> None:
    def fail(_: Progress) -> None:
        raise UnavailableError("The disk is full.", "Make room.")

    atlas = StabilityBench(tmp_path, SMALL)
    with pytest.raises(UnavailableError, match="The disk is full"):
        atlas.measure(StabilityCell(CLEAN, 0, "fast", 0), TrainingHooks(on_progress=fail))
    assert not (tmp_path / STABILITY).exists()


def placed(
    condition: str, severity: int, outcome: str, loss: str, told: str = "", error: str = "", seed: int = 0
) -> Row:
    text = {"condition": condition, "severity": str(severity), "series": "fast", "seed": str(seed)}
    figures = {"outcome": outcome, "loss_db": loss, "depth_loss_mm": "0.1" if loss else ""}
    return dict.fromkeys(FIELDS, "") | text | figures | {"new_warnings": told, "error": error}


ROWS = [
    placed(CLEAN, 0, "held", "0.00"),
    placed("smoke", 1, "held", "1.00"),
    placed("smoke", 1, "silent", "4.00", seed=1),
    placed("smoke", 5, "told", "12.00", "Even the dark tissue is pale | all else"),
    placed("inverted_masks", 3, "refused", "", error="InputError: masks: they look inverted."),
    placed("cutting", 2, "crashed", "", error="IndexError: 5"),
    placed("cutting", 3, "unknown", ""),
    placed("cutting", 4, "diverged", "", error="TrainingDiverged: no number"),
]


def test_a_place_of_the_map_has_the_mean_loss_and_the_worst_outcome_of_its_seeds() -> None:
    places = places_of(ROWS, "fast")
    smoke = places["smoke", 1]
    assert (smoke.outcome, smoke.loss_db, smoke.spread_db) == ("silent", 2.5, 3.0)
    assert count_outcomes(places) == {
        "silent": 1, "crashed": 1, "unknown": 1, "diverged": 1, "told": 1, "refused": 1,
    }  # fmt: skip
    assert places_of(ROWS, "paper") == {}


def test_the_map_is_drawn_with_cells_missing_and_the_same_from_the_same_rows(tmp_path: Path) -> None:
    for folder in ("first", "second"):
        assert draw_map(places_of(ROWS, "fast"), "fast", tmp_path / folder) == "stability-fast"
    first, second = (tmp_path / folder / "stability-fast.svg" for folder in ("first", "second"))
    assert first.read_bytes() == second.read_bytes()
    text = first.read_text()
    assert "not measured" in text
    assert "harmed, and nothing was said" in text
    assert CONDITIONS["smoke"].title in text
    assert CONDITIONS["tools"].title not in text
    assert (tmp_path / "first" / "stability-fast.png").stat().st_size > 10_000


def test_the_table_says_what_the_user_is_told() -> None:
    table = told_table(places_of(ROWS, "fast"), "fast")
    smoke, inverted = (
        next(line for line in table.splitlines() if CONDITIONS[name].title in line)
        for name in ("smoke", "inverted_masks")
    )
    assert "**silent** 2.5 (spread 3.0)" in smoke
    assert smoke.endswith("| Even the dark tissue is pale |")
    assert inverted.endswith("| masks: they look inverted. |")


def test_the_loss_after_a_fit_stands_beside_the_plain_one_where_it_differs() -> None:
    rows = [placed("splash", severity, "silent", "5.00") for severity in (1, 2)]
    places = places_of([rows[0] | {"fitted_loss_db": "2.30"}, rows[1] | {"fitted_loss_db": "4.80"}], "fast")
    assert "| **silent** 5.0 / 2.3 | **silent** 5.0 |" in told_table(places, "fast")
    assert places["splash", 1].judged_db == 5.0
    drift = placed("exposure_drift", 1, "held", "5.00") | {"fitted_loss_db": "2.30"}
    assert places_of([drift], "fast")["exposure_drift", 1].judged_db == 2.3


def test_the_page_shows_plain_and_fitted_scores_of_spoilt_light(tmp_path: Path) -> None:
    scores = {"psnr_db": "20.0", "fitted_db": "24.5"}
    clean = placed(CLEAN, 0, "held", "0.00") | {"psnr_db": "29.0", "fitted_db": "29.1"}
    write_rows(tmp_path / STABILITY, FIELDS, [clean, placed("smoke", 3, "told", "9.00") | scores])
    page = "".join(stability_sections(tmp_path, tmp_path))
    assert f"| {CONDITIONS['smoke'].title} | 29.0 / 29.1 | 20.0 / 24.5 | – |" in page


def test_the_command_draws_what_is_there_and_refuses_what_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stability", "--out", str(tmp_path), "--redraw"]) == ExitCode.BAD_INPUT
    options = ["--conditions", "grey_scale", "--severities", "5", "--series", "fast", "--size", "96x80"]
    short = ["--frames", "10", "--iterations", "5"]
    assert main(["stability", "--out", str(tmp_path), *options, *short]) == 0
    assert "2 cells, 0 of them" in capsys.readouterr().out
    assert main(["stability", "--out", str(tmp_path), *options, *short]) == 0
    assert "2 cells, 2 of them" in capsys.readouterr().out
    assert (tmp_path / "stability-fast.png").exists()
    assert "fast" in (tmp_path / "stability.md").read_text()


def test_the_page_of_results_counts_how_the_places_of_severities_3_and_5_ended(tmp_path: Path) -> None:
    assert stability_sections(tmp_path, tmp_path) == []
    scored = [placed(CLEAN, 0, "held", "0.00", seed=seed) | {"psnr_db": db} for seed, db in enumerate(("29.0", "30.0"))]
    write_rows(tmp_path / STABILITY, FIELDS, [*scored, *ROWS[1:]])
    page = "".join(stability_sections(tmp_path, tmp_path))
    assert "| fast | 29.5 | 3 of 76 | 0 | 0 | 1 | 0 | 1 | 1 | 0 |" in page  # severities 3 and 5
    assert "stability-fast.png" not in page


def test_the_page_shows_the_map_of_fast_if_it_is_drawn(tmp_path: Path) -> None:
    write_rows(tmp_path / STABILITY, FIELDS, ROWS)
    draw_map(places_of(ROWS, "fast"), "fast", tmp_path)
    assert "](stability-fast.png)" in "".join(stability_sections(tmp_path, tmp_path))


@pytest.mark.parametrize(("series", "eyes"), [("fast", "both"), ("fast:eyes=left", "left")])
def test_a_cell_trains_on_the_eyes_that_its_series_names(
    series: str, eyes: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[ReconstructionRequest] = []

    def stop(request: ReconstructionRequest, *_: object) -> None:
        asked.append(request)
        raise Cancelled("seen enough")

    monkeypatch.setattr("lab.evaluate.stability.reconstruct", stop)
    with pytest.raises(Cancelled):
        measured(StabilityCell(CLEAN_STEREO, 0, series, 0), clean_clip(SMALL.settings(0)), SMALL, TrainingHooks())
    assert asked[0].options.eyes == eyes
