"""Selection of the components of a surface, together or one by one; small crumbs are dropped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.coordinates import rounding_step
from clrecon.mesh.base import BaseMesh, give_values
from clrecon.mesh.connectivity import label_components, number_used
from clrecon.mesh.quality import measure_components
from clrecon.mesh.triangles import find_nearest_triangle
from clrecon.system.arguments import as_numbers, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.text import count_of, format_digits

Own = TypeVar("Own", bound=BaseMesh)

Labelled = tuple[int, NDArray[np.int64]]
"""The result of `label_components`: the number of components, and the component of each vertex."""


Seeds = Sequence[Sequence[float]] | Sequence[float]
"""Points in LPS mm, or one."""

SEED_REACH_MM = 20.0
"""Largest distance of a seed from a surface; the middle of a lumbar vertebral body lies 15 mm from its wall."""


_CRUMB_ML = 0.1
"""Components below this volume are counted where there are too many."""

_ROUNDING_OF_AREA = 4.0
"""Two components have equal area when they differ by less than this factor times the rounding step of the coordinates
times the square root of the area; rounding changes it by 0.3 of that product, by 1 where triangles are long and thin.
"""


@dataclass(frozen=True)
class _Chosen:
    """Components of a mesh, and which of them are kept.

    label_of_vertex, label_of_triangle: Number of the component; -1 for vertices that no triangle uses.
    ranked: Components from the largest area to the smallest, see `_rank_areas`; in their own order if no rank was asked
        for.
    keep: ndarray, shape (count,), bool
    facts: Entries for the report of the result.
    """

    label_of_vertex: NDArray[np.int64]
    label_of_triangle: NDArray[np.int64]
    ranked: NDArray[np.int64]
    keep: NDArray[np.bool_]
    facts: dict[str, object]


def select_components(
    mesh: Own,
    keep_largest: int | None = None,
    min_volume_ml: float | None = None,
    *,
    seeds: Seeds = (),
    labelled: Labelled | None = None,
    among: NDArray[np.bool_] | None = None,
) -> Own:
    """Keep the largest components of a surface, or those at given points; the mesh itself when nothing is dropped.

    First, small components are dropped, then those that are not nearest to a seed, then all but the largest of the
    rest. Components are ranked by area, not by volume: a part that is open at the border of the scan encloses nothing,
    and the wall of a cavity has a negative volume; where it is dropped, the cavity is filled.

    keep_largest: This many of largest area; of equal ones, within rounding, the first in the mesh.
    min_volume_ml: Enclosed, regardless of sign; of an open one as if its rim were joined to the mean of its corners.
    seeds: sequence of (x, y, z). The components whose surface lies nearest to one of these points, LPS mm.
    labelled: (int, ndarray). Result of `label_components` for this mesh, if it is already known.
    among: ndarray, shape (count,), bool. True for components of `labelled` that may be kept.

    Returns: A mesh whose report has ``components_found`` and ``components_kept``, and with seeds
        ``seed_distances_mm``: how far the surface lies from each.
    """
    chosen = _choose_components(mesh, keep_largest, min_volume_ml, seeds, labelled, among)
    if chosen.keep.all():
        mesh.report.update(chosen.facts)
        return mesh
    selected = keep_triangles(mesh, chosen.keep[chosen.label_of_triangle])
    selected.report.update(chosen.facts)
    return selected


def keep_triangles(mesh: Own, is_kept: NDArray[np.bool_]) -> Own:
    used, triangles = number_used(mesh.triangles[is_kept], mesh.vertex_count)
    normals = None if mesh.normals is None else mesh.normals[used]
    reduced = type(mesh)(mesh.vertices[used], triangles, normals, dict(mesh.report), trusted=True)
    return give_values(mesh, reduced, used, is_kept)


def split_components(
    mesh: Own,
    keep_largest: int | None = None,
    min_volume_ml: float | None = None,
    *,
    seeds: Seeds = (),
    labelled: Labelled | None = None,
    among: NDArray[np.bool_] | None = None,
    most: int | None = None,
) -> list[Own]:
    """Split a surface into components, the largest area first; see `select_components`; over `most` are refused."""
    chosen = _choose_components(mesh, keep_largest, min_volume_ml, seeds, labelled, among, rank=True)
    kept = np.flatnonzero(chosen.keep)
    if most is not None and len(kept) > most:
        _, volumes = measure_components(
            mesh.vertices, mesh.triangles, chosen.label_of_triangle, len(chosen.keep), areas=False, volumes=True
        )
        small = int(np.count_nonzero(volumes[kept] < _CRUMB_ML))
        least = name_parameter("min_volume_ml", _CRUMB_ML if small < len(kept) else "ML")
        raise UsageError(
            f"the surface has {len(kept):,} components, {small:,} of them below {_CRUMB_ML:g} ml; at most {most:,} are"
            f" written one by one: leave the small ones out ({least},"
            f" {name_parameter('keep_largest', 'N')})"
        )
    rank = np.full(len(chosen.keep) + 1, len(kept))  # the last entry is for unused vertices, whose label is -1
    rank[chosen.ranked[chosen.keep[chosen.ranked]]] = np.arange(len(kept))
    vertex_order, vertex_ends = _group(rank[chosen.label_of_vertex], len(kept))
    triangle_order, triangle_ends = _group(rank[chosen.label_of_triangle], len(kept))
    number = np.empty(mesh.vertex_count, dtype=np.int64)
    number[vertex_order] = np.arange(mesh.vertex_count)
    parts = []
    for part in range(len(kept)):
        used = vertex_order[vertex_ends[part] : vertex_ends[part + 1]]
        faces = triangle_order[triangle_ends[part] : triangle_ends[part + 1]]
        triangles = (number[mesh.triangles[faces]] - vertex_ends[part]).astype(np.uint32)
        normals = None if mesh.normals is None else mesh.normals[used]
        piece = type(mesh)(mesh.vertices[used], triangles, normals, {**mesh.report, **chosen.facts})
        parts.append(give_values(mesh, piece, used, faces))
    return parts


def _group(ranks: NDArray[np.int64], count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the stable order by rank, and the index in it at which each rank from 0 to `count` begins."""
    order = np.argsort(ranks, kind="stable")
    return order, np.searchsorted(ranks[order], np.arange(count + 1))


def _choose_components(
    mesh: BaseMesh,
    keep_largest: int | None,
    min_volume_ml: float | None,
    seeds: Seeds,
    labelled: Labelled | None,
    among: NDArray[np.bool_] | None = None,
    *,
    rank: bool = False,
) -> _Chosen:
    """Find the components and decide which are kept; areas are measured only if the decision or `rank` needs them."""
    if keep_largest is not None and (isinstance(keep_largest, float) or keep_largest < 1):
        raise UsageError(f"keep_largest is a whole number from 1, not {keep_largest}")
    if min_volume_ml is not None and not (math.isfinite(min_volume_ml) and min_volume_ml >= 0):
        raise UsageError(f"min_volume_ml is a volume in ml from 0, not {min_volume_ml}")
    mesh.check()
    if mesh.triangle_count == 0:
        raise NoSurfaceError("the surface is empty: there is no component to keep")

    count, labels = label_components(mesh.triangles, mesh.vertex_count) if labelled is None else labelled
    label_of_triangle = labels[mesh.triangles[:, 0]]
    areas, volumes = measure_components(
        mesh.vertices,
        mesh.triangles,
        label_of_triangle,
        count,
        areas=rank or keep_largest is not None or min_volume_ml is not None,
        volumes=min_volume_ml is not None,
    )
    ranked = _rank_areas(areas, rounding_step(mesh.vertices)) if rank or keep_largest is not None else np.arange(count)
    keep = np.ones(count, dtype=bool) if among is None else np.array(among, dtype=bool)
    if min_volume_ml is not None:
        # Rounding moves a vertex by at most half a step along each axis, and so changes the volume by at most the area
        # times that distance: a component of exactly the least volume is kept wherever it lies.
        rounding_mm = 0.5 * math.sqrt(3.0) * rounding_step(mesh.vertices)
        candidates = keep.copy()
        keep &= volumes + rounding_mm * areas / 1000.0 >= min_volume_ml
        if not keep.any():
            raise NoSurfaceError(
                f"none of {count_of(int(np.count_nonzero(candidates)), 'component')} encloses {min_volume_ml:g} ml: "
                f"the largest has {format_digits(volumes[candidates].max(initial=0.0), 4)} ml, ask for less"
            )
    facts: dict[str, object] = {}
    if len(seeds):
        keep, facts["seed_distances_mm"] = _find_at_seeds(mesh, label_of_triangle, keep, seeds)
    if keep_largest is not None:
        keep[ranked[keep[ranked]][keep_largest:]] = False
    facts.update(components_found=count, components_kept=int(np.count_nonzero(keep)))
    return _Chosen(labels, label_of_triangle, ranked, keep, facts)


def _rank_areas(areas: NDArray[np.float64], step: float) -> NDArray[np.int64]:
    """Components from the largest area to the smallest, those equal within rounding in their own order."""
    ranked = np.argsort(-areas, kind="stable")
    falling = areas[ranked]
    least = falling - _ROUNDING_OF_AREA * step * np.sqrt(falling)
    ends: list[int] = np.searchsorted(-falling, -least, side="right").tolist()
    first = 0
    while first < len(ranked):
        end = ends[first]
        if end > first + 1:
            ranked[first:end] = np.sort(ranked[first:end])
        first = end
    return ranked


def _find_at_seeds(
    mesh: BaseMesh, label_of_triangle: NDArray[np.int64], keep: NDArray[np.bool_], seeds: Seeds
) -> tuple[NDArray[np.bool_], list[float]]:
    """Find the components of `keep` that are nearest to a seed, and the distance of each seed from its component."""
    rows = np.flatnonzero(keep[label_of_triangle])
    triangles = mesh.triangles if len(rows) == mesh.triangle_count else mesh.triangles[rows]
    has_seed = np.zeros_like(keep)
    distances = []
    for seed in seeds if np.ndim(seeds[0]) else [seeds]:
        point = as_numbers("seeds", seed)
        if point.shape != (3,) or not np.isfinite(point).all():
            raise UsageError(f"a seed is a point of three numbers in mm, not {seed}")
        row, distance = find_nearest_triangle(mesh.vertices, triangles, point)
        if distance > SEED_REACH_MM:
            position = ", ".join(f"{value:g}" for value in point)
            raise UsageError(
                f"the seed at LPS ({position}) mm lies {distance:.1f} mm from the nearest component, at most"
                f" {SEED_REACH_MM:g} mm are allowed: check its coordinates and their frame, LPS or RAS"
            )
        has_seed[label_of_triangle[rows[row]]] = True
        distances.append(distance)
    return has_seed, distances
