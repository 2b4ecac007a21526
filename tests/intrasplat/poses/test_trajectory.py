"""Absolute trajectory error, and TUM files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from intrasplat.errors import InputError
from intrasplat.poses.pose_file import read_tum
from intrasplat.poses.rigid import Reals, exp
from intrasplat.poses.trajectory import at_times, from_first, trajectory_error, write_tum


def a_path(count: int = 20) -> Reals:
    random = np.random.default_rng(2)
    twists = np.cumsum(random.normal(0, [1, 1, 1, 0.02, 0.02, 0.02], (count, 6)), axis=0)
    return np.stack([exp(twist) for twist in twists])


def test_a_path_in_another_world_has_no_error() -> None:
    path = a_path()
    error = trajectory_error(exp(np.array([50.0, -20.0, 9.0, 0.4, 1.0, -0.3])) @ path, path)
    assert error.mm == pytest.approx(0, abs=1e-6)
    assert error.deg == pytest.approx(0, abs=1e-4)


def test_the_error_is_the_root_mean_square() -> None:
    path, sign = a_path(), np.tile([1.0, -1.0], 10)
    found = path.copy()
    found[:, 0, 3] += 2 * sign
    assert trajectory_error(found, path).mm == pytest.approx(2, rel=0.05)
    turned = np.stack(
        [pose @ exp(np.array([0, 0, 0, 0, 0, np.radians(each)])) for pose, each in zip(path, sign, strict=True)]
    )
    assert trajectory_error(turned, path).deg == pytest.approx(1, rel=0.05)


def test_a_tum_file_keeps_the_path(tmp_path: Path) -> None:
    path, times_s = a_path(), np.arange(20) / 25
    write_tum(tmp_path / "path.tum", times_s, path)
    read_s, read = read_tum(tmp_path / "path.tum")
    assert_allclose(read_s, times_s)
    assert_allclose(read, path, atol=1e-5)
    assert_allclose(at_times(read_s, read, times_s[5:7]), path[5:7], atol=1e-5)
    assert_allclose(from_first(read)[0], np.eye(4), atol=1e-6)


def test_between_its_poses_a_path_goes_on_evenly() -> None:
    times_s = np.arange(20) / 25
    even = np.tile(np.eye(4), (20, 1, 1))
    even[:, 0, 3] = 3 * np.arange(20)
    assert_allclose(at_times(times_s, even, np.array([0.1]))[0, :3, 3], [7.5, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("times_s", "about_s"),
    [
        (np.arange(10) / 25, "0.40"),
        (np.arange(20) / 25 + 0.1, "0.00"),
        (np.delete(np.arange(20) / 25, range(5, 13)), "0.20"),
    ],
)
def test_a_path_without_poses_at_some_of_the_times_is_refused(times_s: Reals, about_s: str) -> None:
    with pytest.raises(InputError, match=f"none about {about_s} s"):
        at_times(times_s, a_path(len(times_s)), np.arange(20) / 25)


def test_a_path_whose_times_do_not_rise_is_refused() -> None:
    with pytest.raises(InputError, match="do not rise"):
        at_times(np.array([0.0, 0.04, 0.04]), a_path(3), np.array([0.0]))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# no pose\n",
        "1 2 3\n",
        "0 0 0 0 0 0 0 1\n0 0 0 0 0 0 1\n",
        "0 0 0 0 0 0 0 2\n",
        "0 0 0 nan 0 0 0 1\n",
        "a b c d e f g h\n",
    ],
)
def test_what_is_no_tum_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.tum").write_text(text)
    with pytest.raises(InputError) as caught:
        read_tum(tmp_path / "bad.tum")
    assert caught.value.field == "--against"
