"""Import a scene of another installation: only what our own reader understands is stored.

intrasplat/scene/archive.py has checked the archive before. Symbols: T frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import InputError, SceneError
from intrasplat.files.durable import FOR_ALL, replace_file
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.sniff import check_file
from intrasplat.motion.light import light_settings
from intrasplat.names import MANIFEST, RECORDED, REPORT, THUMBNAIL
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import Imported, Report
from intrasplat.scene.archive import AGAIN, FIELD, NESTED, check_words, read_archive
from intrasplat.scene.checkpoint import MISFITS, load_scene, save_scene
from intrasplat.scene.results import without_scores
from intrasplat.scene.scene import TrainedScene

MAX_ROTATION_ERROR = 1e-3


def take_scene(
    archive: Path,
    folder: Path,
    imported: Imported,
    limits: ClipLimits,
    max_bytes: int,
    on_step: Callable[[float], None] = lambda fraction: None,
) -> Report:
    """Write the scene of an archive into an empty folder, as if it had been trained here, and return its report.

    limits: limits of the clips that this installation accepts. on_step(fraction) is called after each step.

    Raises:
        InputError: the archive is refused, or its scene cannot be shown here. The field is FIELD.
        LimitError: the scene has more frames or pixels than this installation accepts.
    """
    read = read_archive(archive, max_bytes, folder)
    on_step(0.3)
    try:
        scene = load_scene(folder)
        settings = _settings(scene)
    except SceneError as error:
        words = str(error).replace(f"{folder}/", "").replace(str(folder), archive.name)
        raise InputError(FIELD, words, AGAIN) from error
    except MISFITS as error:
        raise InputError(FIELD, f"The scene's settings cannot be read ({type(error).__name__}).", AGAIN) from error
    check_words(MANIFEST, " ".join(each.text for each in scene.pose_warnings))  # every view repeats them in a header
    on_step(0.6)
    _check_recording(scene, limits)
    _check_report(scene, read.report)
    kept = [name for name in NESTED if (folder / name).exists()]
    for name in kept:
        check_file(folder / name, FIELD, limits)
    (folder / THUMBNAIL).unlink(missing_ok=True)  # a new one is rendered, so that it shows this scene
    save_scene(folder, replace(scene, settings=settings), {name: (folder / name).read_bytes() for name in kept})
    report = _from_elsewhere(read.report, imported)
    if RECORDED not in kept:
        report = report.model_copy(update={"recorded": None})
    replace_file(folder / REPORT, report.model_dump_json(indent=1).encode(), FOR_ALL)
    on_step(1.0)
    return report


def _settings(scene: TrainedScene) -> dict[str, Any]:
    """The settings that views need, checked: the scene's report says how it was trained."""
    light = light_settings(scene.log_gains, scene.vignetting, scene.veil)
    warnings = [each.model_dump(mode="json") for each in scene.pose_warnings]
    return {"pose_warnings": warnings, "motion_error": scene.motion_error, **light}


def _check_recording(scene: TrainedScene, limits: ClipLimits) -> None:
    """Raise InputError or LimitError unless a clip of such frames, times, poses and camera is accepted here."""
    if len(scene.gaussians) < 1:
        raise InputError(FIELD, "The scene has no Gaussians.", AGAIN)
    k = scene.intrinsics
    limits.check_frame(FIELD, "a frame of the scene", k.width, k.height)
    limits.check_clip(FIELD, "the scene", scene.frame_count, k.width, k.height, eyes=1)
    times_s = scene.frame_times_s
    if times_s[0] != 0 or (np.diff(times_s) <= 0).any():
        raise InputError(FIELD, "The scene's frame_times_s do not begin at 0 and rise.", AGAIN)
    limits.check_duration(FIELD, "the scene", float(times_s[-1]))
    if not _are_rigid(scene.world_from_camera):
        raise InputError(FIELD, "The scene's world_from_camera are no rotations and translations.", AGAIN)


def _are_rigid(poses: NDArray[np.float64]) -> bool:
    """Whether poses [T, 4, 4] are rotations and translations, and nothing else."""
    turns = poses[:, :3, :3]
    is_turn = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() < MAX_ROTATION_ERROR
    return bool(is_turn and (np.linalg.det(turns) > 0).all() and (poses[:, 3] == [0, 0, 0, 1]).all())


def _check_report(scene: TrainedScene, report: Report) -> None:
    """Raise InputError unless the report describes this scene."""
    k = scene.intrinsics
    pairs = {
        "gaussians": (report.gaussians, len(scene.gaussians)),
        "frame_count": (report.frame_count, scene.frame_count),
        "width": (report.width, k.width),
        "height": (report.height, k.height),
    }
    for name, (said, found) in pairs.items():
        if said != found:
            raise InputError(FIELD, f"The report says {name} {said}, the scene has {found}.", AGAIN)


def _from_elsewhere(report: Report, imported: Imported) -> Report:
    """The report, with the origin of its scene added and its scores unchanged."""
    if not report.scored:
        report = without_scores(report, "it was exported before they were known")
    text = (
        f"This scene was made by another installation of intrasplat (version {imported.version}) and imported: its "
        "figures were measured there."
    )
    others = tuple(each for each in report.assumptions if each.code is not NoticeCode.IMPORTED)
    notice = Notice.info(NoticeCode.IMPORTED, text)
    return report.model_copy(update={"imported": imported, "assumptions": (notice, *others)})
