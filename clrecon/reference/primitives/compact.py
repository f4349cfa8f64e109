"""Twin of `clrecon.operators.primitives.scan`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def compact(mask: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the positions of the set bits of a bit mask in ascending order; bit b of word w is position 32 w + b."""
    bits = mask[:, None] >> np.arange(32, dtype=np.uint32) & 1
    return np.flatnonzero(bits).astype(np.uint32)
