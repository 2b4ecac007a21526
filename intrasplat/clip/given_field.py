"""A field of view that the caller gives: a picture of one eye or of both, white where it shows the scene.

Symbols: H W pixels of one eye, as recorded.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.files import check_exists
from intrasplat.clip.images import decode_image
from intrasplat.clip.packing import halves, packing_by_size
from intrasplat.clip.types import DepthClip, StereoClip
from intrasplat.errors import InputError, LimitError
from intrasplat.intake.limits import MAX_FOV_MASK_BYTES, ClipLimits
from intrasplat.intake.sniff import check_field_head, png_size

Mask = NDArray[np.bool_]

FIELD = "fov_mask"
_HEAD_BYTES = 32  # contains a PNG's size
_REMEDY = "Give a PNG that is white where the picture shows the scene, and black elsewhere."


def read_field(path: Path, limits: ClipLimits) -> Mask:
    """The pixels of a PNG that are brighter than half of its brightest, as a bool array; alpha does not count.

    Raises:
        InputError: there is no such file, or it is no PNG or damaged.
        LimitError: it is larger than the limits.
    """
    check_exists(path, FIELD)
    if not path.is_file():
        raise InputError(FIELD, f"{path.name} is not a file.", _REMEDY)
    if path.stat().st_size > MAX_FOV_MASK_BYTES:
        raise LimitError(FIELD, f"{path.name} is larger than {MAX_FOV_MASK_BYTES // 2**20} MiB.", _REMEDY)
    data = path.read_bytes()
    check_field_head(data[:_HEAD_BYTES], FIELD, path.name)
    size = png_size(data[:_HEAD_BYTES])
    if size is None:
        raise InputError(FIELD, f"{path.name} is damaged or cut short.", "Write the image again.")
    limits.check_frame(FIELD, path.name, *size)
    image = decode_image(data, FIELD, path.name)
    limits.on_picture()
    levels = image if image.ndim == 2 else image[:, :, :3].max(axis=2)
    return np.asarray(levels > levels.max() / 2)


@overload
def with_field(clip: StereoClip, picture: Mask) -> StereoClip: ...
@overload
def with_field(clip: DepthClip, picture: Mask) -> DepthClip: ...
def with_field(clip: StereoClip | DepthClip, picture: Mask) -> StereoClip | DepthClip:
    """The clip with a field of view that replaces the one that would be found.

    Args:
        picture: [H, W] bool, True inside the left eye's field; or, for a stereo clip, both eyes as frames are packed.

    Raises:
        InputError: it has another size than the clip's eyes, or shows nothing of an eye.
    """
    is_stereo = isinstance(clip, StereoClip)
    height, width = (clip.height, clip.width) if isinstance(clip, StereoClip) else clip.rgb.shape[1:3]
    packing = packing_by_size(picture.shape, (height, width)) if is_stereo else None
    fields = (picture,) if packing is None else halves(picture, packing)
    if fields[0].shape != (height, width):
        raise InputError(
            FIELD,
            f"it is {picture.shape[1]}x{picture.shape[0]} pixels, the left eye is {width}x{height}.",
            "Give a picture of the size of the left eye" + (", or of both eyes side by side." if is_stereo else "."),
        )
    for eye, field in zip(("left", "right"), fields, strict=False):
        if not field.any():
            which = f" of the {eye} eye" if len(fields) > 1 else ""
            raise InputError(FIELD, f"it is black all over{which}, so nothing is inside.", _REMEDY)
    if isinstance(clip, StereoClip):
        return replace(clip, given_fields=fields)
    return replace(clip, field_of_view=picture)
