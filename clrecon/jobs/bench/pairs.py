"""Timing of two programs in turn, pair by pair, so that changes of the machine's speed affect both."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

FEWEST_PAIRS = 3
"""Pairs that are run in spite of the time limit: fewer give no spread."""


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, quartiles, minimum and maximum of at least one value.

    Returns: ``median, q1, q3, min, max``; quartiles are interpolated between the values (inclusive method).
    """
    if len(values) == 1:
        q1 = median = q3 = float(values[0])
    else:
        q1, median, q3 = statistics.quantiles(values, n=4, method="inclusive")
    return {"median": median, "q1": q1, "q3": q3, "min": float(min(values)), "max": float(max(values))}


def alternate(
    candidate: Callable[[], float],
    peer: Callable[[], float],
    pairs: int,
    *,
    warm: bool = True,
    limit_s: float | None = None,
    clock: Callable[[], float] = perf_counter,
) -> tuple[list[float], list[float]]:
    """Run two programs in turn; their order changes with every pair, so that neither profits from its place.

    candidate, peer: Functions that run once and return the seconds to compare.
    pairs: Number of timed runs of each.
    warm: Run each once before, untimed.
    limit_s: Start no further pair after so many seconds, warm-up included; `FEWEST_PAIRS` are always run.
    clock: Clock for the limit, in seconds.

    Returns:
    candidate_s, peer_s: Both of the same length.
    """
    start = clock()
    if warm:
        candidate(), peer()
    ours: list[float] = []
    theirs: list[float] = []
    for number in range(pairs):
        if limit_s is not None and number >= FEWEST_PAIRS and clock() - start > limit_s:
            break
        if number % 2:
            theirs.append(peer())
            ours.append(candidate())
        else:
            ours.append(candidate())
            theirs.append(peer())
    return ours, theirs


def summarise(ours: Sequence[float], theirs: Sequence[float]) -> dict[str, Any]:
    """Spreads of both sides and of the ratio of each pair (above 1: clrecon is faster).

    Returns: ``pairs`` (int); ``clrecon_s``, ``peer_s`` and ``ratio``, each from `spread`.
    """
    ratios = [theirs_s / ours_s for ours_s, theirs_s in zip(ours, theirs, strict=True)]
    return {"pairs": len(ratios), "clrecon_s": spread(ours), "peer_s": spread(theirs), "ratio": spread(ratios)}
