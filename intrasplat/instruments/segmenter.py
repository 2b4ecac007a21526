"""A user's own network that finds instruments: an ONNX file, run by onnxruntime (extra `onnx`).

Input: float32 [1, 3, h, w], RGB in [0, 1]; any size, or the size that the file fixes, to which pictures are resized.
Output: float32 [1, 1, h, w] or [1, h, w], the probability of an instrument; or [1, C, h, w], scores of C classes, of
which class 0 is tissue.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from intrasplat.errors import UnavailableError
from intrasplat.instruments.find import FoundMask, Rgb

INSTALL = "Install intrasplat with its extra onnx: pip install 'intrasplat[onnx]'."
CHECK = "Set INTRASPLAT_SEGMENTER (--segmenter) to an ONNX network as in docs/operations.md, or leave it unset."
LIKELY = 0.1
"""Minimum probability of a pixel that counts as a possible instrument."""


logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Segmenter:
    """Finds instruments with a loaded network. It is thread-safe.

    session  the InferenceSession of onnxruntime
    size     width and height of the network's input; None: any
    """

    session: Any
    size: tuple[int, int] | None

    def __call__(self, rgb: Rgb) -> FoundMask:
        """The instruments in a picture [H, W, 3].

        Raises:
            UnavailableError: the network fails, or its output is not as described above.
        """
        height, width = rgb.shape[:2]
        given = rgb if self.size is None else cv2.resize(rgb, self.size, interpolation=cv2.INTER_AREA)
        planes = np.ascontiguousarray(given.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        name = self.session.get_inputs()[0].name
        try:
            answer = self.session.run(None, {name: planes})[0]
        except Exception as error:  # onnxruntime has no error tree to rely on
            logger.warning("the segmenter failed: %s", error)
            raise UnavailableError(f"The segmenter failed ({type(error).__name__}).", CHECK) from error
        likely = _probability(np.asarray(answer), given.shape[:2])
        likely = cv2.resize(likely, (width, height), interpolation=cv2.INTER_LINEAR)
        asked = likely > LIKELY
        clear = float((np.abs(2 * likely - 1) * asked).mean())
        return FoundMask(likely > 0.5, float(asked.mean()), clear)


def load_segmenter(path: Path) -> Segmenter:
    """The network in an ONNX file.

    Raises:
        UnavailableError: onnxruntime is not installed, or the file is not such a network.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise UnavailableError("A segmenter is set, and onnxruntime is not installed.", INSTALL) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # frames run in parallel
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        logger.warning("the segmenter %s cannot be loaded: %s", path, error)  # the text may hold paths
        problem = f"The segmenter {path.name} cannot be loaded ({type(error).__name__})."
        raise UnavailableError(problem, CHECK) from error
    inputs = session.get_inputs()
    shape = inputs[0].shape if len(inputs) == 1 else []
    if len(shape) != 4 or not (shape[1] in (3, None) or isinstance(shape[1], str)):
        raise UnavailableError(f"The segmenter {path.name} does not take one input [1, 3, h, w].", CHECK)
    height, width = shape[2:]
    return Segmenter(session, (width, height) if isinstance(width, int) and isinstance(height, int) else None)


def _probability(answer: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    """The probability [h, w] of an instrument."""
    planes = answer.reshape(-1, *answer.shape[-2:]) if answer.ndim in (3, 4) else answer
    if planes.ndim != 3 or not len(planes) or not np.issubdtype(planes.dtype, np.floating):
        raise UnavailableError(f"The segmenter gives {answer.dtype} {list(answer.shape)}, no [1, C, h, w].", CHECK)
    if not np.isfinite(planes).all():
        raise UnavailableError("The segmenter gives NaN or infinity.", CHECK)
    planes = planes.astype(np.float32)
    if len(planes) == 1:
        likely = planes[0]
        if likely.min() < 0 or likely.max() > 1:
            raise UnavailableError("The segmenter gives probabilities below 0 or above 1.", CHECK)
    else:
        weights = np.exp(planes - planes.max(axis=0))
        likely = 1 - weights[0] / weights.sum(axis=0)
    return np.asarray(cv2.resize(likely, size[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
