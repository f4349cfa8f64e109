"""The paper's frontier enters exactly the components of active cells that hold a seed: the identity of growing."""

from __future__ import annotations

import numpy as np
import pytest
from surface_volumes import smooth_volume

from clrecon.proof.surface.case_table import CORNERS, EDGES, case_table
from clrecon.proof.surface.growing import (
    choose_largest,
    count_visited,
    find_active,
    find_mixed,
    find_seeded,
    grow_cells,
    label_cells,
)


def scenes() -> dict[str, np.ndarray]:
    k, j, i = np.indices((11, 12, 13))
    apart = ((i < 4) | (i > 8)) & (j > 2) & (j < 8) & (k > 2) & (k < 8)
    hollow = (np.abs(np.stack([i - 6, j - 6, k - 5])).max(0) < 5) & (np.abs(np.stack([i - 6, j - 6, k - 5])).max(0) > 1)
    rng = np.random.default_rng(4)
    return {
        "two blocks": apart,
        "a hollow block": hollow,
        "dense noise": rng.random((9, 10, 11)) < 0.5,
        "sparse noise": rng.random((9, 10, 11)) < 0.03,
        "a smooth field": smooth_volume((14, 15, 16)).voxels > 200,
        "one cell": np.arange(8).reshape(2, 2, 2) == 3,
    }


@pytest.mark.parametrize("name", scenes())
def test_growing_from_seeds_finds_all_cells_of_their_components_and_no_others(name: str) -> None:
    inside = scenes()[name]
    count, numbers = label_cells(inside)
    assert count == numbers.max() + 1 and ((numbers >= 0) == find_active(inside)).all()
    rng = np.random.default_rng(5)
    wanted = np.unique(rng.integers(0, count, 3))
    seeds = [tuple(rng.permutation(np.argwhere(numbers == component))[0]) for component in wanted]
    grown = grow_cells(inside, seeds)
    assert (grown.cells == np.isin(numbers, wanted)).all()
    assert grown.visited == count_visited(grown.cells)
    assert grown.cells.sum() <= grown.visited <= numbers.size


def test_components_of_cells_are_numbered_in_the_order_of_their_first_cells() -> None:
    _, numbers = label_cells(scenes()["sparse noise"])
    firsts = np.unique(numbers[numbers >= 0], return_index=True)[1]
    assert (np.diff(firsts) > 0).all() and len(firsts) > 5


def test_components_of_blocks_are_counted_as_known() -> None:
    assert label_cells(scenes()["two blocks"])[0] == 2
    assert label_cells(scenes()["a hollow block"])[0] == 2
    # Two cells that share an edge alone: the faces between them and their neighbours are all alike or mixed.
    inside = np.zeros((2, 3, 3), bool)
    inside[:, 0, 0] = inside[:, 2, 2] = True
    assert label_cells(inside)[0] == 2


def test_face_is_mixed_exactly_where_one_to_three_of_its_corners_are_inside() -> None:
    for bits in range(16):
        inside = np.zeros((3, 2, 2), bool)
        inside[1] = np.array([bits >> n & 1 for n in range(4)], bool).reshape(2, 2)
        assert find_mixed(inside, 0)[0, 0, 0] == (bits not in (0, 15))


def test_cells_beside_a_crossed_edge_belong_to_one_component() -> None:
    inside = np.random.default_rng(6).random((6, 7, 8)) < 0.4
    _, numbers = label_cells(inside)
    for k, j, i in np.argwhere(inside[1:-1, 1:-1, :-1] != inside[1:-1, 1:-1, 1:]):
        around = numbers[k : k + 2, j : j + 2, i]
        assert len(np.unique(around)) == 1 and around.min() >= 0


def test_every_crossed_edge_of_an_active_cell_has_a_corner_of_its_triangles() -> None:
    for case, triangles in enumerate(case_table()):
        crossed = {
            number for number, (_, low, high) in enumerate(EDGES) if (case >> low & 1) != (case >> high & 1)
        }  # fmt: skip
        assert {edge for triangle in triangles for edge in triangle} == crossed
    assert len(CORNERS) == 8


def test_seeds_choose_by_inside_corners_and_shares_by_size() -> None:
    inside = scenes()["two blocks"]
    count, numbers = label_cells(inside)
    seeds = np.zeros(inside.shape, bool)
    seeds[5, 5, 6] = True  # outside, between both
    assert not find_seeded(inside, seeds, numbers, count).any()
    seeds[5, 5, 3] = True
    assert find_seeded(inside, seeds, numbers, count).tolist() == [True, False]
    assert choose_largest(np.array([100, 5, 4, 40]), 0.05).tolist() == [True, True, False, True]
