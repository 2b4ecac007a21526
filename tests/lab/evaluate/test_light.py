"""The benchmark of spoilt light on stereo clips: a row a run, in place of an older one, and its section of the page."""

from __future__ import annotations

from pathlib import Path

from lab.benchmarks.bm_light import FIELDS, main
from lab.evaluate.rows import read_rows, write_rows
from lab.pages.recordings import recording_sections

CLIP = "phantom:breathing:128x96:10frames:stereo"


def test_a_run_replaces_its_row_and_is_scored_in_steady_and_in_recorded_light(tmp_path: Path) -> None:
    rows = tmp_path / "light.csv"
    older = {
        "clip": "phantom-breathing-128x96-10frames-stereo",
        "light": "white_balance",
        "level": 1.3,
        "limit": "8 steps",
    }
    write_rows(rows, FIELDS, [older | {"plain_db": 1}, older | {"limit": "9 steps", "plain_db": 2}])
    main(["--clips", CLIP, "--lights", "white_balance", "--iterations", "8", "--out", str(rows)])
    other, row = read_rows(rows)
    assert (other["limit"], other["plain_db"], row["limit"], row["iterations"]) == ("9 steps", "2", "8 steps", "8")
    for eye in ("", "right_"):
        plain, fitted, by_frame, recorded = (
            float(row[f"{eye}{name}_db"]) for name in ("plain", "fitted", "by_frame", "recorded")
        )
        assert plain < fitted <= by_frame
        assert plain < recorded  # the frames have the tint of the recording
    assert abs(float(row["recorded_db"]) - float(row["reported_db"])) < 0.1
    page = "".join(recording_sections(tmp_path))
    assert f"| {row['clip']} | white_balance | 8 steps | {row['plain_db']} |" in page
