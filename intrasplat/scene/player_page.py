"""A scene and the page's player in one HTML file, which opens from a disk without a server or a network.

The page is in the dashboard's folder `file/`. Its style, its script with all modules, and the scene are inserted. Its
content security policy allows nothing else.
"""

from __future__ import annotations

import base64
import hashlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from intrasplat.errors import InputError, LimitError, SceneError, UnavailableError
from intrasplat.names import MANIFEST, REPORT, SCENE
from intrasplat.scene.inline import CannotInlineError, inlined
from intrasplat.version import version

PAGE, STYLE, SCRIPT = "alone.html", "alone.css", "alone.js"
CHARSET = '<meta charset="utf-8">'
SCENE_TAG = '<script type="text/plain" id="scene">'
DRAWN = ("compact", "shared")
"""Coding and kind of motion of the scenes that the player draws."""
MAX_SCENE_BYTES = 256 << 20
"""Browsers limit a string to half a gigabyte; scenes of our presets have a few megabytes."""
PIECE_BYTES = 3 << 18  # a multiple of 3: base64 of it ends on a whole character
DASHBOARD_REMEDY = "Set INTRASPLAT_DASHBOARD_DIR to the page's files, the folder client/dashboard."


def page_parts(folder: Path, scene_id: str | None, dashboard_dir: Path | None) -> Iterator[bytes]:
    """The HTML file of the scene in a folder, piece by piece.

    Raises, before the first piece:
        InputError: the player does not draw scenes of this kind.
        LimitError: the scene is too large for one file.
        SceneError: there is no scene, or its manifest cannot be read.
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
    about = {
        "sceneId": scene_id,
        "version": version(),
        "exportedAtMs": round(1000 * time.time()),
        "sceneBytes": size,
        "psnrDb": report.get("psnr_tissue_db"),
        "warnings": [{"code": each["code"], "text": each["text"]} for each in report.get("warnings", ())],
    }
    head, tail = _page(dashboard_dir, {"manifest": manifest, "about": about})
    return _written(head, folder / SCENE, tail)


def _written(head: str, scene: Path, tail: str) -> Iterator[bytes]:
    yield head.encode()
    with scene.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            yield base64.b64encode(piece)
    yield tail.encode()


def _page(dashboard_dir: Path | None, documents: dict[str, object]) -> tuple[str, str]:
    """The page before and after the scene's bytes."""
    if dashboard_dir is None:
        raise UnavailableError("The page's files are not known here.", DASHBOARD_REMEDY)
    folder = dashboard_dir / "file"
    try:
        page, style, script = (
            (folder / PAGE).read_text(encoding="utf-8"),
            (folder / STYLE).read_text(encoding="utf-8"),
            inlined(folder / SCRIPT),
        )
    except (OSError, CannotInlineError) as error:
        problem = f"The page's files cannot be put into one ({type(error).__name__})."
        raise UnavailableError(problem, DASHBOARD_REMEDY) from error
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; worker-src blob:; "
        "base-uri 'none'; form-action 'none'"
    )
    data = "".join(
        f'<script type="application/json" id="{name}">{json.dumps(each).replace("<", chr(92) + "u003c")}</script>\n'
        for name, each in documents.items()
    )
    parts = {
        CHARSET: f'{CHARSET}\n<meta http-equiv="Content-Security-Policy" content="{policy}">',
        f'<link rel="stylesheet" href="{STYLE}">': f"<style>{style}</style>",
        f'<script type="module" src="{SCRIPT}"></script>': f"{data}{SCENE_TAG}</script>\n<script>{script}</script>",
    }
    for before, after in parts.items():
        if page.count(before) != 1:
            raise UnavailableError(f"The page's file {PAGE} has no {before}.", DASHBOARD_REMEDY)
        page = page.replace(before, after)
    head, opening, tail = page.partition(SCENE_TAG)
    return head + opening, tail


def _hash(text: str) -> str:
    """The hash by which a content security policy names an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
