"""The benchmark of both eyes: a row a run, kept as it ends; and what the page says of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.benchmarks.bm_two_eyes import FIELDS, main
from lab.evaluate.rows import read_rows
from lab.pages.right_eye import TWO_EYES, two_eyes_sections

TINY = ["--clips", "phantom:breathing:96x80:9frames:stereo", "--holdout", "every8", "--iterations", "5"]


def test_a_benchmark_of_both_eyes_goes_on_where_it_was_stopped_and_the_page_has_a_section_of_its_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert two_eyes_sections(tmp_path) == []
    asked = [*TINY, "--seeds", "0", "--csv", str(tmp_path / TWO_EYES)]
    assert main([*asked, "--at-most", "1"]) == 0
    (left,) = read_rows(tmp_path / TWO_EYES)
    assert left["series"] == "fast:eyes=left"
    assert main(asked) == 0
    kept, both = read_rows(tmp_path / TWO_EYES)
    assert (kept, both["series"]) == (left, "fast")
    assert {name for name in FIELDS if not both[name]} == {"error", "not_measured"}
    table = capsys.readouterr().out.splitlines()[-2:]
    assert [line.split()[2] for line in table] == ["fast:eyes=left", "fast"]
    assert main([*asked, "--eyes", "both", "--again"]) == 0
    assert [row["series"] for row in read_rows(tmp_path / TWO_EYES)] == ["fast:eyes=left", "fast"]
    page = "".join(two_eyes_sections(tmp_path))
    assert "| phantom-breathing-96x80-9frames-stereo | every8 | fast:eyes=left | 5 iterations |" in page
    assert "| clip | held out | series | limit | left, dB | right, dB | warp, dB | 10 degrees |" in page


def test_a_run_that_fails_is_said_and_has_no_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["--clips", "phantom:still:96x80:9frames", "--eyes", "left", "--iterations", "5", "--holdout", "every8"]
    assert main([*asked, "--seeds", "0", "--csv", str(tmp_path / TWO_EYES)]) == 1
    assert "has one eye" in capsys.readouterr().out
    assert not (tmp_path / TWO_EYES).exists()
