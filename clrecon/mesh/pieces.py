"""The components of a surface by their size: measures of each, and the list that a page shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.content import Pieces
from clrecon.mesh.connectivity import label_components
from clrecon.mesh.triangles import cross_products
from clrecon.system.pieces import CHUNK, local_origin


def find_pieces(vertices: NDArray[np.floating], triangles: NDArray[np.uint32], most: int) -> Pieces:
    """Divide a surface into its components of largest area, and one part of all others.

    vertices: ndarray, shape (n, 3). mm.
    triangles: ndarray, shape (m, 3), uint32
    most: Components that are parts of their own.  1: the surface is one part, whatever its components.

    Returns: The largest area first.  The volume of an open component is measured as if its rim were joined to the mean
        of its corners; that of all others together is the sum, regardless of sign.
    """
    if most == 1:
        whole = np.zeros(len(triangles), dtype=np.int64)
        _, volumes = measure_components(vertices, triangles, whole, 1, areas=False, volumes=True)
        return Pieces(whole, ("",), (float(volumes[0]),))
    count, labels = label_components(triangles, len(vertices))
    of_triangle = labels[triangles[:, 0]]
    areas, volumes = measure_components(vertices, triangles, of_triangle, count, areas=True, volumes=True)
    ranked = np.argsort(-areas, kind="stable")
    rank = np.empty(count, dtype=np.int64)
    rank[ranked] = np.minimum(np.arange(count), most)
    names = [f"part {number}" for number in range(1, min(count, most) + 1)] if count > 1 else [""]
    sizes = [float(value) for value in volumes[ranked[:most]]]
    if count > most:
        names.append("1 smaller part" if count == most + 1 else f"{count - most:,} smaller parts")
        sizes.append(float(volumes[ranked[most:]].sum()))
    return Pieces(rank[of_triangle], tuple(names), tuple(sizes))


def measure_components(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    label_of_triangle: NDArray[np.int64],
    count: int,
    *,
    areas: bool,
    volumes: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure area in mm2 and enclosed volume in ml, without sign, of each component; zeros where not wanted."""
    twice_area = np.zeros(count)
    six_volumes = np.zeros(count)
    cross_sum = np.zeros((3, count))
    corner_sum = np.zeros((3, count))
    if not areas and not volumes:
        return twice_area, six_volumes
    # Every piece adds to all components: with many components, larger pieces save time.
    size = max(CHUNK, count)
    for where, corner, cross in cross_products(vertices, triangles, local_origin(vertices), size):
        label = label_of_triangle[where]
        if areas:
            twice_area += np.bincount(label, np.sqrt(np.einsum("ij,ij->j", cross, cross)), count)
        if volumes:
            six_volumes += np.bincount(label, np.einsum("ij,ij->j", corner, cross), count)
            for axis in range(3):
                cross_sum[axis] += np.bincount(label, cross[axis], count)
                corner_sum[axis] += np.bincount(label, corner[axis], count)
    # From the common origin to one within each component.  This changes nothing for closed components, whose cross
    # products sum to zero.
    centre = corner_sum / np.bincount(label_of_triangle, minlength=count)
    six_volumes -= np.einsum("ij,ij->j", centre, cross_sum)
    return twice_area / 2.0, np.abs(six_volumes) / 6000.0
