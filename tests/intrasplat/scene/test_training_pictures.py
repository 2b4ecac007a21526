"""The video of the training frames: what went in comes out, frame by frame, or a clear error."""

from __future__ import annotations

import zipfile
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.errors import SceneError
from intrasplat.names import DETAIL, RECORDED
from intrasplat.scene import recorded_video
from intrasplat.scene.recorded_file import EYES, MASK, PICTURE, complete_zip, name_of, read_frame
from intrasplat.scene.recorded_video import KEY_EVERY, RecordedEye, encoded
from intrasplat.scene.training_pictures import coded, pictures_of

WIDTH, HEIGHT = 65, 47
LENS = Intrinsics(width=WIDTH, height=HEIGHT, fx=80.0, fy=81.0, cx=31.5, cy=24.25)
FRAMES = tuple(frame for frame in range(2 * KEY_EVERY + 5) if frame % 8 != 1)


def picture(eye: int, frame: int) -> NDArray[np.uint8]:
    """Smooth colours that move with the frame, and differ between the eyes."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    waves = [np.sin((x + frame) / 9), np.cos((y - 2 * frame) / 7), np.sin((x + y + 40 * eye) / 11)]
    return np.asarray(128 + 90 * np.stack(waves, axis=-1), np.uint8)


def frame_of(eye: int, frame: int) -> av.VideoFrame:
    return coded(picture(eye, frame))


def eyes() -> list[RecordedEye]:
    beside = np.eye(4)
    beside[0, 3] = 4.25
    return [RecordedEye(LENS, np.eye(4)), RecordedEye(LENS, beside)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("scene")
    content = encoded(FRAMES, eyes(), frame_of)
    assert content is not None
    (made / DETAIL).write_bytes(content)
    return made


def error_db(shown: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    return float(-10 * np.log10(np.square(shown / 255.0 - truth / 255.0).mean() + 1e-12))


@pytest.mark.parametrize("order", ["rising", "falling", "far apart"])
def test_each_frame_comes_back_in_any_order(folder: Path, order: str) -> None:
    if not (folder / RECORDED).exists():
        with zipfile.ZipFile(folder / RECORDED, "w") as archive:  # frames without masks
            archive.writestr(name_of("left", 0, "jpg"), b"")
            archive.writestr(name_of("right", 0, "jpg"), b"")
    stored = pictures_of(folder)
    assert stored.frames == FRAMES
    frames = {"rising": FRAMES, "falling": FRAMES[::-1], "far apart": (FRAMES[-1], FRAMES[0], FRAMES[KEY_EVERY])}
    for frame in frames[order]:
        for eye in (0, 1):
            rgb, tissue = stored.picture(eye, frame)
            assert error_db(rgb, picture(eye, frame)) > 38
            assert tissue.all()
            assert tissue.shape == rgb.shape[:2] == (HEIGHT, WIDTH)


@pytest.mark.parametrize("eye", [0, 1])
def test_frames_of_the_video_and_of_the_zip_file_are_served_as_one_row_of_pictures(
    tmp_path: Path, folder: Path, eye: int
) -> None:
    count, held_out = FRAMES[-1] + 1, sorted(set(range(FRAMES[-1] + 1)) - set(FRAMES))
    (tmp_path / DETAIL).write_bytes((folder / DETAIL).read_bytes())
    with zipfile.ZipFile(tmp_path / RECORDED, "w") as archive:
        for frame in held_out:
            shown = cv2.imencode(".jpg", picture(eye, frame)[..., ::-1])[1].tobytes()
            archive.writestr(name_of(EYES[eye], frame, PICTURE), shown)
    complete = zipfile.ZipFile(complete_zip(tmp_path))
    for frame in range(count):
        index, jpeg = read_frame(tmp_path, count, frame / count, EYES[eye])
        shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert index == frame
        assert error_db(shown, picture(eye, frame)) > 30
        assert complete.read(name_of(EYES[eye], frame, PICTURE)) == jpeg


def test_lens_and_pose_of_the_eyes_come_back(folder: Path) -> None:
    for found, given in zip(pictures_of(folder).eyes, eyes(), strict=True):
        assert found.lens == given.lens
        np.testing.assert_array_equal(found.left_from_eye, given.left_from_eye)


def test_the_same_pictures_give_the_same_bytes(folder: Path) -> None:
    assert encoded(FRAMES, eyes(), frame_of) == (folder / DETAIL).read_bytes()


def test_the_other_encoder_serves_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = recorded_video.CODECS["libvpx-vp9"]
    monkeypatch.setattr(recorded_video, "CODECS", {"missing": {}, "libvpx-vp9": options})
    content = encoded(FRAMES[:5], eyes()[:1], frame_of)
    assert content is not None
    (tmp_path / DETAIL).write_bytes(content)
    reader = pictures_of(tmp_path)
    with zipfile.ZipFile(tmp_path / RECORDED, "w") as archive:
        archive.writestr(name_of("left", 0, "jpg"), b"")
    assert error_db(reader.picture(0, FRAMES[3])[0], picture(0, FRAMES[3])) > 36


def test_without_an_encoder_there_is_no_video(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded_video, "CODECS", {"missing": {}})
    assert encoded(FRAMES, eyes(), frame_of) is None


def test_masks_say_what_is_tissue(tmp_path: Path, folder: Path) -> None:
    (tmp_path / DETAIL).write_bytes((folder / DETAIL).read_bytes())
    tool = np.zeros((HEIGHT, WIDTH), np.uint8)
    tool[:, :20] = 255
    with zipfile.ZipFile(tmp_path / RECORDED, "w") as archive:
        for frame in FRAMES:
            archive.writestr(name_of("left", frame, MASK), cv2.imencode(".png", tool)[1].tobytes())
    np.testing.assert_array_equal(pictures_of(tmp_path).picture(0, FRAMES[7])[1], tool == 0)


def test_all_is_tissue_where_the_zip_file_is_empty(tmp_path: Path, folder: Path) -> None:
    (tmp_path / DETAIL).write_bytes((folder / DETAIL).read_bytes())
    with zipfile.ZipFile(tmp_path / RECORDED, "w"):
        pass  # all frames trained the model, and nothing is masked
    stored = pictures_of(tmp_path)
    assert stored.picture(0, stored.frames[0])[1].all()


def test_a_frame_that_was_not_stored_is_an_error(folder: Path) -> None:
    with pytest.raises(SceneError, match="no frame 9"):
        pictures_of(folder).picture(0, 9)


@pytest.mark.parametrize("spoilt", ["missing", "empty", "cut", "noise"])
def test_a_damaged_file_is_an_error(tmp_path: Path, folder: Path, spoilt: str) -> None:
    content = (folder / DETAIL).read_bytes()
    parts = {"empty": b"", "cut": content[:300], "noise": bytes(255 - each for each in content)}
    if spoilt in parts:
        (tmp_path / DETAIL).write_bytes(parts[spoilt])
    with pytest.raises(SceneError):
        pictures_of(tmp_path).picture(0, FRAMES[0])
