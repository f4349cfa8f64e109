"""`StoredValues`: what a header says of how values were stored."""

from __future__ import annotations

from typing import NamedTuple, Protocol


class StoredValues(Protocol):
    """What a header says of the values of its slice.

    slope, intercept: Of the rescale to HU.
    """

    @property
    def bits_stored(self) -> int: ...
    @property
    def signed(self) -> bool: ...
    @property
    def slope(self) -> float: ...
    @property
    def intercept(self) -> float: ...


class StoredRange(NamedTuple):
    """The same of a file that has one type for all slices."""

    bits_stored: int
    signed: bool
    slope: float
    intercept: float
