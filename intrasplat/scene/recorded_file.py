"""Recorded frames of a scene, read from its recorded.zip as they were written (intrasplat/view/recorded.py).

left/000012.jpg    frame 12 of the clip as the model's left camera sees it
left/000012.png    its mask, if there are masks: 1 bit, 255 on instruments, transparent elsewhere
right/...          the same of the right eye, if the model was trained on both eyes
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from intrasplat.errors import InputError, SceneError
from intrasplat.names import Eye

Kind = Literal["jpg", "png"]
PICTURE: Kind = "jpg"
MASK: Kind = "png"

MAX_FRAME_BYTES = 8 << 20
"""Limit of one file in the zip, which may come from another site."""
NAME = re.compile(r"(left|right)/(\d{6})\.(jpg|png)")


def name_of(eye: Eye, frame: int, kind: Kind) -> str:
    """The name of a frame's picture or mask in the zip."""
    return f"{eye}/{frame:06d}.{kind}"


def nearest(frames: Iterable[int], t: float, frame_count: int) -> int:
    """The one of `frames` (at least one) that is nearest to model time t in a clip of frame_count frames."""
    wanted = min(t, 1.0) * frame_count
    return min(frames, key=lambda frame: abs(frame - wanted))


def read_frame(path: Path, frame_count: int, t: float, eye: Eye = "left", kind: Kind = PICTURE) -> tuple[int, bytes]:
    """The frame nearest to model time t, and its picture or mask.

    Raises:
        SceneError: the scene has no recorded frames, or the file is damaged.
        InputError: it has none of this eye, or no masks.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            found = [match.groups() for name in archive.namelist() if (match := NAME.fullmatch(name))]
            frames = [int(number) for side, number, ending in found if (side, ending) == (eye, kind)]
            if not found:
                raise _no_recorded_frames()
            if not frames:
                raise _none_of(eye, kind, is_masked=any(ending == MASK for _, _, ending in found))
            index = nearest(frames, t, frame_count)
            entry = archive.getinfo(name_of(eye, index, kind))
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > MAX_FRAME_BYTES:
                raise zipfile.BadZipFile
            return index, archive.read(entry)
    except FileNotFoundError:
        raise _no_recorded_frames() from None
    except (OSError, ValueError, LookupError, NotImplementedError, zipfile.BadZipFile) as error:
        raise SceneError(f"The recorded frames of this scene cannot be read ({type(error).__name__}).") from error


def _no_recorded_frames() -> SceneError:
    return SceneError(
        "This scene keeps no recorded frames: keep_recorded was off, or it was made before they were kept."
    )


def _none_of(eye: Eye, kind: Kind, *, is_masked: bool) -> InputError:
    if kind == MASK and not is_masked:
        return InputError("masks", "this scene has no masks.", "Ask for masks=off.")
    return InputError("eye", f"no frames of the {eye} eye are kept: it did not teach the model.", "Ask for eye=left.")
