"""A text file that nests too deep for a parser is refused before one sees it; a calibration is not."""

from __future__ import annotations

import json

import pytest

from intrasplat.errors import InputError
from intrasplat.intake.nesting import nesting
from intrasplat.intake.sniff import MAX_NESTING, check_calibration_text


@pytest.mark.parametrize("level", ['{"a":', "[", "{a: ", "- ", "a: ", "<a>", "<a b='1'>"])
@pytest.mark.parametrize("head", ["", "%YAML:1.0\n---\nM1: ", '<?xml version="1.0"?>\n<opencv_storage>\n', '{"M1": '])
def test_a_file_nested_too_deep_is_refused_before_it_is_parsed(head: str, level: str) -> None:
    with pytest.raises(InputError, match=r"nested \d+ levels deep; the limit is 64") as error:
        check_calibration_text(head + level * (900_000 // len(level)), "calibration", "c")
    assert error.value.field == "calibration"


def test_a_long_file_of_few_levels_is_not_deep() -> None:
    rows = [[float(j) for j in range(100)] for _ in range(100)]
    assert nesting(json.dumps({"a": {"b": rows}, "c": rows})) == 4
    assert nesting("M1: !!opencv-matrix\n   rows: 3\n   data: [ 1., 2.,\n       3. ]\n" * 1000) < MAX_NESTING
    assert nesting("[]{}<a></a>" * 10_000) == 1
    assert nesting("[" * 60 + "]" * 60) == nesting("<a>" * 60 + "</a>" * 60) == nesting("- " * 60) == 60
    assert nesting("<a>" + "<b>1</b><c d='e'/>" * 1000 + "</a>") == 2
