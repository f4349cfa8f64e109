"""What a check of the self-test is, how results are compared, and volumes, label maps and cameras to compare."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import DeviceError
from clrecon.geometry import Volume
from clrecon.geometry.grid import DEVICE_DTYPES
from clrecon.opencl import Device
from clrecon.rendering.views.camera import Camera

VOXEL_TYPES = tuple(dtype.name for dtype in DEVICE_DTYPES)

LEAST_ITEMS = 501
"""Fewest work-items of a kernel in its check, where its data allow more: several work-groups on every device."""


@dataclass(frozen=True)
class Check:
    """One check of the self-test, of kernels that it launches and whose results it compares.

    run: Takes the device, returns what was compared.  Raises `DeviceError` with what is wrong.
    variants: For a kernel file the ``-D`` macros, other than types and those of the device, that it is built with.
    """

    name: str
    kernels: tuple[str, ...]
    run: Callable[[Device], str]
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def require_equal(found: ArrayLike, expected: ArrayLike, subject: str) -> None:
    """Refuse arrays that are not equal element by element."""
    actual, wanted = np.asarray(found), np.asarray(expected)
    _require_shape(actual, wanted, subject)
    wrong = int(np.count_nonzero(actual != wanted))
    if wrong:
        numbers = f", {actual} in place of {wanted}" if actual.ndim == 0 else ""
        raise DeviceError(f"{subject}: {wrong:,} of {actual.size:,} differ{numbers}")


def require_close(found: ArrayLike, expected: ArrayLike, allowed: float, subject: str) -> float:
    """Refuse numbers more than `allowed` apart, or with NaN at other places; return the largest distance."""
    return require_share(found, expected, allowed, 0.0, subject)


def require_share(found: ArrayLike, expected: ArrayLike, allowed: float, share: float, subject: str) -> float:
    """Refuse where more than a share is more than `allowed` apart; return the largest distance of the others."""
    actual, wanted = np.asarray(found, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    _require_shape(actual, wanted, subject)
    with np.errstate(invalid="ignore"):
        away = np.abs(actual - wanted)
    away = np.where(np.isnan(actual) & np.isnan(wanted), 0.0, away)
    wrong = ~(away <= allowed)
    if wrong.mean() > share:
        worst = np.max(np.where(np.isnan(away), np.inf, away))
        raise DeviceError(
            f"{subject}: {int(wrong.sum()):,} of {actual.size:,} are off, by up to {worst:.3g} ({allowed:g} is allowed)"
        )
    return float(away[~wrong].max(initial=0.0))


def _require_shape(actual: NDArray[Any], wanted: NDArray[Any], subject: str) -> None:
    if actual.shape != wanted.shape:
        counts = (" x ".join(f"{n:,}" for n in array.shape) for array in (actual, wanted))
        raise DeviceError(f"{subject}: {' elements in place of '.join(counts)} elements")


def require_colors(
    image: NDArray[np.uint8], expected: NDArray[Any], allowed: float, subject: str, share: float = 0.0
) -> float:
    """Refuse a picture (..., 4) that is not as expected over black, premultiplied, of 255; see `require_share`."""
    opacity = image[..., 3:].astype(np.float64)
    shown = np.concatenate([image[..., :3] * (opacity / 255.0), opacity], axis=-1)
    away = np.abs(shown - expected).max(axis=-1)
    return require_share(away, np.zeros_like(away), allowed, share, f"{subject}, of 255")


def require_whole(report: Mapping[str, Any]) -> None:
    """Refuse a result made in parts: wrong sums look like a lack of memory, and thin slabs may hide a fault."""
    words = [text for text in report["warnings"] if "continued with" in text]
    if words or report.get("slabs", 1) != 1:
        raise DeviceError(f"made in parts: {'; '.join(words) or 'the device has too little memory'}")


OBLIQUE = np.array([[0.7, 0.1, 0.05, -50.0], [-0.1, 0.5, 0.02, -30.0], [0.0, 0.05, 0.9, -146.0], [0.0, 0.0, 0.0, 1.0]])
"""An affine that is anisotropic, oblique and sheared."""

MIRRORED = OBLIQUE @ np.diag((-1.0, 1.0, 1.0, 1.0))

WIDE = (45, 40, 70)
"""Voxels (k, j, i) whose samples fill some 5,000 words of 32: more than 500 work-items of eight words each."""


def random_integers(shape: tuple[int, ...], dtype: str, high: int) -> NDArray[Any]:
    """Return whole numbers below `high`, the same each time."""
    return np.random.default_rng(20).integers(0, high, shape).astype(dtype)


def stack(voxels: NDArray[Any], affine: NDArray[np.float64], *, uneven: bool = False) -> Volume:
    """Return a volume; with `uneven`, its slices have gaps of their own and lie aside."""
    if not uneven:
        return Volume(voxels, affine)
    rng = np.random.default_rng(21)
    heights = np.concatenate([[0.0], np.cumsum(rng.choice((0.4, 1.0, 1.9), len(voxels) - 1))])
    unit = affine[:3, 2] / np.linalg.norm(affine[:3, 2])
    aside = rng.uniform(-0.2, 0.2, len(voxels))[:, None] * affine[:3, 1]
    table = affine[:3, 3] + heights[:, None] * unit + aside
    placed = affine.copy()
    placed[:3, 2], placed[:3, 3] = (table[-1] - table[0]) / (len(table) - 1), table[0]
    return Volume(voxels, placed, slice_positions=table)


def waves(shape: tuple[int, int, int], dtype: str, low: float = 0.0, high: float = 100.0) -> NDArray[Any]:
    """Return voxels between `low` and `high` whose level surfaces cross nearly every word of 32, in few cells."""
    k, j, i = np.indices(shape)
    values = low + (high - low) * (0.5 + 0.5 * np.sin(2.0 * np.pi * (i / 29.0 + 0.013 * j + 0.017 * k + 0.1)))
    return values.astype(dtype) if np.dtype(dtype).kind == "f" else np.rint(values).astype(dtype)


def noise(shape: tuple[int, int, int], dtype: str, high: int = 6) -> NDArray[Any]:
    """Return voxels of whole numbers below `high`: cells of every case."""
    return random_integers(shape, dtype, high)


def centre_of(volume: Volume) -> NDArray[np.float64]:
    return np.asarray(volume.ijk_to_lps([(np.array(volume.shape_ijk) - 1) / 2])[0])


def blobs(shape: tuple[int, int, int], affine: NDArray[np.float64], dtype: str, *, uneven: bool = False) -> Volume:
    """Return something smooth from -700 to about 1200 HU with structure in all directions."""
    volume = stack(np.zeros(shape, np.int8), affine, uneven=uneven)
    k, j, i = np.indices(shape).reshape(3, -1)
    x, y, z = (volume.ijk_to_lps(np.stack([i, j, k], axis=1)) - centre_of(volume)).T / 3.0
    values = 700.0 * np.sin(x) * np.cos(0.8 * y + 0.3) * np.cos(0.7 * z) + 500.0 * np.exp(-(x**2 + y**2 + z**2) / 9.0)
    if np.dtype(dtype).kind != "f":
        limits = np.iinfo(dtype)
        values = np.rint(np.clip(values if limits.max > 255 else 60.0 + values / 12.0, limits.min, limits.max))
    return volume.with_voxels(values.reshape(shape).astype(dtype))


def look_at(
    volume: Volume, towards: Sequence[float], half_height: float, *, perspective: bool = False, distance: float = 150.0
) -> Camera:
    """Return a camera `distance` mm before the middle of a volume; `half_height` mm of it reach the picture's top."""
    centre, forward = centre_of(volume), np.array(towards, dtype=np.float64) / np.linalg.norm(towards)
    position, up = tuple(centre - distance * forward), (0.1, 0.2, 1.0)
    if perspective:
        angle = 2.0 * float(np.degrees(np.arctan(half_height / distance)))
        return Camera(position, tuple(centre), up, view_angle=angle)
    return Camera(position, tuple(centre), up, parallel_scale=half_height)
