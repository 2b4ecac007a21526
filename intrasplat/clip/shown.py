"""What of a clip with depth shows the scene: its field of view, its frames, and those of them that training uses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from intrasplat.clip.empty_frames import EmptyFrames, find_empty
from intrasplat.clip.field_of_view import Fields, Mask, find_fields
from intrasplat.clip.given_field import FIELD
from intrasplat.clip.sampling import Mapping, Thumbnail, sampled, thumbnail
from intrasplat.clip.splashes import lost_detail
from intrasplat.clip.split import training_frames
from intrasplat.clip.types import DepthClip
from intrasplat.errors import InputError
from intrasplat.machine.cores import cores
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.machine.opencv import one_opencv_thread
from intrasplat.names import Fov
from intrasplat.notices import Notice
from intrasplat.options import ReconstructionOptions


def with_shown_parts(clip: DepthClip, options: ReconstructionOptions) -> DepthClip:
    """A clip with depth of one eye, without tissue outside the field of view, and with its skipped frames.

    The clip's own field of view is taken as given; None: it is found.

    Raises:
        InputError: no frame shows anything, or a field is given and options.fov is "all".
    """
    thumbnails = [[thumbnail(rgb) for rgb in clip.rgb]]
    train = training_frames(clip.frame_count, options.holdout)
    given = () if clip.field_of_view is None else (clip.field_of_view,)
    fields, empty = find_shown([clip.rgb], thumbnails, train, options.fov, clip.tissue, given=given)
    if fields.left is not None:
        inside = mapped_zeros(clip.tissue.shape, np.bool_)
        for index, tissue in enumerate(clip.tissue):
            np.logical_and(tissue, fields.left, out=inside[index])
            let_go(inside[index])
        clip = replace(clip, tissue=inside)
    clip = replace(
        clip,
        field_of_view=fields.left,
        fov=fields.entry,
        assumptions=(*clip.assumptions, *fields.notices),
        warnings=(*clip.warnings, *empty.notices(clip.frame_count), *_drops(clip, _some(train, empty))),
    )
    return sampled(clip, options, empty.frames)


def _drops(clip: DepthClip, frames: Sequence[int]) -> tuple[Notice, ...]:
    """What may be drops on the lens. A clip without masks is not searched: instruments have no fine detail, either."""
    if clip.masks is not None and clip.masks.source == "none":
        return ()
    with one_opencv_thread(), ThreadPoolExecutor(cores()) as pool:
        return lost_detail(clip.rgb, lambda index: clip.tissue[index], frames, pool)


def find_shown(
    eyes: Sequence[NDArray[np.uint8]],
    thumbnails: Sequence[Sequence[Thumbnail]],
    train: Sequence[int],
    fov: Fov,
    tissue: Iterable[Mask],
    mapping: Mapping = map,
    given: Sequence[Mask] = (),
    *,
    may_coincide: bool = False,
) -> tuple[Fields, EmptyFrames]:
    """The fields of view of a clip's eyes, and the frames that show no whole scene within them.

    The field is found in frames that are not empty, and whether a frame is empty is judged within the field.

    Args:
        eyes: [T, H, W, 3] of each eye.
        thumbnails: T thumbnails of each eye.
        train: the frames that are not held out, rising.
        tissue: [T, H, W] what the masks leave; none: no masks.
        mapping: a replacement of map(), such as a thread pool's.
        given: fields of view [H, W] that the caller gave, from the left eye's on.
        may_coincide: as in find_fields.

    Raises:
        InputError: no training frame shows anything, or a field is given and fov is "all".
    """
    empty = find_empty(thumbnails, train, tissue_shares=_shares(tissue, None, mapping))
    fields = find_fields(eyes, _some(train, empty), fov, mapping, given, may_coincide=may_coincide)
    found = () if fov == "all" else [fields.left, fields.right][: len(eyes)]
    empty = find_empty(thumbnails, train, found, _shares(tissue, fields.left, mapping))
    _some(train, empty, is_given=bool(given))
    return fields, empty


def _shares(tissue: Iterable[Mask], field: Mask | None, mapping: Mapping) -> list[float]:
    """The share of the field [H, W] that each of tissue [T, H, W] fills; None: of the picture."""

    def share(shown: Mask) -> float:
        return float(np.count_nonzero(shown if field is None else shown & field) / shown.size)

    size = 1.0 if field is None else max(float(field.mean()), 1e-9)
    return [each / size for each in mapping(share, tissue)]


def _some(train: Sequence[int], empty: EmptyFrames, *, is_given: bool = False) -> list[int]:
    """The training frames that are not empty. Raises InputError if there are none.

    is_given: whether the caller gave the field of view in which they are empty.
    """
    shown = sorted(set(train) - set(empty.frames))
    if not shown:
        raise InputError(
            FIELD if is_given else "clip",
            f"no frame that may be trained on shows the scene{' within the field of view' if is_given else ''}: "
            "all are of one colour, or covered by masks.",
            "Give the recording of the operation, and masks of its instruments alone.",
        )
    return shown
