"""Twin of `clrecon.operators.primitives.scan`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def exclusive_scan(counts: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], int]:
    """Return the sum of all counts before each element, (n,) uint32, and the total."""
    sums = np.cumsum(counts, dtype=np.uint64)
    total = int(sums[-1]) if sums.size else 0
    return (sums - counts).astype(np.uint32), total
