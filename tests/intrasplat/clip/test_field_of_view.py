"""A calibration by which the picture shows less or more than endoscopes see is told."""

from __future__ import annotations

import numpy as np
import pytest

from intrasplat.clip.calibration import rectify
from intrasplat.intake.calibration.types import StereoCalibration, parse_calibration
from tests.intrasplat.clip.test_calibration import HEIGHT, RECTIFIED, WIDTH, clip_of, raw_calibration


@pytest.mark.parametrize("kind", ["rectified", "raw"])
@pytest.mark.parametrize(("factor", "degrees"), [(0.5, "98"), (1.0, None), (2.0, "32")])
def test_a_focal_length_of_another_image_size_is_told(kind: str, factor: float, degrees: str | None) -> None:
    calibration: StereoCalibration
    if kind == "rectified":
        calibration = parse_calibration(RECTIFIED | {"fx_px": 140.0 * factor, "fy_px": 140.0 * factor})
    else:
        raw = raw_calibration()
        eyes = {side: getattr(raw, side) for side in ("left", "right")}
        scaled = {
            side: eye.model_copy(update={"fx_px": 140.0 * factor, "fy_px": 140.0 * factor, "distortion": ()})
            for side, eye in eyes.items()
        }
        calibration = raw.model_copy(update=scaled)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    warnings = [each for each in rectify(clip_of(image, image), calibration).warnings if "view" in each.code]
    assert [(each.code, f"{degrees} degrees" in each.text) for each in warnings] == (
        [] if degrees is None else [("field_of_view_unusual", True)]
    )
