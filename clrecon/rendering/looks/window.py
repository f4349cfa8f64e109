"""Windows: the ranges of HU that grey pictures show from black to white."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.system.pieces import chunks

BONE_WINDOW = (-450.0, 1050.0)
"""Level 300, width 1500 HU: distinguishes marrow, cortex and soft tissue."""

WINDOWS = {
    "bone": BONE_WINDOW,
    "soft": (-150.0, 250.0),
    "lung": (-1350.0, 150.0),
    "abdomen": (-150.0, 250.0),
    "mediastinum": (-125.0, 225.0),
    "brain": (0.0, 80.0),
}
"""Windows by name, HU.  All but bone: the typical widths and levels of Radiopaedia, "Windowing (CT)": lungs
1500 about -600, soft tissue of the abdomen 400 about 50, mediastinum 350 about 50, brain 80 about 40."""

BODY_SHARE = 0.05
"""Least share of the most water along a ray; rays with less meet air, a table or the fold of a blanket, but no body."""


BODY_HU = -500.0
"""Highest HU along a ray below which it meets air, foam or a blanket, but no body."""


def checked_window(window: Sequence[float] | str) -> tuple[float, float]:
    """Return the low and high end, HU that are black and white, of a window or of a name of `WINDOWS`."""
    if isinstance(window, str):
        named = WINDOWS.get(window.strip().lower())
        if named is None:
            raise UsageError(
                f"no window is called {window!r:.60}: use one of {', '.join(WINDOWS)}, or the HU that are black and"
                " white, such as (-450, 1050)"
            )
        return named
    try:
        low, high = (float(end) for end in window)
    except (TypeError, ValueError, OverflowError):
        low = high = np.nan
    if not (-np.inf < low < high < np.inf):
        raise UsageError(f"a window is its lowest and highest HU, such as (-450, 1050), not {window!r}")
    return low, high


def grey_image(values: NDArray[Any], window: Sequence[float]) -> NDArray[np.uint8]:
    """Turn values (h, w), HU or NaN for empty pixels, into a picture (h, w, 4), where these have opacity 0."""
    low, high = checked_window(window)
    pixels = np.empty(values.shape, "<u4")
    grey, flat = pixels.reshape(-1), values.reshape(-1)
    for part in chunks(len(flat)):  # in the caches: a picture as a whole takes six times as long
        there = ~np.isnan(flat[part])
        share = np.clip((np.where(there, flat[part], low) - low) / (high - low), 0.0, 1.0)
        grey[part] = np.rint(255.0 * share).astype("<u4") * 0x010101 + there.astype("<u4") * 0xFF000000
    return pixels.view(np.uint8).reshape(*values.shape, 4)


def choose_window(values: NDArray[Any]) -> tuple[float, float]:
    """Choose a window from the 1st to the 99th percentile of the finite values, at least 1 HU wide."""
    there = values[np.isfinite(values)]
    if not len(there):
        return BONE_WINDOW
    low, high = _percentiles(there)
    return (low, high) if high - low >= 1.0 else (low - 0.5, low + 0.5)


def choose_mip_window(values: NDArray[Any]) -> tuple[float, float]:
    """Choose a window from the rays of a maximum projection that meet the body, so that air is not the black end."""
    of_body = values[values >= BODY_HU]
    return choose_window(of_body if len(of_body) else values)


def choose_water_window(values: NDArray[Any]) -> tuple[float, float]:
    """Choose a window from the 1st to the 99th percentile of mm of water along rays of a radiograph that meet the body.

    They have more than `BODY_SHARE` of the largest value; if all of them have the same, black is 0.
    """
    most = float(values.max(initial=0.0))
    if not most > 0.0:
        return 0.0, 1.0
    low, high = _percentiles(values[values > BODY_SHARE * most])
    return (low, high) if high - low >= 0.01 * high else (0.0, high)


def _percentiles(values: NDArray[Any]) -> tuple[float, float]:
    low, high = (float(end) for end in np.percentile(values[:: max(1, len(values) // 100_000)], (1.0, 99.0)))
    return low, high
