"""Draws docs/images/phantom.jpg: synthetic tissue, what its instrument hides, and its depth.

python docs/images/draw_phantom.py
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from worker.phantom import Motion, PhantomFrame, PhantomSettings, make_phantom, orbit_pose

OUT = Path(__file__).with_name("phantom.jpg")
WIDTH, HEIGHT = 400, 320
ROWS: tuple[tuple[Motion, int, int], ...] = (("pull", 20, 0), ("cut", 52, 3))  # (motion, frame, seed)
NEAREST_MM, FARTHEST_MM = 48.0, 100.0
JPEG_QUALITY = 88


def main() -> None:
    rows = []
    for motion, index, seed in ROWS:
        phantom = make_phantom(PhantomSettings(WIDTH, HEIGHT, 64, motion, seed))
        frame = phantom.frame(index)
        novel, _ = phantom.render(index, orbit_pose(14, -4))
        rows.append(np.hstack([frame.left, _bytes(frame.hidden_rgb), _bytes(novel), _depth_colours(frame)]))
    picture = cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(OUT), picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    print(f"recorded left eye | hidden surface | another viewpoint | depth {NEAREST_MM:g}..{FARTHEST_MM:g} mm: {OUT}")


def _bytes(rgb: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(rgb * 255), dtype=np.uint8)


def _depth_colours(frame: PhantomFrame) -> NDArray[np.uint8]:
    near = np.clip((FARTHEST_MM - frame.depth_mm) / (FARTHEST_MM - NEAREST_MM), 0, 1)
    colours = cv2.applyColorMap(_bytes(near.astype(np.float32)), cv2.COLORMAP_MAGMA)
    return np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2RGB))


if __name__ == "__main__":
    main()
