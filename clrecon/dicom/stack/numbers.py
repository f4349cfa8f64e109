"""Numbers about numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["median"]


def median(values: Sequence[float] | NDArray[Any]) -> float:
    """As `numpy.median` of at least one value.

    That one loads numpy's masked arrays, 10 ms at every start of the program, and is slow on the few values of a stack.
    """
    ordered = np.sort(values)
    middle = len(ordered) // 2
    return float(ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2)
