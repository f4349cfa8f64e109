"""Twin of `clrecon.operators.primitives.scan`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def radix_sort(keys: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Sort keys, equal ones in the order of the input.

    Returns:
    keys: ndarray, shape (n,), uint32, ascending
    values: ndarray, shape (n,), uint32. Number of each of them in the input.
    """
    order = np.argsort(keys, kind="stable")
    return keys[order], order.astype(np.uint32)
