"""Work on meshes of many components grows with their number, not with its square: counted, not timed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import pytest
import sample_meshes as samples

from clrecon.exchange.coordinates import find_coincident, find_places
from clrecon.mesh import Mesh, measure_quality
from clrecon.mesh.components import select_components, split_components
from clrecon.mesh.connectivity import find_edges, find_split_vertices, label_components
from clrecon.mesh.intersections import find_self_intersections
from clrecon.mesh.quality import find_pieces
from clrecon.mesh.refine.smoothing import smooth_mesh
from clrecon.mesh.triangle_tree import TriangleTree

pytestmark = pytest.mark.unit

FEW, MANY = 400, 1600
"""Components of the smaller and the larger mesh."""

MOST_GROWTH = 1.25 * MANY / FEW
"""Of calls and of elements: sorting grows with the logarithm too; squares would grow 16-fold."""


class CountedArray(np.ndarray):
    """An array that adds its size, and that of all arrays made from it, to `elements`."""

    elements = 0

    def __array_finalize__(self, source: Any) -> None:
        CountedArray.elements += self.size


def count_work(action: Callable[..., Any], vertices: Any, triangles: Any) -> tuple[int, int]:
    """Return the calls of functions that an action makes, and the elements of the arrays it makes from its own."""
    calls = 0

    def count(_frame: Any, event: str, _argument: Any) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    arrays = vertices.view(CountedArray), triangles.view(CountedArray)
    CountedArray.elements = 0
    sys.setprofile(count)
    try:
        action(*arrays)
    finally:
        sys.setprofile(None)
    return calls, CountedArray.elements


def boxes(count: int) -> tuple[Any, Any]:
    """A row of boxes of 1 mm whose distances grow, each a component, as arrays."""
    vertices, triangles = samples.box()
    moves = 3.0 * np.arange(count)[:, None, None] * [1.0, 0.1, 0.0]
    rows = triangles[None] + 8 * np.arange(count)[:, None, None]
    return (vertices[None] + moves).reshape(-1, 3).astype(np.float32), rows.reshape(-1, 3).astype(np.uint32)


class CountedMesh(Mesh):
    @cached_property
    def vertices(self) -> CountedArray:
        return super().vertices.view(CountedArray)

    @cached_property
    def triangles(self) -> CountedArray:
        return super().triangles.view(CountedArray)


ACTIONS = {
    "label components": lambda vertices, triangles: label_components(triangles, len(vertices)),
    "find edges": lambda vertices, triangles: find_edges(triangles, len(vertices)),
    "find split vertices": lambda vertices, triangles: find_split_vertices(
        triangles, len(vertices), find_edges(triangles, len(vertices))
    ),
    "measure quality": measure_quality,
    "find pieces for a page": lambda vertices, triangles: find_pieces(vertices, triangles, len(vertices)),
    "keep the largest": lambda *arrays: select_components(CountedMesh(*arrays), keep_largest=3),
    "split": lambda *arrays: split_components(CountedMesh(*arrays)),
    "find coincident vertices": lambda vertices, triangles: find_coincident(vertices),
    "join corners": lambda vertices, triangles: find_places(vertices[triangles].reshape(-1, 3)),
    "find crossings": find_self_intersections,
    "tree of triangles": TriangleTree,
    "smooth": lambda *arrays: smooth_mesh(CountedMesh(*arrays), max_deviation_mm=0.1),
}


@pytest.mark.parametrize("name", ACTIONS)
def test_work_on_four_times_as_many_components_is_about_four_times_as_much(name):
    (few_calls, few_elements), (many_calls, many_elements) = (
        count_work(ACTIONS[name], *boxes(count)) for count in (FEW, MANY)
    )
    assert many_calls <= MOST_GROWTH * few_calls
    assert many_elements <= MOST_GROWTH * few_elements


def test_work_that_grows_with_the_square_is_counted_as_such():
    def look_at_all_for_each(vertices: Any, triangles: Any) -> None:
        for row in range(0, len(vertices), 8):
            (vertices == vertices[row]).any()

    (_, few_elements), (_, many_elements) = (count_work(look_at_all_for_each, *boxes(count)) for count in (FEW, MANY))
    assert many_elements > MOST_GROWTH * few_elements
