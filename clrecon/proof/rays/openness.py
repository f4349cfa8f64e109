"""Twin of cl/rays/openness.cl: the openness of a volume in plain numpy, in float32, to the bits of the kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.views.camera import box_corners
from clrecon.rendering.views.clip import Clip

_WHOLE, _FREE = np.float32(100.0), np.float32(0.75)
_WEIGHTS = {1: 1.0 / 21.0, 2: 4.0 / 105.0, 3: 9.0 / 280.0}
"""Of Lebedev's quadrature of 26 points, by the coordinates that are not 0."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """Voxels of a cell along i, j, k, and cells along k, j, i; sides of a cell, and the reach of what hides, in mm."""

    voxels: NDArray[np.int64]
    shape: tuple[int, int, int]
    sides_mm: Float64Array
    reach_mm: float

    @classmethod
    def of(cls, volume: Volume) -> _Grid:
        diagonal = float(np.linalg.norm(np.ptp(box_corners(volume), axis=0)))
        lengths, spacing = np.maximum(volume.shape_ijk, 2), np.array(volume.spacing)
        voxels = np.clip(np.ceil(diagonal / 300.0 / spacing).astype(np.int64), 1, lengths // 2)
        gi, gj, gk = np.ceil(lengths / voxels).astype(int).tolist()
        return cls(voxels, (gk, gj, gi), voxels * spacing, 0.05 * diagonal)


def cell_length(volume: Volume) -> float:
    """Return the mm over which the opacity of a cell counts."""
    return float(np.cbrt(np.prod(_Grid.of(volume).sides_mm)))


class OpenPlaces:
    """The openness of places: `opacity` is that of each voxel, (nk, nj, ni) float32, over the length of a cell."""

    def __init__(self, volume: Volume, opacity: NDArray[np.float32], clip: Clip | None = None):
        self.cells = _Grid.of(volume)
        density = _find_density(opacity, self.cells)
        if clip is not None:
            density = np.where(self._find_shown(volume, clip), density, np.float32(0.0))
        self.grid = _find_most(_sweep_light(density, self.cells))

    def _find_shown(self, volume: Volume, clip: Clip) -> NDArray[np.bool_]:
        """Return which cells have their middle within clip planes."""
        k, j, i = np.indices(self.cells.shape)
        middles = (np.stack([i, j, k], axis=-1) + 0.5) * self.cells.voxels - 0.5
        points = volume.ijk_to_lps(middles.reshape(-1, 3))
        shown = (points @ clip.planes[:, :3].T >= clip.planes[:, 3]).all(axis=1)
        return np.asarray(shown.reshape(i.shape))

    def shares(self, ijk: Float64Array) -> Float64Array:
        """Return the share of the light that reaches places, index coordinates (n, 3): 0 to 1."""
        from scipy import ndimage

        places = (ijk + 0.5) / self.cells.voxels - 0.5
        light = ndimage.map_coordinates(self.grid.astype(np.float64), places[:, ::-1].T, order=1, mode="nearest")
        return np.asarray(light / float(_WHOLE))


def _find_density(opacity: NDArray[np.float32], cells: _Grid) -> NDArray[np.float32]:
    """Return the mean opacity of the voxels of each cell, of those that there are."""
    lengths = cells.shape * cells.voxels[::-1]
    wide = [np.repeat(np.arange(n), 2 if n == 1 else 1) for n in opacity.shape]  # an axis of one voxel is doubled
    whole = opacity[np.ix_(*wide)]
    pads = [(0, length - n) for length, n in zip(lengths, whole.shape, strict=True)]
    voxels, exist = np.pad(whole, pads), np.pad(np.ones(whole.shape, np.float32), pads)
    total, count = np.zeros(cells.shape, np.float32), np.zeros(cells.shape, np.float32)
    ci, cj, ck = cells.voxels
    for k, j, i in product(range(ck), range(cj), range(ci)):
        total += voxels[k::ck, j::cj, i::ci]
        count += exist[k::ck, j::cj, i::ci]
    return np.asarray(total / count, np.float32)


def _sweep_light(density: NDArray[np.float32], cells: _Grid) -> NDArray[np.float32]:
    """Return the share of the light from all directions that reaches each cell."""
    reaching = np.zeros(density.shape, np.float32)
    dense = np.pad(density, 1)
    for direction in product((-1, 0, 1), repeat=3):
        if not any(direction):
            continue
        step_mm = float(np.linalg.norm(direction * cells.sides_mm[::-1]))
        keep = np.float32(np.exp(-step_mm / cells.reach_mm))
        hidden = np.zeros(dense.shape, np.float32)
        axis = next(number for number, step in enumerate(direction) if step)
        layers = range(density.shape[axis], 0, -1) if direction[axis] > 0 else range(1, density.shape[axis] + 1)
        inner = [slice(1, -1)] * 3
        towards = [slice(1 + step, step + n - 1) for step, n in zip(direction, dense.shape, strict=True)]
        for layer in layers:
            here = tuple(layer if number == axis else part for number, part in enumerate(inner))
            before = tuple(layer + direction[axis] if n == axis else part for n, part in enumerate(towards))
            hidden[here] = keep * (dense[before] + (np.float32(1.0) - dense[before]) * hidden[before])
        weight = np.float32(_WEIGHTS[sum(map(abs, direction))])
        reaching += weight * (np.float32(1.0) - hidden[1:-1, 1:-1, 1:-1])
    return reaching


def _find_most(reaching: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the square of the most of a cell and those around it, as whole numbers up to `_WHOLE` in the open."""
    wide = np.pad(reaching, 1)
    k, j, i = reaching.shape
    most = np.max([wide[a : a + k, b : b + j, c : c + i] for a, b, c in product(range(3), repeat=3)], axis=0)
    share = np.minimum(most / _FREE, np.float32(1.0))
    return np.floor(_WHOLE * share * share + np.float32(0.5))


def open_volume(
    volume: Volume, opacity: Callable[[NDArray], NDArray], share: float, clip: Clip | None
) -> Callable[[Float64Array], Float64Array]:
    """Return what tells the light that is left at places (n, 3) of index coordinates."""
    if share == 0.0:
        return lambda ijk: np.ones(len(ijk))
    places = OpenPlaces(volume, opacity(volume.voxels).astype(np.float32), clip)
    return lambda ijk: 1.0 - share * (1.0 - places.shares(ijk))
