"""A segment of a feed's model on disk: a folder with a scene (intrasplat/scene/checkpoint.py), whose name says what it
holds, as with recorded parts (intrasplat/live/parts.py).

    segments/00000012-24000000-25600000-1764403200000000-1764403201600000/
             number, first and last source time, arrival of these frames; times in microseconds

A folder is written under another name and renamed when all of it is on disk, so that one with such a name is complete.
"""

from __future__ import annotations

import io
import re
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from intrasplat.errors import SceneError
from intrasplat.files.durable import move_folder
from intrasplat.live.window import ARRIVED_AT, WindowPictures
from intrasplat.names import DETAIL, RECORDED
from intrasplat.scene.checkpoint import load_scene, save_scene
from intrasplat.scene.recorded_file import EYES, MASK, name_of
from intrasplat.scene.recorded_video import encoded
from intrasplat.scene.scene import TrainedScene
from intrasplat.scene.training_pictures import TrainingPictures, coded
from intrasplat.view.recorded import mask_png

NAME = re.compile(r"(\d{8})-(-?\d{1,18})-(-?\d{1,18})-(\d{1,18})-(\d{1,18})", re.ASCII)
MICRO = 1_000_000
WRITING = "writing-"
LEAST_LOGIT = -10.0
"""A Gaussian of less opacity is a spare one that is not drawn: it is not stored."""
HALVED = frozenset(f"gaussians.{name}" for name in ("quaternion", "log_scale", "opacity_logit", "sh", "gloss")) | {
    "deformation.weight",
    "seen",
}
"""Stored as float16. Centres stay float32: they lie up to a hundred units away, where float16 has steps of 1 / 16."""


@dataclass(frozen=True, eq=False)
class PastSegment:
    """A segment of the model.

    source_s, arrived_at  of its first and last frame: source times, and UNIX times, s
    path                  its folder; None: it is in memory alone
    bytes                 on disk; in memory, of its model and its recorded pictures
    """

    number: int
    source_s: tuple[float, float]
    arrived_at: tuple[float, float]
    path: Path | None = None
    bytes: int = 0

    @classmethod
    def of(cls, number: int, scene: TrainedScene) -> PastSegment:
        """The segment of a scene, in memory."""
        (first_s, last_s), (first_at, last_at) = (
            (float(times[0]), float(times[-1])) for times in (scene.frame_times_s, arrivals(scene))
        )
        return cls(number, (first_s, last_s), (first_at, last_at), bytes=scene.byte_count + _in_memory(scene.pictures))

    @classmethod
    def at(cls, path: Path) -> PastSegment | None:
        """The segment that a folder is; None if it is none."""
        match = NAME.fullmatch(path.name)
        if match is None or not path.is_dir():
            return None
        number, *times = (int(each) for each in match.groups())
        first_s, last_s, first_at, last_at = (each / MICRO for each in times)
        return cls(number, (first_s, last_s), (first_at, last_at), path, _bytes(path))

    @property
    def name(self) -> str:
        """The name of its folder."""
        times = "-".join(str(round(each * MICRO)) for each in (*self.source_s, *self.arrived_at))
        return f"{self.number:08d}-{times}"

    def written(self, folder: Path, scene: TrainedScene) -> PastSegment:
        """The segment on disk, in `folder`, when this returns.

        Raises:
            OSError: the disk refuses.
            SceneError: the scene's numbers are not finite.
        """
        target, draft = folder / self.name, folder / f"{WRITING}{self.name}"
        try:
            save_scene(draft, _drawn(scene), _recorded(scene.pictures), halved=HALVED)
            move_folder(draft, target)
        except BaseException:
            shutil.rmtree(draft, ignore_errors=True)
            raise
        return replace(self, path=target, bytes=_bytes(target))

    def load(self) -> TrainedScene:
        """The scene on disk. Raises SceneError if it is damaged."""
        assert self.path is not None
        scene = load_scene(self.path)
        arrivals(scene)
        return scene


def arrivals(scene: TrainedScene) -> NDArray[np.float64]:
    """[T] UNIX times, s, at which the frames of a feed's scene came in; they never fall.

    Raises:
        SceneError: they are missing.
    """
    found = np.array(scene.settings.get(ARRIVED_AT, ()), np.float64)
    if found.shape != (scene.frame_count,) or not np.isfinite(found).all():
        raise SceneError("The segment does not say when its frames came in.")
    return np.maximum.accumulate(found)


def _drawn(scene: TrainedScene) -> TrainedScene:
    """The scene without spare Gaussians."""
    rows = torch.nonzero(scene.gaussians.opacity_logit > LEAST_LOGIT)[:, 0]
    if len(rows) == len(scene.gaussians):
        return scene
    tensors = {name: each[rows] for name, each in scene.gaussians.tensors().items()}
    gaussians = replace(scene.gaussians, **tensors)
    return replace(
        scene, gaussians=gaussians, deformation=scene.deformation.select(rows), seen=scene.seen[rows].contiguous()
    )


def _in_memory(pictures: TrainingPictures | None) -> int:
    """Bytes of a window's pictures."""
    return pictures.byte_count if isinstance(pictures, WindowPictures) else 0


def _recorded(pictures: TrainingPictures | None) -> dict[str, bytes]:
    """The recorded pictures as files by name: a video, and masks if something is masked."""
    if pictures is None:
        return {}
    video = encoded(pictures.frames, pictures.eyes, lambda eye, frame: coded(pictures.picture(eye, frame)[0]))
    if video is None:
        return {}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, png in _masks(pictures):
            archive.writestr(zipfile.ZipInfo(name), png)
    return {DETAIL: video, RECORDED: content.getvalue()}


def _masks(pictures: TrainingPictures) -> Iterator[tuple[str, bytes]]:
    found = {
        name_of(EYES[eye], frame, MASK): ~pictures.picture(eye, frame)[1]
        for eye in range(len(pictures.eyes))
        for frame in pictures.frames
    }
    if any(mask.any() for mask in found.values()):
        for name, mask in found.items():
            yield name, mask_png(mask)


def _bytes(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.iterdir())
