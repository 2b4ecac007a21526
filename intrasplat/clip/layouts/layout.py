"""The interface of an input layout, and the files that it opens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from intrasplat.clip.bit_depth import at_own_depth
from intrasplat.clip.files import FileTree
from intrasplat.clip.images import open_images
from intrasplat.clip.masks import BrightClass, MaskFrames
from intrasplat.clip.naming import eye_folders, eye_of
from intrasplat.clip.packing import FrameSequence
from intrasplat.clip.types import DepthClip, StereoClip
from intrasplat.clip.video import open_video, open_video_in
from intrasplat.errors import InputError
from intrasplat.intake.limits import ClipLimits
from intrasplat.names import MaskPolarity, PoseConvention


@dataclass(frozen=True)
class ClipFiles:
    """The files of a clip and the caller's options for them; nothing is decoded yet.

    tree             files of a folder or zip, or one image; None if path is a single other file, such as a video
    detected         the layout is to be detected
    masks            masks that the caller gave in addition to the clip
    ignores_masks    the caller wants no masks, not even those in the tree
    mask_polarity    the caller's meaning of white in masks
    pose_convention  the caller's axes of poses_bounds.npy
    """

    path: Path
    tree: FileTree | None
    limits: ClipLimits
    detected: bool = False
    masks: MaskFrames | None = None
    ignores_masks: bool = False
    mask_polarity: MaskPolarity = "auto"
    pose_convention: PoseConvention = "opengl"

    def tree_for(self, layout: str) -> FileTree:
        """The files of a layout that needs several. InputError if a single file was given."""
        if self.tree is None:
            problem = f'layout "{layout}" needs a folder or zip, {self.path.name} is neither.'
            raise InputError("options.layout", problem, "Leave it out.")
        return self.tree

    @cached_property
    def videos(self) -> tuple[str, ...]:
        """Names of the tree's videos that are not masks."""
        return outside_masks(self.tree.videos()) if self.tree is not None else ()

    @cached_property
    def images(self) -> tuple[str, ...]:
        """Names of the tree's images that are not masks."""
        return outside_masks(self.tree.images()) if self.tree is not None else ()

    @cached_property
    def sequence(self) -> FrameSequence | None:
        """The single sequence of pictures: one video, or images whose names give no eye; else None."""
        if self.tree is None:
            return open_video(self.path, "clip", self.limits)
        if len(self.videos) == 1:
            return open_video_in(self.tree, self.videos[0])
        folders = eye_folders(self.images)
        if self.videos or not self.images or any(eye_of(name, folders) for name in self.images):
            return None
        return at_own_depth(open_images(self.tree, self.images))[0]


@dataclass(frozen=True)
class InputLayout:
    """A layout of input files.

    name        its name in options
    recognises  whether files are in this layout, for detection; it may raise InputError
    open        returns the clip; raises InputError, LimitError. A DepthClip comes with its masks applied; open_clip
                applies the masks of a StereoClip
    white       default meaning of white in the masks of a StereoClip; None: decided by their look
    title       the name as its authors write it, for messages
    """

    name: str
    recognises: Callable[[ClipFiles], bool]
    open: Callable[[ClipFiles], StereoClip | DepthClip]
    white: BrightClass | None = None
    title: str = ""


def outside_masks(names: tuple[str, ...]) -> tuple[str, ...]:
    """The names outside folders called masks or mask."""
    masks = {"masks", "mask"}
    return tuple(name for name in names if not masks & {part.lower() for part in PurePosixPath(name).parts[:-1]})
