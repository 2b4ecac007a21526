"""What tests share: comparison that says where and how badly two arrays differ."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def assert_close(
    actual: Any,
    expected: Any,
    *,
    relative: float = 1e-4,
    absolute: float = 1e-6,
    where: NDArray[np.bool_] | None = None,
    name: str = "arrays",
) -> None:
    """Asserts max |actual - expected| <= relative * max |expected| + absolute, over the whole array at once.

    The scale is the array's, not the element's: an element near 0 in a large array may be off by the array's rounding.
    Where it fails, the message gives the place of the worst difference and how many elements are beyond the tolerance.

    Args:
        actual, expected: arrays or tensors of one shape; NaN or infinity in either fails.
        where: bool mask over the leading axes; only True elements are compared.
    """
    got, wanted = _as_array(actual), _as_array(expected)
    assert got.shape == wanted.shape, f"{name}: shape {got.shape}, expected {wanted.shape}"
    if got.size == 0:
        return
    assert np.isfinite(wanted).all(), f"{name}: expected holds {int((~np.isfinite(wanted)).sum())} NaN or infinity"
    broken = ~np.isfinite(got)
    assert not broken.any(), f"{name}: {int(broken.sum())} NaN or infinity, the first at {_first(broken)}"
    difference = np.abs(got - wanted)
    if where is not None:
        kept = where.reshape(where.shape + (1,) * (got.ndim - where.ndim))
        difference = np.where(kept, difference, 0.0)
        wanted = np.where(kept, wanted, 0.0)
    tolerance = relative * float(np.abs(wanted).max()) + absolute
    worst = tuple(int(i) for i in np.unravel_index(int(difference.argmax()), difference.shape))
    beyond = int((difference > tolerance).sum())
    assert difference[worst] <= tolerance, (
        f"{name} {got.shape}: worst at {worst}: {got[worst]:.9g}, expected {wanted[worst]:.9g}, difference "
        f"{difference[worst]:.3g} > {tolerance:.3g}; {beyond} of {difference.size} beyond it"
    )


def _as_array(values: Any) -> NDArray[np.float64]:
    if hasattr(values, "detach"):
        values = values.detach().cpu().numpy()
    return np.asarray(values, dtype=np.float64)


def _first(mask: NDArray[np.bool_]) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(mask)[0])
