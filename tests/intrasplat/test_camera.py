"""A camera holds numbers that a pinhole can have, as Python's own kinds, and nothing else is read as one."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from intrasplat.camera import Intrinsics

CAMERA = Intrinsics(width=64, height=48, fx=80.0, fy=75.5, cx=31.0, cy=25.0)


def test_a_camera_comes_back_from_json_as_it_was() -> None:
    assert Intrinsics.parsed(json.loads(json.dumps(CAMERA.numbers()))) == CAMERA


def test_numpys_numbers_become_pythons() -> None:
    made = Intrinsics(width=np.int64(64), height=48, fx=np.float64(80), fy=np.float64(75.5), cx=31, cy=25)  # type: ignore[arg-type]
    assert made == CAMERA
    assert {type(value) for value in made.numbers().values()} == {int, float}


@pytest.mark.parametrize(
    "wrong",
    [{"width": 0}, {"height": -1}, {"width": 6.5}, {"fx": 0.0}, {"fy": -1.0}, {"cx": math.nan}, {"cy": math.inf},
     {"cx": "31"}, {"cx": None}, {"cx": True}, {"more": 1}],
)  # fmt: skip
def test_what_is_no_camera_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="camera"):
        Intrinsics.parsed({**CAMERA.numbers(), **wrong})


def test_a_number_may_not_be_missing() -> None:
    with pytest.raises(ValueError, match="has cx, cy, fx, fy, height, width, and nothing else"):
        Intrinsics.parsed({"width": 64})
