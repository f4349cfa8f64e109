"""Tissue that a wrong PixelPaddingValue or PixelPaddingRangeLimit masks: air stands in its place then.

Padding has one value, mostly far below air, and reaches the edge of the picture.  Voxels with the HU of tissue are
measured ones where they lie within the picture, or have values between the ends of a range.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.dicom.pixels.padding import AIR_RANGE_HU


def count_masked_tissue(header: SliceHeader, stored: NDArray[Any], padding: NDArray[np.bool_]) -> int:
    """Count voxels of the padding of a slice that are tissue by value and place.

    stored: ndarray, shape (rows, columns). Before padding is replaced.
    padding: ndarray of bool, shape (rows, columns)
    """
    assert header.padding is not None
    low, high = header.padding
    # Padding below air is the usual case and needs no search.  NaN is not above air either.
    if not max(low * header.slope, high * header.slope) + header.intercept > AIR_RANGE_HU[1]:
        return 0
    suspect = padding & ~_find_outer_runs(padding) | padding & (stored > low) & (stored < high)
    values = stored[suspect] * np.float64(header.slope) + header.intercept
    return int(np.count_nonzero(values > AIR_RANGE_HU[1]))


def _find_outer_runs(padding: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the padding that reaches an edge of the picture along its row or its column."""
    outer = np.zeros_like(padding)
    for axis in (0, 1):
        outer |= np.logical_and.accumulate(padding, axis=axis)
        outer |= np.flip(np.logical_and.accumulate(np.flip(padding, axis), axis=axis), axis)
    return outer


def describe_masked_tissue(count: int) -> str:
    """Return one line about the masked voxels of all slices; empty where there are none."""
    if not count:
        return ""
    return (
        f"{count:,} voxels with the HU of tissue are padding by PixelPaddingValue (0028,0120) or PixelPaddingRangeLimit"
        " (0028,0121) and are read as air, but lie inside of the picture or have many values: correct or remove these"
        " elements if the holes are not meant"
    )
