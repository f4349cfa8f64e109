"""Smoothing within an error bound in mm of the given surface: a low pass, the volume of each component, no crossings.

The steps of the vertices are a polynomial of the mean of neighbours, applied to how far each vertex lies from that
mean. They are shortened to a share of the bound, and the rest of it is for the shift along the normals that gives each
component its volume: its volume is a cubic of that shift, which is solved for all components at once.  So no step is
longer than the bound, by construction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.exchange.coordinates import rounding_step
from clrecon.mesh.connectivity import label_components, order_by_number
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.refine.decimation import carry_on, check_refinement
from clrecon.mesh.refine.shifts import Follow, follow_none, move_vertices
from clrecon.mesh.triangles import cross_product
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import in_threads, local_origin
from clrecon.system.progress import Progress, ignore_progress

_PASS_BAND = 0.1
"""Pass band of the windowed sinc filter.  On CT at 0.7 mm and 20 iterations the surface moves by a mean of 0.05 voxel
and by 0.15 at the 95th percentile; half the pass band loses more than 0.5 % of the volume."""

_GAIN = 0.999
"""Gain at the pass band for which the offset of the filter is chosen."""

_WIDEST_OFFSET = 16.0
"""The offset for one iteration; it is about 10 over the number of iterations, and less for few."""

_NUTTALL = (0.355768, 0.487396, 0.144232, 0.012604)
"""Window of Nuttall 1981, as VTK's filter has it by default."""

_ESTIMATES = 2
"""Shifts along the normals after each of which steps are shortened again; the last is the size of what is missing."""

_ROOM = 1.1
_LEAST_ROOM = 0.0005
"""Share of the bound that is kept for the exact shift of a component: this many times the last estimate, and this."""

_LESS = (1.0, 0.7, 0.5, 0.25)
"""Factors of the steps, in turn, where no shift gives a component its volume, as of specks that become a point."""

_NEWTON_STEPS = 8
_VOLUME_SLACK = 1e-6
"""Share of its volume by which the cubic of a component may miss it."""

_TAKEN_BACK_SLACK = 2e-3
"""The same after vertices were taken back from crossings, and rounded: a component beyond it is left as it was."""

Term = tuple[np.float32, np.float32]
"""Factor of a Chebyshev polynomial, and share of the sum of what follows."""

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]


@dataclass(frozen=True)
class Rings:
    """The corners of triangles at each vertex: of vertex v those from ``begin[v]`` to ``begin[v + 1]``.

    after, before: ndarray, shape (3 m,). The next and the previous corner of the triangle.
    weights: ndarray, shape (n,), float32. 1 / number of corners; 0 for vertices at a border and for those without
        triangles, which do not move.
    """

    begin: NDArray[np.int32]
    after: NDArray[np.uint32]
    before: NDArray[np.uint32]
    weights: Float32Array

    @classmethod
    def of(cls, triangles: NDArray[np.uint32], vertex_count: int) -> Rings:
        """Find the corners.  The next ones of a vertex are, on a closed surface, each neighbour once.

        A vertex whose next corners are not its previous ones is at a border, or at an edge along which two triangles
        run in one direction.  Sums of scrambled numbers are compared, exact in float64.
        """
        corners = triangles.reshape(-1)
        after, before = np.roll(triangles, -1, axis=1).reshape(-1), np.roll(triangles, 1, axis=1).reshape(-1)
        degree = np.bincount(corners, minlength=vertex_count)
        begin = np.zeros(vertex_count + 1, np.int32)
        np.cumsum(degree, out=begin[1:])
        mixed = (np.arange(1, vertex_count + 1, dtype=np.uint32) * np.uint32(0x9E3779B1)).astype(np.float64)
        balance = np.bincount(corners, mixed.take(after) - mixed.take(before), vertex_count)
        weights = np.zeros(vertex_count, np.float32)
        np.divide(np.float32(1.0), degree.astype(np.float32), out=weights, where=(balance == 0.0) & (degree > 0))
        order = order_by_number(corners)
        return cls(begin, after.take(order), before.take(order), weights)


class Filter:
    """A low pass over a surface, and its components: twin of `cl/surface/smoothing.cl`, to the bit."""

    def __init__(self, rings: Rings):
        self._rings = rings

    def label(self, triangles: NDArray[np.uint32]) -> tuple[int, NDArray[np.int64]]:
        """Number the components, see `clrecon.mesh.connectivity.label_components`."""
        return label_components(triangles, len(self._rings.weights))

    def measure_bends(self, places: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return how far each vertex lies from the mean of its neighbours, (n, 3) mm, and its normal, of length mm2."""
        rings = self._rings
        centres = np.repeat(places, np.diff(rings.begin), axis=0)
        after, before = places.take(rings.after, axis=0) - centres, places.take(rings.before, axis=0) - centres
        entries = self._matrix(np.arange(len(centres), dtype=np.int32), len(centres))
        normals = entries @ np.ascontiguousarray(cross_product(after.T, before.T).T)
        return rings.weights[:, None] * (entries @ after), normals

    def find_steps(self, bends: Float32Array, terms: Sequence[Term]) -> Float32Array:
        """Return the steps, shape (n, 3), mm, by a polynomial of the mean of neighbours, see `sinc_terms`."""
        weights = self._rings.weights[:, None]
        matrix = self._matrix(self._rings.after.view(np.int32), len(weights))
        later, sums = np.zeros_like(bends), np.zeros_like(bends)
        for factor, share in terms:
            np.subtract(factor * bends + share * (later + weights * (matrix @ later)), sums, out=sums)
            later, sums = sums, later
        return later

    def _matrix(self, columns: NDArray[np.int32], size: int) -> Any:
        """Return the sparse matrix that sums what the columns name over the corners at each vertex, in their order."""
        from scipy.sparse import csr_array

        ones = np.ones(len(columns), np.float32)
        return csr_array((ones, columns, self._rings.begin), shape=(len(self._rings.weights), size))


MakeFilter = Callable[[Rings], Filter]
"""Makes a filter: `Filter`, or what does the same elsewhere."""


def sinc_terms(iterations: int) -> list[Term]:
    """Return the terms of the filter, from the last one on: their factors, and the shares of what follows.

    With A = (1 + mean of neighbours) / 2 the filter is ``sum(c T(k)(A))`` with Chebyshev polynomials T, and its gain
    for what is constant is 1.  So ``filter - 1`` can be divided by ``A - 1``, which gives half the bends.
    """
    theta, order = np.arccos(1.0 - 0.5 * _PASS_BAND), np.arange(1, iterations + 1)
    phases = np.pi * np.arange(iterations + 1) / (iterations + 1)
    window = sum(part * np.cos(turn * phases) for turn, part in enumerate(_NUTTALL))

    def filter_at(offset: float) -> Float64Array:
        edge = theta + offset
        return window * np.concatenate([[edge / np.pi], 2.0 * np.sin(order * edge) / (order * np.pi)])

    def gain(offset: float) -> float:
        return float(np.cos(theta * np.arange(iterations + 1)) @ filter_at(offset))

    offsets = np.linspace(0.0, min(np.pi - theta, _WIDEST_OFFSET / iterations), 65)
    first = next((number for number, offset in enumerate(offsets) if gain(offset) >= _GAIN), len(offsets) - 1)
    low, high = offsets[max(first - 1, 0)], offsets[first]
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if gain(middle) >= _GAIN else (middle, high)
    chebyshev = filter_at(high)
    chebyshev /= chebyshev.sum()
    # The quotient d of sum(c T(k)) - 1 and x - 1: 2 x T(k) = T(k + 1) + T(k - 1).
    divided = np.zeros(iterations + 2)
    for k in range(iterations, 0, -1):
        divided[k - 1] = 2.0 * chebyshev[k] + 2.0 * divided[k] - divided[k + 1]
    divided[0] *= 0.5
    factors = (0.5 * divided[:iterations]).astype(np.float32)
    return [(factors[k], np.float32(1.0 if k else 0.5)) for k in range(iterations - 1, -1, -1)]


class _Components:
    """Components of a surface near zero that are to keep their volumes, by shifts along `normals` of any length.

    components: Their number, and the one of each vertex, -1 for none.
    still: Vertices that do not move: their components are open.
    """

    def __init__(
        self,
        places: Float64Array,
        triangles: NDArray[np.uint32],
        normals: Float32Array,
        components: tuple[int, NDArray[np.int64]],
        still: IntArray,
    ):
        self._columns, self._triangles = np.ascontiguousarray(places.T), triangles
        self._normals = np.ascontiguousarray(normals.T, dtype=np.float64)
        length = np.sqrt(_dot(self._normals, self._normals))
        np.divide(self._normals, length, out=self._normals, where=length > 0.0)
        self._areas = length / 6.0
        self._count, labels = components
        self._labels = np.where(labels < 0, self._count, labels)
        self._of_triangle = self._labels.take(triangles[:, 0])
        self._is_closed = np.ones(self._count + 1, bool)  # the last one for vertices without triangles
        self._is_closed[self._labels[still]] = False
        self._is_closed[-1] = False
        self._volumes = self._measure(self._columns, triangles, self._of_triangle)

    def _measure(
        self, columns: Float64Array, triangles: NDArray[np.uint32], of_triangle: NDArray[np.int64]
    ) -> Float64Array:
        """Return the volume of each component in mm3, shape (count + 1,)."""
        (volumes,) = _determinants(columns, None, triangles)
        return np.bincount(of_triangle, volumes, self._count + 1).astype(np.float64)

    def keep_volumes(self, steps: Float32Array, longest: float) -> tuple[Float64Array, int, int]:
        """Shorten steps (n, 3) to `longest` mm, and shift them so that each closed component keeps its volume.

        Returns them with the number of steps that were longer, and of components that are not moved, as no share of
        their steps leaves them their volume.
        """
        wanted = np.ascontiguousarray(steps.T, dtype=np.float64)
        length = np.sqrt(_dot(wanted, wanted))
        moves = _shorten(wanted, length, longest)
        area = np.bincount(self._labels, self._areas, self._count + 1)
        for _ in range(_ESTIMATES):  # the gradient of the volume at a vertex is a third of the area around it
            lost = self._volumes - self._measure(self._columns + moves, self._triangles, self._of_triangle)
            shift = np.divide(lost, area, out=np.zeros_like(lost), where=self._is_closed & (area > 0.0))
            shift = shift.clip(-0.5 * longest, 0.5 * longest)
            moves += self._normals * shift[self._labels]
            moves = _shorten(moves, np.sqrt(_dot(moves, moves)), longest)
        room = (_ROOM * np.abs(shift) + _LEAST_ROOM * longest).clip(0.0, 0.5 * longest)
        pending = self._is_closed.copy()
        for less in _LESS:
            if not pending.any():
                break
            vertices = np.flatnonzero(pending[self._labels])
            room = np.maximum(room, (1.0 - less) * longest)
            trial = moves.take(vertices, axis=1) if less == 1.0 else less * wanted.take(vertices, axis=1)
            trial = _shorten(trial, np.sqrt(_dot(trial, trial)), (longest - room)[self._labels[vertices]])
            done = self._shift(vertices, trial, pending, room)
            done_vertices = done[self._labels[vertices]]
            moves[:, vertices[done_vertices]] = trial[:, done_vertices]
            pending &= ~done
        moves[:, pending[self._labels]] = 0.0
        return np.ascontiguousarray(moves.T), int(np.count_nonzero(length > longest)), int(np.count_nonzero(pending))

    def _shift(
        self, vertices: IntArray, steps: Float64Array, pending: NDArray[np.bool_], room: Float64Array
    ) -> NDArray[np.bool_]:
        """Shift the vertices of pending components along their normals; return which then have their volume.

        At places x + s n the volume of a component is ``sum(det(a + s u, b + s v, c + s w)) / 6`` over its triangles, a
        cubic of s.

        steps: ndarray, shape (3, k), mm. Changed in place.
        room: ndarray, shape (count + 1,), mm. No shift of a component is longer.
        """
        columns, normals = self._columns.take(vertices, axis=1) + steps, self._normals.take(vertices, axis=1)
        triangles, of_triangle = self._triangles, self._of_triangle
        if len(vertices) < len(self._labels):
            rows = np.flatnonzero(pending[of_triangle])
            number = np.zeros(len(self._labels), np.uint32)
            number[vertices] = np.arange(len(vertices), dtype=np.uint32)
            triangles, of_triangle = number.take(triangles.take(rows, axis=0)), of_triangle.take(rows)
        parts = _determinants(columns, normals, triangles)
        sums = np.array([np.bincount(of_triangle, part, self._count + 1) for part in parts], dtype=np.float64)
        sums[0] -= self._volumes
        constant, linear, quadratic, cubic = sums
        shift = np.zeros(self._count + 1)
        for _ in range(_NEWTON_STEPS):
            value, slope = (
                ((cubic * shift + quadratic) * shift + linear) * shift + constant,
                (3.0 * cubic * shift + 2.0 * quadratic) * shift + linear,
            )
            shift -= np.divide(value, slope, out=np.zeros_like(shift), where=np.abs(slope) > 1e-9 * np.abs(value))
            shift = shift.clip(-room, room)
        value = ((cubic * shift + quadratic) * shift + linear) * shift + constant
        steps += normals * shift[self._labels[vertices]]
        return np.asarray(pending & (np.abs(value) <= _VOLUME_SLACK * np.abs(self._volumes)))

    def find_changed(self, vertices: Float64Array, share: Float64Array) -> IntArray:
        """Find the vertices of components that lost volume where of each step only `share`, (n,), is made."""
        touched = np.zeros(self._count + 1, bool)
        touched[self._labels[share < 1.0]] = True
        touched &= self._is_closed
        rows = np.flatnonzero(touched[self._of_triangle])
        now = self._measure(np.ascontiguousarray(vertices.T), self._triangles[rows], self._of_triangle[rows])
        lost = touched & ~(np.abs(now - self._volumes) <= _TAKEN_BACK_SLACK * np.abs(self._volumes))
        return np.flatnonzero(lost[self._labels])


def _determinants(
    columns: Float64Array, normals: Float64Array | None, triangles: NDArray[np.uint32]
) -> list[Float64Array]:
    """Return of each triangle its part of the volume in mm3, or with normals its parts of the cubic of a shift."""
    parts = [np.empty(len(triangles)) for _ in range(1 if normals is None else 4)]

    def measure_piece(piece: slice) -> None:
        corners = triangles[piece].T.astype(np.intp)
        a, b, c = (columns.take(corner, axis=1, mode="clip") for corner in corners)
        across = cross_product(b, c)
        parts[0][piece] = _dot(a, across) / 6.0
        if normals is None:
            return
        u, v, w = (normals.take(corner, axis=1, mode="clip") for corner in corners)
        beside = cross_product(v, w)
        parts[1][piece] = (_dot(u, across) + _dot(v, cross_product(c, a)) + _dot(w, cross_product(a, b))) / 6.0
        parts[2][piece] = (_dot(a, beside) + _dot(b, cross_product(w, u)) + _dot(c, cross_product(u, v))) / 6.0
        parts[3][piece] = _dot(u, beside) / 6.0

    in_threads(measure_piece, len(triangles))
    return parts


def _dot(first: Float64Array, second: Float64Array) -> Float64Array:
    return np.asarray(first[0] * second[0] + first[1] * second[1] + first[2] * second[2])


def _shorten(steps: Float64Array, length: Float64Array, longest: float | Float64Array) -> Float64Array:
    """Return steps in columns, shape (3, k), of these lengths, none of them longer than `longest`."""
    return steps * np.minimum(longest / np.maximum(length, longest), 1.0)


def _roughness(bends: Float32Array) -> float:
    """Return the root mean square of the lengths of bends, shape (n, 3)."""
    return float(np.sqrt(np.square(bends, dtype=np.float64).sum() / max(len(bends), 1)))


def smooth_mesh(
    mesh: Mesh,
    iterations: int = 20,
    max_deviation_mm: float | None = None,
    *,
    progress: Progress | None = None,
    make_filter: MakeFilter = Filter,
    follow: Follow = follow_none,
) -> Mesh:
    """Smooth a surface, see `clrecon.operators.surface.smoothing.smooth_mesh`.

    make_filter, follow: `Filter`, or what does the same elsewhere, and the marks of `move_vertices`.
    """
    if isinstance(iterations, float) or not 1 <= iterations <= 1000:
        raise UsageError(f"smoothing takes from 1 to 1000 iterations, not {iterations}")
    progress = progress or ignore_progress
    progress("smooth", 0, 3)
    bound = check_refinement(mesh, max_deviation_mm)
    # Both surfaces are stored rounded, each coordinate by at most half a step.
    longest = max(bound - rounding_step(mesh.vertices), 0.5 * bound)
    origin = local_origin(mesh.vertices)
    rings = Rings.of(mesh.triangles, mesh.vertex_count)
    low_pass = make_filter(rings)

    def measure_bends(vertices: NDArray[np.floating]) -> tuple[Float32Array, Float32Array]:
        # Differences of float32 are exact in float32; float64 is far from zero.
        near = vertices if vertices.dtype == np.float32 else (vertices - origin).astype(np.float32)
        return low_pass.measure_bends(near)

    bends, normals = measure_bends(mesh.vertices)
    wanted = low_pass.find_steps(bends, sinc_terms(iterations))
    progress("smooth", 1, 3)
    still = np.flatnonzero(rings.weights == 0.0)
    components = _Components(mesh.vertices - origin, mesh.triangles, normals, low_pass.label(mesh.triangles), still)
    steps, held_back, left = components.keep_volumes(wanted, longest)
    progress("smooth", 2, 3)
    vertices, taken_back = move_vertices(
        mesh.vertices, mesh.triangles, steps, follow=follow,
        find_changed=lambda now, made: components.find_changed(now - origin, made),
    )  # fmt: skip
    progress("smooth", 3, 3)
    facts = {
        "iterations": iterations,
        "max_deviation_mm": bound,
        "roughness_before_mm": _roughness(bends),
        "roughness_after_mm": _roughness(measure_bends(vertices)[0]),
        "vertices_held_back": held_back,
        "vertices_taken_back": taken_back,
        "components_left": left,
    }
    return carry_on(mesh, vertices, mesh.triangles, "smooth", facts)
