"""Surfaces of bone as others make them, for `measure_levels.py`: a fixed level, Otsu's, and 50 % at each vertex.

References
----------
Otsu 1979, "A threshold selection method from gray-level histograms", IEEE Trans. Syst. Man Cybern. 9, 62-66.
Spoor, Zonneveld and Macho 1993, "Linear measurements of cortical bone and dental enamel by computed tomography", Am. J.
Phys. Anthropol. 91, 469-484 (the half-maximum height of each profile).
"""

from __future__ import annotations

import numpy as np
from compare_iso_values import by_otsu
from level_phantoms import REACH_MM
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.mesh import Mesh

PEER_LEVELS = {"226 HU": lambda volume: 226.0, "Otsu": by_otsu}
"""Levels of other programs: the preset of InVesalius; Otsu's upper level of three classes (two part air and body)."""

_SAMPLE_MM = 0.1
_PIECE = 50_000


def move_to_half_heights(mesh: Mesh, volume: Volume, scale: float = 1.0) -> NDArray[np.float32]:
    """Return the vertices of a surface moved along their normals to half the height of their own profiles.

    The height is that of the highest value within `REACH_MM` inwards over the lowest within as much outwards.  Of the
    places where a profile falls below its half, the nearest is taken; vertices without one stay.

    scale: What lengths are multiplied by.
    """
    from scipy.ndimage import map_coordinates

    assert mesh.normals is not None
    steps = int(np.ceil(REACH_MM / _SAMPLE_MM))
    way = scale * _SAMPLE_MM * np.arange(-steps, steps + 1)
    inverse = np.linalg.inv(volume.affine)
    voxels = volume.voxels.astype(np.float32)
    moved = mesh.vertices.astype(np.float32)
    for begin in range(0, len(moved), _PIECE):
        rows = slice(begin, begin + _PIECE)
        along = mesh.vertices[rows, None] + way[:, None] * mesh.normals[rows, None]
        kji = (along.reshape(-1, 3) @ inverse[:3, :3].T + inverse[:3, 3])[:, ::-1].T
        values = map_coordinates(voxels, kji, order=1, mode="nearest").reshape(-1, len(way))
        half = 0.5 * (values[:, : steps + 1].max(axis=1) + values[:, steps:].min(axis=1))
        high, low = values[:, :-1], values[:, 1:]
        falls = (high >= half[:, None]) & (low < half[:, None])
        share = np.where(falls, (high - half[:, None]) / np.where(falls, high - low, 1.0), 0.0)
        places = np.where(falls, way[:-1] + (way[1] - way[0]) * share, np.inf)
        nearest = places[np.arange(len(places)), np.abs(places).argmin(axis=1)]
        shift = np.where(np.isfinite(nearest), nearest, 0.0)
        moved[rows] += (shift[:, None] * mesh.normals[rows]).astype(np.float32)
    return moved
