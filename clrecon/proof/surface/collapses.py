"""Twin of `collapse_edges` for a first round, edge by edge in float64: which collapses pass, and where the vertex goes.

Distances to the given surface are exact here.  The kernel walks to a near face from a near vertex, which it may miss,
and measures points of new edges in steps that depend on the distance: a collapse should pass, may pass, or must not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array

PULL = 1e-3
"""Weight of the middle of an edge in cl/surface/collapse.h."""

STEEPEST = 0.2
"""Least cosine between the normals of a face before and after, of cl/surface/collapse.h."""

SLENDER = 0.01
"""Sine below which a normal is not looked at, of cl/surface/collapse.h."""

_MOST_RING = 16

_UNSURE = 1e-3
"""Relative difference from a threshold below which float32 may decide otherwise."""

_SAMPLES = 9
"""Points of each new edge."""


class Surroundings(NamedTuple):
    """The ring of an edge from u to w, counterclockwise, and which end each of its edges has its face with.

    ring: ndarray, shape (n,). Vertices.
    from_u: ndarray, shape (n,), bool. The face of the edge from ring vertex i to the next one had the corner u, else w.
    """

    ring: NDArray[np.int64]
    from_u: NDArray[np.bool_]


class Verdict(NamedTuple):
    """What is right for a collapse: it passes unless a walk misses the near face, or it may pass, or it must not.

    position, ring: ndarray, shapes (3,) and (n, 3), mm. The vertex that stays, and its neighbours.
    looked_at: ndarray, shape (1 + n,), bool. Whether the position and the middles of the new faces are measured.
    """

    should_pass: bool
    may_pass: bool
    position: Float64Array
    ring: Float64Array
    looked_at: NDArray[np.bool_]


def find_surroundings(triangles: NDArray[np.uint32], fans: list[list[int]], u: int, w: int) -> Surroundings | None:
    """Return the ring; None where the collapse would change the topology, or the ring is too long."""
    following: dict[int, tuple[int, bool]] = {}
    for end, has_u in ((u, True), (w, False)):
        for row in fans[end]:
            corners = triangles[row].tolist()
            first = corners.index(end)
            after, last = corners[first - 2], corners[first - 1]
            if u + w - end not in (after, last):
                if after in following:
                    return None
                following[after] = last, has_u
    ring = [min(following)]
    while following[ring[-1]][0] != ring[0]:
        ring.append(following[ring[-1]][0])
        if ring[-1] not in following or len(ring) > len(following):
            return None
    if len(ring) != len(following) or not 3 <= len(ring) <= _MOST_RING:
        return None
    return Surroundings(np.array(ring), np.array([following[vertex][1] for vertex in ring]))


def measure_planes(vertices: Float64Array, triangles: NDArray[np.uint32]) -> Float64Array:
    """Return the matrix of each vertex, (n, 3, 3): squared distances to the planes around it, by twice their areas."""
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    planes = np.einsum("ka,kb->kab", normal, normal / np.linalg.norm(normal, axis=1, keepdims=True))
    of_vertices = np.zeros((len(vertices), 3, 3))
    for corner in triangles.T:
        np.add.at(of_vertices, corner, planes)
    return of_vertices


class FirstRound:
    """A given surface, of which no edge has collapsed.

    limit_mm: Largest distance of points.
    longest_mm: Edges that are longer have a point in their middle.
    rise_mm: Height of a ridge of 90 degrees between points that do not show it, see `is_flat` in cl/surface/collapse.h.
    distance: Of points (k, 3) from the surface, mm.
    """

    def __init__(
        self,
        vertices: Float64Array,
        triangles: NDArray[np.uint32],
        limit_mm: float,
        longest_mm: float,
        rise_mm: float,
        distance: Callable[[Float64Array], Float64Array],
    ):
        self._vertices, self._triangles = vertices, triangles
        self._limit, self._longest = limit_mm, longest_mm
        self._rise = rise_mm
        self._fans: list[list[int]] = [[] for _ in vertices]
        for row, corners in enumerate(triangles.tolist()):
            for corner in corners:
                self._fans[corner].append(row)
        self._planes = measure_planes(vertices, triangles)
        self._distance = distance

    def judge(self, pairs: Sequence[tuple[int, int]]) -> list[Verdict]:
        """Judge the collapse of each edge, given by its ends."""
        verdicts: list[Verdict | None] = [self._judge_shape(u, w) for u, w in pairs]
        points = [np.zeros((0, 3)) if verdict is None else self._find_samples(verdict) for verdict in verdicts]
        distances = np.split(self._distance(np.concatenate(points)), np.cumsum([len(rows) for rows in points])[:-1])
        return [
            Verdict(False, False, np.zeros(3), np.zeros((0, 3)), np.zeros(1, bool))
            if verdict is None
            else verdict._replace(
                should_pass=verdict.should_pass and float(away.max()) < (1.0 - _UNSURE) * self._limit,
                may_pass=not (away[: len(verdict.looked_at)] > (1.0 + _UNSURE) * self._limit)[verdict.looked_at].any(),
            )
            for verdict, away in zip(verdicts, distances, strict=True)
        ]

    def _judge_shape(self, u: int, w: int) -> Verdict | None:
        """Judge all but the distances from the given surface; None: the collapse must not pass."""
        around = find_surroundings(self._triangles, self._fans, u, w)
        if around is None:
            return None
        position, normal = self._find_place(u, w)
        turns = self._measure_turns(around, self._vertices[[u, w]], position, normal)
        ring = self._vertices[around.ring]
        landed = self._land(np.stack(list(self._find_points(u, w))), position, ring)
        if turns < 1.0 - _UNSURE or landed > (1.0 + _UNSURE) * self._limit:
            return None
        passes = turns > 1.0 + _UNSURE and landed < (1.0 - _UNSURE) * self._limit
        return Verdict(passes, True, position, ring, self._find_looked_at(position, ring, normal, landed))

    def _find_looked_at(
        self, position: Float64Array, ring: Float64Array, normal: Float64Array, landed: float
    ) -> NDArray[np.bool_]:
        """Mark the position and the faces that are too steep for the points of the given surface to show them."""
        faces = np.cross(ring - position, np.roll(ring, -1, axis=0) - position)
        faces /= np.linalg.norm(faces, axis=1, keepdims=True)
        lean = np.arccos(np.clip(faces @ normal / np.linalg.norm(normal), 0.0, 1.0)).max()
        bend = np.arccos(np.clip(np.einsum("ka,ka->k", faces, np.roll(faces, 1, axis=0)), -1.0, 1.0))
        rises = np.tan(np.append(lean, np.minimum(lean, 0.5 * bend)))
        return landed + self._rise * rises > (1.0 + _UNSURE) * self._limit

    @staticmethod
    def _find_samples(verdict: Verdict) -> Float64Array:
        """Return points of new faces: the position, the middle of each face, and points of the new edges."""
        position, ring = verdict.position, verdict.ring
        shares = np.linspace(0.0, 1.0, _SAMPLES, endpoint=False)[1:, None, None]
        middles = (position + ring + np.roll(ring, -1, axis=0)) / 3.0
        return np.vstack([position, middles, (position + shares * (ring - position)).reshape(-1, 3)])

    def _find_place(self, u: int, w: int) -> tuple[Float64Array, Float64Array]:
        """Return the position of the least sum of squares on the plane that keeps the volume, and its normal."""
        start, end = self._vertices[u], self._vertices[w]
        middle = 0.5 * (start + end)
        sums = self._planes[u] + self._planes[w]
        linear = self._planes[u] @ (start - middle) + self._planes[w] @ (end - middle)
        best = np.linalg.solve(sums + PULL * np.trace(sums) * np.eye(3), linear)
        corners = np.stack(list(self._faces_at(u, w))) - middle
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = normals.sum(axis=0)
        volume = np.einsum("ka,ka->", normals, corners[:, 0])
        return middle + best + normal * ((volume - normal @ best) / (normal @ normal)), normal

    def _faces_at(self, u: int, w: int) -> Iterator[Float64Array]:
        """Yield the corners of each face at u or w, (3, 3)."""
        for row in sorted({*self._fans[u], *self._fans[w]}):
            yield self._vertices[self._triangles[row]]

    def _measure_turns(
        self, around: Surroundings, ends: Float64Array, position: Float64Array, normal: Float64Array
    ) -> float:
        """Return how far the least of the normals lies from being refused: below 1 one is."""
        ring = self._vertices[around.ring]
        following = np.roll(ring, -1, axis=0)
        apex: Float64Array = np.where(around.from_u[:, None], ends[0], ends[1])
        before, after = np.cross(ring - apex, following - apex), np.cross(ring - position, following - position)
        size_before, size = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)

        def longest(corner: Float64Array) -> Float64Array:
            sides = np.stack([ring - corner, following - corner, following - ring])
            return np.asarray((sides**2).sum(axis=2).max(axis=0))

        slender = size / (SLENDER * longest(position))
        turned = np.einsum("ka,ka->k", before, after) / (STEEPEST * size * size_before)
        had_normal = size_before**2 > SLENDER * longest(apex) ** 2
        turned = np.where(had_normal, turned, 2.0 * (after @ normal > 0.0))
        return float(min(slender.min(), turned.min()))

    def _find_points(self, u: int, w: int) -> Iterator[Float64Array]:
        """Yield the points in lists of the faces at u and w, but for those at the ring and on it."""
        yield self._vertices[u]
        yield self._vertices[w]
        for corners in self._faces_at(u, w):
            yield corners.mean(axis=0)
        for end in (u, w):
            for corner in self._vertices[sorted({*self._triangles[self._fans[end]].ravel().tolist()})]:
                if np.linalg.norm(corner - self._vertices[end]) > self._longest:
                    yield 0.5 * (corner + self._vertices[end])

    @staticmethod
    def _land(points: Float64Array, position: Float64Array, ring: Float64Array) -> float:
        """Return the largest distance of points from the nearest face of a fan."""
        corners = np.broadcast_to(position, ring.shape), ring, np.roll(ring, -1, axis=0)
        fan = [np.tile(corner, (len(points), 1)) for corner in corners]
        apart = measure_triangles(np.repeat(points, len(ring), axis=0), *fan)
        return float(apart.reshape(len(points), -1).min(axis=1).max())


def measure_triangles(points: Float64Array, a: Float64Array, b: Float64Array, c: Float64Array) -> Float64Array:
    """Return the distance of each point from its triangle, all (k, 3): from its plane above it, else from an edge."""
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    is_above, nearest = np.ones(len(points), bool), np.full(len(points), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along, away = end - start, points - start
        is_above &= np.einsum("ka,ka->k", np.cross(along, away), normal) >= 0.0
        share = np.clip(np.einsum("ka,ka->k", along, away) / np.einsum("ka,ka->k", along, along), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(away - share[:, None] * along, axis=1))
    return np.where(is_above, np.abs(np.einsum("ka,ka->k", points - a, normal)) / size, nearest)
