"""Features lie where the picture shows them, whatever its size."""

from __future__ import annotations

import cv2
import numpy as np

from intrasplat.clip.features import find_features


def test_features_lie_at_the_same_place_in_a_picture_of_another_size() -> None:
    noise = np.random.default_rng(0).standard_normal((960, 1280))
    smooth = cv2.GaussianBlur(noise, (0, 0), 8)
    large = np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    full, reduced = (find_features(large, max_width_px=width) for width in (1280, 320))
    apart = reduced.points[:, None] - full.points[None]
    nearest = apart[np.arange(len(apart)), np.square(apart).sum(2).argmin(1)]
    close = np.abs(nearest).max(1) < 2
    assert close.sum() > 20
    assert np.abs(np.median(nearest[close], axis=0)).max() < 0.2
