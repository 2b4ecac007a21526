"""The mean of a model over some of its steps: the noise of single steps cancels, what they agree on stays."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

PREFIX = "average."


class RunningMean:
    """Sums of a model's parameters; arrays by the names that the model gives them."""

    def __init__(self) -> None:
        self.count = 0
        self._total: dict[str, np.ndarray] = {}

    def add(self, parameters: Mapping[str, np.ndarray]) -> None:
        """One more of what is averaged."""
        self.count += 1
        if self.count == 1:
            self._total = {name: values.copy() for name, values in parameters.items()}
            return
        for name, values in parameters.items():  # torch adds on every core, numpy on one; the sums are the same
            torch.from_numpy(self._total[name]).add_(torch.from_numpy(values))

    def put(self, parameters: Mapping[str, np.ndarray]) -> None:
        """Write the mean into these arrays and begin anew."""
        for name, values in parameters.items():
            np.divide(self._total[name], np.float32(self.count), out=values)
        self.count, self._total = 0, {}

    def arrays(self) -> dict[str, np.ndarray]:
        """What a resumed run needs beside the count."""
        return {PREFIX + name: values for name, values in self._total.items()}

    def load_arrays(self, arrays: Mapping[str, np.ndarray], count: int) -> None:
        """Put back what arrays() gave, out of more."""
        self.count = count
        self._total = {name.removeprefix(PREFIX): a.copy() for name, a in arrays.items() if name.startswith(PREFIX)}
