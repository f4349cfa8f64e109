"""A fast median for short sequences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


def median(values: Sequence[float] | NDArray[Any]) -> float:
    """Return the same as `numpy.median` of one or more values.

    `numpy.median` loads numpy's masked arrays, 10 ms at every start of the program, and is slow for few values.
    """
    ordered = np.sort(values)
    middle = len(ordered) // 2
    return float(ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2)
