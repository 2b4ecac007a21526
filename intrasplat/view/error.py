"""The error of a view: by how much the model's colours differ from a recorded frame of the same moment and eye.

Symbols: H W pixels of the view, h w pixels of the recorded frame.

The view is the endoscope's own, at the frame's time, in the light of the moment, through its smoke and without detail
of recorded frames (AS_RECORDED). Where the frame shows an instrument, nothing is compared.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import InputError
from intrasplat.picture import Highlights, IntrinsicsOverride
from intrasplat.pose import Pose
from intrasplat.view.recorded import RecordedPicture

AS_RECORDED = {"light": "recorded", "smoke": "show", "highlights": Highlights.ON, "detail": "off"}
"""How a view is drawn that is compared."""


def check_comparable(pose: Pose | None, camera: IntrinsicsOverride) -> None:
    """Check that a recorded frame shows what a view does.

    Raises:
        InputError: it has another pose or another lens.
    """
    remedy = "Leave it out: errors are those of the endoscope's own view."
    if pose is not None:
        raise InputError("pose", "recorded frames show nothing from another pose.", remedy)
    for name in ("fx", "fy", "cx", "cy"):
        if getattr(camera, name) is not None:
            raise InputError(name, "recorded frames show nothing through another lens.", remedy)


def error_levels(rgb: NDArray[np.uint8], recorded: RecordedPicture, unseen: NDArray[np.bool_]) -> NDArray[np.float32]:
    """[H, W] mean of |model - recorded| over R G B in levels of 255; NaN on instruments and where unseen [H, W] is set.

    It is negative where the model is darker in the mean of R G B. Exact files have no sign (encode.py).

    Args:
        rgb: [H, W, 3] of the model.
    """
    height, width = unseen.shape
    is_smaller = width < recorded.rgb.shape[1]
    how = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
    true = np.asarray(cv2.resize(recorded.rgb, (width, height), interpolation=how), np.float32)
    tool = cv2.resize(recorded.tool.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    difference = rgb.astype(np.float32) - true
    levels = np.copysign(np.abs(difference).mean(axis=2), difference.mean(axis=2))
    return np.where(tool | unseen, np.float32(np.nan), levels).astype(np.float32)
