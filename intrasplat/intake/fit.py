"""Detects options that contradict the files of an upload, without a decoder.

Reconstruction makes the same checks and more. This early check saves the caller from waiting for the job to fail.
"""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path, PurePosixPath

from intrasplat.errors import InputError
from intrasplat.intake.sniff import ZIP_SUFFIX
from intrasplat.names import POSES_FILE, POSES_UNUSED, Fov, Poses
from intrasplat.options import ReconstructionOptions

_OF_MANY_FILES = ("endonerf", "stereomis", "frames")
"""Layouts whose clip is a zip."""
EITHER_REMEDY = "Leave one of them out."
STEREO_VIDEOS = ("sbs", "tb")
"""Layouts whose clip shows both eyes. A video, unlike a zip, cannot contain a calibration."""


def check_fit(options: ReconstructionOptions, files: Mapping[str, Path], sent: Collection[str]) -> None:
    """Check that the options fit the files.

    Args:
        files: the files of an upload by part, each of which has passed check_file().
        sent: the parts that came with the options; the others belong to an earlier job's clip.

    Raises:
        InputError: names the option; the clip, if it lacks a file of the requested layout; the field of view, if the
            whole picture is asked for; or the calibration, if it is missing for a video that certainly shows two eyes.
    """
    layout, clip = options.layout, files.get("clip")
    if clip is None and layout != "auto":
        raise InputError("options.layout", f'layout "{layout}" does not go with two files.', "Leave it out.")
    is_zip = clip is not None and _is_zip(clip)
    if clip is not None and layout in _OF_MANY_FILES and not is_zip:
        problem = f'layout "{layout}" needs a zip, {clip.name} is none.'
        raise InputError("options.layout", problem, "Leave it out, or send the files in a zip.")
    shows_two_eyes = clip is None or layout in STEREO_VIDEOS
    if shows_two_eyes and "calibration" not in files and not _is_zip(clip or files["left"]):
        raise calibration_missing()
    has_poses = clip is not None and is_zip and _holds(clip, POSES_FILE)
    if layout == "endonerf" and not has_poses:
        raise InputError("clip", f"the zip has no {POSES_FILE}.", "Put it beside images/, or leave the layout out.")
    of_layout = has_poses and layout in ("auto", "endonerf")
    if options.poses == "given" and not of_layout and "poses_file" not in files:
        problem = "it asks for poses that come with the clip, and only the EndoNeRF layout brings poses."
        raise InputError("options.poses", problem, 'Send poses_file too, or say "auto" or "estimate".')
    if "poses_file" in sent:
        check_poses_used(options.poses, "poses_file")
    if "fov_mask" in sent:
        check_not_all(options.fov)
    if options.mask_source == "none" and "masks" in sent:
        problem = '"none" uses no masks, and masks came with it.'
        raise InputError("options.mask_source", problem, EITHER_REMEDY)


def check_poses_used(poses: Poses, field: str) -> None:
    """InputError if the options use no given poses although this field gives some."""
    if poses in POSES_UNUSED:
        raise InputError("options.poses", f'"{poses}" uses no given poses, and {field} came with it.', EITHER_REMEDY)


def check_not_all(fov: Fov) -> None:
    """InputError if the options ask for the whole picture although a field of view is given."""
    if fov == "all":
        problem = 'it came with fov "all", which takes the whole picture.'
        raise InputError("fov_mask", problem, EITHER_REMEDY)


def calibration_missing() -> InputError:
    """The error for a video of two eyes without a calibration."""
    return InputError(
        "calibration", "a video of two eyes needs a calibration.", "Add the calibration of this endoscope."
    )


def _is_zip(path: Path) -> bool:
    return path.suffix.lower() == ZIP_SUFFIX


def _holds(path: Path, name: str) -> bool:
    """Whether a zip contains a file of that name in any folder."""
    with zipfile.ZipFile(path) as archive:
        return any(PurePosixPath(each).name == name for each in archive.namelist())
