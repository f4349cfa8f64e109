"""`PointStep`: what a step made of a cloud, and what it removed for which reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.points.cloud import PointCloud


def count_numbers(numbers: NDArray[np.uint8], reasons: Sequence[str]) -> dict[str, int]:
    """Return how many points have the number of each reason, from 1: a pass for each is faster than one for all."""
    return {reason: int(np.count_nonzero(numbers == number)) for number, reason in enumerate(reasons, 1)}


@dataclass(frozen=True, eq=False)
class PointStep:
    """The result of a function that takes a cloud and gives another one.

    cloud: The new cloud: the points that are kept, in the order of the input.
    removed: ndarray, shape (n,), uint8. For each point of the input 0 if it is kept, or the number of the reason why it
        was removed, from 1.
    reasons: The reasons: number r is ``reasons[r - 1]``, for example "noise" or "sheet".
    facts: Further entries of the step's report: parameters as they were used, figures measured, doubtful points.
    warnings: A line each.
    """

    cloud: PointCloud
    removed: NDArray[np.uint8]
    reasons: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """Number of removed points for each reason."""
        return count_numbers(self.removed, self.reasons)

    def as_dict(self) -> dict[str, Any]:
        """Return the entries of the step's report: points before and after, removed by reason, facts."""
        return {
            "points_before": len(self.removed),
            "points_after": len(self.cloud),
            "removed": self.counts,
            **self.facts,
        }
