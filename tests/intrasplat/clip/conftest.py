"""Small clips written to disk for the loaders' tests.

Symbols: T frames, H W pixels of one eye.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

Frames = NDArray[np.uint8]

DISPARITY_PX = 4


@dataclass(frozen=True)
class Studio:
    """Writes clips below one temporary folder."""

    root: Path

    def eyes(self, frames: int = 6, height: int = 80, width: int = 96) -> tuple[Frames, Frames]:
        """(left, right) RGB [T, H, W, 3] of a reddish, blotchy texture drifting down; frame i differs from frame j."""
        random = np.random.default_rng(3)
        cells = (height + frames) // 4 + 2, (width + DISPARITY_PX) // 4 + 2
        noise = random.integers(40, 216, cells, dtype=np.uint8)
        grey = cv2.resize(noise, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
        texture = np.dstack([grey, grey // 2, grey // 2])
        rows = [slice(frames - i, frames - i + height) for i in range(frames)]
        left = np.stack([texture[row, :width] for row in rows])
        right = np.stack([texture[row, DISPARITY_PX : DISPARITY_PX + width] for row in rows])
        return left, right

    def tool(self, frames: int = 6, height: int = 80, width: int = 96) -> NDArray[np.bool_]:
        """A tool [T, H, W] that enters from the left border and covers about an eighth of the picture."""
        tool = np.zeros((frames, height, width), dtype=np.bool_)
        tool[:, height // 4 : height // 2, : width // 2] = True
        return tool

    def image(self, name: str, pixels: NDArray[np.generic]) -> Path:
        """One PNG or JPEG; RGB pixels are stored as RGB."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)
        return path

    def images(self, pattern: str, frames: NDArray[np.generic]) -> Path:
        """A folder of images; pattern holds {} for the frame number."""
        for index, frame in enumerate(frames):
            path = self.image(pattern.format(f"{index:06d}"), frame)
        return path.parent

    def masks(self, folder: str, marked: NDArray[np.bool_]) -> Path:
        """A folder of masks, marked pixels white."""
        return self.masks_named(folder + "/{}.png", marked)

    def masks_named(self, pattern: str, marked: NDArray[np.bool_]) -> Path:
        """As masks; pattern holds {} for the frame number."""
        return self.images(pattern, np.where(marked, np.uint8(255), np.uint8(0)))

    def endonerf(self, frames: int = 3, height: int = 64, width: int = 80, name: str = "endonerf") -> Path:
        """A good EndoNeRF folder: depth 60 mm with an invalid corner, still camera, tool masks."""
        depth = np.full((frames, height, width), 60, dtype=np.uint8)
        depth[:, :4, :4] = 0
        self.images(name + "/images/frame-{}.color.png", self.eyes(frames, height, width)[0])
        self.images(name + "/depth/frame-{}.depth.png", depth)
        self.masks(name + "/masks", self.tool(frames, height, width))
        self.poses(name, np.tile(np.eye(3, 4), (frames, 1, 1)), height, width)
        return self.root / name

    def poses(self, name: str, matrices: NDArray[np.float64], height: int, width: int, focal_px: float = 100.0) -> None:
        """poses_bounds.npy of camera-to-world matrices [T, 3, 4] as stored."""
        sizes = np.tile([[height], [width], [focal_px]], (len(matrices), 1, 1))
        rows = np.concatenate([matrices, sizes], axis=2).reshape(len(matrices), 15)
        np.save(self.root / name / "poses_bounds.npy", np.hstack([rows, np.tile([1.0, 200.0], (len(matrices), 1))]))

    def zip(self, folder: Path, name: str = "clip.zip", prefix: str = "") -> Path:
        """A zip of everything in a folder."""
        path = self.root / name
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in sorted(folder.rglob("*")):
                if file.is_file():
                    archive.write(file, prefix + file.relative_to(folder).as_posix())
        return path

    def video(self, name: str, frames: Frames, codec: str = "VP90", rate_hz: float = 25.0) -> Path:
        """A lossy video of RGB frames [T, H, W, 3]; the suffix of name chooses the container."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        height, width = frames.shape[1:3]
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate_hz, (width, height))
        assert writer.isOpened()
        for frame in frames:
            writer.write(np.ascontiguousarray(frame[:, :, ::-1]))
        writer.release()
        return path


@pytest.fixture
def studio(tmp_path: Path) -> Studio:
    return Studio(tmp_path)
