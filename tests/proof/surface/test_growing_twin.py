"""The paper's frontier enters exactly the components of active cells that hold a seed: the identity of growing."""

from __future__ import annotations

import numpy as np
import pytest
from surface_volumes import smooth_volume

from clrecon.proof.surface.growing import (
    choose_largest,
    count_visited,
    find_active,
    find_mixed,
    find_seeded,
    grow_cells,
    label_cells,
)


def inside_masks() -> dict[str, np.ndarray]:
    """Which samples are inside, by the name of what they show."""
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


@pytest.mark.parametrize("name", inside_masks())
def test_growing_from_seeds_finds_all_cells_of_their_components_and_no_others(name: str) -> None:
    inside = inside_masks()[name]
    count, numbers = label_cells(inside)
    rng = np.random.default_rng(5)
    seeded_components = np.unique(rng.integers(0, count, 3))
    seeds = [tuple(rng.permutation(np.argwhere(numbers == component))[0]) for component in seeded_components]

    grown = grow_cells(inside, seeds)

    assert (grown.cells == np.isin(numbers, seeded_components)).all()


@pytest.mark.parametrize("name", inside_masks())
def test_growing_visits_as_many_cells_as_are_counted_for_its_result_and_no_more_than_all(name: str) -> None:
    inside = inside_masks()[name]
    first_and_last_cell = [tuple(cell) for cell in np.argwhere(find_active(inside))[[0, -1]]]

    grown = grow_cells(inside, first_and_last_cell)

    assert grown.visited == count_visited(grown.cells)
    assert grown.cells.sum() <= grown.visited <= find_active(inside).size


@pytest.mark.parametrize("name", inside_masks())
def test_components_have_numbers_from_0_at_the_active_cells_alone(name: str) -> None:
    inside = inside_masks()[name]
    count, numbers = label_cells(inside)
    assert count == numbers.max() + 1
    assert ((numbers >= 0) == find_active(inside)).all()


def test_components_of_cells_are_numbered_in_the_order_of_their_first_cells() -> None:
    _, numbers = label_cells(inside_masks()["sparse noise"])
    first_cells = np.unique(numbers[numbers >= 0], return_index=True)[1]
    assert len(first_cells) > 5  # enough to be out of order: measured 24
    assert (np.diff(first_cells) > 0).all()


# the hollow block has a surface outside and one within
@pytest.mark.parametrize("name", ["two blocks", "a hollow block"])
def test_two_blocks_and_a_hollow_block_have_two_components(name: str) -> None:
    assert label_cells(inside_masks()[name])[0] == 2


def test_blocks_whose_cells_share_an_edge_alone_are_two_components() -> None:
    inside = np.zeros((2, 3, 3), bool)
    inside[:, 0, 0] = inside[:, 2, 2] = True  # no face between the cells around them has corners of both kinds
    assert label_cells(inside)[0] == 2


@pytest.mark.parametrize("bits", range(16))
def test_face_is_mixed_exactly_where_one_to_three_of_its_corners_are_inside(bits: int) -> None:
    corners_inside = np.array([bits >> n & 1 for n in range(4)], bool)
    inside = np.zeros((3, 2, 2), bool)
    inside[1] = corners_inside.reshape(2, 2)
    assert find_mixed(inside, 0)[0, 0, 0] == (1 <= corners_inside.sum() <= 3)


def test_cells_beside_a_crossed_edge_belong_to_one_component() -> None:
    inside = np.random.default_rng(6).random((6, 7, 8)) < 0.4
    _, numbers = label_cells(inside)

    crossed_edges = np.argwhere(inside[1:-1, 1:-1, :-1] != inside[1:-1, 1:-1, 1:])  # along i

    assert len(crossed_edges) > 50  # measured 71 of 4 x 5 x 7
    around = np.array([numbers[k : k + 2, j : j + 2, i].ravel() for k, j, i in crossed_edges])
    assert (around == around[:, :1]).all()
    assert around.min() >= 0


@pytest.mark.parametrize(
    ("seed_kji", "chosen"),
    [
        pytest.param((5, 5, 6), [False, False], id="seed outside between both blocks"),
        pytest.param((5, 5, 3), [True, False], id="seed in the first block"),
    ],
)
def test_seed_chooses_the_component_of_which_it_is_an_inside_corner(
    seed_kji: tuple[int, int, int], chosen: list[bool]
) -> None:
    inside = inside_masks()["two blocks"]
    count, numbers = label_cells(inside)
    seeds = np.zeros(inside.shape, bool)
    seeds[seed_kji] = True
    assert find_seeded(inside, seeds, numbers, count).tolist() == chosen


def test_components_of_at_least_a_share_of_the_largest_are_chosen() -> None:
    sizes = np.array([100, 5, 4, 40])
    assert choose_largest(sizes, 0.05).tolist() == [True, True, False, True]
