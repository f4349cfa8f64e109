"""Collapses are undone with those that depend on them, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.mesh.refine.collapse import History

pytestmark = pytest.mark.unit


def history_of(count: int, *collapses: tuple[int, int, int, list[int]]) -> History:
    """Collapses (gone, stayed, round, ring); the one that stayed moves by 1 along x in each."""
    into, rounds, begin, size = np.full((4, count), -1)
    places, earlier = np.zeros((2, count, 3), np.float32)
    neighbours: list[int] = []
    for gone, stayed, number, ring in collapses:
        into[gone], rounds[gone], begin[gone], size[gone] = stayed, number, len(neighbours), len(ring)
        neighbours += ring
        earlier[gone] = places[stayed]
        places[stayed, 0] += 1.0
    return History(into, rounds, earlier, places, begin, size, np.array(neighbours))


def test_names_lead_to_the_vertex_that_is_there():
    history = history_of(5, (1, 0, 0, [2, 3]), (0, 4, 1, [2, 3]))
    assert history.names().tolist() == [4, 4, 2, 3, 4]
    assert history.latest().tolist() == [1, -1, -1, -1, 0]
    assert history.count == 2


def test_collapses_into_one_vertex_are_undone_from_the_last_one_on():
    history = history_of(4, (1, 0, 0, [3]), (2, 0, 1, [3]))
    assert history.undo(np.array([2])).tolist() == [0, 2]
    assert (history.names().tolist(), history.places[0, 0]) == ([0, 0, 2, 3], 1.0)
    assert history.undo(np.array([1])).tolist() == [0, 1]
    assert (history.names().tolist(), history.places[0, 0]) == ([0, 1, 2, 3], 0.0)


def test_an_earlier_collapse_takes_later_ones_of_its_vertex_back():
    history = history_of(4, (1, 0, 0, [3]), (2, 0, 1, [3]))
    assert history.undo(np.array([1])).tolist() == [0, 1, 2]
    assert (history.count, history.places[0, 0]) == (0, 0.0)


def test_later_collapses_beside_are_undone_and_earlier_ones_stay():
    """The vertex 0 is in the ring of the collapses of 3 and 5; that of 5 came first."""
    history = history_of(8, (5, 4, 0, [0, 7]), (1, 0, 1, [2, 6]), (3, 2, 2, [0, 6]))
    assert history.undo(np.array([1])).tolist() == [0, 1, 2, 3]
    assert history.names().tolist() == [0, 1, 2, 3, 4, 4, 6, 7]


def test_what_depends_on_what_depends_is_undone_too():
    history = history_of(9, (1, 0, 0, [2]), (3, 2, 1, [0, 4]), (5, 4, 2, [2, 6]), (8, 7, 3, [6]))
    assert history.undo(np.array([1])).tolist() == [0, 1, 2, 3, 4, 5]
    assert history.count == 1
