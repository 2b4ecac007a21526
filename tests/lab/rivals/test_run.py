"""A rival's row, its clock, and what a series of its name is."""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

import pytest
import torch

from intrasplat.clip import FrameSplit
from intrasplat.clip.sampling import most_frames
from intrasplat.errors import Cancelled, InputError, TrainingDiverged
from intrasplat.machine.timing import Stopwatch
from intrasplat.methods.registry import PRESETS
from intrasplat.splat.backend import choose_device
from intrasplat.train.hooks import TrainingHooks
from lab.evaluate import measure, stability
from lab.evaluate.cells import Cell, capacity_grid, options_of, plan, preset_of
from lab.evaluate.measure import OF_WHOLE_PICTURES, OPAQUE, Bench
from lab.evaluate.rows import CURVE_FIELDS, KEY, RUN_FIELDS, TRUTH
from lab.evaluate.sources import source_of
from lab.rivals import RIVAL_BUDGET_S, RIVAL_SYSTEMS, run, scored_step_px
from lab.rivals.endogaussian import EndoGaussian
from lab.rivals.endonerf import EndoNerf
from lab.rivals.lerplane import LerPlane
from lab.rivals.rival import Rival, Seen
from lab.rivals.run import Length, Make, Renders, run_rival, train_rival
from tests.lab.rivals.cases import check_step, small_clip
from tests.lab.rivals.test_endogaussian import TINY as TINY_GAUSSIANS
from tests.lab.rivals.test_endonerf import TINY as TINY_NERF
from tests.lab.rivals.test_lerplane import TINY as TINY_PLANES

CLIP = "phantom:pull:64x48:9frames"


def tiny_nerf(seen: Seen, seed: int) -> EndoNerf:
    return EndoNerf(seen, seed, TINY_NERF)


def tiny_gaussians(seen: Seen, seed: int) -> EndoGaussian:
    return EndoGaussian(seen, seed, TINY_GAUSSIANS)


def tiny_planes(seen: Seen, seed: int) -> LerPlane:
    return LerPlane(seen, seed, TINY_PLANES)


OF_EACH_RIVAL = pytest.mark.parametrize("make", [tiny_nerf, tiny_gaussians, tiny_planes])


@pytest.mark.parametrize(
    ("series", "make", "not_measured"),
    [
        ("endonerf", tiny_nerf, ("motion", "confidence", "coverage and seen_ok", "whole pictures")),
        ("endogaussian", tiny_gaussians, ("confidence",)),
    ],
)
def test_a_rival_s_row_has_every_figure_but_those_it_cannot_have_and_says_why(
    series: str, make: Make, not_measured: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measure, "TIMED_RENDERS", 2)
    source = source_of(CLIP)
    made: list[Rival] = []

    def kept(seen: Seen, seed: int) -> Rival:
        made.append(make(seen, seed))
        return made[-1]

    bench = Bench({source.name: source}, "cpu", {series: kept})
    row, curve = bench.measure(Cell(source.name, series, "every8", 0, iterations=2), TrainingHooks())
    empty = {name for name in RUN_FIELDS if row.get(name) in (None, "") or row[name] != row[name]}
    of_the_right_eye = {"psnr_right_db", "psnr_right_clear_db", "warp_db", "warp_clear_db"}
    of_scenes = {"bases", "floats_a_gaussian", "stored_loss_held_out_db"}
    of_moving = {"moving_mm", "moving_error_mm"}  # nothing moves a millimetre in so short a clip
    of_gaussians: set[str] = set() if made[0].gaussians else {"gaussians"}
    figures = {
        "motion": ("mo",), "confidence": ("rank_",), "coverage and seen_ok": OPAQUE, "whole pictures": OF_WHOLE_PICTURES
    }  # fmt: skip
    starts = sum((figures[each] for each in not_measured), ())
    cannot = {name for name in RUN_FIELDS if name in TRUTH + OF_WHOLE_PICTURES + OPAQUE and name.startswith(starts)}
    assert empty == {"error", *of_the_right_eye, *of_scenes, *of_moving, *of_gaussians, *cannot}
    assert [each.partition(":")[0] for each in str(row["not_measured"]).split("; ")] == list(not_measured)
    assert row["scene_bytes"] == 4 * sum(each.numel() for each in made[0].parameters())
    end = curve[-1]  # a slow machine has points on the way, too
    assert set(CURVE_FIELDS) - set(KEY) == set(end)
    assert (end["ssim"] is None) == ("ssim" in cannot)
    assert (end["iteration"], end["t_train_s"]) == (2, row["t_train_s"])
    assert row["t_post_s"] == end["t_post_s"] >= row["t_train_s"]  # type: ignore[operator]
    for name in {"psnr_tissue_db", "ssim", "depth_agreement_mm"} - cannot:
        assert end[name] == pytest.approx(row[name], abs=1e-3)


@OF_EACH_RIVAL
def test_a_step_changes_the_numbers_that_have_a_gradient(make: Make) -> None:
    check_step(make(Seen.of(small_clip(2), [0, 1]), 0))


def test_a_budget_ends_the_training_and_scoring_takes_none_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "SCORED_SECONDS", (0.1,))
    rival, clock = tiny_nerf(Seen.of(small_clip(2), [1]), 0), Stopwatch()
    scored: list[int] = []

    def score(made: int) -> float:
        scored.append(made)
        time.sleep(0.4)
        return 20.0

    reports: list[float] = []
    hooks = TrainingHooks(on_progress=lambda now: reports.append(now.fraction))
    made = train_rival(rival, Length(None, 0.3), clock, hooks, score)
    assert clock.elapsed_s >= 0.3, "all of the budget is used"
    assert scored == sorted({*scored, made}), "0.4 s of scoring at the mark of 0.1 s would have ended it"
    assert reports == sorted(reports)


@OF_EACH_RIVAL
def test_a_budget_that_the_start_uses_up_leaves_one_iteration(make: Make) -> None:
    rival = make(Seen.of(small_clip(2), [0, 1]), 0)
    before = [each.detach().clone() for each in rival.parameters()]
    scored: list[int] = []

    def score(made: int) -> float:
        scored.append(made)
        return 20.0

    assert train_rival(rival, Length(None, 1e-9), Stopwatch(), TrainingHooks(), score) == 1
    assert scored == [1]
    assert any(not torch.equal(was, now) for was, now in zip(before, rival.parameters(), strict=True))


def test_a_budget_ends_at_the_published_iterations_if_these_come_first() -> None:
    clip = small_clip(2)

    class Published(EndoGaussian):
        published_steps = 3

    def make(seen: Seen, seed: int) -> Published:
        return Published(seen, seed, TINY_GAUSSIANS)

    fitted = run_rival(
        "endogaussian", make, clip, FrameSplit([1], [0], []), Length(None, 600.0),
        seed=0, device=choose_device("cpu"), waited_s=0.0, hooks=TrainingHooks(),
    )  # fmt: skip
    assert fitted.report.iterations == 3
    assert Length(4, 600.0).progress(1, 300.0) == 0.5, "the rates follow what is nearer its end"


def test_a_rival_knows_how_much_of_its_time_is_used() -> None:
    shares: list[float] = []

    class Noting(EndoNerf):
        def step(self, iteration: int, progress: float) -> float:
            assert self.time_share <= progress
            shares.append(self.time_share)
            time.sleep(0.02)
            return 0.0

    seen = Seen.of(small_clip(2), [1])
    train_rival(Noting(seen, 0, TINY_NERF), Length(10**6, 0.1), Stopwatch(), TrainingHooks(), lambda _: math.nan)
    assert 0 <= shares[0] < shares[1] <= shares[-1] < 1
    shares.clear()
    train_rival(Noting(seen, 0, TINY_NERF), Length(2, None), Stopwatch(), TrainingHooks(), lambda _: math.nan)
    assert shares == [0.0, 0.0]


def test_a_rival_stops_when_it_is_asked_to_and_when_its_loss_is_no_number() -> None:
    rival = tiny_nerf(Seen.of(small_clip(2), [1]), 0)
    with pytest.raises(Cancelled):
        train_rival(rival, Length(9, None), Stopwatch(), TrainingHooks(should_stop=lambda: True), lambda _: math.nan)
    with torch.no_grad():
        rival.parameters()[0].fill_(math.nan)
    with pytest.raises(TrainingDiverged, match="iteration 1"):
        train_rival(rival, Length(9, None), Stopwatch(), TrainingHooks(), lambda _: math.nan)


def test_a_clip_without_depth_is_refused() -> None:
    clip = small_clip(2)
    blind = dataclasses.replace(clip, depth_mm=0 * clip.depth_mm)
    with pytest.raises(InputError, match="valid depth"):
        Seen.of(blind, [1])


def test_a_rival_is_a_series_without_changes_and_no_preset() -> None:
    cells = plan(["clip"], ["table1"], ["every8"], [0])
    assert [cell.series for cell in cells] == ["fast", "paper", *reversed(tuple(RIVAL_SYSTEMS))]
    assert cells[-1].budget_s == RIVAL_BUDGET_S
    assert not set(RIVAL_SYSTEMS) & set(PRESETS)
    for series in ("endonerf:bases=3", "endonerf:eyes=left"):
        with pytest.raises(InputError, match="changes a system of others"):
            plan(["clip"], [series], ["every8"], [0])
    with pytest.raises(InputError, match="no preset"):
        preset_of("endonerf")
    with pytest.raises(InputError, match="'endonerf' is measured as published") as refused:
        capacity_grid("endonerf")
    assert refused.value.field == "--grid"
    with pytest.raises(InputError, match="no series 'nerfies'") as unknown:
        plan(["clip"], ["nerfies"], ["every8"], [0])
    assert unknown.value.field == "--series"
    assert "lerplane" in unknown.value.remedy


def test_a_rival_trains_on_the_frames_of_the_published_method_whatever_its_budget() -> None:
    for series in ("paper", "endonerf"):
        assert most_frames(options_of(Cell("clip", series, "every8", 0, budget_s=1.0))) is None
    assert most_frames(options_of(Cell("clip", "fast", "every8", 0, budget_s=1.0))) is not None


def test_a_picture_is_rendered_once_until_the_rival_trains_further() -> None:
    clip = small_clip(2)
    rival = tiny_nerf(Seen.of(clip, [1]), 0)
    renders = Renders(rival)
    first = renders(0.5, clip.world_from_camera[1], clip.intrinsics)
    assert renders(0.5, clip.world_from_camera[1], clip.intrinsics) is first
    assert renders(0.6, clip.world_from_camera[1], clip.intrinsics) is not first
    renders.forget()
    assert renders(0.5, clip.world_from_camera[1], clip.intrinsics) is not first


def test_what_draws_ray_by_ray_is_scored_at_as_few_pixels_of_a_wide_clip_as_of_a_narrow_one() -> None:
    cpu = choose_device("cpu")
    steps_px = [scored_step_px("lerplane", cpu, width) for width in (64, 160, 320, 640, 1920)]
    assert steps_px == [5, 5, 5, 10, 30]
    assert scored_step_px("endogaussian", cpu, 1920) == 1


def test_a_rival_has_cells_in_the_atlas_that_tell_of_the_clip(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(stability, "RIVAL_SYSTEMS", {"endonerf": tiny_nerf})
    atlas = stability.StabilityBench(tmp_path, stability.Grid(64, 48, frames=9, iterations=2))
    cells = stability.plan(["smoke"], [5], ["endonerf"], [0])
    rows = [atlas.measure(cell, TrainingHooks()) for cell in cells]
    assert [row["severity"] for row in rows] == ["0", "5"]
    for row in rows:
        assert row["error"] == "", row["error"]
        assert all(row[name] for name in ("psnr_db", "depth_error_mm", "reported_db"))
        assert row["outcome"] in ("held", "told", "silent")
    assert ["warning:veiled" in row["codes"].split() for row in rows] == [False, True]
    assert atlas.missing(cells) == []
