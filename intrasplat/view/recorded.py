"""Recorded frames as the model's cameras see them, with their masks: for detail, and to compare model and masks with.

A scene stores them of at most MAX_MOMENTS moments, in two files that intrasplat/scene/recorded_file.py reads.
Symbols: h w pixels of a picture.
"""

from __future__ import annotations

import io
import itertools
import zipfile
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.clip import DepthClip, Eye
from intrasplat.clip.images import jpeg_size
from intrasplat.clip.split import spread
from intrasplat.errors import InputError, SceneError
from intrasplat.intake.sniff import png_size
from intrasplat.machine.mapped import let_go
from intrasplat.names import DETAIL, RECORDED
from intrasplat.names import Eye as EyeName
from intrasplat.picture import RecordedMasks
from intrasplat.report import Recorded, RecordedPixels
from intrasplat.scene.recorded_file import EYES, MASK, PICTURE, name_of, nearest, read_frame
from intrasplat.scene.recorded_video import RecordedEye, encoded
from intrasplat.scene.scene import TrainedScene
from intrasplat.scene.training_pictures import coded

MAX_MOMENTS = 120
"""Most moments of a clip whose frames are stored."""
MAX_WIDTH = 720
"""Pixels: a wider frame is shrunk by an integer factor, which takes a third of the time of any other factor."""
MAX_HEIGHT = 4 * MAX_WIDTH
"""Pixels: limit of a picture that is decoded; it may come from another site."""
QUALITY = 60
MAX_LIVE_WIDTH, LIVE_QUALITY = 1280, 80
"""Of frames of live feeds, which are shown and not kept. A wider one is shrunk as above."""
MARK, MARK_SHARE = (0, 220, 255), 0.45
"""RGB that no tissue has, and its opacity on the masked parts; their outline is opaque."""
AFTER_HEADER = 33
"""Byte offset of a PNG's second chunk."""
BLACK_IS_CLEAR = b"\x00\x00\x00\x02tRNS\x00\x00\x76\x93\xcd\x38"
"""PNG chunk that makes grey level 0 transparent."""

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RecordedPicture:
    """One recorded frame: its number, R G B [h, w, 3], and where it shows instruments [h, w]."""

    index: int
    rgb: Picture
    tool: Mask


class ClipPictures:
    """The TrainingPictures of an opened clip."""

    def __init__(self, clip: DepthClip, eyes: int, frames: Sequence[int]) -> None:
        """eyes: number of eyes that train the model. frames: those that train it, rising."""
        self._eyes, self.frames = clip.eyes[:eyes], tuple(frames)
        left = clip.world_from_camera[0]
        self.eyes = tuple(
            RecordedEye(each.intrinsics.resized(*_shown_size(each)), np.linalg.inv(left) @ each.world_from_camera[0])
            for each in self._eyes
        )

    def picture(self, eye: int, frame: int) -> tuple[Picture, Mask]:
        """See TrainingPictures."""
        return self.rgb(eye, frame), ~_tool(self._eyes[eye], frame)

    def rgb(self, eye: int, frame: int) -> Picture:
        """R G B [h, w, 3] of a frame."""
        return _rgb(self._eyes[eye], frame)


def recorded_files(
    clip: DepthClip, eyes: Sequence[EyeName], trained: Iterable[int]
) -> tuple[dict[str, bytes | None], Recorded]:
    """A clip's recorded frames as files by name, and their entry in the report. The same clip gives the same bytes.

    These are all frames, or MAX_MOMENTS that are spread evenly. If the masks were found in the pictures, frames without
    a mask are skipped: nobody searched them. Frames that trained the model go into the video; without an encoder for
    it, all go into the zip file.
    """
    looked_at = clip.used if clip.masks is not None and clip.masks.are_found else range(clip.frame_count)
    frames, chosen = spread(looked_at, MAX_MOMENTS), set(trained)
    pictures = ClipPictures(clip, len(eyes), [frame for frame in frames if frame in chosen])
    filmed = pictures.frames
    video = encoded(filmed, pictures.eyes, lambda eye, frame: coded(pictures.rgb(eye, frame)))
    zipped, is_masked = _zipped(clip, eyes, frames, set() if video is None else set(filmed))
    lens = pictures.eyes[0].lens
    summary = Recorded(
        frames=tuple(frames),
        eyes=tuple(eyes),
        width=lens.width,
        height=lens.height,
        masks=is_masked,
        size_bytes=len(zipped) + len(video or b""),
        pixels=_recorded_pixels(clip),
    )
    return {RECORDED: zipped, DETAIL: video}, summary


def _recorded_pixels(clip: DepthClip) -> RecordedPixels:
    """Where the left eye's pixels are in the recording."""
    height, width = clip.tissue.shape[1:]
    done = clip.rectification
    if done is None:
        return RecordedPixels(width=width, height=height)
    rays = np.linalg.inv(np.array(done.projection)[:, :3] @ np.array(done.rotation))
    camera = tuple(itertools.chain(*done.camera))
    return RecordedPixels(
        width=width, height=height, rays=tuple(rays.ravel().tolist()), distortion=done.distortion, camera=camera
    )


def _zipped(
    clip: DepthClip, eyes: Sequence[EyeName], frames: Sequence[int], filmed: Container[int]
) -> tuple[bytes, bool]:
    """The zip file of recorded frames, without the pictures of those in the video, and whether it has masks."""
    content, is_masked = io.BytesIO(), False
    masks: dict[str, bytes] = {}
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name in eyes:
            for index in frames:
                eye = _eye(clip, name)
                tool = _tool(eye, index)
                is_masked = is_masked or bool(tool.any())
                if index not in filmed:
                    archive.writestr(zipfile.ZipInfo(name_of(name, index, PICTURE)), _jpeg(_rgb(eye, index)))
                masks[name_of(name, index, MASK)] = mask_png(tool)
        for path, png in masks.items() if is_masked else ():
            archive.writestr(zipfile.ZipInfo(path), png)
    return content.getvalue(), is_masked


def live_frame(
    clip: DepthClip, t: float, eye: EyeName = "left", masks: RecordedMasks = RecordedMasks.MARKED
) -> tuple[int, bytes]:
    """The frame nearest to model time t that has a mask, as JPEG; or its mask alone, as PNG.

    Raises:
        InputError: the clip has no such eye.
    """
    return _as_file(clip_picture(clip, t, eye), masks)


def clip_picture(clip: DepthClip, t: float, eye: EyeName = "left") -> RecordedPicture:
    """As live_frame, in memory."""
    index, of = nearest(clip.used, t, clip.frame_count), _eye(clip, eye)
    return RecordedPicture(index, _rgb(of, index), _tool(of, index))


def pictured_frame(
    scene: TrainedScene, t: float, eye: EyeName = "left", masks: RecordedMasks = RecordedMasks.MARKED
) -> tuple[int, bytes]:
    """As live_frame, from the training pictures that a scene has in memory.

    Raises:
        InputError: it has none, or none of this eye.
    """
    return _as_file(scene_picture(scene, t, eye), masks)


def scene_picture(scene: TrainedScene, t: float, eye: EyeName = "left") -> RecordedPicture:
    """As pictured_frame, in memory."""
    pictures, place = scene.pictures, EYES.index(eye)
    if pictures is None or place >= len(pictures.eyes):
        raise InputError("eye", f"the scene has no recorded frames of the {eye} eye.", "Ask for eye=left.")
    index = nearest(pictures.frames, t, scene.frame_count)
    rgb, tissue = pictures.picture(place, index)
    return RecordedPicture(index, rgb, ~tissue)


def stored_frame(
    folder: Path,
    frame_count: int,
    t: float,
    eye: EyeName = "left",
    masks: RecordedMasks = RecordedMasks.MARKED,
) -> tuple[int, bytes]:
    """As live_frame, from the scene in a folder.

    Raises:
        SceneError: it has no recorded frames, or a file is damaged.
        InputError: it has no such eye, or no masks.
    """
    if masks is not RecordedMasks.MARKED:
        return read_frame(folder, frame_count, t, eye, MASK if masks is RecordedMasks.ONLY else PICTURE)
    return _as_file(stored_picture(folder, frame_count, t, eye), masks)


def stored_picture(folder: Path, frame_count: int, t: float, eye: EyeName = "left") -> RecordedPicture:
    """As stored_frame, in memory."""
    index, jpeg = read_frame(folder, frame_count, t, eye)
    try:
        _, png = read_frame(folder, frame_count, t, eye, MASK)
    except InputError:  # nothing is masked
        rgb = np.ascontiguousarray(_decoded(jpeg, cv2.IMREAD_COLOR)[..., ::-1])
        return RecordedPicture(index, rgb, np.zeros(rgb.shape[:2], np.bool_))
    if jpeg_size(jpeg) != (size := png_size(png)) or size is None or size[0] > MAX_WIDTH or size[1] > MAX_HEIGHT:
        raise SceneError("A recorded frame of this scene is damaged, too large, or does not fit its mask.")
    rgb, tool = _decoded(jpeg, cv2.IMREAD_COLOR)[..., ::-1], _decoded(png, cv2.IMREAD_GRAYSCALE) > 0
    return RecordedPicture(index, np.ascontiguousarray(rgb), tool)


def _as_file(recorded: RecordedPicture, masks: RecordedMasks) -> tuple[int, bytes]:
    """The frame's number, and the frame as JPEG or its mask as PNG."""
    if masks is RecordedMasks.ONLY:
        return recorded.index, mask_png(recorded.tool)
    rgb = recorded.rgb if masks is RecordedMasks.OFF else _marked(recorded.rgb.copy(), recorded.tool)
    return recorded.index, _jpeg(rgb)


def _eye(clip: DepthClip, name: EyeName) -> Eye:
    try:
        return clip.eyes[EYES.index(name)]
    except IndexError:
        raise InputError("eye", f"this clip has no {name} eye.", "Ask for eye=left.") from None


def _rgb(eye: Eye, index: int) -> Picture:
    """A frame [h, w, 3]."""
    rgb, size = np.array(eye.rgb[index], np.uint8), _shown_size(eye)
    let_go(eye.rgb[index])
    if size != rgb.shape[1::-1]:
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    return rgb


def _tool(eye: Eye, index: int) -> Mask:
    """Where a frame shows instruments [h, w]."""
    size = _shown_size(eye)
    tool: Mask = np.logical_not(eye.tissue[index])
    let_go(eye.tissue[index])
    if size != tool.shape[::-1]:
        tool = cv2.resize(tool.view(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return tool


def _shown_size(eye: Eye) -> tuple[int, int]:
    """Width and height of its pictures, px."""
    height, width = eye.tissue.shape[1:]
    factor = -(-width // MAX_WIDTH)
    return (width // factor, max(1, height // factor)) if factor > 1 else (width, height)


def _marked(rgb: Picture, tool: Mask) -> Picture:
    """Mark the instruments in the given picture, and return it."""
    mark: NDArray[np.float32] = np.array(MARK, np.float32)
    outline = cv2.morphologyEx(tool.view(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    rgb[tool] = (1 - MARK_SHARE) * rgb[tool] + MARK_SHARE * mark
    rgb[outline] = mark
    return rgb


def frame_of_feed(rgb: Picture) -> bytes:
    """The JPEG of one eye's frame of a live feed, at most MAX_LIVE_WIDTH wide."""
    height, width = rgb.shape[:2]
    factor = -(-width // MAX_LIVE_WIDTH)
    if factor > 1:
        rgb = np.asarray(cv2.resize(rgb, (width // factor, height // factor), interpolation=cv2.INTER_AREA), np.uint8)
    return _jpeg(rgb, LIVE_QUALITY)


def _jpeg(rgb: Picture, quality: int = QUALITY) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _decoded(content: bytes, flags: int) -> Picture:
    """A picture or a mask from a scene's file.

    Raises:
        SceneError: the content is no such picture.
    """
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if picture is None:
        raise SceneError("A recorded frame of this scene is damaged.")
    return np.asarray(picture, np.uint8)


def mask_png(tool: Mask) -> bytes:
    """255 on instruments, transparent elsewhere, 1 bit a pixel."""
    png = cv2.imencode(".png", tool.view(np.uint8) * np.uint8(255), [cv2.IMWRITE_PNG_BILEVEL, 1])[1].tobytes()
    return png[:AFTER_HEADER] + BLACK_IS_CLEAR + png[AFTER_HEADER:]
