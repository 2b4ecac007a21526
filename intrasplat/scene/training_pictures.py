"""The recorded pictures of a scene's training frames, from which views take what the model misses (view/detail.py).

Symbols: h w pixels of a picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import InputError, SceneError
from intrasplat.names import DETAIL
from intrasplat.scene.recorded_file import EYES, MASK, read_frame
from intrasplat.scene.recorded_video import FORMAT, RecordedEye, RecordedVideo, even

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


class TrainingPictures(Protocol):
    """Recorded pictures of training frames.

    frames  the clip's frames that there are, rising
    eyes    the left eye, and the right one if it trained the model, too
    """

    @property
    def frames(self) -> Sequence[int]: ...

    @property
    def eyes(self) -> Sequence[RecordedEye]: ...

    def picture(self, eye: int, frame: int) -> tuple[Picture, Mask]:
        """R G B [h, w, 3] of a frame, and [h, w] where it shows tissue.

        Raises:
            SceneError: the files are missing or damaged.
        """
        ...


def coded(rgb: Picture) -> av.VideoFrame:
    """The picture [h, w, 3] for recorded_video.encoded()."""
    height, width = rgb.shape[:2]
    rgb = cv2.copyMakeBorder(rgb, 0, even(height) - height, 0, even(width) - width, cv2.BORDER_REPLICATE)
    y_cr_cb = cv2.cvtColor(rgb, cv2.COLOR_RGB2YCrCb)
    cr_cb = cv2.resize(y_cr_cb[..., 1:], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    planes = [y_cr_cb[..., 0].ravel(), cr_cb[..., 1].ravel(), cr_cb[..., 0].ravel()]
    return av.VideoFrame.from_ndarray(np.concatenate(planes).reshape(-1, rgb.shape[1]), format=FORMAT)


def _rgb(picture: av.VideoFrame) -> Picture:
    """[h, w, 3] of a picture of the video, without the rows and columns that make its size even."""
    planes = np.asarray(picture.to_ndarray(), np.uint8)
    height, width = picture.height, picture.width
    cb, cr = planes[height:].reshape(2, height // 2, width // 2)
    size = (width, height)
    colours = (cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR) for plane in (cr, cb))
    return np.asarray(cv2.cvtColor(cv2.merge((planes[:height], *colours)), cv2.COLOR_YCrCb2RGB), np.uint8)


class StoredPictures:
    """The TrainingPictures of a video of recorded_video.encoded()."""

    def __init__(self, video: Path | bytes, tissue: Callable[[int, int], Mask | None]) -> None:
        """tissue: where (eye, frame) shows tissue; None: everywhere."""
        self._video, self._tissue = RecordedVideo(video), tissue

    @property
    def frames(self) -> Sequence[int]:
        """See TrainingPictures. Raises as picture() does."""
        return self._video.frames

    @property
    def eyes(self) -> Sequence[RecordedEye]:
        """See TrainingPictures. Raises as picture() does."""
        return self._video.eyes

    def picture(self, eye: int, frame: int) -> tuple[Picture, Mask]:
        """See TrainingPictures."""
        lens, tissue = self.eyes[eye].lens, self._tissue(eye, frame)
        rgb = np.ascontiguousarray(_rgb(self._video.picture(eye, frame))[: lens.height, : lens.width])
        if tissue is not None and tissue.shape != rgb.shape[:2]:
            raise SceneError(f"The masks of this scene do not fit {DETAIL}.")
        return rgb, np.ones(rgb.shape[:2], np.bool_) if tissue is None else tissue


def pictures_of(folder: Path) -> StoredPictures:
    """The TrainingPictures of a scene's folder, with the masks in recorded.zip."""

    def tissue(eye: int, frame: int) -> Mask | None:
        count = frame + 1
        try:
            index, png = read_frame(folder, count, frame / count, EYES[eye], MASK)
        except InputError:  # nothing is masked
            return None
        tool = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
        if index != frame or tool is None:
            raise SceneError(f"A mask of this scene is damaged, or does not fit {DETAIL}.")
        return np.asarray(tool == 0)

    return StoredPictures(folder / DETAIL, tissue)
