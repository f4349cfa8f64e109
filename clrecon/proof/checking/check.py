"""What a check of the self-test is, and how results are compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import DeviceError
from clrecon.opencl import Device

LEAST_ITEMS = 501
"""Fewest work-items of a kernel in its check, where its data allow more: several work-groups on every device."""


@dataclass(frozen=True)
class Check:
    """One check of the self-test.

    name: What is tested, for people.
    kernels: Kernels that it launches and whose results it compares.
    run: Takes the device, returns what was compared.  Raises `DeviceError` with what is wrong.
    variants: For a kernel file the ``-D`` macros, other than types and those of the device, that it is built with.
    """

    name: str
    kernels: tuple[str, ...]
    run: Callable[[Device], str]
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def require_equal(found: ArrayLike, expected: ArrayLike, what: str) -> None:
    """Refuse arrays that are not equal element by element."""
    one, other = np.asarray(found), np.asarray(expected)
    if one.shape != other.shape:
        raise DeviceError(f"{what}: {_describe_shape(one)} in place of {_describe_shape(other)}")
    wrong = int(np.count_nonzero(one != other))
    if wrong:
        raise DeviceError(f"{what}: {wrong:,} of {one.size:,} differ")


def require_close(found: ArrayLike, expected: ArrayLike, allowed: float, what: str) -> float:
    """Refuse numbers that are more than `allowed` apart; return the largest distance.

    NaN must be where NaN is expected.
    """
    return require_share(found, expected, allowed, 0.0, what)


def require_share(found: ArrayLike, expected: ArrayLike, allowed: float, share: float, what: str) -> float:
    """Refuse numbers of which more than a share is more than `allowed` apart; return the largest distance of the
    others.

    share: Between 0 and 1: float32 takes the other side of an edge at some elements.
    """
    one, other = np.asarray(found, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    if one.shape != other.shape:
        raise DeviceError(f"{what}: {_describe_shape(one)} in place of {_describe_shape(other)}")
    with np.errstate(invalid="ignore"):
        away = np.abs(one - other)
    away = np.where(np.isnan(one) & np.isnan(other), 0.0, away)
    wrong = ~(away <= allowed)
    if wrong.mean() > share:
        worst = np.max(np.where(np.isnan(away), np.inf, away))
        raise DeviceError(
            f"{what}: {int(wrong.sum()):,} of {one.size:,} are off, by up to {worst:.3g} ({allowed:g} is allowed)"
        )
    return float(away[~wrong].max(initial=0.0))


def require_whole(report: Mapping[str, Any]) -> None:
    """Refuse a result that was made in parts.

    Wrong sums look like a lack of memory.  An operator then goes on with thinner slabs, perhaps so thin that a kernel's
    fault does not show.
    """
    words = [text for text in report["warnings"] if "continued with" in text]
    if words or report.get("slabs", 1) != 1:
        raise DeviceError(f"made in parts: {'; '.join(words) or 'the device has too little memory'}")


def _describe_shape(array: np.ndarray[Any, Any]) -> str:
    return f"{' x '.join(f'{n:,}' for n in array.shape)} elements"
