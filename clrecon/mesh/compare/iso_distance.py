"""Distance of a mesh from the trilinear iso surface of the voxels that it was made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import METAL_HU, Volume
from clrecon.geometry.iso_rule import IsoRule, layer_normal_matrices
from clrecon.mesh.compare.distances import DistanceSummary, summarise_distances
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.quality import measure_triangles
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import chunks
from clrecon.system.records import Record

SAMPLES = 100_000
"""Most points; larger meshes are measured at every n-th vertex and triangle."""

_METAL_REACH = 2
"""Voxels: at metal a level of bone lies in the outermost ones; the surface is a staircase, which smoothing leaves."""

_AT_A_CORNER = 1.0 / 12.0
"""Share of the area of a triangle at each corner, the rest at its centre: exact where the distance is quadratic."""

_STEPS = 12
_ON_THE_SURFACE = 1e-3
"""A point is found when a last step would move it by at most this, in mm."""

_LINE_STEPS = 16
"""Number of parts of the line to a voxel on the other side of the level."""

_PIECE = 1 << 13
_CORNERS = [(corner & 1, corner >> 1 & 1, corner >> 2) for corner in range(8)]

Float64Array = NDArray[np.float64]


def smallest_voxel_mm(volume: Volume) -> float:
    """Return the shortest of the three voxel steps: the unit of every bound that is given in voxels."""
    return float(min(volume.spacing))


def rule_of_report(report: dict[str, Any]) -> IsoRule | None:
    """Return the iso rule of a mesh by its report, as far as distances need it; None where it is no iso surface."""
    ends = report.get("inside_levels_hu") or [report.get("iso_level_hu")]
    levels = [float(level) for level in ends if level is not None]
    closed = bool(report.get("closed_at_border", False))
    if not levels or (closed and report.get("outside_hu") is None):
        return None
    outside = float(report["outside_hu"]) if closed else 0.0
    upper = levels[1] if len(levels) > 1 else None
    return IsoRule(levels[0], levels[0], levels[0], outside, closed, upper_level=upper)


class _Voxels:
    """The voxels around places, i, j, k whole, (3, n), up to some steps away; beyond a closed border `outside`."""

    def __init__(self, volume: Volume, rule: IsoRule, ijk: NDArray[np.int64], steps: range):
        self._values = volume.voxels.reshape(-1)
        self._first, self._outside = steps.start, rule.outside
        self._offsets: list[list[NDArray[np.int64]]] = []
        self._beyond: list[list[NDArray[np.bool_] | None]] = []
        stride = 1
        for numbers, count in zip(ijk, volume.shape_ijk, strict=True):
            places = [numbers + step for step in steps]
            marks: list[NDArray[np.bool_] | None] = [None] * len(steps)
            if len(numbers) and (numbers.min() + steps.start < 0 or numbers.max() + steps.stop > count):
                within = [np.clip(place, 0, count - 1) for place in places]
                if rule.closed:
                    marks = [one != other for one, other in zip(within, places, strict=True)]
                places = within
            self._beyond.append(marks)
            self._offsets.append([place * stride for place in places])
            stride *= count

    def at(self, step: Sequence[int]) -> Float64Array:
        """Return the voxels so many steps along i, j and k from the places, shape (n,)."""
        i, j, k = (own[at - self._first] for own, at in zip(self._offsets, step, strict=True))
        values = self._values.take(i + j + k).astype(np.float64)
        for tables, index in zip(self._beyond, step, strict=True):
            marks = tables[index - self._first]
            if marks is not None:
                values[marks] = self._outside
        return values


def trilinear_field(volume: Volume, rule: IsoRule, ijk: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return value, HU, and gradient, HU per step along i, j, k, of the trilinear field at index coordinates (n, 3).

    Beyond the border of a closed volume the value is `outside` of the rule; for an open one, points there are moved to
    it.
    """
    cell, shares = _split_cells(volume, rule, ijk.T)
    voxels, (x, y, z) = _Voxels(volume, rule, cell, range(2)), ((1.0 - share, share) for share in shares)
    xy, yz, zx = ([[own * other for other in second] for own in first] for first, second in ((x, y), (y, z), (z, x)))
    value, gradient = np.zeros(len(ijk)), np.zeros(shares.shape)
    part = np.empty_like(value)
    for i, j, k in _CORNERS:
        sample = voxels.at((i, j, k))
        np.multiply(xy[i][j], z[k], out=part)
        part *= sample
        value += part
        for along, is_upper, others in zip(gradient, (i, j, k), (yz[j][k], zx[k][i], xy[i][j]), strict=True):
            np.multiply(sample, others, out=part)
            (np.add if is_upper else np.subtract)(along, part, out=along)
    return value, gradient.T


def trilinear_values(volume: Volume, rule: IsoRule, ijk: Float64Array) -> Float64Array:
    """Return only the values of `trilinear_field`, in less time."""
    cell, shares = _split_cells(volume, rule, ijk.T)
    voxels, (x, y, z) = _Voxels(volume, rule, cell, range(2)), ((1.0 - share, share) for share in shares)
    value = np.zeros(len(ijk))
    for i, j, k in _CORNERS:
        value += voxels.at((i, j, k)) * (x[i] * y[j] * z[k])
    return value


def _split_cells(volume: Volume, rule: IsoRule, ijk: Float64Array) -> tuple[NDArray[np.int64], Float64Array]:
    """Return the lowest corner of each point's cell, and the position of the point in it, all (3, n)."""
    low = -rule.border
    cell, within = np.empty(ijk.shape, np.int64), np.empty(ijk.shape)
    for floors, shares, numbers, count in zip(cell, within, ijk, volume.shape_ijk, strict=True):
        np.clip(numbers, low, count - 1 + rule.border, out=shares)
        np.clip(np.floor(shares), low, max(count - 2 + rule.border, low), out=floors, casting="unsafe")
    within -= cell
    return cell, within


def distances_to_iso_surface(volume: Volume, rule: IsoRule, points: Float64Array) -> Float64Array:
    """Measure the distances of points from a near trilinear iso surface, by Newton steps along the gradient.

    The surface of a range consists of the surfaces of both ends: the nearer one counts.
    Where the field is flat, or steps alternate across a crease, the surface is searched along lines to the surrounding
    voxels.  A step is residual over gradient, at most half a voxel long, in mm through the affine of the slice, so it
    is also correct for sheared and unevenly spaced stacks.  The result is the distance to a point of the surface: never
    less than the true distance, and equal to it where the surface is smooth.

    points: ndarray, shape (n, 3), float64, LPS mm
    Returns: ndarray, shape (n,), mm. NaN where no surface was found.
    """
    distances = _distances_to_level(volume, rule, rule.iso_level, points)
    for level in rule.levels[1:]:
        distances = np.fmin(distances, _distances_to_level(volume, rule, level, points))
    lost = np.flatnonzero(np.isnan(distances))
    for level in rule.levels:
        distances[lost] = np.fmin(distances[lost], _distances_along_lines(volume, rule, level, points[lost]))
    return distances


def _distances_to_level(volume: Volume, rule: IsoRule, level: float, points: Float64Array) -> Float64Array:
    matrices = np.asarray(layer_normal_matrices(volume, rule.border)).transpose(1, 2, 0)
    longest = 0.5 * smallest_voxel_mm(volume)
    distances = np.full(len(points), np.nan)

    def take_step(going: NDArray[np.int64], here: Float64Array) -> tuple[NDArray[np.int64], Float64Array]:
        """Move points, (3, n), towards the surface; return those that have not reached it, and where they are."""
        # Beyond the border the field does not change: a step from there would begin at the border all the same.
        ijk = np.add(*_split_cells(volume, rule, volume.lps_to_ijk(np.ascontiguousarray(here.T)).T))
        position = np.ascontiguousarray(volume.ijk_to_lps(ijk.T).T)
        value, per_step = trilinear_field(volume, rule, ijk.T)
        slices: Any = slice(1)
        if volume.uneven:
            slices = np.clip(np.floor(ijk[2]).astype(np.int64) + rule.border, 0, matrices.shape[2] - 1)
        rows = matrices[:, :, slices]
        gradient = rows[:, 0] * per_step[:, 0] + rows[:, 1] * per_step[:, 1] + rows[:, 2] * per_step[:, 2]
        square = gradient[0] ** 2 + gradient[2] ** 2 + gradient[1] ** 2
        if not square.all():  # a point of a flat field has no way
            uphill = square > 0.0
            going, square = going[uphill], square[uphill]
            value = value[uphill]
            position, gradient = position.compress(uphill, axis=1), gradient.compress(uphill, axis=1)
        step = (level - value) / square * gradient
        length = _lengths(step)
        step *= np.minimum(1.0, longest / np.maximum(length, longest))
        position += step
        there = length <= _ON_THE_SURFACE
        reached = going[there]
        distances[reached] = _lengths(position.compress(there, axis=1) - points.take(reached, axis=0).T)
        return going[~there], position.compress(~there, axis=1)

    going, here = np.arange(len(points)), points.T
    for _ in range(_STEPS):
        if len(going) == 0:
            break
        left = [take_step(going[piece], here[:, piece]) for piece in chunks(len(going), _PIECE)]
        going, here = (np.concatenate(parts, axis=-1) for parts in zip(*left, strict=True))
    return distances


def _lengths(vectors: Float64Array) -> Float64Array:
    """Return the lengths of vectors, (3, n), as `numpy.linalg.norm` does, which takes several times as long."""
    x, y, z = vectors
    lengths: Float64Array = np.sqrt(x * x + y * y + z * z)
    return lengths


def _distances_along_lines(volume: Volume, rule: IsoRule, level: float, points: Float64Array) -> Float64Array:
    """Return distances to the level along lines to the surrounding voxels; NaN where all lie on the point's side.

    A trilinear field has its extremes at the corners of the cells.  So if the level passes through the cell of a point
    or a neighbouring cell, one of the 64 surrounding voxels lies on the other side, and the line to it meets the level.
    """
    corners = np.array(list(product(range(-1, 3), repeat=3)), float)
    distances = np.full(len(points), np.nan)
    for piece in chunks(len(points), 1024):
        start = volume.lps_to_ijk(points[piece])
        nearest = np.full(len(start), np.inf)

        def above(ijk: Float64Array) -> Float64Array:
            return trilinear_values(volume, rule, ijk.reshape(-1, 3)).reshape(ijk.shape[:-1]) - level

        ends = np.floor(start)[:, None] + corners
        here = above(start)
        row, corner = np.nonzero((above(ends) >= 0.0) != (here >= 0.0)[:, None])
        line = ends[row, corner] - start[row]
        before, way_before = here[row], 0.0
        for fraction in np.arange(1, _LINE_STEPS + 1) / _LINE_STEPS:
            after = above(start[row] + fraction * line)
            met = np.flatnonzero((before >= 0.0) != (after >= 0.0))
            share = before[met] / (before[met] - after[met])
            ijk = start[row[met]] + (way_before + share * (fraction - way_before))[:, None] * line[met]
            np.minimum.at(nearest, row[met], np.linalg.norm(volume.ijk_to_lps(ijk) - points[piece][row[met]], axis=1))
            before, way_before = after, fraction
        distances[piece] = np.where(np.isfinite(nearest), nearest, np.nan)
    return distances


@dataclass(frozen=True, eq=False)
class IsoDistance(Record):
    """How far a mesh lies from the trilinear iso surface, in mm and in units of `voxel_mm`, the shortest voxel step.

    Means and percentiles are of the area: what counts is that of the triangle, or of those around a vertex.

    samples: ``vertices`` and ``centres`` that were measured.
    not_found: Points from which no surface was reached; the figures are of the others.
    surface_voxel: Of vertices and centres together: decimation leaves vertices outside of what is round, and centres
        inside, so that neither alone is how far the surface lies.
    near_metal_share: Share of the area within `_METAL_REACH` voxels of a voxel above `METAL_HU`.
    away_from_metal_voxel: Without what is near metal, of vertices or of both, whichever is nearer; None where that is
        nothing, or more than half.
    """

    voxel_mm: float
    samples: Mapping[str, int]
    not_found: int
    vertices_mm: DistanceSummary | None
    vertices_voxel: DistanceSummary | None
    centres_mm: DistanceSummary | None
    centres_voxel: DistanceSummary | None
    surface_voxel: DistanceSummary | None
    near_metal_share: float = 0.0
    away_from_metal_voxel: DistanceSummary | None = None


def measure_iso_distances(
    meshes: Sequence[Mesh],
    volume: Volume,
    rule: IsoRule,
    samples: int = SAMPLES,
    twice_areas: Sequence[Float64Array] | None = None,
) -> list[IsoDistance]:
    """Measure how far vertices and centres of triangles lie from the iso surface that meshes were made from.

    The vertices of an extracted surface lie on it, up to the rounding of float32; the centres show the error of flat
    triangles.  After smoothing and decimation both show the error that these have added.  Small meshes are measured
    together: a call costs as much for ten points as for a thousand.

    samples: Most vertices and triangles of a mesh that are measured; of more, every n-th.
    twice_areas: Of the triangles of each mesh, mm2, if they are known.
    """
    result: list[IsoDistance] = []
    waiting: list[_Points] = []
    known = twice_areas or [
        measure_triangles(mesh.vertices, mesh.triangles, by_triangle=True).twice_areas for mesh in meshes
    ]
    for number, (mesh, areas) in enumerate(zip(meshes, known, strict=True), start=1):
        waiting.append(_Points.of(mesh, samples, areas))
        if number == len(meshes) or sum(len(each.places) for each in waiting) >= samples:
            places = np.concatenate([each.places for each in waiting])
            ends = np.cumsum([len(each.places) for each in waiting])[:-1]
            distances = np.split(distances_to_iso_surface(volume, rule, places), ends)
            near_metal = np.split(_find_near_metal(volume, rule, places), ends)
            result += map(partial(_sum_up, smallest_voxel_mm(volume)), waiting, distances, near_metal)
            waiting.clear()
    return result


@dataclass(frozen=True, eq=False)
class _Points:
    """Vertices of a mesh and, after them, centres of triangles, with the area that each stands for."""

    places: Float64Array
    areas: Float64Array
    vertex_count: int

    @classmethod
    def of(cls, mesh: Mesh, most: int, twice: Float64Array) -> _Points:
        """Take every n-th, at most so many of both; in a mesh without area all stand for the same."""
        if not twice.any():
            twice = np.full(len(twice), 2.0)
        by_vertices, by_triangles = (-(-count // most) or 1 for count in (mesh.vertex_count, mesh.triangle_count))
        flat = mesh.triangles.reshape(-1)
        corners = np.flatnonzero(flat // by_vertices * by_vertices == flat)  # a remainder is not vectorised
        places = mesh.vertices[::by_vertices].astype(np.float64)
        of_corners = 0.5 * twice.take(corners // 3) * _AT_A_CORNER
        of_vertices = np.bincount(flat.take(corners) // by_vertices, of_corners, len(places))
        a, b, c = (mesh.vertices.take(corner, axis=0).astype(np.float64) for corner in mesh.triangles[::by_triangles].T)
        both = np.concatenate([places, (a + b + c) / 3.0])
        at_centres = (1.0 - 3.0 * _AT_A_CORNER) * (0.5 * twice[::by_triangles])
        areas = np.concatenate([by_vertices * of_vertices, by_triangles * at_centres])
        return cls(both, areas, len(places))


def _sum_up(voxel: float, points: _Points, distances: Float64Array, near_metal: NDArray[np.bool_]) -> IsoDistance:
    count, areas = points.vertex_count, points.areas
    vertices, centres = slice(count), slice(count, None)
    share, away = float(areas[near_metal].sum() / (areas.sum() or 1.0)), None
    if 0.0 < share <= 0.5:
        clear = np.where(near_metal, np.nan, distances)
        known = (_in_units(_summarise(clear[part], areas[part]), voxel) for part in (vertices, slice(None)))
        away = min(filter(None, known), key=lambda one: one.mean, default=None)
    of_vertices = _summarise(distances[vertices], areas[vertices])
    of_centres = _summarise(distances[centres], areas[centres])
    return IsoDistance(
        voxel,
        {"vertices": count, "centres": len(distances) - count},
        int(np.count_nonzero(~np.isfinite(distances))),
        vertices_mm=of_vertices,
        vertices_voxel=_in_units(of_vertices, voxel),
        centres_mm=of_centres,
        centres_voxel=_in_units(of_centres, voxel),
        surface_voxel=_in_units(_summarise(distances, areas), voxel),
        near_metal_share=share,
        away_from_metal_voxel=away,
    )


def _in_units(summary: DistanceSummary | None, unit_mm: float) -> DistanceSummary | None:
    return summary and DistanceSummary(*(value / unit_mm for value in summary.values()))


def _summarise(distances: Float64Array, areas: Float64Array) -> DistanceSummary | None:
    """Sum up the finite distances by the area that each stands for, None without any."""
    known = np.isfinite(distances) & (areas > 0.0)
    if not known.any():
        return None
    return summarise_distances(distances[known], areas[known])


def _find_near_metal(volume: Volume, rule: IsoRule, points: Float64Array) -> NDArray[np.bool_]:
    """Return which points have a voxel above `METAL_HU` within `_METAL_REACH`; none at a level of metal."""
    near = np.zeros(len(points), np.bool_)
    hu_range = None if max(rule.levels) >= METAL_HU else volume.hu_range
    if hu_range is None or hu_range[1] <= METAL_HU:
        return near
    reach = range(-_METAL_REACH, _METAL_REACH + 1)
    voxels = _Voxels(volume, rule, np.rint(volume.lps_to_ijk(points).T).astype(np.int64), reach)
    for step in product(reach, repeat=3):
        near |= voxels.at(step) > METAL_HU
    return near
