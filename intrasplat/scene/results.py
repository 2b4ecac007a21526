"""Add the scores of a finished scene to its folder when they are known.

A reader finds either the scene alone, or the scene with its scores: the manifest, which is replaced last, contains the
hashes of the report and the curve.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from intrasplat.errors import SceneError
from intrasplat.files.durable import FOR_ALL, replace_file
from intrasplat.names import CURVE, MANIFEST, REPORT
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import Report

RESULTS = (REPORT, CURVE, MANIFEST)
"""The files that change, in the order in which they are replaced."""


def listed_files(manifest: dict[str, Any]) -> dict[str, Any]:
    """A scene's files as its manifest lists them: those that rendering reads, and those beside them.

    Raises:
        KeyError, TypeError: this is not the manifest of a scene.
    """
    files: dict[str, Any] = manifest["files"] | manifest.get("beside", {})
    return files


def add_scores(folder: Path, report: Report) -> None:
    """Write the scored report into a scene's folder. The report's score becomes the curve's last point.

    The earlier points score the model in training, on at most sixteen held-out frames.

    Raises:
        FileNotFoundError: the scene has been removed.
        SceneError: its manifest or its curve is damaged.
    """
    try:
        manifest = json.loads((folder / MANIFEST).read_bytes())
        curve = _with_score((folder / CURVE).read_text(), report)
        files = {REPORT: report.model_dump_json(indent=1).encode(), CURVE: curve.encode()}
        for name, content in files.items():
            manifest["files"][name] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    except (ValueError, KeyError, TypeError) as error:
        raise SceneError(f"The manifest or the curve of the scene in {folder.name} is damaged.") from error
    for name, content in files.items():
        replace_file(folder / name, content, FOR_ALL)
    replace_file(folder / MANIFEST, json.dumps(manifest, indent=1, allow_nan=False).encode(), FOR_ALL)


def without_scores(first: Report, reason: str) -> Report:
    """The report of a scene whose scores will never be known.

    Args:
        first: the report before scoring.
        reason: a type's name or a few words.
    """
    text = f"The scores of this scene could not be measured ({reason}): how good it is, is not known."
    kept = (each for each in first.warnings if each.code is not NoticeCode.SCORES_PENDING)
    failed = Notice.warning(NoticeCode.SCORES_FAILED, text)
    return first.model_copy(update={"scored": True, "warnings": (*kept, failed)})


def _with_score(curve: str, report: Report) -> str:
    head, *points = curve.splitlines()
    if points and report.psnr_tissue_db is not None:
        last = dict(zip(head.split(","), points[-1].split(","), strict=True))
        last["psnr_tissue_db"] = f"{report.psnr_tissue_db:.4f}"
        last["psnr_right_db"] = "" if report.psnr_right_db is None else f"{report.psnr_right_db:.4f}"
        points[-1] = ",".join(last.values())
    return "\n".join([head, *points]) + "\n"
