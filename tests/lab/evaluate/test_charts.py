"""Charts are drawn from the rows alone, and tell what is missing."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import cv2
import pytest
from matplotlib.figure import Figure

from lab.evaluate.charts import draw_all
from lab.evaluate.published import LABEL
from lab.evaluate.rows import CURVE_FIELDS, CURVES, RUN_FIELDS, RUNS, Results, write_rows
from tests.lab.evaluate.made_up import curve_rows, failed_row, run_row

CHARTS = ["curves", "curves-ssim", "curves-depth", "pareto", "pareto-one-clip", "frames"]


def results_in(folder: Path) -> Results:
    """Two presets and one that failed at two places, one of them without `paper`; and a clip where all failed."""
    fast = [run_row("fast", 39.0 + seed / 10, seed=seed) for seed in range(3)]
    paper = run_row("paper", 38.0, limit="3000 iterations", t_train_s=240.0, scene_bytes=140_000_000)
    blocks = run_row("fast", 33.0, holdout="blocks8")
    failed = [failed_row("hexplane"), failed_row("fast") | {"clip": "other"}]
    curves = [row for run in (*fast, blocks) for row in curve_rows(run, [(5.0, 200, 35.0), (60.0, 2900, 39.0)])]
    write_rows(folder / RUNS, RUN_FIELDS, [*fast, paper, blocks, *failed])
    write_rows(folder / CURVES, CURVE_FIELDS, [*curves, *curve_rows(paper, [(240.0, 3000, 38.0)])])
    return Results(folder)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import matplotlib as mpl

    folder = tmp_path_factory.mktemp("charts")
    with mpl.rc_context({"svg.fonttype": "none"}):  # text stays text
        assert draw_all(results_in(folder), folder) == CHARTS
    return folder


def draw_only(patch: pytest.MonkeyPatch, *patterns: str) -> None:
    """Leave out files that match none of the patterns: drawing all takes seconds, and the first test here does it."""
    draw = Figure.savefig

    def draw_if_wanted(figure: Figure, path: Path, **how: Any) -> None:
        if any(fnmatch(path.name, pattern) for pattern in patterns):
            draw(figure, path, **how)

    patch.setattr(Figure, "savefig", draw_if_wanted)


@pytest.mark.parametrize("name", CHARTS)
def test_every_chart_is_drawn_as_png_and_svg(name: str, drawn: Path) -> None:
    picture = cv2.imread(str(drawn / f"{name}.png"))
    assert picture is not None
    assert picture.std() > 1, "something is on it"
    assert (drawn / f"{name}.svg").read_text().startswith("<?xml")


def test_the_same_rows_give_the_same_bytes(drawn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib as mpl

    draw_only(monkeypatch, "pareto.*", "curves.*")
    with mpl.rc_context({"svg.fonttype": "none"}):
        draw_all(results_in(tmp_path), tmp_path)
    for name in ("pareto.svg", "curves.svg", "curves.png"):
        assert (tmp_path / name).read_bytes() == (drawn / name).read_bytes()


def test_a_chart_names_what_is_missing_what_failed_and_what_others_published(drawn: Path) -> None:
    text = (drawn / "pareto.svg").read_text()
    assert "failed: hexplane; missing:" in text
    assert "failed: fast; missing:" in text, "a clip where everything failed keeps its panel"
    assert text.count(LABEL) == 1
    assert text.count(">copying: flow<") == 2


def test_the_clock_of_the_user_has_charts_of_its_own_that_name_who_lacks_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import matplotlib as mpl

    draw_only(monkeypatch, "*.svg")
    fast, paper = run_row("fast", 39.0, t_post_s=75.0), run_row("paper", 38.0)
    points = [(5.0, 200, 35.0), (60.0, 2900, 39.0)]
    other = run_row("fast", 33.0, clip="other")
    write_rows(tmp_path / RUNS, RUN_FIELDS, [fast, paper, other])
    curves = [*curve_rows(fast, points, 9.0), *curve_rows(paper, points), *curve_rows(other, points)]
    write_rows(tmp_path / CURVES, CURVE_FIELDS, curves)
    with mpl.rc_context({"svg.fonttype": "none"}):
        assert set(draw_all(Results(tmp_path), tmp_path)) == {*CHARTS, "curves-post", "pareto-post"}
    charts = {name: (tmp_path / f"{name}.svg").read_text() for name in (*CHARTS, "curves-post", "pareto-post")}
    assert ("other, every8" in charts["curves"], "other, every8" in charts["curves-post"]) == (True, False)
    for name in ("curves-post", "pareto-post"):
        assert charts[name].count(">seconds since the request (log)<") == 1
        assert charts[name].count("without t_post_s: paper<") == 1
        assert LABEL not in charts[name], "papers print seconds of training"
    alone = charts["pareto-one-clip"]
    assert (alone.count(">seconds of training (log)<"), alone.count(">seconds since the request (log)<")) == (1, 1)
    assert "without t_" not in charts["curves"] + charts["pareto"]


def test_left_and_right_eye_stand_beside_each_other_where_a_clip_has_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import matplotlib as mpl

    draw_only(monkeypatch, "curves-eyes.*", "pareto-right.*")
    stereo = {"clip": "d4d-a-stereo", "copy_blend_db": "", "warp_db": 30.7}
    runs = [run_row("fast", 37.5, psnr_right_db=36.0, **stereo), run_row("fast", 40.0)]
    runs.append(run_row("fast:eyes=left", 38.6, psnr_right_db=30.6, **stereo))
    curves = [row for run in runs for row in curve_rows(run, [(5.0, 200, 35.0), (60.0, 2900, 39.0)])]
    write_rows(tmp_path / RUNS, RUN_FIELDS, runs)
    write_rows(tmp_path / CURVES, CURVE_FIELDS, [row | {"psnr_right_db": "33"} for row in curves])
    with mpl.rc_context({"svg.fonttype": "none"}):
        assert draw_all(Results(tmp_path), tmp_path) == [*CHARTS, "curves-eyes", "pareto-right"]
    eyes, pareto = ((tmp_path / f"{name}.svg").read_text() for name in ("curves-eyes", "pareto-right"))
    assert (eyes.count(">left eye<"), eyes.count(">right eye<")) == (1, 1), "the clip of one eye has no panel"
    assert ">held-out psnr_right, dB<" in eyes
    assert ">fast:eyes=left<" in pareto
    for text in (eyes, pareto):
        assert text.count(">warped left eye<") == 1
    assert "copying" not in pareto


def test_a_grid_of_capacities_is_drawn_as_its_knee_alone(tmp_path: Path) -> None:
    rows = [run_row("fast", 30.0)]
    rows += [
        run_row(f"fast:bases={bases},points_per_image={points}", 29.0, scene_bytes=bases * points * 40)
        for bases in (3, 9)
        for points in (10_000, 20_000)
    ]
    write_rows(tmp_path / RUNS, RUN_FIELDS, rows)
    assert draw_all(Results(tmp_path), tmp_path) == ["knee"]


@pytest.mark.parametrize("rows", [[], [failed_row("fast")]], ids=["none", "failed"])
def test_without_a_run_that_ended_well_nothing_is_drawn(rows: list[dict[str, str]], tmp_path: Path) -> None:
    write_rows(tmp_path / RUNS, RUN_FIELDS, rows)
    assert draw_all(Results(tmp_path), tmp_path) == []
