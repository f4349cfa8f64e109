"""Pixels of a data set, stored in any way."""

from __future__ import annotations

from typing import Any

import numpy as np
from dicom_series import set_values


def set_pixels(make: Any, **values: Any) -> Any:
    """A change that puts `make(stored array)` in place of the stored pixels."""

    def change(ds: Any, k: int) -> None:
        array = np.frombuffer(ds.PixelData, np.int16).reshape(ds.Rows, ds.Columns).copy()
        ds.PixelData = np.ascontiguousarray(make(array, k)).tobytes()
        set_values(**values)(ds, k)

    return change
