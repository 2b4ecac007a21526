"""The benchmark of one eye: its bounds, and what is trained for them."""

from __future__ import annotations

import math

import pytest

from benchmarks.bm_one_eye import colours_alone, main
from worker.methods.registry import preset_named

LINES = ["warp", "warp by flow", "left eye", "both eyes", "left's colours"]


def test_a_line_is_printed_for_every_bound_and_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--clip", "phantom:breathing:160x128:12frames:stereo", "--iterations", "5"]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line[:16].strip() for line in lines] == LINES
    right = {line[:16].strip(): float(line[16:].split()[2]) for line in lines}
    assert all(math.isfinite(score) for score in right.values())
    assert right["warp by flow"] >= right["warp"]  # the flow has seen the picture
    assert right["both eyes"] > right["left eye"]


def test_a_clip_of_one_eye_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--clip", "phantom:still:96x80:9frames"]) == 1
    assert "give a stereo clip" in capsys.readouterr().out


def test_colours_alone_hold_everything_else() -> None:
    rates = colours_alone(preset_named("fast")).rates
    assert (rates.colour, rates.motion_colour) == (
        preset_named("fast").rates.colour,
        preset_named("fast").rates.motion_colour,
    )
    assert {rates.mean.start, rates.motion_mean.start, rates.opacity.start, rates.gloss.start} == {0.0}
