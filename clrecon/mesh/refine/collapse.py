"""Collapses of edges in parallel rounds: the surface that they start from, the order of rounds, and what comes back."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh.connectivity import Edges, Fans, Lists, find_split_vertices, list_runs
from clrecon.system.light_dataclass import dataclass

NONE = 0xFFFFFFFF
"""No vertex and no half-edge."""

REFUSED = 255
"""Octave of edges that do not collapse."""

FAR, SEVERAL = -3, -2
"""In place of faces that show that a triangle is near: none do, or more than are listed."""

_FEW = 0.02
"""Where fewer of the vertices collapse in a round, edges of higher cost are let in."""

_OCTAVES = 4
"""By so many octaves; with 2 there are as many rounds, and the surface is the same to a few triangles."""

_FIRST_SHARE = 20
"""Percentage of the edges that the first round lets in, those of least cost."""

_LEAST = 1e-4
"""Share of the vertices that ends the rounds, once edges of any cost are let in and no more of them collapse."""

_MOST_ROUNDS = 1000
_LOOK_AGAIN = 8
"""Rounds after which vertices that are gone are left out."""

Float32Array = NDArray[np.float32]
IntArray = NDArray[np.integer]


@dataclass(frozen=True)
class Surface:
    """A surface near zero, and its half-edges.

    opposite: ndarray, shape (3 m,), uint32. NONE at edges that are not in two faces, oppositely run.
    leaving: ndarray, shape (n,), uint32. A half-edge that starts from each vertex; NONE for locked ones: those
        at such edges, of several fans, and without faces.
    """

    places: Float32Array
    triangles: NDArray[np.uint32]
    fans: Fans
    opposite: NDArray[np.uint32]
    leaving: NDArray[np.uint32]
    mean_edge: float

    @staticmethod
    def of(places: Float32Array, triangles: NDArray[np.uint32], edges: Edges) -> Surface:
        corners = triangles.reshape(-1)
        opposite, leaving = np.full(triangles.size, NONE, np.uint32), np.full(len(places), NONE, np.uint32)
        pairs = edges.first[edges.uses == 2]
        ahead, back = edges.half_edges[pairs], edges.half_edges[pairs + 1]
        contrary = corners[ahead] != corners[back]
        ahead, back = ahead[contrary], back[contrary]
        opposite[ahead], opposite[back] = back, ahead
        leaving[corners] = np.arange(len(corners), dtype=np.uint32)
        loose = np.flatnonzero(opposite == NONE)
        leaving[corners[loose]] = NONE
        leaving[triangles[:, (1, 2, 0)].reshape(-1)[loose]] = NONE
        leaving[find_split_vertices(triangles, len(places), edges, None if len(loose) else opposite)] = NONE
        ways = places[edges.ends[0]] - places[edges.ends[1]]
        mean = float(np.sqrt(np.einsum("ij,ij->i", ways, ways)).mean(dtype=np.float64)) if len(ways) else 0.0
        return Surface(places, triangles, Fans(triangles, len(places)), opposite, leaving, mean)


@dataclass
class History:
    """Collapses that stand.  Each is named by the vertex that it took away.

    into, rounds: ndarray, shape (n,), int. The vertex that stayed, and the round; -1 for vertices that are there.
    earlier: ndarray, shape (n, 3), float32. Place of the vertex that stayed, before the collapse.
    places: ndarray, shape (n, 3), float32. Places now; of vertices that are gone, the last one.
    begin, size, neighbours: The ring of each collapse begins in `neighbours` at `begin` and has `size` vertices.
    """

    into: IntArray
    rounds: IntArray
    earlier: Float32Array
    places: Float32Array
    begin: IntArray
    size: IntArray
    neighbours: IntArray
    _beside: Lists | None = None

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.into >= 0))

    def names(self) -> NDArray[np.uint32]:
        """Return for each vertex the one that it has become, shape (n,)."""
        into = np.where(self.into >= 0, self.into, np.arange(len(self.into))).astype(np.uint32)
        while True:
            further = into[into]
            if np.array_equal(further, into):
                return into
            into = further

    def name_again(self, names: NDArray[np.uint32], standing: IntArray) -> IntArray:
        """Give names to vertices that are there, and to those that they are made of; return all of these."""
        names[standing] = standing
        vertices, going = [standing], standing
        while len(going):
            others, size = self._collapses_beside().around(going)
            names_of_others = np.repeat(names[going], size)
            is_into = self.into[others] == np.repeat(going, size)
            going = others[is_into]
            names[going] = names_of_others[is_into]
            vertices.append(going)
        return np.concatenate(vertices)

    def latest(self) -> IntArray:
        """Return the last collapse into each vertex, -1 where there is none."""
        gone = np.flatnonzero(self.into >= 0)
        gone = gone[np.argsort(self.rounds[gone].astype(np.int16), kind="stable")]  # those of 16 bits by counting
        last = np.full(len(self.into), -1)
        last[self.into[gone]] = gone
        return last

    def undo(self, collapses: IntArray) -> IntArray:
        """Undo collapses, and those after them whose faces they had changed; return the vertices that have changed.

        A collapse changes the faces around the vertex that stays.  A later one depends on it if that vertex is one of
        its two, or of its ring.  What stands is then as if the others had never been made: closed and connected as
        before, with each volume.
        """
        undone = np.zeros(len(self.into), dtype=bool)
        going = np.unique(collapses)
        while len(going):
            undone[going] = True
            others, size = self._collapses_beside().around(self.into[going])
            later = self.rounds[others] > np.repeat(self.rounds[going], size)
            going = np.unique(others[later & ~undone[others] & (self.into[others] >= 0)])
        gone = np.flatnonzero(undone)
        gone = gone[np.argsort(-self.rounds[gone], kind="stable")]
        stayed = self.into[gone]
        self.places[stayed] = self.earlier[gone]  # the first of equals, as it is the last that is written
        self.into[gone] = self.rounds[gone] = -1
        return np.unique(np.concatenate([gone, stayed]))

    def _collapses_beside(self) -> Lists:
        """Return the collapses that have each vertex at one end or in the ring."""
        if self._beside is None:
            gone = np.flatnonzero(self.into >= 0)
            ring = self.neighbours[list_runs(self.begin[gone], self.size[gone])]
            self._beside = Lists(np.concatenate([ring, self.into[gone], gone]), len(self.into))
            owner = np.concatenate([np.repeat(gone, self.size[gone]), gone, gone])
            self._beside.rows = owner[self._beside.rows]
        return self._beside


@dataclass(frozen=True)
class Pairing:
    """Where two surfaces are near each other; faces of both have the numbers of given ones.

    faces_at: ndarray, shape (m,). The present face at the middle of each given one.
    below: ndarray, shape (m,). A given face at each present one; -1 where none is known.
    homes: ndarray, shape (n,). A given vertex near each present one.
    """

    faces_at: IntArray
    below: IntArray
    homes: IntArray


class Collapser(Protocol):
    """Tries collapses in parallel: those that a round selects have no face in common."""

    def octaves(self) -> NDArray[np.uint8]:
        """Return the octave of the cost of each half-edge; REFUSED for one of the two of each edge."""

    def look_at_standing(self) -> int:
        """Leave out vertices that are gone from now on; return the number of the others."""

    def run_round(self, number: int, octave: int, most: int) -> tuple[int, int]:
        """Select edges up to an octave, each the first one of its surroundings, at most so many, and try to collapse
        them; return how many were selected, and how many collapses were made up to now.
        """

    def finish(self) -> tuple[History, Pairing]:
        """Return the collapses, and where the surfaces are near each other."""

    def show_present(
        self, places: Float32Array, corners: NDArray[np.uint32], rows: IntArray, changed: IntArray
    ) -> None:
        """Bring the present surface to the device, of which some faces have changed since the last time.

        places: ndarray, shape (n, 3). Of given vertices.
        corners: ndarray, shape (m, 3). What the corners of given triangles have become.
        rows, changed: Those that are faces, and those of them that have changed.
        """

    def find_near_faces(
        self, corners: Float32Array, hints: NDArray[np.int32], present: bool, limit: float
    ) -> NDArray[np.int32]:
        """Find faces that show that triangles, shape (k, 3, 3), lie within a distance of a surface at all their points.

        hints: ndarray, shape (k, 4). A face of the surface near each triangle, or -1; a vertex near each corner.
        present: The surface is the present one, else the given one.
        limit: Square of the distance in mm2.
        Returns: shape (k, 4). Faces of the surface, and -1; all SEVERAL where there are more than four; all FAR where
            none is found for a part of the triangle.
        """


def collapse_in_rounds(collapser: Collapser, faces: int, wanted: float, tell: Callable[[int], None]) -> int:
    """Collapse edges, those of least cost first, until no more than `wanted` faces are left, or none collapses.

    tell: Called with the number of faces that are left.
    Returns the number of rounds.
    """
    octaves = collapser.octaves()
    used = octaves[octaves != REFUSED]
    if len(used) == 0:
        return 0
    octave, highest = int(np.percentile(used, _FIRST_SHARE)), int(used.max())
    done = standing = 0
    for number in range(_MOST_ROUNDS):
        if number % _LOOK_AGAIN == 0:
            standing = collapser.look_at_standing()
            tell(faces - 2 * done)
        most = math.ceil((faces - 2 * done - wanted) / 2)
        if most <= 0:
            return number
        selected, done = collapser.run_round(number, octave, most)
        if selected < _FEW * standing:
            if octave >= highest and selected <= _LEAST * standing:
                return number + 1
            octave = min(octave + _OCTAVES, REFUSED - 1)
    return _MOST_ROUNDS
