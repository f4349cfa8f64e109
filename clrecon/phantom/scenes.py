"""Scenes: bodies made of many parts, each of one material, drawn in HU, with a material label for every voxel.

The parts are painted in order, later ones over earlier ones, in mm about the centre of the volume.  Axes are the
patient's: x to the left, y to the posterior, z to the superior.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import column_spacing
from clrecon.phantom.fields import Field, coverage
from clrecon.phantom.placing import Piece, PlacedPiece, Window, paint
from clrecon.phantom.settings import CENTRE_LPS_MM, PhantomSettings
from clrecon.system.progress import Progress

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
LabelArray = NDArray[np.uint8]
Point = tuple[float, float, float]

MATERIALS = ("air", "tissue", "bone", "contrast", "metal", "water", "table")
"""Materials of the parts; the label of a voxel is the index in this tuple."""

AIR_HU = -1000.0
CEILING_HU = 3071
"""Highest value of 12 stored bits with the intercept -1024; metal is cut off there."""
DENSE_HU = 300.0
"""Voxels above this are counted for each material."""


@dataclass(frozen=True)
class Part:
    """One solid of one material.

    material: One of `MATERIALS`.
    distance: Takes x, y, z (float32, mm in the part's own frame) and gives the distance to the surface in mm, positive
        inside.
    low, high: (x, y, z). Box that holds the part, in its own frame, mm.
    center: (x, y, z). Origin of the frame of the part, mm about the centre of the volume.
    axes: ndarray, shape (3, 3). Rows are the directions of that frame.
    """

    material: str
    hu: float
    distance: Callable[[Field, Field, Field], Field]
    low: Point
    high: Point
    center: Point = (0.0, 0.0, 0.0)
    axes: Float64Array = field(default_factory=lambda: np.eye(3))

    def distance_at(self, x: Field, y: Field, z: Field) -> Field:
        """Return the distance to the surface at points in mm about the centre of the volume."""
        from_center = [at - np.float32(origin) for at, origin in zip((x, y, z), self.center, strict=True)]
        local = (sum(np.float32(c) * at for c, at in zip(axis, from_center, strict=True)) for axis in self.axes)
        return np.asarray(self.distance(*local), dtype=np.float32)


@dataclass(frozen=True)
class Plan:
    """The parts of a body in order, with the y of its front and back surfaces, against which a table may lie.

    `rest` is the middle (x, z) of the head, for a head rest.
    """

    parts: Sequence[Part]
    front: float
    back: float
    rest: tuple[float, float] = (0.0, 0.0)


def draw_scene(
    parts: Sequence[Part], settings: PhantomSettings, affine: Float64Array, progress: Progress | None = None
) -> tuple[Float32Array, LabelArray]:
    """Draw the parts without point spread and noise.

    Every interface is a linear ramp of about one voxel.  Thick slices are averaged from thin ones.

    parts: In the order of painting.
    affine: ndarray, shape (4, 4). Index (i, j, k) to LPS mm.
    progress: Called as ``progress("draw", done, slices)``.

    Returns:
    voxels: ndarray, shape (nk, nj, ni), float32. HU.
    labels: ndarray, shape (nk, nj, ni), uint8. Index in `MATERIALS` of the part that holds the centre of each voxel.
    """
    shape = settings.shape_kji
    grid = affine.copy()
    grid[:3, 3] -= CENTRE_LPS_MM
    di, dj, dk = column_spacing(affine)
    subslices = int(np.clip(round(dk / math.sqrt(di * dj)), 1, 4))
    ramp = (di * dj * dk / subslices) ** (1.0 / 3.0)
    margin = np.full(3, 2.0 * ramp + float(np.linalg.norm(grid[:3, :3], axis=0).max()))
    placed = [
        PlacedPiece(Piece(np.array(p.center), p.axes, p.low - margin, p.high + margin), grid, shape) for p in parts
    ]
    voxels, labels = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.uint8)
    offsets = (np.arange(subslices) + 0.5) / subslices - 0.5
    for k in range(shape[0]):
        met = [(part, piece) for part, piece in zip(parts, placed, strict=True) if piece.meets(k)]
        for offset in offsets:
            canvas = np.full(shape[1:], AIR_HU, dtype=np.float32)
            for part, piece in met:
                at = piece.window(k + offset)
                paint(canvas, at.region, coverage(_distance(part, at), ramp), part.hu)
            voxels[k] += canvas
        voxels[k] /= np.float32(subslices)
        for part, piece in met:
            at = piece.window(float(k))
            labels[k][at.region][_distance(part, at) >= 0.0] = MATERIALS.index(part.material)
        if progress is not None:
            progress("draw", k + 1, shape[0])
    return voxels, labels


def _distance(part: Part, at: Window) -> Field:
    return np.asarray(part.distance(at.x, at.y, at.z), dtype=np.float32)


def describe_parts(voxels: NDArray[np.int16], labels: LabelArray, affine: Float64Array) -> dict[str, dict[str, float]]:
    """Describe each material that is present: its label, voxels, volume and number of dense voxels."""
    voxel_ml = abs(float(np.linalg.det(affine[:3, :3]))) / 1000.0
    found = {}
    for label, material in enumerate(MATERIALS):
        mask = labels == label
        if count := int(np.count_nonzero(mask)):
            found[material] = {
                "label": label,
                "voxels": count,
                "volume_ml": round(count * voxel_ml, 3),
                "voxels_above_300_hu": int(np.count_nonzero(voxels[mask] > DENSE_HU)),
            }
    return found
