"""The parent's side of the decoding process: turns its output into a clip and its calibration.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip import ClipLimits, DepthClip, StereoClip
from intrasplat.clip.files import MAX_FOLDER_DEPTH
from intrasplat.clip.layouts import registered_files
from intrasplat.clip.types import RgbFrame
from intrasplat.decode.contained import MALFORMED, REMEDY, Decoder, take_decoder
from intrasplat.decode.guard import LIMITED_MEMORY, PROTECTIONS, Allowance
from intrasplat.decode.handover import EYES, FIELDS, MASKS, ArrayFile, map_array
from intrasplat.errors import InputError
from intrasplat.intake.calibration.check import check_calibration
from intrasplat.intake.calibration.types import (
    RawCalibration,
    RectifiedCalibration,
    StereoCalibration,
    parse_calibration,
)
from intrasplat.machine.hooks import Hooks, Progress
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.machine.memory_limit import memory_bytes
from intrasplat.notices import Notice, NoticeCode
from intrasplat.options import ClipOptions
from intrasplat.report import Masks

STAGE = "decode"
LIBRARIES_BYTES = 2 * 2**30  # address space of Python, NumPy, OpenCV and a decoder's threads
MAX_SHARE = 2 / 3  # of the available memory; the rest is for the calling process
MAX_CPU_S = 1800  # of all cores together; the same as MAX_TOTAL_S of one core


@dataclass(frozen=True)
class StereoRecording:
    """A stereo clip, whose frames arrive during decoding, and its calibration.

    clip.pairs waits for each frame, and raises as decode_clip if decoding fails on the way. It can be read repeatedly.
    close() ends decoding; a recording that was read to its end or garbage-collected is closed.
    """

    clip: StereoClip
    calibration: StereoCalibration
    close: Callable[[], None]


class _ArrivingPairs:
    """Left and right frames [H, W, 3] from the files of a process that may still write them, readable repeatedly.

    They are read, not mapped, so that a process that truncates its files cannot crash the reader.
    """

    def __init__(self, decoder: Decoder, size: tuple[int, int, int]) -> None:
        self._decoder, self._size = decoder, size
        self._files: dict[str, ArrayFile] = {}

    def __call__(self) -> Iterator[tuple[RgbFrame, RgbFrame]]:
        for index in range(self._size[0]):
            self._decoder.until_frame(index)
            try:
                self._files = self._files or {eye: ArrayFile(self._decoder.folder, eye, self._size) for eye in EYES}
                left, right = (self._files[eye].frame(index) for eye in EYES)
            except (ValueError, OSError) as error:
                raise _unfit(error) from error
            if index + 1 == self._size[0]:
                self._decoder.until_ended()
                self._decoder.close()
            yield left, right


def decode_clip(
    clip: Path,
    right: Path | None = None,
    *,
    calibration: Path | None = None,
    masks: Path | None = None,
    fov_mask: Path | None = None,
    options: ClipOptions | None = None,
    limits: ClipLimits | None = None,
    hooks: Hooks | None = None,
) -> StereoRecording | DepthClip:
    """The clip and calibration in these files, bit-identical to those of open_clip and load_calibration.

    fov_mask is a PNG of the field of view (intrasplat/clip/given_field.py), which the clip then has.

    Another process decodes every frame into a private folder below tempfile.gettempdir(). Its memory and time are
    limited. If the kernel allows it, the process has no network and can read only these files. `assumptions` lists the
    active protections. A clip with depth is complete when this returns; the frames of a stereo clip are still being
    decoded. The folder is removed with the process; arrays and open files live as long as the clip.

    Raises:
        InputError, LimitError: as open_clip, load_calibration, read_field and with_field raise them; or the stereo clip
            has no calibration; or the decoder crashed, made no progress for 10 s, or took more memory or time than
            allowed.
        Cancelled: hooks.should_stop returned True.
        UnavailableError: the disk is full.
    """
    limits, hooks = limits or ClipLimits(), hooks or Hooks()
    given = {"path": clip, "right": right, "masks": masks, "calibration": calibration, "fov_mask": fov_mask}
    paths = {name: str(path.absolute()) for name, path in given.items() if path is not None}
    layouts = [str(file) for file in registered_files()]
    request = {
        "paths": paths,
        "options": (options or ClipOptions()).model_dump(include=set(ClipOptions.model_fields)),
        "layouts": layouts,
        "readable": [each for path in (*paths.values(), *layouts) for each in _reached(path)],
        "limits": limits.numbers(),
    }
    allowance = allowance_of(limits)
    decoder = take_decoder()
    decoder.ask(
        request,
        allowance,
        on_report=lambda share: hooks.on_progress(Progress(STAGE, share)),
        should_stop=hooks.should_stop,
    )
    decoder.until_opened()
    try:
        return _received(decoder, allowance)
    except (*MALFORMED, OSError) as error:
        decoder.close()
        raise _unfit(error) from error


def allowance_of(limits: ClipLimits) -> Allowance:
    """The limits of a clip's decoding process: memory for libraries and clip, at most MAX_SHARE of what there is."""
    wanted, there = LIBRARIES_BYTES + limits.decoded_bytes, memory_bytes()
    allowed = wanted if there is None else min(wanted, int(MAX_SHARE * there))
    return Allowance(allowed, max(limits.clip_bytes, limits.decoded_bytes), MAX_CPU_S)


def _unfit(error: Exception) -> InputError:
    return InputError(
        "clip", f"it cannot be decoded: the decoder's answer does not fit ({type(error).__name__}).", REMEDY
    )


def _reached(path: str) -> list[str]:
    """A file or folder, and the targets of the folder's links, which only a local user can create."""
    found = [path]
    for folder, subfolders, files in os.walk(path, followlinks=True):
        if len(Path(folder).relative_to(path).parts) >= MAX_FOLDER_DEPTH:
            subfolders.clear()
        entries = (os.path.join(folder, name) for name in (*subfolders, *files))
        found += [os.path.realpath(entry) for entry in entries if os.path.islink(entry)]
    return found


def _received(decoder: Decoder, allowance: Allowance) -> StereoRecording | DepthClip:
    described, folder = decoder.opened or decoder.result or {}, decoder.folder
    frames, height, width = (int(each) for each in described["size"])
    size = (frames, height, width)
    if min(size) < 1 or frames * height * width > allowance.file_bytes:
        raise ValueError(f"a clip of {size}")
    frame_times_s = ArrayFile(folder, "frame_times_s", size).whole()
    if not np.isfinite(frame_times_s).all():
        raise ValueError("frame times that are not finite")
    assumptions = (*_notices(described["assumptions"]), _protection(described["granted"], allowance))
    warnings = _notices(described["warnings"])
    fields = tuple(ArrayFile(folder, name, size).whole() != 0 for name in FIELDS[: int(described["fields"])])
    if decoder.opened is None:
        whole = DepthClip(
            rgb=map_array(folder, "rgb", size),
            tissue=_tissue(folder, "tissue", size),
            depth_mm=_checked_depth(map_array(folder, "depth_mm", size)),
            depth_confidence=map_array(folder, "depth_confidence", size),
            intrinsics=Intrinsics.parsed(described["intrinsics"]),
            world_from_camera=_finite(map_array(folder, "world_from_camera", size).copy()),
            frame_times_s=frame_times_s,
            field_of_view=fields[0] if fields else None,
            masks=described["masks"] and Masks.model_validate(described["masks"]),
            first_pose=described["first_pose"] and _finite(np.array(described["first_pose"], np.float64).reshape(4, 4)),
            assumptions=assumptions,
            warnings=warnings,
        )
        decoder.close()
        return whole
    tissue, tissue_right = (_tissue(folder, name, size) if name in described["masked"] else None for name in MASKS)
    damaged = tuple(int(each) for each in described["damaged"])
    if not set(damaged) <= set(range(frames)):
        raise ValueError(f"damaged frames that are not some of {frames}")
    pairs = _ArrivingPairs(decoder, size)
    clip = StereoClip(
        frames, height, width, pairs, tissue, frame_times_s, assumptions, warnings, tissue_right, damaged,
        given_fields=fields,
    )  # fmt: skip
    return StereoRecording(clip, _calibration(described["calibration"]), decoder.close)


def _tissue(folder: Path, name: str, size: tuple[int, int, int]) -> NDArray[np.bool_]:
    file, tissue = ArrayFile(folder, name, size), mapped_zeros(size, np.bool_)
    for index, mask in enumerate(tissue):
        np.not_equal(file.frame(index), 0, out=mask)
        let_go(mask)
    return tissue


def _notices(described: Any) -> tuple[Notice, ...]:
    return tuple(Notice.model_validate(each) for each in described)


def _protection(granted: list[str], allowance: Allowance) -> Notice:
    """The notice on the protections that were active during decoding, and on those that the kernel did not grant."""
    amounts = {LIMITED_MEMORY: f" of {allowance.memory_bytes / 2**30:.1f} GiB"}
    active = [each + amounts.get(each, "") for each in PROTECTIONS if each in granted]
    lacking = [each for each in PROTECTIONS if each not in granted]
    denied = f"; the kernel did not grant: {', '.join(lacking)}" if lacking else ""
    text = f"decoding: in a process of its own ({', '.join(active) or 'not confined'}{denied})"
    return Notice.info(NoticeCode.DECODING, text)


def _finite(values: NDArray[np.float64]) -> NDArray[np.float64]:
    if not np.isfinite(values).all():
        raise ValueError("poses that are not finite")
    return values


def _checked_depth(depth_mm: NDArray[np.float32]) -> NDArray[np.float32]:
    """The depth, after a check that it is finite and not negative, frame by frame because it is large."""
    if not all(bool(np.isfinite(frame).all()) and float(frame.min()) >= 0 for frame in depth_mm):
        raise ValueError("depth that is negative or not finite")
    return depth_mm


def _calibration(value: Any) -> RectifiedCalibration | RawCalibration:
    calibration = parse_calibration(value)
    check_calibration(calibration)
    return calibration
