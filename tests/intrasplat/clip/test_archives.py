"""Zips from strangers: nothing reaches outside, hides, or outgrows the limits."""

from __future__ import annotations

import stat
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from intrasplat.clip import ClipLimits, find_calibration, open_clip
from intrasplat.errors import InputError, LimitError

GOOD = "left/000000.png"


def write_zip(path: Path, entries: list[tuple[zipfile.ZipInfo, bytes]]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry, content in entries:
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    return path


def named(name: str, kind: int = stat.S_IFREG) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo("placeholder")
    entry.filename = name
    entry.create_system = 3
    entry.external_attr = (kind | 0o644) << 16
    return entry


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        (named("/etc/000000.png"), "absolute path"),
        (named("C:/000000.png"), "absolute path"),
        (named("left/../../000000.png"), r'"\.\."'),
        (named("\\\\server\\000000.png"), "absolute path"),
        (named("C:\\000000.png"), "absolute path"),
        (named("left\\..\\..\\000000.png"), r'"\.\."'),
        (named("LEFT\\000000.png"), "twice"),
        (named("left/0\n.png"), "a control character"),
        (named("left/000001.png", stat.S_IFLNK), "symbolic link"),
        (named("left/000001.png", stat.S_IFCHR), "not a plain file"),
        (named("more.zip"), "archive inside the archive"),
        (named("left/frames.tar.gz"), "archive inside the archive"),
    ],
)
def test_members_that_could_reach_outside_or_hide_something_are_refused(
    tmp_path: Path, entry: zipfile.ZipInfo, problem: str
) -> None:
    path = write_zip(tmp_path / "clip.zip", [(named(GOOD), b"x"), (entry, b"x")])
    with pytest.raises(InputError, match=problem) as caught:
        open_clip(path)
    assert caught.value.field == "clip"


def test_encrypted_members_are_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "clip.zip", [(named(GOOD), b"x")])
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 8] |= 1  # general purpose bit 0 in the central directory
    path.write_bytes(data)
    with pytest.raises(InputError, match="encrypted"):
        open_clip(path)


def test_duplicate_members_are_refused(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = write_zip(tmp_path / "clip.zip", [(named(GOOD), b"x"), (named(GOOD), b"y")])
    with pytest.raises(InputError, match="twice"):
        open_clip(path)


def test_overlapping_members_are_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "clip.zip", [(named(GOOD), b"x" * 99), (named("right/000000.png"), b"y" * 99)])
    data = bytearray(path.read_bytes())
    second = data.index(b"PK\x01\x02", data.index(b"PK\x01\x02") + 4)
    data[second + 42 : second + 46] = bytes(4)  # both members now start at byte 0
    path.write_bytes(data)
    with pytest.raises(InputError, match="overlap"):
        open_clip(path)


def test_what_inflates_to_too_much_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "clip.zip", [(named(GOOD), bytes(5_000_000))])
    assert path.stat().st_size < 10_000
    with pytest.raises(LimitError, match="inflates to 5000000 bytes"):
        open_clip(path, limits=ClipLimits(decoded_bytes=4_000_000))


BOMB = (np.random.default_rng(5).bytes(1 << 10) + bytes(127 << 10)) * 512
"""64 MiB of zeros with a little noise, so that they shrink not quite as suspiciously: to less than 1 MiB in a zip."""


def test_a_member_that_inflates_as_no_picture_does_is_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "clip.zip", [(named(GOOD), bytes(2 << 20))])
    with pytest.raises(LimitError, match=r"left/000000.png' in clip.zip inflates from \d+ to 2097152 bytes"):
        open_clip(path)


def test_names_that_differ_in_case_only_are_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "clip.zip", [(named(GOOD), b"x"), (named(GOOD.upper()), b"y")])
    with pytest.raises(InputError, match="twice"):
        open_clip(path)


@pytest.mark.parametrize(
    ("at", "value", "problem"), [(10, 40_000, "40000 files"), (12, 1 << 30, "has 1073741824 bytes")]
)
def test_a_directory_beyond_any_clips_is_refused_unread(tmp_path: Path, at: int, value: int, problem: str) -> None:
    path = write_zip(tmp_path / "clip.zip", [(named(GOOD), b"x")])
    data = bytearray(path.read_bytes())
    end = data.rindex(b"PK\x05\x06")
    data[end + at : end + at + (2 if at == 10 else 4)] = value.to_bytes(2 if at == 10 else 4, "little")
    path.write_bytes(data)
    with pytest.raises(LimitError, match=problem):
        open_clip(path)


def peak_bytes_of_refusing(work: Callable[[], object]) -> int:
    """Most memory that Python and NumPy held while work() was refused as too large."""
    tracemalloc.start()
    try:
        with pytest.raises(LimitError, match="is larger than"):
            work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", ["images/frame-000001.color.png", "depth/frame-000002.depth.png", "poses_bounds.npy"])
def test_a_member_larger_than_its_kind_can_be_is_refused_before_it_fills_the_memory(studio, name: str) -> None:
    """The images keep their right header and picture; zeros follow."""
    folder = studio.endonerf()
    with (folder / name).open("ab") as file:
        file.write(BOMB)
    path = studio.zip(folder)
    assert path.stat().st_size < 1_000_000
    assert peak_bytes_of_refusing(lambda: open_clip(path)) < len(BOMB) // 8


def test_a_calibration_larger_than_any_is_not_copied_out_of_a_zip(studio, tmp_path: Path) -> None:
    folder = studio.endonerf()
    (folder / "calibration.json").write_bytes(BOMB)
    path = studio.zip(folder)
    assert peak_bytes_of_refusing(lambda: find_calibration(path, tmp_path)) < len(BOMB) // 8


def test_a_member_whose_content_is_damaged_is_named(studio) -> None:
    left, right = studio.eyes(1)
    studio.images("clip/left/{}.png", left)
    studio.images("clip/right/{}.png", right)
    path = studio.zip(studio.root / "clip")
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        start = archive.getinfo("right/000000.png").header_offset + 400
    data[start : start + 300] = bytes(300)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"right/000000.png"):
        next(open_clip(path).pairs())


def test_a_member_that_is_larger_than_it_declares_is_refused(studio) -> None:
    left, right = studio.eyes(1)
    studio.images("clip/left/{}.png", left)
    studio.images("clip/right/{}.png", right)
    path = studio.zip(studio.root / "clip")
    data = bytearray(path.read_bytes())
    directory = data.index(b"PK\x01\x02")
    data[directory + 24 : directory + 28] = (2000).to_bytes(4, "little")  # uncompressed size of the first member
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"left/000000.png"):
        next(open_clip(path).pairs())


def test_a_cut_zip_is_refused(studio) -> None:
    folder = studio.endonerf()
    path = studio.zip(folder)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"not an mp4, mov, mkv or webm file|not a readable zip"):
        open_clip(path)


def test_what_file_managers_add_is_ignored(studio) -> None:
    folder = studio.endonerf()
    for litter in ("__MACOSX/images/._frame-000000.color.png", "images/.DS_Store", "images/Thumbs.db"):
        (folder / litter).parent.mkdir(parents=True, exist_ok=True)
        (folder / litter).write_bytes(b"litter")
    clip = open_clip(studio.zip(folder))
    np.testing.assert_array_equal(clip.rgb, studio.eyes(3, 64, 80)[0])


def test_a_name_that_is_no_text_is_refused(studio) -> None:
    left, right = studio.eyes(1)
    studio.images("clip/left/{}.png", left)
    studio.images("clip/right/{}.png", right)
    path = studio.zip(studio.root / "clip")
    data = bytearray(path.read_bytes())
    data[7] |= 1 << 3  # bit 11 of the local header's flags says that the name is UTF-8
    data[30] = 0xFF
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"left/000000.png"):
        open_clip(path)
