"""What a filter of volumes is asked for, checked, its window of voxels in mm, and what its report says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.noise import Noise, measure_noise
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.certificate import amend
from clrecon.geometry.iso_rule import LARGEST_INTEGER, checked_iso_value
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.system.light_dataclass import dataclass, replace

LARGEST_REACH = 14
"""Most voxels from the middle of a window to its end, along each axis: with two rings, a group of 16."""

_RADIUS_OF_SIGMA = 2.5
"""Radius of a window over the sigma, if it is not capped: what lies farther has less than 4 % of the weight."""

_SAME_RING = 1e-6
"""Relative difference of squared distances that are one ring: a distance of affines from files."""


@dataclass(frozen=True)
class Window:
    """Taps of a window, sorted by k, j and i.

    offsets: ndarray, shape (n, 3), int32. Steps along i, j, k, the voxel itself among them.
    exponents: ndarray, shape (tables, n), float64. Logarithm to base 2 of the weight by distance: a row for each slice
        where they are uneven, else one.
    share: Weight of these taps over that of the `whole_taps` of the whole window.
    """

    offsets: NDArray[np.int32]
    exponents: Float64Array
    share: float
    whole_taps: int

    @property
    def taps(self) -> int:
        return len(self.offsets)

    @property
    def reach(self) -> tuple[int, int, int]:
        """Voxels from the middle to the end along i, j, k."""
        i, j, k = np.abs(self.offsets).max(axis=0).tolist()
        return i, j, k

    def rows(self) -> NDArray[np.int32]:
        """Return the rows of taps, (m, 4) int32: steps along j and k, first step along i, number of taps."""
        goes_on = (np.diff(self.offsets, axis=0) == (1, 0, 0)).all(axis=1)
        starts = np.flatnonzero(np.append(True, ~goes_on))
        first, counts = self.offsets[starts], np.diff(np.append(starts, self.taps))
        return np.column_stack([first[:, 1], first[:, 2], first[:, 0], counts]).astype(np.int32)

    def without_middle(self) -> Window:
        """Return the window without the voxel itself, whose weight is 1."""
        others = self.offsets.any(axis=1)
        return replace(self, offsets=self.offsets[others], exponents=np.ascontiguousarray(self.exponents[:, others]))


def choose_window(volume: Volume, sigma_mm: float, dimensions: int, most_taps: int) -> Window:
    """Choose the taps of a window: the box around the ball of 2.5 sigma, or the nearest voxels of it.

    Distances are those of the voxels' places, so that anisotropic, sheared and uneven volumes are filtered in mm; in 2
    dimensions the window stays within its slice.  Of a box with more than `most_taps` the nearest voxels stay, in whole
    rings of equal distance: of square pixels 13 are the disc of five that OpenCV has, and 5, 29 and 49 those of 3, 7
    and 9. Below the number of the first ring the middle stays alone.
    """
    box = _box(volume, _RADIUS_OF_SIGMA * sigma_mm, dimensions)
    k, j, i = np.meshgrid(
        *(np.arange(-n, n + 1) for n in np.minimum(box, 3 * LARGEST_REACH)[::-1].tolist()), indexing="ij"
    )
    whole = np.column_stack([i.ravel(), j.ravel(), k.ravel()]).astype(np.int32)
    squares = _squares(whole, _nominal_steps(volume))
    is_kept = np.asarray((np.abs(whole) <= np.minimum(box, LARGEST_REACH)).all(axis=1))
    if np.count_nonzero(is_kept) > most_taps:
        is_kept = _nearest_rings(whole, squares, is_kept, most_taps)
    weights = np.exp(-squares / (2.0 * sigma_mm**2))
    total = float(weights.sum())
    if (box > 3 * LARGEST_REACH).any():  # too many to add: the integral, for sigmas of many voxels
        steps = _nominal_steps(volume)[:, :dimensions]
        total = (math.tau * sigma_mm**2) ** (dimensions / 2) / math.sqrt(np.linalg.det(steps.T @ steps))
    share = float(weights[is_kept].sum()) / total
    offsets_kept = whole[is_kept]
    return Window(offsets_kept, _exponents(volume, offsets_kept, sigma_mm), share, math.prod((2 * box + 1).tolist()))


def _nominal_steps(volume: Volume) -> Float64Array:
    """Return the steps along i, j, k in mm as columns; of uneven slices the mean step."""
    steps = np.array(volume.affine[:3, :3])
    if volume.uneven:
        origins = volume.slice_origins()
        steps[:, 2] = (origins[-1] - origins[0]) / (len(origins) - 1)
    return steps


def _squares(offsets: NDArray[np.int32], steps: Float64Array) -> Float64Array:
    places = offsets @ steps.T
    squares: Float64Array = np.einsum("ni,ni->n", places, places)
    return squares


def _box(volume: Volume, radius_mm: float, dimensions: int) -> NDArray[np.int64]:
    """Return half the size of the box of voxels that holds a ball, along i, j, k."""
    in_plane = volume.affine[:3, :2]
    if dimensions == 2:
        reach = np.append(np.linalg.norm(np.linalg.pinv(in_plane), axis=1), 0.0)
    else:
        along = np.diff(volume.slice_origins(), axis=0) if volume.uneven else volume.affine[None, :3, 2]
        layers = np.stack([np.column_stack([in_plane, step]) for step in along])
        reach = np.linalg.norm(np.linalg.inv(layers), axis=2).max(axis=0)
    # Rounding adds no voxels to a radius of whole steps.
    box: NDArray[np.int64] = np.ceil(np.minimum(radius_mm * reach, 1e6) - 1e-9).astype(np.int64)
    return box


def _exponents(volume: Volume, offsets: NDArray[np.int32], sigma_mm: float) -> Float64Array:
    per_square = -1.0 / (2.0 * math.log(2.0) * sigma_mm * sigma_mm)
    if not volume.uneven or not offsets[:, 2].any():
        return per_square * _squares(offsets, volume.affine[:3, :3])[None]
    border = int(offsets[:, 2].max())
    origins = volume.slice_origins(border)
    nk = volume.shape_ijk[2]
    exponents = np.empty((nk, len(offsets)))
    in_plane = offsets[:, :2] @ volume.affine[:3, :2].T
    for k in range(nk):
        steps = in_plane + (origins[k + border + offsets[:, 2]] - origins[k + border])
        exponents[k] = per_square * np.einsum("ni,ni->n", steps, steps)
    return exponents


def _nearest_rings(
    offsets: NDArray[np.int32], squares: Float64Array, candidates: NDArray[np.bool_], most_taps: int
) -> NDArray[np.bool_]:
    """Mark the nearest taps, in whole rings."""
    order = np.flatnonzero(candidates)
    order = order[np.argsort(squares[order], kind="stable")]
    sorted_squares = squares[order]
    is_next = np.diff(sorted_squares) > _SAME_RING * sorted_squares[1:]
    ends = np.append(np.flatnonzero(is_next) + 1, len(order))
    is_nearest = np.zeros(len(offsets), np.bool_)
    is_nearest[order[: ends[ends <= most_taps].max(initial=1)]] = True
    return is_nearest


NOISE_FACTOR = 3.0
"""Sigma of the differences over the noise, where it is not given."""

_TAPS = {2: 29, 3: 125}
"""Most taps by dimensions, where they are not given."""

_MOST_TAPS = 4096

LEAST_SHARE = 0.9
"""Share of the weight of the whole window below which a cut by the number of taps is warned of."""


@dataclass(frozen=True)
class BilateralSettings:
    """A filter of a volume; `rings` of voxels around those that may change sides: 1, or 2 where normals count."""

    sigma_mm: float
    sigma_hu: float
    dimensions: int
    near: float | None
    rings: int
    most_taps: int
    window: Window
    noise: Noise | None

    @classmethod
    def checked(
        cls,
        volume: Volume,
        sigma_mm: float | None,
        sigma_hu: float | None,
        dimensions: int,
        near: float | None,
        normals: bool,
        taps: int | None,
    ) -> BilateralSettings:
        """Check the parameters of `filter_bilateral`, and choose those that are not given."""
        if dimensions not in (2, 3) or isinstance(dimensions, bool):
            raise UsageError(f"a filter has 2 dimensions, slice by slice, or 3, not {dimensions!r}")
        most_taps = _checked_taps(taps, dimensions)
        if near is not None:
            near = checked_iso_value(near)
            inside_level(volume.voxels.dtype, near)
        _check_whole_numbers(volume)
        steps = volume.spacing[:dimensions]
        default = math.prod(steps) ** (1.0 / dimensions)
        sigma_mm = default if sigma_mm is None else checked_length("sigma_mm", sigma_mm, volume)
        noise = None
        if sigma_hu is None:
            noise = _measured_noise(volume)
            sigma_hu = NOISE_FACTOR * noise.hu
        sigma_hu = _positive("sigma_hu", sigma_hu, "a number of HU above 0")
        window = choose_window(volume, sigma_mm, dimensions, most_taps)
        if window.taps == 1:
            raise UsageError(
                f"taps={most_taps} leaves no neighbour in the window, whose nearest ring has more: allow more taps"
            )
        return cls(sigma_mm, sigma_hu, dimensions, near, 2 if normals else 1, most_taps, window, noise)

    @property
    def warnings(self) -> list[str]:
        """What a user should know of the window."""
        window = self.window
        if window.share >= LEAST_SHARE:
            return []
        return [
            f"the window of {window.taps:,} taps holds {100.0 * window.share:.0f} % of the weight that"
            f" sigma_mm={self.sigma_mm:.3g} gives to {window.whole_taps:,}: the filter smooths less far than asked for"
        ]

    def as_report(self) -> dict[str, Any]:
        reach = self.window.reach[: self.dimensions]
        return {
            "filter": "bilateral",
            "dimensions": self.dimensions,
            "sigma_mm": round(self.sigma_mm, 4),
            "sigma_hu": round(self.sigma_hu, 3),
            "noise_hu": None if self.noise is None else round(self.noise.hu, 3),
            "taps": self.window.taps,
            "window": [2 * n + 1 for n in reach],
            "whole_window_taps": self.window.whole_taps,
            "window_share": round(self.window.share, 4),
            "near_hu": self.near,
            "rings": None if self.near is None else self.rings,
        }


def inside_level(dtype: np.dtype[Any], near: float) -> Any:
    """Return the lowest value inside as a scalar of the voxels' type."""
    if dtype.kind == "f":
        return np.float32(near)
    limits, level = np.iinfo(dtype), math.ceil(near)
    if level > limits.max:
        raise NoSurfaceError(f"no voxel can lie near {near:g} HU: voxels are {dtype}, at most {limits.max}")
    return dtype.type(max(level, limits.min))


def _checked_taps(taps: int | None, dimensions: int) -> int:
    if taps is None:
        return _TAPS[dimensions]
    if isinstance(taps, bool) or not isinstance(taps, (int, np.integer)) or not 2 <= taps <= _MOST_TAPS:
        raise UsageError(f"taps are a whole number from 2 to {_MOST_TAPS:,}, not {taps!r}")
    return int(taps)


def _check_whole_numbers(volume: Volume) -> None:
    if volume.voxels.dtype != np.int32:
        return
    low, high = volume.hu_range or (0.0, 0.0)
    if max(-low, high) >= LARGEST_INTEGER:
        raise UsageError(
            f"the voxels run from {low:.0f} to {high:.0f}: integers from {LARGEST_INTEGER} on cannot be filtered"
            " exactly, rescale them or convert them to float32"
        )


def _positive(name: str, value: float, requirement: str) -> float:
    is_number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not is_number or not 0.0 < value < math.inf:
        raise UsageError(f"{name} is {requirement}, not {value!r}")
    return float(value)


def checked_length(name: str, value: float, volume: Volume) -> float:
    length = _positive(name, value, "a length in mm above 0")
    sides = [n * step for n, step in zip(volume.shape_ijk, volume.spacing, strict=True)]
    if length > max(sides):
        sides_text = " x ".join(f"{side:.4g}" for side in sides)
        raise UsageError(f"{name} is {length:g} mm, larger than the volume ({sides_text} mm)")
    return length


def _measured_noise(volume: Volume) -> Noise:
    try:
        noise = measure_noise(volume)
    except UsageError as error:
        raise UsageError(f"{error}: give sigma_hu=HU") from error
    if noise.hu == 0.0:
        raise UsageError("the soft tissue of the volume has no noise: give sigma_hu=HU")
    return noise


def report_filter(volume: Volume, voxels: NDArray[Any], facts: dict[str, Any], warnings: Sequence[str]) -> Volume:
    """Return a volume with filtered voxels, and one step more, in plain JSON types, in ``report["filtered"]``."""
    filtered = volume.with_voxels(voxels)
    steps = (filtered.report.get("filtered") or {}).get("steps", [])
    known = list(filtered.report.get("warnings", []))
    filtered.report = amend(filtered.report, filtered={"steps": [*steps, facts]}, warnings=[*known, *warnings])
    return filtered


def finish_result(
    resident: DeviceVolume,
    voxels: NDArray[Any],
    voxels_d: Any,
    facts: dict[str, Any],
    warnings: Sequence[str],
    *,
    keep: bool,
) -> Volume | DeviceVolume:
    """Return the filtered volume, see `report_filter`; with `keep` on the device, where `voxels_d` may be it."""
    filtered = report_filter(resident.volume, voxels, facts, warnings)
    return resident.follow(filtered, voxels_d) if keep else filtered
