"""POST /reconstruct/check: checks the description of a clip before the clip is sent. Nothing is stored.

The rules are those of POST /reconstruct, and those of the worker that need no decoder. A finding is `refused` if POST
/reconstruct would refuse the clip. Findings that rest on the caller's own measurements, or that would fail in the
worker, are reported too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from fastapi import APIRouter, Request
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from contract.access.keys import KeyScope
from contract.wire.checks import DescribedClip, DescribedFile, Finding, FindingCode
from intrasplat.errors import InputError, LimitError
from intrasplat.intake.calibration.fit import fitted
from intrasplat.intake.calibration.opencv import look_at_calibration
from intrasplat.intake.calibration.types import StereoCalibration
from intrasplat.intake.fit import STEREO_VIDEOS, calibration_missing
from intrasplat.intake.limits import ClipLimits
from intrasplat.intake.sniff import ZIP_SUFFIX, check_calibration_file, check_field_head, check_head
from intrasplat.options import JobOptions, parse_options
from service.access import Caller
from service.deps import AnyCaller, Deps, Services
from service.problems import Problem
from service.reconstruct import check_scopes, read_json
from service.retention import check_retention
from service.upload import check_part_size, checked_suffix

router = APIRouter(tags=["jobs"])

MAX_BODY_BYTES = 3 * 1024 * 1024
"""Maximum bytes of a description; a calibration's text may double in JSON."""
REMEDY = 'Send {"clip": {"suffix": ".mp4", "size_bytes": N}} and what else is known of its files.'
MAX_APART_S = 0.1
"""If the durations of two eyes differ by more, they do not have the same number of frames."""
EYES_OF = {
    "sbs": ((2, 1),),
    "tb": ((1, 2),),
    "auto": ((2, 1), (1, 2)),
}
"""The numbers of eyes (columns, rows) in a video frame, by layout."""


class Findings(BaseModel):
    """Everything that was found, in the order of the form; an empty list is no promise."""

    findings: list[Finding]


@router.post(
    "/reconstruct/check",
    operation_id="check_clip",
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/json": {"schema": {"$ref": "#/components/schemas/DescribedClip"}}},
        }
    },
)
async def check_clip(request: Request, services: Services, caller: AnyCaller) -> Findings:
    """The problems of a clip, found before it is sent. Send a description of its files, and the calibration's text."""
    caller.require(KeyScope.RECONSTRUCT)
    described = await read_json(request, services, DescribedClip, MAX_BODY_BYTES, REMEDY)
    return Findings(findings=await run_in_threadpool(lambda: list(_findings(services, caller, described))))


def _findings(services: Deps, caller: Caller, described: DescribedClip) -> Iterator[Finding]:
    files = described.files()
    total_bytes = sum(file.size_bytes for file in files.values())
    of_files = [finding for part, file in files.items() for finding in _of_file(part, file)]
    yield from of_files
    if total_bytes:
        yield from _found(FindingCode.NO_ROOM, lambda: services.intake.check(caller.tenant, total_bytes))
    yield from _of_sizes(services.settings.clip_limits, files)
    if ("calibration", FindingCode.ENDING) not in {(finding.field, finding.code) for finding in of_files}:
        yield from _of_calibration(described)
    yield from _of_options(services, caller, described)


def _of_file(part: str, file: DescribedFile) -> Iterator[Finding]:
    if file.size_bytes == 0:
        yield _finding(part, FindingCode.EMPTY, "the file is empty.", "Send a file with content.")
        return
    if wrong := list(_found(FindingCode.ENDING, lambda: checked_suffix(part, file.suffix))):
        yield from wrong  # the content is checked only if the kind of file is right
        return
    yield from _found(FindingCode.TOO_LARGE, lambda: check_part_size(part, file.size_bytes))
    head = bytes.fromhex(file.head)
    if part in ("calibration", "poses_file") or not head:
        return
    if part == "fov_mask":
        yield from _found(FindingCode.KIND, lambda: check_field_head(head, part, "the file"))
    elif file.suffix.lower() != ZIP_SUFFIX:
        yield from _found(FindingCode.KIND, lambda: check_head(head, file.suffix, part, "the file"))
    elif not head.startswith(b"PK"):
        yield _finding(part, FindingCode.KIND, "the file is not a zip.", "Zip the files again.", refused=False)


def _of_sizes(limits: ClipLimits, files: dict[str, DescribedFile]) -> Iterator[Finding]:
    """Findings from the sizes and durations that the caller measured."""
    for part in files.keys() & {"clip", "left", "right"}:
        file = files[part]
        if file.width and file.height:
            check = partial(limits.check_frame, part, "it", file.width, file.height)
            yield from _found(FindingCode.TOO_LARGE, check, refused=False)
        if file.duration_s is not None:
            check = partial(limits.check_duration, part, "it", file.duration_s)
            yield from _found(FindingCode.TOO_LONG, check, refused=False)
    left, right = files.get("left"), files.get("right")
    if left is None or right is None:
        return
    sizes = {(file.width, file.height) for file in (left, right) if file.width and file.height}
    if len(sizes) > 1:
        problem = "the eyes are of different sizes: " + " and ".join(f"{w}x{h}" for w, h in sorted(sizes)) + "."
        yield _finding("right", FindingCode.EYES_DIFFER, problem, "Give both eyes of one recording.", refused=False)
    durations_s = [file.duration_s for file in (left, right) if file.duration_s is not None]
    if len(durations_s) > 1 and abs(durations_s[0] - durations_s[1]) > MAX_APART_S:
        problem = f"the left eye lasts {durations_s[0]:.2f} s, the right one {durations_s[1]:.2f} s."
        yield _finding("right", FindingCode.EYES_DIFFER, problem, "Cut both to the same frames.", refused=False)


def _of_calibration(described: DescribedClip) -> Iterator[Finding]:
    file, clip = described.calibration, described.clip or described.left
    if file is None:
        if clip is not None and described.clip_of is None and clip.suffix.lower() != ZIP_SUFFIX:
            is_stereo = described.left is not None or described.options.get("layout") in STEREO_VIDEOS
            yield _of_error(FindingCode.CALIBRATION_MISSING, calibration_missing(), refused=is_stereo)
        return
    if file.text is None:
        return
    try:
        check_calibration_file(file.text, "calibration", "it")
        calibration = look_at_calibration(file.text)
    except InputError as error:
        yield _of_error(FindingCode.CALIBRATION_UNREADABLE, error)
        return
    if calibration is not None:
        yield from _of_fit(calibration, described)


def _of_fit(calibration: StereoCalibration, described: DescribedClip) -> Iterator[Finding]:
    """A finding if the calibration fits none of the sizes that the clip's eyes may have, or only after a conversion."""
    clip = described.clip or described.left
    if clip is None or clip.width is None or clip.height is None:
        return
    layout = str(described.options.get("layout", "auto"))
    packings = ((1, 1),) if described.left is not None else EYES_OF.get(layout, ())
    errors: list[InputError] = []
    fits: list[StereoCalibration] = []
    for beside, below in packings:
        try:
            fits.append(fitted(calibration, clip.width // beside, clip.height // below))
        except InputError as error:
            errors.append(error)
    if packings and len(errors) == len(packings):
        yield _of_error(FindingCode.CALIBRATION_SIZE, errors[0], refused=False)
    elif fits and all(each.scaled_from is not None for each in fits):
        problem = f"it is for {calibration.width}x{calibration.height} pixels an eye, and is scaled to {_sizes(fits)}."
        remedy = "If it is not of this recording, give the one that is: else every distance is wrong."
        yield _finding("calibration", FindingCode.CALIBRATION_SCALED, problem, remedy, refused=False)


def _sizes(fits: list[StereoCalibration]) -> str:
    return " or ".join(f"{each.width}x{each.height}" for each in fits)


def _of_options(services: Deps, caller: Caller, described: DescribedClip) -> Iterator[Finding]:
    try:
        options = parse_options(JobOptions, described.options)
        check_retention(options, services.settings)
    except InputError as error:
        yield _of_error(FindingCode.OPTION, error)
        return
    try:
        check_scopes(options, caller, services.settings)
    except Problem as problem:
        yield _finding("options", FindingCode.NOT_ALLOWED, problem.detail, problem.remedy or "")


def _found(code: FindingCode, check: Callable[[], Any], *, refused: bool = True) -> Iterator[Finding]:
    """The finding of a check that raises."""
    try:
        check()
    except LimitError as error:
        yield _of_error(FindingCode.TOO_LARGE if code is FindingCode.NO_ROOM else code, error, refused=refused)
    except InputError as error:
        yield _of_error(code, error, refused=refused)
    except Problem as problem:
        yield _finding(problem.field or "clip", code, problem.detail, problem.remedy or "", refused=refused)


def _of_error(code: FindingCode, error: InputError, *, refused: bool = True) -> Finding:
    return _finding(error.field, code, error.problem, error.remedy, refused=refused)


def _finding(field: str, code: FindingCode, problem: str, remedy: str, *, refused: bool = True) -> Finding:
    return Finding(field=field, code=code, refused=refused, problem=problem, remedy=remedy)
