"""What of a clip with depth shows the scene: its field of view, its frames, and those of them that training uses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intrasplat.clip.empty_frames import find_empty
from intrasplat.clip.field_of_view import find_fields
from intrasplat.clip.sampling import sampled, thumbnail
from intrasplat.clip.split import training_frames
from intrasplat.clip.types import DepthClip
from intrasplat.errors import InputError
from intrasplat.machine.mapped import let_go, mapped_zeros
from intrasplat.options import ReconstructionOptions


def with_shown_parts(clip: DepthClip, options: ReconstructionOptions) -> DepthClip:
    """A clip with depth of one eye, without tissue outside the field of view, and with its skipped frames.

    Raises:
        InputError: no frame shows anything.
    """
    thumbnails = [[thumbnail(rgb) for rgb in clip.rgb]]
    shares = [float(tissue.mean()) for tissue in clip.tissue]
    train = training_frames(clip.frame_count, options.holdout)
    empty = find_empty(thumbnails, train, tissue_shares=shares)
    fields = find_fields([clip.rgb], shown_frames(train, empty.frames), options.fov)
    if fields.left is not None:
        inside = mapped_zeros(clip.tissue.shape, np.bool_)
        for index, tissue in enumerate(clip.tissue):
            np.logical_and(tissue, fields.left, out=inside[index])
            let_go(inside[index])
        clip = replace(clip, tissue=inside, field_of_view=fields.left)
    empty = find_empty(thumbnails, train, [fields.left], shares)
    shown_frames(train, empty.frames)
    clip = replace(
        clip,
        fov=fields.entry,
        assumptions=(*clip.assumptions, *fields.notices),
        warnings=(*clip.warnings, *empty.notices(clip.frame_count)),
    )
    return sampled(clip, options, empty.frames)


def shown_frames(train: list[int], empty: tuple[int, ...]) -> list[int]:
    """The training frames that are not empty.

    Raises:
        InputError: there are none.
    """
    shown = sorted(set(train) - set(empty))
    if not shown:
        raise InputError(
            "clip",
            "no frame that may be trained on shows the scene: all are of one colour, or covered by masks.",
            "Give the recording of the operation, and masks of its instruments alone.",
        )
    return shown
