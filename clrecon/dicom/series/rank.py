"""What distinguishes CT stacks of a similar number of slices: original or derived, direction, thickness."""

from __future__ import annotations

from typing import NamedTuple

from clrecon.dicom.series.series import Series
from clrecon.dicom.stack.layout import median_thickness

_DIRECTIONS = ("sagittal", "coronal", "axial")
"""Names of slices whose normal lies nearest to x, y, z of the patient."""
_NOT_ORIGINAL = ("DERIVED", "SECONDARY")
"""Words of ImageType: pixels computed from other images, or images made after the examination (DICOM PS3.3
C.7.6.1.1.2)."""


class Rank(NamedTuple):
    """What a series is chosen by.

    original: False where ImageType says that the images are derived or secondary; True where it says nothing.
    direction: "axial", "coronal" or "sagittal", the nearest.
    thickness_mm: As stated, to a hundredth of a millimetre; None where no slice states it.
    """

    original: bool
    direction: str
    thickness_mm: float | None


def rank_series(series: Series) -> Rank:
    """Return the rank of a stack by the header of its first slice, and by the thickness of all."""
    if not series.headers:
        return Rank(True, "axial", None)
    first = series.headers[0]
    words = dict(first.phase).get("ImageType", "").upper().replace("\\", " ").split()
    thickness = median_thickness(series.headers)
    return Rank(
        not any(word in _NOT_ORIGINAL for word in words),
        _nearest_direction(first.row_cosines, first.column_cosines),
        None if thickness is None else round(thickness, 2),
    )


def _nearest_direction(row: tuple[float, ...], column: tuple[float, ...]) -> str:
    normal = [abs(row[a] * column[b] - row[b] * column[a]) for a, b in ((1, 2), (2, 0), (0, 1))]
    return _DIRECTIONS[normal.index(max(normal))]
