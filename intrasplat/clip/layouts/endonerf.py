"""Layout "endonerf": images/ depth/ masks/ poses_bounds.npy, decoded at once.

Symbols: T frames, H W pixels.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from intrasplat.camera import Intrinsics
from intrasplat.clip.bit_depth import at_own_depth
from intrasplat.clip.depth_kind import (
    FRAMES_LOOKED_AT,
    check_not_stretched,
    check_with_right_eye,
    instrument_warnings,
    parallax_warnings,
    unit_warnings,
)
from intrasplat.clip.files import FileTree
from intrasplat.clip.frame_times import assumed_times
from intrasplat.clip.images import ImageSequence, as_depth_mm, open_images
from intrasplat.clip.layouts.layout import ClipFiles, InputLayout
from intrasplat.clip.masks import MaskFrames, TissueMasks, no_masks, tissue_from_masks
from intrasplat.clip.naming import check_aligned
from intrasplat.clip.poses import Poses, parse_poses
from intrasplat.clip.types import DepthClip
from intrasplat.errors import InputError
from intrasplat.intake.limits import MAX_POSES_BYTES
from intrasplat.names import POSES_FILE, PoseConvention
from intrasplat.notices import Notice, NoticeCode
from intrasplat.report import Masks

TITLE = "EndoNeRF"
CONFIDENT = 255  # depth_confidence of every valid depth: the layout has no confidence
_MIN_DEPTH_SHARE = 0.5  # a smaller share of tissue pixels with depth causes a warning
_MAX_THREADS = 4  # decoding PNG releases the interpreter; more threads than this wait for the disk


def _recognises(files: ClipFiles) -> bool:
    """Whether files are meant to be in this layout; missing files are then an error."""
    tree = files.tree
    if tree is None:
        return False
    return any(name.endswith(POSES_FILE) for name in tree.names) or bool(tree.images("images") and tree.images("depth"))


def _open(files: ClipFiles) -> DepthClip:
    """The clip, decoded as a whole. Masks that the caller gives replace the folder's own.

    Depth images contain millimetres in 8 or 16 bit, 0 = invalid. The layout stores f alone: cx = W / 2, cy = H / 2.
    Raises InputError for inconsistent files and LimitError for a clip that is too large.
    """
    tree, convention = files.tree_for("endonerf"), files.pose_convention
    _check_files(tree)
    images = open_images(tree, tree.images("images"))
    size = images.frame_count, images.width, images.height
    tree.limits.check_clip(tree.field, tree.label, *size, eyes=1, has_depth=True)
    header_bytes, frame_bytes = MAX_POSES_BYTES
    poses = parse_poses(
        tree.read(POSES_FILE, header_bytes + frame_bytes * images.frame_count), images.frame_count, convention
    )
    _check_size(images, poses)
    masks = _masks(tree, images, files)
    (images,) = at_own_depth(images)
    rgb = _decode_all(images, np.uint8, (3,), images.picture)
    depth_mm = _read_depth(tree, images)
    if not ((depth_mm > 0) & masks.tissue).any():
        where = "on tissue" if (depth_mm > 0).any() else "anywhere"
        raise InputError(
            tree.field, f"depth/ has no valid depth {where}.", "Give millimetres as grey PNG, 0 = invalid."
        )
    unusual = _kind_of_depth(rgb, depth_mm, masks.tissue, poses, images)
    frame_times_s, rate = assumed_times(images.frame_count)
    return DepthClip(
        rgb=rgb,
        tissue=masks.tissue,
        depth_mm=depth_mm,
        depth_confidence=np.where(depth_mm > 0, np.uint8(CONFIDENT), np.uint8(0)),
        intrinsics=Intrinsics(
            width=images.width,
            height=images.height,
            fx=poses.focal_px,
            fy=poses.focal_px,
            cx=images.width / 2,
            cy=images.height / 2,
        ),
        world_from_camera=poses.world_from_camera,
        first_pose=poses.first_pose,
        frame_times_s=frame_times_s,
        masks=Masks(source="given" if masks.given else "none", share=float(1 - masks.tissue.mean())),
        assumptions=(*_assumptions(masks, poses, convention), rate, *images.notices),
        warnings=(*masks.warnings, *_depth_warnings(depth_mm, masks.tissue), *unusual),
    )


def _assumptions(masks: TissueMasks, poses: Poses, convention: PoseConvention) -> tuple[Notice, ...]:
    camera = "fixed" if np.allclose(poses.world_from_camera, np.eye(4), atol=1e-6) else "moving"
    return (
        Notice.info(NoticeCode.LAYOUT, f"layout: {TITLE}"),
        masks.assumption,
        *masks.remarks,
        Notice.info(NoticeCode.POSES, f"poses: {convention} camera-to-world, {camera} camera"),
        Notice.info(NoticeCode.INTRINSICS, "intrinsics: principal point at the image centre"),
        Notice.info(NoticeCode.DEPTH_UNIT, "depth: millimetres"),
    )


def _check_files(tree: FileTree) -> None:
    for folder, names in (("images", tree.images("images")), ("depth", tree.images("depth"))):
        if not names:
            raise InputError(
                tree.field, f"{tree.label} has no images in {folder}/.", f"Put the frames' {folder} there."
            )
    if POSES_FILE not in tree.names:
        raise InputError(tree.field, f"{tree.label} has no {POSES_FILE}.", "Put it beside images/.")


def _check_size(images: ImageSequence, poses: Poses) -> None:
    if (poses.height, poses.width) != (images.height, images.width):
        raise InputError(
            images.tree.field,
            f"{POSES_FILE} says {poses.width}x{poses.height} pixels, the images are {images.width}x{images.height}.",
            f"Write the images' size into {POSES_FILE}, and scale f with it.",
        )


def _read_depth(tree: FileTree, images: ImageSequence) -> NDArray[np.float32]:
    """Depth [T, H, W] float32 in mm, 0 = invalid."""
    names = tree.images("depth")
    check_aligned(tree.field, images.names, names)
    depth = open_images(tree, names)
    if (depth.height, depth.width) != (images.height, images.width):
        raise InputError(
            tree.field,
            f"depth is {depth.width}x{depth.height} pixels, the images are {images.width}x{images.height}.",
            "Give depth in the images' size.",
        )
    return _decode_all(depth, np.float32, (), lambda name: as_depth_mm(depth.decode(name), tree.field, name))


def _masks(tree: FileTree, images: ImageSequence, files: ClipFiles) -> TissueMasks:
    shape, given = (images.frame_count, images.height, images.width), files.masks
    if given is None:
        names = () if files.ignores_masks else tree.images("masks")
        if not names:
            none = no_masks(ignored=files.ignores_masks)
            return TissueMasks(np.ones(shape, dtype=np.bool_), none, given=False)
        check_aligned("masks", images.names, names)
        given = MaskFrames(open_images(tree, names))
    return tissue_from_masks(given, shape, files.mask_polarity, by_layout=(TITLE, "tool"))


def _decode_all(
    images: ImageSequence, dtype: type, channels: tuple[int, ...], decode: Callable[[str], NDArray[Any]]
) -> NDArray[Any]:
    """All frames of a sequence [T, H, W, ...], decoded by a few threads."""
    result: NDArray[Any] = np.empty((images.frame_count, images.height, images.width, *channels), dtype=dtype)

    def fill(index: int) -> None:
        result[index] = decode(images.names[index])

    with ThreadPoolExecutor(min(_MAX_THREADS, os.cpu_count() or 1)) as threads:
        for _ in threads.map(fill, range(images.frame_count)):
            pass
    return result


def _kind_of_depth(
    rgb: NDArray[np.uint8], depth: NDArray[np.float32], tissue: NDArray[np.bool_], poses: Poses, images: ImageSequence
) -> tuple[Notice, ...]:
    """Warnings about depth that may be none. InputError if it was stretched for display or is inverted."""
    tree = images.tree
    check_not_stretched(depth, tree.field)
    names = tree.images("images_right")
    if len(names) == images.frame_count:
        right = replace(open_images(tree, names), white=images.white)
        frames = range(0, images.frame_count, -(-images.frame_count // FRAMES_LOOKED_AT))
        if (right.height, right.width) == (images.height, images.width):
            check_with_right_eye(((rgb[i], right.picture(names[i])) for i in frames), depth[frames], tree.field)
    camera = poses.focal_px, images.width / 2, images.height / 2
    by_path = parallax_warnings(rgb, depth, tissue, poses.world_from_camera, camera, tree.field)
    return (*instrument_warnings(depth, tissue), *by_path)


def _depth_warnings(depth_mm: NDArray[np.float32], tissue: NDArray[np.bool_]) -> tuple[Notice, ...]:
    """Warnings about depth that has some valid pixel on tissue; it is checked on every 4th row and column."""
    depth_mm, tissue = depth_mm[:, ::4, ::4], tissue[:, ::4, ::4]
    valid = (depth_mm > 0) & tissue
    warnings: list[Notice] = []
    if valid.any():
        warnings += unit_warnings(float(np.median(depth_mm[valid])))
    share = np.count_nonzero(valid) / max(1, int(np.count_nonzero(tissue)))
    if share < _MIN_DEPTH_SHARE:
        text = f"depth: only {100 * share:.0f} % of the tissue pixels have one"
        warnings.append(Notice.warning(NoticeCode.LITTLE_DEPTH, text))
    return tuple(warnings)


ENDONERF = InputLayout("endonerf", _recognises, _open, title=TITLE)
