"""How alike two pictures of one camera are: MSE and SSIM, and pictures that show what these figures are worth.

Reference: Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity", IEEE
Transactions on Image Processing 13(4), as scikit-image's ``structural_similarity`` computes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.records import Record

WINDOW = 7
"""Edge of the window of SSIM, pixels."""

RANGE = 255.0

SHIFT = 5
"""Pixels by which the shifted control picture is moved."""

_SEED = 20190601
"""Of the noise in control pictures: the same at every call."""


@dataclass(frozen=True, eq=False)
class PictureLikeness(Record):
    """How alike two pictures are: mean squared difference, 0 to 65025, and structural similarity, 1 for equal pictures.

    box: First row, first column, and the row and column after the last: what was compared.
    """

    mse: float
    ssim: float
    box: tuple[int, int, int, int]


@explains_arguments
def measure_pictures(
    picture: ArrayLike, reference: ArrayLike, *, background: Sequence[int] | int = 0, whole: bool = False
) -> PictureLikeness:
    """Compare two pictures of one camera by MSE and SSIM over the box around what is drawn in either.

    Parameters
    ----------
    picture, reference : array_like, shape (rows, columns), (rows, columns, 3) or (rows, columns, 4), uint8
        Grey, RGB or RGBA, both alike.  RGBA is laid over the background first.
    background : int or sequence of ints
        Value or colour where nothing is drawn.
    whole : bool
        True: compare the whole pictures.

    Returns
    -------
    PictureLikeness

    Raises
    ------
    UsageError
        Shapes or types differ or are not those of pictures, a picture is smaller than the window of SSIM, or nothing
        is drawn in either.
    """
    given, wanted = (_as_picture(pixels, background) for pixels in (picture, reference))
    if given.shape != wanted.shape:
        raise UsageError(f"pictures of one camera have one shape: these have {given.shape} and {wanted.shape}")
    rows, columns = given.shape[:2]
    if min(rows, columns) < WINDOW:
        raise UsageError(f"a picture of {columns} x {rows} pixels is smaller than the window of SSIM, {WINDOW} pixels")
    empty = _colour(background, given.shape[2])
    drawn = ((given != empty) | (wanted != empty)).any(axis=2)
    if not whole and not drawn.any():
        raise UsageError("nothing is drawn in either picture: there is nothing to compare")
    (top, bottom), (left, right) = (
        (0, size) if whole else _span(drawn.any(axis=1 - axis)) for axis, size in enumerate((rows, columns))
    )
    first, second = (pixels[top:bottom, left:right].astype(np.float64) for pixels in (given, wanted))
    mse = float(np.mean((first - second) ** 2))
    return PictureLikeness(mse, _measure_similarity(first, second), (top, left, bottom, right))


def _measure_similarity(first: Float64Array, second: Float64Array) -> float:
    """Return the mean of SSIM over all windows in two pictures (rows, columns, channels)."""
    from scipy.ndimage import uniform_filter

    def average(values: Float64Array) -> Float64Array:
        margin = WINDOW // 2
        return np.asarray(uniform_filter(values, (WINDOW, WINDOW, 1))[margin:-margin, margin:-margin])

    unbiased = WINDOW**2 / (WINDOW**2 - 1)
    c1, c2 = (0.01 * RANGE) ** 2, (0.03 * RANGE) ** 2
    mean, mean_2 = average(first), average(second)
    variances = average(first**2) - mean**2 + average(second**2) - mean_2**2
    covariance = average(first * second) - mean * mean_2
    alike = (2.0 * mean * mean_2 + c1) * (2.0 * unbiased * covariance + c2)
    return float(np.mean(alike / ((mean**2 + mean_2**2 + c1) * (unbiased * variances + c2))))


def _as_picture(pixels: ArrayLike, background: Sequence[int] | int) -> NDArray[np.uint8]:
    """Return a picture as (rows, columns, 1 or 3), uint8, without its alpha."""
    array = np.asarray(pixels)
    if array.dtype != np.uint8 or array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise UsageError(
            "a picture has shape (rows, columns), (rows, columns, 3) or (rows, columns, 4) and type uint8, this one has"
            f" {array.shape} and {array.dtype}"
        )
    if array.ndim == 2:
        return array[:, :, None]
    if array.shape[2] == 3:
        return array
    alpha = array[:, :, 3:].astype(np.float64) / RANGE
    laid = array[:, :, :3] * alpha + _colour(background, 3) * (1.0 - alpha)
    return np.asarray(np.rint(laid), dtype=np.uint8)


def _colour(background: Sequence[int] | int, channels: int) -> NDArray[np.uint8]:
    values = np.asarray(background)
    if values.dtype.kind not in "iu" or values.shape not in ((), (channels,)) or values.min() < 0 or values.max() > 255:
        raise UsageError(f"the background is one whole number from 0 to 255 or {channels} of them, not {background!r}")
    return np.asarray(np.broadcast_to(values, channels), dtype=np.uint8)


def _span(drawn: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the first and the end of what is drawn along an axis, grown to the window of SSIM."""
    places = np.flatnonzero(drawn)
    first, end = int(places[0]), int(places[-1]) + 1
    first = max(min(first, end - WINDOW, len(drawn) - WINDOW), 0)
    return first, max(end, first + WINDOW)


def make_control_pictures(picture: ArrayLike, next_picture: ArrayLike | None = None) -> Mapping[str, NDArray[Any]]:
    """Return pictures whose likeness to ``picture`` shows what the figures are worth.

    Parameters
    ----------
    picture : array_like, shape (rows, columns[, 3 or 4]), uint8
    next_picture : array_like, optional
        A neighbouring one, such as the next slice.

    Returns
    -------
    dict
        ``black``, ``white``, ``noise`` (even, the same at every call), ``shifted`` (by 5 pixels to the right), and
        ``next`` where it is given.
    """
    pixels = _as_picture(picture, 0)
    controls = {
        "black": np.zeros_like(pixels),
        "white": np.full_like(pixels, 255),
        "noise": np.random.default_rng(_SEED).integers(0, 256, pixels.shape, dtype=np.uint8),
        "shifted": np.concatenate([pixels[:, :1].repeat(SHIFT, axis=1), pixels[:, :-SHIFT]], axis=1),
    }
    if next_picture is not None:
        controls["next"] = _as_picture(next_picture, 0)
    grey = np.ndim(picture) == 2
    return {name: control[:, :, 0] if grey else control for name, control in controls.items()}
