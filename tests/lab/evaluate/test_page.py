"""The page of results says what the rows say, and names what they lack."""

from __future__ import annotations

from pathlib import Path

from lab.benchmarks.bm_post import FIELDS
from lab.evaluate.rows import CURVE_FIELDS, CURVES, RUN_FIELDS, RUNS, write_rows
from lab.pages.__main__ import PICTURES, ROWS, SHOWN, collect_charts
from lab.pages.evaluation import CAPACITY, MARKS, sections, write_readme
from lab.pages.gpu import ORIGIN, gpu_sections
from lab.pages.post import POST, post_sections, post_table
from lab.pages.right_eye import TWO_EYES, two_eyes_sections
from lab.pages.table1 import TABLE_1, table1_sections
from tests.lab.evaluate.made_up import curve_rows, failed_row, run_row


def results(folder: Path) -> Path:
    """`fast` on two clips, `paper` on one of them, an ablation that failed, and a grid of one capacity."""
    paper = run_row("paper", 38.0, limit="3000 iterations")
    fast, other = run_row("fast", 39.0), run_row("fast", 30.0, clip="phantom-pull", psnr_view10_db=27.5, moving_mm=4.2)
    (folder / CAPACITY).mkdir(parents=True)
    write_rows(folder / RUNS, RUN_FIELDS, [paper, fast, other, failed_row("hexplane")])
    curves = curve_rows(paper, [(240.0, 3000, 38.0)]) + curve_rows(fast, [(6.0, 200, 36.0), (12.0, 400, 38.0)])
    write_rows(folder / CURVES, CURVE_FIELDS, curves)
    write_rows(folder / CAPACITY / RUNS, RUN_FIELDS, [run_row("fast", 30.0), run_row("fast:bases=9", 30.05)])
    return folder


def page_of(folder: Path) -> str:
    return "".join(sections(folder, folder))


def test_the_page_makes_its_claims_from_rows(tmp_path: Path) -> None:
    page = page_of(results(tmp_path / "results"))
    assert "on 1 of 1 clips: 20.0 times sooner than `paper` ends, 20.0 times sooner than `paper` first" in page
    assert "and in 7.5 times fewer iterations" in page
    assert "| phantom-pull | fast | 27.5 |" in page
    assert "Within 0.1 dB of the best or above it: 1 of 1" in page
    assert "4 runs, 1 of them failed" in page


def test_the_page_tells_the_right_eye_beside_the_left_one(tmp_path: Path) -> None:
    assert two_eyes_sections(tmp_path) == []
    stereo = run_row("fast", 37.5, clip="d4d-a-stereo", psnr_right_db=36.04, warp_db=30.7)
    rows = [stereo, stereo | {"series": "fast:eyes=left", "psnr_right_db": "30.6"}]
    write_rows(tmp_path / TWO_EYES, RUN_FIELDS, rows)
    page = "".join(two_eyes_sections(tmp_path))
    assert "In 60 s, `fast` scores 37.5 dB in the left eye of `d4d-a-stereo` (every8) and 36.0 dB in the right" in page
    assert "| d4d-a-stereo | every8 | fast:eyes=left | 60 s | 37.5 | 30.6 | 30.7 | – |" in page


def test_the_page_says_what_failed_and_what_is_missing(tmp_path: Path) -> None:
    page = page_of(results(tmp_path / "results"))
    assert "failed: TrainingDiverged: no more" in page
    assert "Not run. d4d-a: instant" in page
    assert "; phantom-pull: instant, quality, small, paper" in page


def test_without_rows_there_is_nothing_to_say(tmp_path: Path) -> None:
    assert sections(tmp_path, tmp_path) == []


def test_the_readme_is_written_between_its_marks_alone_and_only_if_there_is_a_chart(tmp_path: Path) -> None:
    folder, readme = results(tmp_path / "docs"), tmp_path / "README.md"
    first, last = MARKS
    readme.write_text(f"before\n{first}\nold\n{last}\nafter\n")
    write_readme(readme, folder, folder)
    assert "old" in readme.read_text()
    (folder / "pareto-one-clip.png").touch()
    write_rows(folder / POST, FIELDS, [post_row()])
    write_readme(readme, folder, folder)
    text = readme.read_text()
    assert text.startswith(f"before\n{first}\n")
    assert text.endswith(f"{last}\nafter\n")
    assert "old" not in text
    assert "](docs/pareto-one-clip.png)" in text
    assert "| fast | 60 | 39.0 |" in text
    assert "| paper | 60 | 38.0 |" in text
    assert "| copying | – | 41.9 |" in text
    assert "| instant | cpu | 2.0 | 6.2 | 14.5 |" in text
    write_readme(readme, folder, folder)
    assert readme.read_text() == text, "twice is as good as once"


def post_row(**values: object) -> dict[str, object]:
    known = {"clip": "d4d_stereo", "preset": "instant", "way": "http", "commit": "new", "first_view_s": 2.0,
             "done_s": 15.0, "psnr_db": 32.0, "stages": '{"t_train_s": 6.2, "t_post_s": 14.5}'}  # fmt: skip
    return {**known, "machine": "a machine", **values}


def test_the_page_tells_what_a_caller_waits_for_by_both_clocks(tmp_path: Path) -> None:
    assert post_sections(tmp_path) == []
    assert post_table(tmp_path) == ""
    rows = [post_row(commit="old", first_view_s=9.0), post_row(good_view_s=12.1), post_row(first_view_s=2.4)]
    rows += [post_row(preset="fast", budget_s=20), post_row(way="shell", first_view_s="", done_s=20.0)]
    rows += [post_row(device="cuda (a GPU)", first_view_s=0.5, commit="newer")]
    rows += [post_row(poses="estimate", first_view_s=3.0), post_row(clip="phantom:pull", first_view_s=3.5)]
    write_rows(tmp_path / POST, FIELDS, rows)
    page = "".join(post_sections(tmp_path))
    assert "| d4d_stereo | instant | http | cpu | 2 | 2.2 | 12.1 (1 of 2) | 6.2 | 14.5 | 15.0 | 32.0 | – |" in page
    assert "| d4d_stereo | fast, 20 s | http | cpu | 1 | 2.0 | – | 6.2 | 14.5 | 15.0 | 32.0 | – |" in page
    assert "| d4d_stereo | instant | http | cuda (a GPU) | 1 | 0.5 | – | 6.2 | 14.5 | 15.0 | 32.0 | – |" in page
    assert "| d4d_stereo | instant | shell | cpu | 1 | – | – | 6.2 | 14.5 | 20.0 | 32.0 | – |" in page
    assert "| d4d_stereo, poses=estimate | instant | http | cpu | 1 | 3.0 | – | 6.2 | 14.5 | 15.0 | 32.0 | – |" in page
    assert "commits new, newer" in page
    shown = post_table(tmp_path)
    assert "| instant | cpu | 2.2 | 6.2 | 14.5 |" in shown
    assert "| instant | a GPU | 0.5 | 6.2 | 14.5 |" in shown
    assert shown.count("| instant |") == 2, "phantoms and poses that were asked for stand on the page alone"
    assert "fast" not in shown, "it was given other seconds than its own"


def test_each_system_of_table_1_stands_beside_the_next_and_the_papers_difference(tmp_path: Path) -> None:
    assert table1_sections(tmp_path) == []
    folder = tmp_path / TABLE_1
    folder.mkdir()
    runs = [
        run_row("paper", 34.0, limit="3000 iterations", render_fps=60, machine="Xeon, 2 cores, 2026-11-26"),
        run_row("endogaussian", 30.0, t_train_s=60, render_fps=40, machine="EPYC, 2 cores, 2026-11-26"),
        run_row("endogaussian", 31.5, limit="300 s", t_train_s=300, render_fps=20, machine="EPYC, 2 cores, 2026-11-26"),
        run_row("lerplane", 28.0, render_fps=0.2, machine="EPYC, 2 cores, 2026-11-27"),
        run_row("endonerf", 25.0, render_fps=0.04, machine="EPYC, 2 cores, 2026-11-27"),
    ]
    runs = [{**each, "psnr_paper_db": each["psnr_tissue_db"]} for each in runs]
    write_rows(folder / RUNS, RUN_FIELDS, runs)
    page = "".join(table1_sections(tmp_path))
    row = "| d4d-a | 2.5 * | 2.0 | 3.0 | 3.0 * | 100.0 | 5.0 |"
    assert row in page, "the longest run of each, but dB of two rivals after equal limits"
    assert "| published, EndoNeRF data | 0.2 | 1.1 | 1.0 | 2.6 | 88.4 | 48.3 |" in page
    assert page.index("| d4d-a | endogaussian | 300 |") < page.index("| d4d-a | endonerf |")
    assert "| d4d-a | endogaussian | 60 |" not in page


def test_two_rivals_are_compared_at_the_limit_at_which_the_first_ran_longest(tmp_path: Path) -> None:
    folder = tmp_path / TABLE_1
    folder.mkdir()
    runs = [
        run_row("lerplane", 28.0),
        run_row("lerplane", 29.0, limit="100 iterations", t_train_s=90),
        run_row("endonerf", 25.0),
        run_row("endonerf", 24.0, limit="100 iterations", t_train_s=30),
    ]
    write_rows(folder / RUNS, RUN_FIELDS, [{**each, "psnr_paper_db": each["psnr_tissue_db"]} for each in runs])
    assert "| d4d-a | – | – | 5.0 |" in "".join(table1_sections(tmp_path))


def test_the_page_tells_what_a_gpu_was_measured_to_do_and_what_of_it_is_not_to_be_believed(tmp_path: Path) -> None:
    assert gpu_sections(tmp_path) == []
    where = {name: f"a {name}" for name in ORIGIN}
    speeds: list[dict[str, object]] = [
        {"what": what, "scene": "fdm", "frames": frames, "value": value, "unit": "ms", "clock": "host"}
        for what, frames, value in [
            ("step, as trained", 1, 0.50812),
            ("step, as trained", 2, 1023.4),
            ("kernel: sort", 1, 3),
            ("stereo", 1, 7),
        ]
    ]
    checks: list[dict[str, object]] = [
        {"check": "the loss", "worst": 1.23456e-6, "limit": 1e-3, "ok": True, "detail": "d mean 1e-6"},
        {"check": "a sort", "worst": 1.0, "limit": 0, "ok": False, "detail": ""},
    ]
    for name, rows, believed in (("speed", speeds, "yes"), ("correct", checks, "another process ran")):
        told = [{**row, **where, "believed": believed} for row in rows]
        write_rows(tmp_path / f"gpu-{name}.csv", tuple(told[0]), told)
    page = "".join(gpu_sections(tmp_path))
    assert "|  | fdm, 1 | fdm, 2 |" in page
    assert "| step, as trained, ms | 0.508 | 1023 |" in page
    assert "| stereo | fdm | 1 | 7 | ms |" in page
    assert "kernel: sort" not in page
    assert "1 of 2 checks of the kernels hold; failed: a sort." in page
    assert 'that of "the loss": 1.23e-06, limit 0.00100.' in page
    assert "d mean" not in page
    assert "Measured on a machine, a gpu, driver a driver, torch a torch, triton a triton, commit a commit.\n" in page
    assert "**Not to be believed: another process ran.**" in page


def test_charts_that_a_page_shows_move_to_the_pictures(tmp_path: Path) -> None:
    rows, pictures = tmp_path / "rows", tmp_path / "pictures"
    (rows / "capacity").mkdir(parents=True)
    for name in ("curves.png", "curves-ssim.png", "capacity/knee.png"):
        (rows / name).touch()
    collect_charts(rows, pictures)
    assert sorted(str(path.relative_to(pictures)) for path in pictures.rglob("*.png")) == [
        "capacity/knee.png",
        "curves.png",
    ]
    assert (rows / "curves-ssim.png").exists()


def test_every_picture_is_shown_by_a_page_and_rows_lie_with_the_laboratory() -> None:
    pages = (PICTURES / "index.md").read_text() + (PICTURES.parent.parent / "README.md").read_text()
    stored = {str(path.relative_to(PICTURES)) for path in PICTURES.rglob("*") if path.is_file()}
    assert [name for name in sorted(stored) if name != "index.md" and f"{name})" not in pages] == []
    assert stored >= set(SHOWN)
    assert (ROWS / RUNS).exists()
