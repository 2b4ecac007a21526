"""The names of clips on the command line, and the clips themselves.

PATH                                        anything `reconstruct` reads
phantom:MOTION[:WxH][:FRAMESframes][:seedN] synthetic tissue with true depth, 320x256, 64 frames, seed 0
phantom:MOTION[+PATH...][:...]              the same under an endoscope that follows paths: swing, pan, advance,
                                            retreat, roll, turn, shake (lab/phantom/camera.py), or the path
                                            paths/PATH.tum in the folder INTRASPLAT_DATA names; the clip has the true
                                            poses
phantom:MOTION[:...]:TOOL[+TOOL...]         with other instruments than the grasper: steel, yellow, dark; or none
phantom:MOTION[:...]:nomasks                without masks of the instruments
phantom:MOTION[:...]:stereo                 the same tissue as a stereo clip: both eyes without loss, their calibration
                                            and the left eye's masks, rectified and matched as a user's clip is; it has
                                            no poses
d4d_endonerf[:WxH], d4d_stereo, hamlyn20    the recordings in the folder INTRASPLAT_DATA names; rows call them d4d-a.
                                            WxH, of a clip with depth: shrunk by a whole number to this size
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip
from intrasplat.errors import InputError
from intrasplat.machine.hooks import Hooks
from intrasplat.machine.timing import Timings
from intrasplat.options import ClipOptions, ReconstructionOptions
from intrasplat.pipeline import open_with_poses
from intrasplat.splat.backend import CPU, Device
from intrasplat.stereo import match_eyes
from intrasplat.train.request import ReconstructionRequest
from lab.evaluate.thinned import shrunk
from lab.phantom import CAMERA_PATHS, MOTIONS, TOOLS, Phantom, PhantomSettings, make_phantom

DATA_VARIABLE = "INTRASPLAT_DATA"
PHANTOM_WIDTH, PHANTOM_HEIGHT = 320, 256
NO_TOOLS = "none"
_STEREO: Mapping[str, Any] = {"calibration": "calibration.json", "masks": "tool_masks.zip"}
PHANTOM_SPELLING = "phantom:MOTION[+PATH...][:WxH][:FRAMESframes][:seedN][:TOOL[+TOOL...]][:nomasks][:stereo]"
RECORDINGS: Mapping[str, tuple[str, str, Mapping[str, Any]]] = {
    "d4d_endonerf": ("d4d-a", "d4d_endonerf", {}),
    "d4d_stereo": ("d4d-a-stereo", "d4d_stereo/stereo_sbs.mp4", _STEREO),
    "hamlyn20": ("hamlyn20", "hamlyn20/clip", {"calibration": "calibration.json"}),
}
"""By argument: the name in rows, the file, and the files beside it that `reconstruct` needs. Rows never give a
patient's recording its own name."""


@dataclass(frozen=True)
class Source:
    """A clip that can be opened. The command line calls it `argument`, rows call it `name`.

    phantom  how to draw it; None for a recording
    stereo   whether it is drawn for both eyes, and its depth is stereo's
    masks    whether a drawn clip has masks of its instruments
    clip     the recording's file or folder
    files    beside it: calibration, masks
    options  how the files are to be read
    size     (width, height) that a recording with depth is shrunk to; None leaves it as it is
    """

    name: str
    argument: str
    phantom: PhantomSettings | None = None
    stereo: bool = False
    masks: bool = True
    clip: Path = Path()
    files: Mapping[str, Path] = field(default_factory=dict)
    options: ClipOptions = field(default_factory=ClipOptions)
    size: tuple[int, int] | None = None


@dataclass(frozen=True, eq=False)
class OpenClip:
    """A clip with depth; phantom knows its truth, seconds what decoding and stereo took.

    tissue is [T, H, W] bool, where the left eye shows tissue: exact for a phantom, whose clip may have no masks, and
    the clip's own else; tissue_right the exact one of a phantom's right eye, None where there is no such eye.
    """

    clip: DepthClip
    phantom: Phantom | None
    seconds: Mapping[str, float]
    tissue: NDArray[np.bool_]
    tissue_right: NDArray[np.bool_] | None = None


def source_of(argument: str, files: Mapping[str, Path] | None = None, options: ClipOptions | None = None) -> Source:
    """The source that an argument names; files (calibration, masks) and options are of a clip that is a path.

    Raises:
        InputError: there is no such motion or file, or a recording is asked for, and INTRASPLAT_DATA is not set.
    """
    if argument.startswith("phantom:"):
        return _drawn(argument)
    if argument.partition(":")[0] in RECORDINGS and not Path(argument).exists():
        return _recording(argument)
    if not argument or not Path(argument).exists():  # an empty path is the current folder
        remedy = f"Give a path, phantom:MOTION ({', '.join(MOTIONS)}), or one of {', '.join(RECORDINGS)}."
        raise InputError("CLIP", f"there is no {argument!r}.", remedy)
    path = Path(argument)
    return Source(path.stem, argument, clip=path, files=files or {}, options=options or ClipOptions())


def open_source(source: Source, holdout: str, hooks: Hooks, device: Device = CPU) -> OpenClip:
    """Draw or decode the clip. Stereo measures the frames that are not held out, so a clip belongs to its holdout.

    Raises:
        InputError: the clip or its calibration cannot be used.
    """
    timings = Timings()
    if source.phantom is not None:
        phantom = make_phantom(source.phantom)
        if not source.stereo:
            exact = phantom.depth_clip()
            tissue = exact.tissue
            clip = exact if source.masks else replace(exact, tissue=np.ones_like(tissue))
            return OpenClip(clip, phantom, {}, tissue)
        drawn = phantom.stereo_recording(masks=source.masks)
        clip = match_eyes(
            drawn.clip,
            drawn.calibration,
            holdout,
            hooks,
            timings,
            device=device.kind,
            mask_source=source.options.mask_source,
        )
        return OpenClip(clip, phantom, timings.seconds, drawn.tissue, drawn.tissue_right)
    options = ReconstructionOptions(
        holdout=holdout, use_frames="all", **source.options.model_dump()
    )  # each run chooses
    calibration, masks = source.files.get("calibration"), source.files.get("masks")
    request = ReconstructionRequest(source.clip, options, calibration=calibration, masks=masks)
    clip = open_with_poses(request, hooks, timings, device)
    clip = clip if source.size is None else shrunk(clip, _shrinks_by(clip, source))
    return OpenClip(clip, None, timings.seconds, clip.tissue)


def _shrinks_by(clip: DepthClip, source: Source) -> int:
    """The whole number by which the clip shrinks to the source's size. InputError if there is none."""
    assert source.size is not None
    height, width = clip.intrinsics.height, clip.intrinsics.width
    step = width // source.size[0]
    if (width, height) != (step * source.size[0], step * source.size[1]):
        problem = f"{source.argument} has {width}x{height} pixels, which no whole number shrinks to that size."
        raise InputError("CLIP", problem, f"Write {source.argument.partition(':')[0]}:{width // 2}x{height // 2}.")
    return step


def _recording(argument: str) -> Source:
    known_as, _, size = argument.partition(":")
    name, file, beside = RECORDINGS[known_as]
    wanted = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", size)
    if size and (wanted is None or beside):
        raise InputError("CLIP", f"{argument!r} is not known.", "Write d4d_endonerf:WxH, or leave the size out.")
    folder, remedy = os.environ.get(DATA_VARIABLE), f"Set {DATA_VARIABLE} to the folder that holds it, or leave it out."
    if not folder:
        problem = f"{argument} is looked for where {DATA_VARIABLE} says, and that is not set."
        raise InputError("CLIP", problem, remedy)
    path = Path(folder) / file
    if not path.exists():
        raise InputError("CLIP", f"{known_as} is not under {folder}.", remedy)
    files = {key: path.parent / each for key, each in beside.items()}
    if wanted is None:
        return Source(name, argument, clip=path, files=files)
    return Source(f"{name}-{size}", argument, clip=path, files=files, size=(int(wanted[1]), int(wanted[2])))


def _drawn(argument: str) -> Source:
    """The source of phantom:MOTION[...]. InputError for what is not known."""
    values: dict[str, Any] = {"width": PHANTOM_WIDTH, "height": PHANTOM_HEIGHT}
    flags = {"stereo": False, "nomasks": False}
    _, moves, *parts = argument.split(":")
    motion, *paths = moves.split("+")
    for path in set(paths) - set(CAMERA_PATHS):
        recorded = Path(os.environ.get(DATA_VARIABLE, ""), "paths", f"{path}.tum")
        if recorded.is_file():
            paths.remove(path)
            values["recorded_path"] = recorded
    for part in parts:
        if match := re.fullmatch(r"(\d+)x(\d+)", part):
            values |= {"width": int(match[1]), "height": int(match[2])}
        elif match := re.fullmatch(r"(\d+)frames", part):
            values["frames"] = int(match[1])
        elif match := re.fullmatch(r"seed(\d+)", part):
            values["seed"] = int(match[1])
        elif part in flags:
            flags[part] = True
        elif part == NO_TOOLS or set(part.split("+")) <= set(TOOLS):
            values["tools"] = () if part == NO_TOOLS else tuple(part.split("+"))
        else:
            problem = f"{part!r} in {argument!r} is not known."
            raise InputError("CLIP", problem, f"Write {PHANTOM_SPELLING}.")
    try:
        settings = PhantomSettings(motion=motion, camera=tuple(paths), **values)  # type: ignore[arg-type]  # it judges
    except InputError as error:  # it names an option of another command
        raise InputError("CLIP", f"{argument!r} cannot be drawn: {error.problem}", error.remedy) from error
    stereo, masks = flags["stereo"], not flags["nomasks"]
    name = _phantom_name(settings) + "-nomasks" * (not masks) + "-stereo" * stereo
    return Source(name, argument, settings, stereo, masks)


def _phantom_name(settings: PhantomSettings) -> str:
    """phantom-MOTION and what differs from the usual clip."""
    usual = PhantomSettings()
    parts = ["phantom", *settings.moves.split("+")]
    if (settings.width, settings.height) != (PHANTOM_WIDTH, PHANTOM_HEIGHT):
        parts.append(f"{settings.width}x{settings.height}")
    if settings.frames != usual.frames:
        parts.append(f"{settings.frames}frames")
    if settings.seed != usual.seed:
        parts.append(f"seed{settings.seed}")
    if settings.tools != usual.tools:
        parts.extend(settings.tools or [NO_TOOLS])
    return "-".join(parts)
