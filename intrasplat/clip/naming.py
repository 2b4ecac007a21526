"""Eye and frame from file names, and whether two lists of files match."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Set
from pathlib import PurePosixPath
from typing import Literal

from intrasplat.clip.files import VIDEO_SUFFIXES, natural_key
from intrasplat.errors import InputError

Side = Literal["left", "right"]

_SIDES: dict[str, Side] = {"l": "left", "left": "left", "r": "right", "right": "right"}
_SWAPPED = ((re.compile("left"), "right"), (re.compile("(?<![a-z0-9])l(?![a-z0-9])"), "r"))
_NUMBERED = re.compile(r"(cam|camera|images?|img|view|eye)[_\-. ]?([0-9]{1,3})")
_NO_PICTURES = re.compile("mask|depth|disp|label|seg")
_FOLDERS_REMEDY = (
    "Use folders left/ and right/ (or L/ and R/, left_frames/ and right_frames/, image01/ and image02/, "
    "cam0/ and cam1/), or names like 000001l.png and 000001r.png."
)
_MAX_DIGITS = 100
_WORD_ALONE = re.compile(r"(?P<side>left|right)(?P<frame>)", re.IGNORECASE)
_WORD_AT_END = re.compile(r"(?P<frame>.+?)[_\-. ](?P<side>left|right|l|r)", re.IGNORECASE)
_LETTER_AFTER_DIGIT = re.compile(r"(?P<frame>.*\d)(?P<side>left|right|l|r)", re.IGNORECASE)
_WORD_AT_START = re.compile(r"(?P<side>left|right|l|r)[_\-. ]?(?P<frame>\d.*|(?<=[_\-. ]).+)", re.IGNORECASE)


def eye_folders(names: Iterable[str]) -> dict[str, Side]:
    """The folders and videos (in lower case, without ending) that are an eye's by their pair: L and R, cam0 and cam1.

    left and right are eyes without a pair, too. Of numbered pairs the lower one is the left eye's. Folders of masks and
    depth count only if there are no others.
    """
    paths = [PurePosixPath(name) for name in names]
    stems = {path.stem.lower() for path in paths if path.suffix.lower() in VIDEO_SUFFIXES}
    folders = {part.lower() for path in paths for part in path.parts[:-1]} | stems
    alone: dict[str, Side] = {"left": "left", "right": "right"}
    return alone | _pairs({each for each in folders if not _NO_PICTURES.search(each)} or folders)


def _pairs(folders: Set[str]) -> dict[str, Side]:
    found: dict[str, Side] = {}
    numbered: dict[str, dict[int, str]] = {}
    for folder in sorted(folders):
        for left, right in _SWAPPED:
            if (other := left.sub(right, folder)) != folder and other in folders:
                found |= {folder: "left", other: "right"}
        if match := _NUMBERED.fullmatch(folder):
            numbered.setdefault(match[1], {})[int(match[2])] = folder
    for pair in numbered.values():
        if len(pair) == 2 and max(pair) - min(pair) == 1:
            found |= {pair[min(pair)]: "left", pair[max(pair)]: "right"}
    return found


def eye_of(name: str, folders: Mapping[str, Side]) -> tuple[Side, str] | None:
    """(eye, frame key) of left/000001.png, 000001l.png, 000001_left.png or left_000001.png; None for other names.

    folders: the folders that are an eye's, as eye_folders() finds them.
    """
    path = PurePosixPath(name)
    for depth, part in enumerate(path.parts[:-1]):
        if (side := folders.get(part.lower())) is not None:
            others = path.parts[:depth] + path.parts[depth + 1 : -1]
            # an eye in the file name repeats that of the folder; it is not part of the frame key
            stem = _by_stem(path.stem)
            frame = stem[1] if stem else re.sub(f"^{re.escape(part)}", "", path.stem, flags=re.IGNORECASE)
            return side, "/".join((*others, frame))
    found = _by_stem(path.stem)
    if found is None and path.suffix.lower() in VIDEO_SUFFIXES and path.stem.lower() in folders:
        return folders[path.stem.lower()], path.parent.as_posix()
    return (found[0], (path.parent / found[1]).as_posix()) if found else None


def left_eye_only(names: tuple[str, ...]) -> tuple[str, ...]:
    """The names without the right eye's, if the names distinguish both eyes; else all names."""
    right = set(right_eye_only(names))
    return tuple(name for name in names if name not in right)


def right_eye_only(names: tuple[str, ...]) -> tuple[str, ...]:
    """The right eye's names, if the names distinguish both eyes; else none."""
    folders = eye_folders(names)
    eyes = {name: found[0] for name in names if (found := eye_of(name, folders))}
    if set(eyes.values()) != {"left", "right"}:
        return ()
    return tuple(name for name in names if eyes.get(name) == "right")


def pair_names(names: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """(left, right) file names, frame by frame in natural order.

    InputError if a frame lacks an eye, or a name has none.
    """
    frames: dict[str, dict[Side, str]] = {}
    folders = eye_folders(names)
    for name in names:
        found = eye_of(name, folders)
        if found is None:
            raise InputError("clip", f"{name} names neither the left nor the right eye.", _FOLDERS_REMEDY)
        side, key = found
        other = frames.setdefault(key, {}).setdefault(side, name)
        if other != name:
            raise InputError("clip", f"{other} and {name} are the same frame of the {side} eye.", "Keep one of them.")
    for sides in frames.values():
        if len(sides) == 1:
            ((side, name),) = sides.items()
            missing = "right" if side == "left" else "left"
            raise InputError(
                "clip", f"{name} has no frame of the {missing} eye beside it.", "Give both eyes of each frame."
            )
    keys = sorted(frames, key=natural_key)
    return tuple(frames[key]["left"] for key in keys), tuple(frames[key]["right"] for key in keys)


def check_aligned(field: str, names: tuple[str, ...], others: tuple[str, ...]) -> None:
    """InputError if two lists differ in length, or in the steps between their frame numbers."""
    if len(names) != len(others):
        raise InputError(
            field,
            f"there are {len(others)} files like {others[0] if others else 'none'} for {len(names)} like {names[0]}.",
            "Give one for each frame.",
        )
    numbers, other_numbers = _frame_numbers(names), _frame_numbers(others)
    if numbers is None or other_numbers is None:
        return
    for name, other, number, other_number in zip(names, others, numbers, other_numbers, strict=True):
        if number - numbers[0] != other_number - other_numbers[0]:
            raise InputError(
                field, f"{other} stands where {name} is: their numbers differ.", "Number both lists alike."
            )


def _by_stem(stem: str) -> tuple[Side, str] | None:
    for pattern in (_WORD_ALONE, _WORD_AT_END, _LETTER_AFTER_DIGIT, _WORD_AT_START):
        if found := pattern.fullmatch(stem):
            return _SIDES[found["side"].lower()], found["frame"]
    return None


def _frame_numbers(names: tuple[str, ...]) -> list[int] | None:
    """The last number in each name, if these rise from file to file; else None."""
    found = [re.findall(r"[0-9]+", PurePosixPath(name).stem) for name in names]
    if not all(found):
        return None
    if any(len(digits[-1]) > _MAX_DIGITS for digits in found):
        return None
    numbers = [int(digits[-1]) for digits in found]
    return numbers if all(a < b for a, b in itertools.pairwise(numbers)) else None
