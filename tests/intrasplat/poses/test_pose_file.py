"""Files of poses in their formats, and the poses of a clip's frames."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from intrasplat.errors import InputError
from intrasplat.poses.pose_file import StoredPoses, poses_of_frames, read_poses
from intrasplat.poses.rigid import Reals, exp
from intrasplat.poses.trajectory import write_tum
from lab.phantom import PhantomSettings, make_phantom

PATH = np.stack([exp(np.array([i, 2 * i, 50, 0.01 * i, 0.2, 0.1])) for i in range(6)])


def lines(rows: Reals) -> str:
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("list.json", "\ufeff" + json.dumps(PATH.tolist())),
        ("3x4.json", json.dumps({"poses": PATH[:, :3].tolist()})),
        ("frames.json", json.dumps({"frames": [{"transform_matrix": each.tolist()} for each in PATH]})),
        ("kitti.txt", lines(PATH[:, :3].reshape(-1, 12))),
        ("16.csv", "# one a line\n" + lines(PATH.reshape(-1, 16)).replace(" ", ",")),
        ("rows.txt", lines(PATH.reshape(-1, 4))),
        ("rows3.txt", lines(PATH[:, :3].reshape(-1, 4))),
    ],
)
def test_matrices_are_read_from_json_and_text(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    stored = read_poses(tmp_path / name)
    assert_allclose(stored.matrices, PATH, atol=1e-8)
    assert stored.stamps is None


def test_a_tum_file_keeps_its_stamps_and_unit(tmp_path: Path) -> None:
    write_tum(tmp_path / "path.tum", np.arange(6) / 25, PATH)
    stored = read_poses(tmp_path / "path.tum")
    assert stored.stamps is not None
    assert_allclose(stored.stamps, np.arange(6) / 25)
    assert_allclose(1000 * stored.matrices[:, :3, 3], PATH[:, :3, 3], atol=1e-5)


SCALED = lines(2 * PATH.reshape(-1, 16))


@pytest.mark.parametrize(
    "text",
    ["", "# nothing\n", "1 2 3\n", "[[1, 2], [3]]", "{}", "[", "\0", "0 0 0 0 0 0 0 2\n", SCALED],
)
def test_what_holds_no_rigid_poses_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(InputError) as caught:
        read_poses(tmp_path / "bad.txt")
    assert caught.value.field == "poses_file"
    assert caught.value.remedy


def test_poses_go_to_frames_by_count_by_number_or_by_time() -> None:
    clip = make_phantom(PhantomSettings(width=64, height=48, frames=4, frame_rate_hz=2.0)).depth_clip()
    assert poses_of_frames(clip, StoredPoses(PATH[:4])) is not None
    assert_allclose(poses_of_frames(clip, StoredPoses(PATH, np.arange(6) + 0.0)), PATH[:4])
    assert_allclose(poses_of_frames(clip, StoredPoses(PATH, np.arange(6) - 1.0)), PATH[1:5])
    twice = StoredPoses(PATH, np.arange(6) * 0.5 + 7.1)
    assert_allclose(poses_of_frames(clip, twice), PATH[:4], atol=1e-9)
    few = StoredPoses(PATH[:3])
    for refused in (few, replace(few, stamps=np.arange(3.0)), replace(few, stamps=np.arange(3) * 0.1)):
        with pytest.raises(InputError, match="poses"):
            poses_of_frames(clip, refused)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("huge.json", json.dumps([[[10**400] * 4] * 4])),
        ("far.json", json.dumps([[[1, 0, 0, 1e305], [0, 1, 0, 0], [0, 0, 1, 0]]])),
        ("far.tum", "0 1e300 0 0 0 0 0 1\n"),
    ],
)
def test_positions_that_no_camera_has_are_refused_without_the_path_of_the_file(
    tmp_path: Path, name: str, text: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as refused:
        read_poses(tmp_path / name)
    assert refused.value.field == "poses_file"
    assert str(tmp_path) not in str(refused.value)
    with pytest.raises(InputError, match="cannot be read") as absent:
        read_poses(tmp_path / "none.tum")
    assert str(tmp_path) not in str(absent.value)
