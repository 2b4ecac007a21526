"""The trust in each Gaussian of a model that follows a feed, by the newest frames (intrasplat/quality/trust.py).

Symbols: N Gaussians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from intrasplat.live.window import Window
from intrasplat.quality.trust import sees, trust_of, weights_in

REMEMBERED = 0.8
"""Weight of what was found before, from one look at an eye to the next: half of it is of the last three looks."""


class Trusted:
    """How the pictures of late showed each Gaussian. Every look takes about as long as a step of one eye."""

    def __init__(self, count: int) -> None:
        self._looks = np.zeros(2)
        self._seen = np.zeros((2, count), np.float32)
        self._on_tissue, self._wrong = np.zeros((2, count), np.float32)

    def look(self, window: Window) -> None:
        """Look at the newest frame, at one eye in turn."""
        moment = window.newest
        place = int(self._looks[0] > self._looks[1])
        eye, frame = moment.clip.eyes[place], moment.frames[place]
        here, drawn, wrong = weights_in(window.model, frame.camera, frame.t, eye, 0, moment.scale)
        self._looks[place] = REMEMBERED * self._looks[place] + 1
        self._seen[place] = REMEMBERED * self._seen[place] + sees(here, drawn)
        self._on_tissue = np.sqrt(REMEMBERED) * self._on_tissue + here
        self._wrong = np.sqrt(REMEMBERED) * self._wrong + wrong

    def forget(self, columns: NDArray[np.intp]) -> None:
        """Start anew for the Gaussians of these columns [M], which now show other tissue of the newest frame."""
        self._seen[:, columns] = self._looks[:, None]
        self._on_tissue[columns] = self._wrong[columns] = (
            1.0  # of errors between right and wrong, until it is looked at
        )

    def trust(self) -> NDArray[np.float32]:
        """[N] in [0, 1], as intrasplat.quality.trust.trust; 0 everywhere before the first look."""
        share = (self._seen / np.maximum(self._looks, 1e-6)[:, None]).max(0)
        error = np.maximum(self._wrong, 0) / np.maximum(self._on_tissue, 1e-6)
        return trust_of(np.stack([share, error]))
