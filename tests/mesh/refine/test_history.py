"""Collapses are undone with those that depend on them, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.mesh.refine.collapse import History

pytestmark = pytest.mark.unit


Collapse = tuple[int, int, int, list[int]]


def collapse(gone: int, *, into: int, turn: int, ring: list[int]) -> Collapse:
    """One vertex goes into another in the round `turn`; the vertices of `ring` lie around both."""
    return gone, into, turn, ring


def history_of(count: int, *collapses: Collapse) -> History:
    """The collapses among `count` vertices; the one that stayed moves by 1 along x in each."""
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
    history = history_of(5, collapse(1, into=0, turn=0, ring=[2, 3]), collapse(0, into=4, turn=1, ring=[2, 3]))
    assert history.names().tolist() == [4, 4, 2, 3, 4]
    assert history.latest().tolist() == [1, -1, -1, -1, 0]
    assert history.count == 2


def test_collapses_into_one_vertex_are_undone_from_the_last_one_on():
    history = history_of(4, collapse(1, into=0, turn=0, ring=[3]), collapse(2, into=0, turn=1, ring=[3]))
    assert history.undo(np.array([2])).tolist() == [0, 2]
    assert (history.names().tolist(), history.places[0, 0]) == ([0, 0, 2, 3], 1.0)
    assert history.undo(np.array([1])).tolist() == [0, 1]
    assert (history.names().tolist(), history.places[0, 0]) == ([0, 1, 2, 3], 0.0)


def test_an_earlier_collapse_takes_later_ones_of_its_vertex_back():
    history = history_of(4, collapse(1, into=0, turn=0, ring=[3]), collapse(2, into=0, turn=1, ring=[3]))
    assert history.undo(np.array([1])).tolist() == [0, 1, 2]
    assert (history.count, history.places[0, 0]) == (0, 0.0)


def test_later_collapses_beside_are_undone_and_earlier_ones_stay():
    """The vertex 0 is in the ring of the collapses of 3 and 5; that of 5 came first."""
    history = history_of(
        8,
        collapse(5, into=4, turn=0, ring=[0, 7]),
        collapse(1, into=0, turn=1, ring=[2, 6]),
        collapse(3, into=2, turn=2, ring=[0, 6]),
    )
    assert history.undo(np.array([1])).tolist() == [0, 1, 2, 3]
    assert history.names().tolist() == [0, 1, 2, 3, 4, 4, 6, 7]


def test_what_depends_on_what_depends_is_undone_too():
    history = history_of(
        9,
        collapse(1, into=0, turn=0, ring=[2]),
        collapse(3, into=2, turn=1, ring=[0, 4]),
        collapse(5, into=4, turn=2, ring=[2, 6]),
        collapse(8, into=7, turn=3, ring=[6]),
    )
    assert history.undo(np.array([1])).tolist() == [0, 1, 2, 3, 4, 5]
    assert history.count == 1
