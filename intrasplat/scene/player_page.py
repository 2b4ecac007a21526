"""A scene and the page's player in one HTML file, which opens from a disk without a server or a network.

The page is in the dashboard's folder `file/`. Inserted are its styles, its script with all modules, the scene, and
recorded frames where they are wanted. Its content security policy allows nothing else.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from zipfile import ZipInfo

from intrasplat.errors import InputError, LimitError, SceneError, UnavailableError
from intrasplat.formats import MAX_RECORDED_BYTES
from intrasplat.names import DETAIL, MANIFEST, RECORDED, REPORT, SCENE, Keep
from intrasplat.scene.inline import CannotInlineError, inlined
from intrasplat.scene.recorded_file import read_files, seam_files
from intrasplat.version import version

PAGE, SCRIPT = "alone.html", "alone.js"
STYLE_TAG = re.compile(r'<link rel="stylesheet" href="([^"]+)">')
CHARSET = '<meta charset="utf-8">'
PICTURES_TAG = '<script type="application/json" id="pictures">'
SCENE_TAG = '<script type="text/plain" id="scene">'
VIDEO_TAG = '<script type="text/plain" id="video">'
DRAWN = ("compact", "shared")
"""Coding and kind of motion of the scenes that the player draws."""
REPORTED = ("scored", "psnr_tissue_db", "detail", "baseline_blend_db", "baseline_flow_db", "warnings")
"""Of the report: what verdict and likeness are made of."""
MAX_SCENE_BYTES = 256 << 20
"""Browsers limit a string to half a gigabyte; scenes of our presets have a few megabytes."""
PIECE_BYTES = 3 << 18  # a multiple of 3: base64 of it ends on a whole character
DASHBOARD_REMEDY = "Set INTRASPLAT_DASHBOARD_DIR to the page's files, the folder client/dashboard."


@dataclass(frozen=True)
class _Recorded:
    """A scene's recorded frames in a page.

    size    bytes of those that there are; 0 if nobody looked, or they are damaged
    state   in: they are in the page; off, large, damaged, none: why they are not
    video   detail.mkv; None: not in the page
    files   of recorded.zip in the page
    """

    size: int
    state: Literal["in", "off", "large", "damaged", "none"]
    video: Path | None = None
    files: tuple[ZipInfo, ...] = ()


def page_parts(
    folder: Path, scene_id: str | None, dashboard_dir: Path | None, recorded: Keep | None = None
) -> Iterator[bytes]:
    """The HTML file of the scene in a folder, piece by piece.

    Args:
        recorded: whether the recorded frames are put in; None: if they have at most MAX_RECORDED_BYTES and are sound.

    Raises, before the first piece:
        InputError: the player does not draw scenes of this kind, or the scene has no recorded frames.
        LimitError: scene and recorded frames are too large for one file.
        SceneError: there is no scene, or its manifest cannot be read, or the recorded frames that are asked for cannot.
        UnavailableError: the page's files are missing.
    """
    try:
        manifest: dict[str, Any] = json.loads((folder / MANIFEST).read_bytes())
        report: dict[str, Any] = json.loads((folder / REPORT).read_bytes()) if (folder / REPORT).is_file() else {}
        kind, size = (manifest["coding"], manifest["deformation"]), (folder / SCENE).stat().st_size
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"The scene cannot be read ({type(error).__name__}).") from error
    if kind != DRAWN:
        problem = f"a page draws compact scenes of shared motion; this one is {' and '.join(map(str, kind))}."
        raise InputError("format", problem, "Export webm or mp4, or reconstruct with another preset.")
    if size > MAX_SCENE_BYTES:
        problem = f"the scene has {size} bytes; one file holds {MAX_SCENE_BYTES}."
        raise LimitError("format", problem, "Export it as scene.")
    frames = _recorded_frames(folder, recorded, MAX_SCENE_BYTES - size)
    about = {
        "sceneId": scene_id,
        "version": version(),
        "exportedAtMs": round(1000 * time.time()),
        "sceneBytes": size,
        "recorded": {"bytes": frames.size, "state": frames.state},
        "report": {"warnings": ()} | {name: report[name] for name in REPORTED if name in report} if report else None,
    }
    page = _page(dashboard_dir, {"manifest": manifest, "about": about})
    pictures = _pictures(folder, frames.files)
    return _written(
        page, {PICTURES_TAG: pictures, SCENE_TAG: _base64(folder / SCENE), VIDEO_TAG: _base64(frames.video)}
    )


def _recorded_frames(folder: Path, recorded: Keep | None, max_bytes: int) -> _Recorded:
    """The recorded frames that go into the page; raises as page_parts()."""
    if recorded == "off":
        return _Recorded(0, "off" if any((folder / each).is_file() for each in (DETAIL, RECORDED)) else "none")
    try:
        frames = _fitting_frames(folder, recorded, max_bytes)
        for _ in read_files(folder, frames.files):
            pass  # their checksums are right
    except SceneError:
        if recorded == "on":
            raise
        return _Recorded(0, "damaged")
    return frames


def _fitting_frames(folder: Path, recorded: Keep | None, max_bytes: int) -> _Recorded:
    video = folder / DETAIL if (folder / DETAIL).is_file() else None
    files = seam_files(folder)
    size = sum(each.file_size for each in files) + (video.stat().st_size if video else 0)
    if recorded == "on" and size == 0:
        raise InputError("recorded", "this scene has no recorded frames.", "Leave it out.")
    if recorded == "on" and size > max_bytes:
        problem = f"the recorded frames have {size} bytes; in one file there is space for {max_bytes}."
        raise LimitError("recorded", problem, "Add recorded=off.")
    if size == 0:
        return _Recorded(0, "none")
    if recorded is None and size > min(max_bytes, MAX_RECORDED_BYTES):
        return _Recorded(size, "large")
    return _Recorded(size, "in", video, files)


def _written(page: str, inserted: Mapping[str, Iterator[bytes]]) -> Iterator[bytes]:
    """The page with something behind each tag, in their order."""
    for tag, parts in inserted.items():
        head, _, page = page.partition(tag)
        yield f"{head}{tag}".encode()
        yield from parts
    yield page.encode()


def _base64(path: Path | None) -> Iterator[bytes]:
    if path is None:
        return
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            yield base64.b64encode(piece)


def _pictures(folder: Path, files: tuple[ZipInfo, ...]) -> Iterator[bytes]:
    """A JSON object of files in base64, by name."""
    before = b"{"
    for name, content in read_files(folder, files):
        yield before + f'"{name}": "'.encode() + base64.b64encode(content) + b'"'
        before = b", "
    yield b"}" if files else b"{}"


def _page(dashboard_dir: Path | None, documents: Mapping[str, object]) -> str:
    """The page with documents, and with tags for pictures, scene and video."""
    if dashboard_dir is None:
        raise UnavailableError("The page's files are not known here.", DASHBOARD_REMEDY)
    folder = dashboard_dir / "file"
    try:
        page, script = (folder / PAGE).read_text(encoding="utf-8"), inlined(folder / SCRIPT)
        styles = [(folder / each).read_text(encoding="utf-8") for each in STYLE_TAG.findall(page)]
    except (OSError, CannotInlineError) as error:
        problem = f"The page's files cannot be put into one ({type(error).__name__})."
        raise UnavailableError(problem, DASHBOARD_REMEDY) from error
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(''.join(styles))}; worker-src blob:; "
        "base-uri 'none'; form-action 'none'"
    )
    data = "".join(
        f'<script type="application/json" id="{name}">{json.dumps(each).replace("<", chr(92) + "u003c")}</script>\n'
        for name, each in documents.items()
    )
    parts = {
        CHARSET: f'{CHARSET}\n<meta http-equiv="Content-Security-Policy" content="{policy}">',
        "</head>": f"<style>{''.join(styles)}</style>\n</head>",
        f'<script type="module" src="{SCRIPT}"></script>': (
            f"{data}{PICTURES_TAG}</script>\n{SCENE_TAG}</script>\n{VIDEO_TAG}</script>\n<script>{script}</script>"
        ),
    }
    page = STYLE_TAG.sub("", page)
    for before, after in parts.items():
        if page.count(before) != 1:
            raise UnavailableError(f"The page's file {PAGE} has no {before}.", DASHBOARD_REMEDY)
        page = page.replace(before, after)
    return page


def _hash(text: str) -> str:
    """The hash by which a content security policy names an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
