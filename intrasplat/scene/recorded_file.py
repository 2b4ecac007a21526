"""Recorded frames of a scene, read from its folder (intrasplat/view/recorded.py writes them).

detail.mkv             the frames that trained the model (intrasplat/scene/recorded_video.py)
recorded.zip           the other ones, and all masks:
    left/000012.jpg    frame 12 of the clip as the model's left camera sees it
    left/000012.png    its mask, if there are masks: 1 bit, 255 on instruments, transparent elsewhere
    right/...          the same of the right eye, if the model was trained on both eyes
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import BinaryIO, Literal

from intrasplat.errors import InputError, SceneError
from intrasplat.names import DETAIL, RECORDED, Eye
from intrasplat.scene.recorded_video import KEY_EVERY, RecordedVideo

EYES: tuple[Eye, Eye] = ("left", "right")
Kind = Literal["jpg", "png"]
PICTURE: Kind = "jpg"
MASK: Kind = "png"

MAX_FRAME_BYTES = 8 << 20
"""Limit of one file in the zip, which may come from another site."""
NAME = re.compile(r"(left|right)/(\d{6})\.(jpg|png)")
_DAMAGED = (ValueError, LookupError, RuntimeError, EOFError, zipfile.BadZipFile)
"""What zipfile and PyAV raise on content that they cannot read; an encrypted file is a RuntimeError."""
_DECODING = Lock()
"""A run of pictures is decoded once, whoever asks for its frames at the same time."""


def name_of(eye: Eye, frame: int, kind: Kind) -> str:
    """The name of a frame's picture or mask in the zip."""
    return f"{eye}/{frame:06d}.{kind}"


def nearest(frames: Iterable[int], t: float, frame_count: int) -> int:
    """The one of `frames` (at least one) that is nearest to model time t in a clip of frame_count frames."""
    wanted = min(t, 1.0) * frame_count
    return min(frames, key=lambda frame: abs(frame - wanted))


def read_frame(folder: Path, frame_count: int, t: float, eye: Eye = "left", kind: Kind = PICTURE) -> tuple[int, bytes]:
    """The frame nearest to model time t of the scene in a folder, and its picture or mask.

    Raises:
        SceneError: the scene has no recorded frames, or a file is damaged.
        InputError: it has none of this eye, or no masks.
    """
    try:
        with zipfile.ZipFile(folder / RECORDED) as archive:
            found = [match.groups() for name in archive.namelist() if (match := NAME.fullmatch(name))]
            filmed = _filmed(folder, eye)
            if not found and not filmed:
                raise _no_recorded_frames()
            filmed = filmed if kind == PICTURE else ()
            frames = {int(number) for side, number, ending in found if (side, ending) == (eye, kind)} | {*filmed}
            if not frames:
                raise _none_of(eye, kind, is_masked=any(ending == MASK for _, _, ending in found))
            index = nearest(sorted(frames), t, frame_count)
            if index in filmed:
                return index, _filmed_pictures(folder, eye, index)[index]
            entry = archive.getinfo(name_of(eye, index, kind))
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > MAX_FRAME_BYTES:
                raise zipfile.BadZipFile
            return index, archive.read(entry)
    except FileNotFoundError:
        raise _no_recorded_frames() from None
    except (OSError, *_DAMAGED) as error:
        raise _unreadable(error) from error


def seam_files(folder: Path) -> tuple[zipfile.ZipInfo, ...]:
    """Entries of recorded.zip for a comparison with the left eye, beside detail.mkv: its pictures, and its masks; both
    eyes' masks if there is a video. (): the scene has none.

    Raises:
        SceneError: a file is damaged.
    """
    eyes = EYES if (folder / DETAIL).is_file() else EYES[:1]
    kinds = {(eye, MASK) for eye in eyes} | {(EYES[0], PICTURE)}
    try:
        with zipfile.ZipFile(folder / RECORDED) as archive:
            named = ((NAME.fullmatch(entry.filename), entry) for entry in archive.infolist())
            found = tuple(entry for match, entry in named if match and match.group(1, 3) in kinds)
            if any(each.compress_type != zipfile.ZIP_STORED or each.file_size > MAX_FRAME_BYTES for each in found):
                raise zipfile.BadZipFile
            return found
    except FileNotFoundError:
        return ()
    except (OSError, *_DAMAGED) as error:
        raise _unreadable(error) from error


def read_files(folder: Path, entries: Collection[zipfile.ZipInfo]) -> Iterator[tuple[str, bytes]]:
    """Names and contents of entries of seam_files(), one after another. Raises as it does."""
    if not entries:
        return
    try:
        with zipfile.ZipFile(folder / RECORDED) as archive:
            for entry in entries:
                yield entry.filename, archive.read(entry)
    except (OSError, *_DAMAGED) as error:
        raise _unreadable(error) from error


def complete_zip(folder: Path) -> BinaryIO:
    """recorded.zip of the scene in a folder, in memory, with the frames of detail.mkv as JPEG.

    Raises:
        SceneError: a file is damaged.
        OSError: recorded.zip is missing, or cannot be read.
    """
    content = io.BytesIO()
    try:
        with zipfile.ZipFile(folder / RECORDED) as stored, zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
            for eye in EYES:
                filmed, done = _filmed(folder, eye), -1
                for frame in filmed:
                    if frame > done:
                        pictures = _filmed_pictures(folder, eye, frame)
                        done = max(pictures)
                    archive.writestr(zipfile.ZipInfo(name_of(eye, frame, PICTURE)), pictures[frame])
            for each in stored.infolist():
                archive.writestr(zipfile.ZipInfo(each.filename), stored.read(each))
    except _DAMAGED as error:
        raise _unreadable(error) from error
    content.seek(0)
    return content


def _filmed(folder: Path, eye: Eye) -> tuple[int, ...]:
    """The frames of an eye in a scene's video, rising; () without a video."""
    try:
        changed_ns = (folder / DETAIL).stat().st_mtime_ns
    except FileNotFoundError:
        return ()
    frames, eyes = _listed(folder / DETAIL, changed_ns)
    return frames if EYES.index(eye) < eyes else ()


def _filmed_pictures(folder: Path, eye: Eye, frame: int) -> dict[int, bytes]:
    """The pictures, as JPEG, of a frame in a scene's video and of those decoded with it."""
    path, place = folder / DETAIL, _filmed(folder, eye).index(frame)
    with _DECODING:
        return _run(path, path.stat().st_mtime_ns, EYES.index(eye), place // KEY_EVERY)


@lru_cache(maxsize=64)
def _listed(path: Path, changed_ns: int) -> tuple[tuple[int, ...], int]:
    """Frames and number of eyes of a video."""
    video = RecordedVideo(path)
    return video.frames, len(video.eyes)


@lru_cache(maxsize=16)
def _run(path: Path, changed_ns: int, eye: int, run: int) -> dict[int, bytes]:
    """The pictures of an eye from a key frame to the next, as JPEG."""
    video = RecordedVideo(path)
    return {frame: video.jpeg(eye, frame) for frame in video.frames[run * KEY_EVERY : (run + 1) * KEY_EVERY]}


def _unreadable(error: Exception) -> SceneError:
    return SceneError(f"The recorded frames of this scene cannot be read ({type(error).__name__}).")


def _no_recorded_frames() -> SceneError:
    return SceneError(
        "This scene keeps no recorded frames: keep_recorded was off, or it was made before they were kept."
    )


def _none_of(eye: Eye, kind: Kind, *, is_masked: bool) -> InputError:
    if kind == MASK and not is_masked:
        return InputError("masks", "this scene has no masks.", "Ask for masks=off.")
    return InputError("eye", f"no frames of the {eye} eye are kept: it did not teach the model.", "Ask for eye=left.")
