"""Cells of shapes that are counted by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import sample_meshes as samples
from refusals import refused
from sample_meshes import SHEARED, placed
from uneven_volume import uneven

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.proof.compare.mesh_cells import GridCells, _steps_per_mm, find_mesh_cells, measure_cells, meets_box

pytestmark = pytest.mark.unit


FAR = SHEARED + np.array([[0.0, 0, 0, 1250.0], [0, 0, 0, -1071.0], [0, 0, 0, 846.0], [0, 0, 0, 0]])
"""Where float32 rounds millimetres to 1e-4."""


def grid(shape=(12, 12, 12), affine=None) -> Volume:
    return Volume(np.zeros(shape, np.int16), np.eye(4) if affine is None else affine)


def cells_of(mesh: samples.Arrays, on: Volume) -> set[tuple[int, ...]]:
    return set(map(tuple, find_mesh_cells(placed(mesh, on), on).ijk.tolist()))


def shell(low: int, high: int) -> set[tuple[int, ...]]:
    """Cells of a cube's faces: from `low` to `high`, both included, along each axis."""
    every = itertools.product(range(low, high + 1), repeat=3)
    return {cell for cell in every if any(n in (low, high) for n in cell)}


@pytest.mark.parametrize("affine", [np.eye(4), SHEARED], ids=["even", "sheared"])
def test_cells_of_a_box_are_those_of_its_six_faces(affine):
    box_from_2_5_to_7_5 = samples.box(low=(2.5,) * 3, size=(5.0,) * 3)
    assert cells_of(box_from_2_5_to_7_5, grid(affine=affine)) == shell(2, 7)


@pytest.mark.parametrize("affine", [np.eye(4), SHEARED], ids=["even", "sheared"])
def test_box_within_a_cell_passes_through_that_cell_alone(affine):
    box_from_2_25_to_2_75 = samples.box(low=(2.25,) * 3, size=(0.5,) * 3)
    assert cells_of(box_from_2_25_to_2_75, grid(affine=affine)) == {(2, 2, 2)}


@pytest.mark.parametrize("affine", [np.eye(4), SHEARED, FAR], ids=["even", "sheared", "far"])
def test_faces_between_cells_belong_to_the_upper_ones(affine):
    low, high = 2, 7
    wanted = set()
    for axis, plane in itertools.product(range(3), (low, high)):
        for u, v in itertools.product(range(low, high), repeat=2):
            cell = [u, v]
            cell.insert(axis, plane)
            wanted.add(tuple(cell))
    assert cells_of(samples.box(low=(2.0,) * 3, size=(5.0,) * 3), grid(affine=affine)) == wanted


def test_cells_that_a_diagonal_plane_touches_at_a_corner_alone_are_not_its_cells():
    # x + y + z = 4: the cells whose lowest corner has the sum 2 or 3, its highest then 5 or 6
    corners = np.array([[4.0, 0, 0], [0, 4, 0], [0, 0, 4]])
    cells = cells_of((corners, np.array([[0, 1, 2]])), grid())
    assert cells == {cell for cell in itertools.product(range(4), repeat=3) if sum(cell) in (2, 3)}


@pytest.mark.parametrize("number", range(3))
def test_cells_of_a_triangle_across_the_grid_are_those_of_which_clipping_leaves_a_part(number):
    corners = np.random.default_rng(5).uniform(0.5, 14.5, (3, 3, 3))[number]
    within_its_bounds = itertools.product(*(range(int(n.min()), int(n.max()) + 1) for n in corners.T))

    expected = {cell for cell in within_its_bounds if clip(corners - np.array(cell) - 0.5).size}

    assert len(expected) > 64  # more than one part of the search; measured 75 to 77
    assert cells_of((corners, np.array([[0, 1, 2]])), grid(shape=(16, 16, 16), affine=SHEARED)) == expected


def test_triangles_that_meet_a_box_are_those_of_which_clipping_leaves_a_part():
    rng = np.random.default_rng(1)
    corners = rng.normal(0.0, 0.8, (2000, 3, 3))
    assert np.array_equal(meets_box(corners, 0.5), [clip(triangle).size > 0 for triangle in corners])


def clip(polygon: np.ndarray) -> np.ndarray:
    """What is left of a polygon (n, 3) in the cube from -0.5 to 0.5 (Sutherland and Hodgman 1974)."""
    for axis, sign in itertools.product(range(3), (1.0, -1.0)):
        kept = []
        for here, after in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            depth, later = 0.5 - sign * here[axis], 0.5 - sign * after[axis]
            if depth >= 0.0:
                kept.append(here)
            if depth * later < 0.0:
                kept.append(here + depth / (depth - later) * (after - here))
        if not kept:
            return np.zeros((0, 3))
        polygon = np.array(kept)
    return polygon


ONE = GridCells([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 0, 0]])
OTHER = GridCells([[1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0], [-1, 0, 0]], "t-mc")
"""Three and five different cells, of which two are common."""


def test_different_and_common_cells_of_two_surfaces_are_counted():
    found = measure_cells(ONE, OTHER, grid())
    assert (found.cells, found.reference_cells, found.common_cells, found.reference) == (3, 5, 2, "t-mc")


def test_overlap_of_cells_has_recall_precision_dice_and_jaccard_by_hand():
    found = measure_cells(ONE, OTHER, grid())
    assert found.recall == pytest.approx(2 / 5)
    assert found.precision == pytest.approx(2 / 3)
    assert found.dice == pytest.approx(2 * 2 / (3 + 5))
    assert found.jaccard == pytest.approx(2 / (3 + 5 - 2))


def test_recall_of_cells_is_the_precision_where_surface_and_reference_are_exchanged():
    assert measure_cells(OTHER, ONE, grid()).recall == measure_cells(ONE, OTHER, grid()).precision


def test_cells_have_the_lowest_corners_that_they_were_made_of():
    corners = [[5, -1, 2], [0, 0, -70], [900_000, 3, 0]]
    assert sorted(GridCells(corners).ijk.tolist()) == sorted(corners)


def test_cells_of_no_corners_are_none():
    assert len(GridCells([])) == 0


def test_cells_show_their_number_and_name():
    assert repr(GridCells([[5, -1, 2], [0, 0, -70], [9, 3, 0]], "truth")) == "GridCells(3 cells of truth)"


EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.uint32))


def test_surface_without_cells_is_not_measured():
    with pytest.raises(NoSurfaceError, match="the surface passes through no cell"):
        measure_cells(EMPTY, placed(samples.box(low=(2.5,) * 3, size=(5.0,) * 3), grid()), grid())


def test_reference_without_cells_is_not_measured():
    with pytest.raises(NoSurfaceError, match="the reference passes through no cell"):
        measure_cells(placed(samples.box(low=(2.5,) * 3, size=(5.0,) * 3), grid()), EMPTY, grid())


def test_surface_outside_of_the_grid_is_refused_with_its_extent():
    box_from_14_to_19 = placed(samples.box(low=(14.5,) * 3, size=(5.0,) * 3), grid())
    box = placed(samples.box(low=(2.5,) * 3, size=(5.0,) * 3), grid())
    with refused(UsageError, 14, 19):
        measure_cells(box_from_14_to_19, box, grid())


def test_mesh_of_kilometres_is_refused_as_of_another_grid():
    with pytest.raises(UsageError, match="does not belong to this grid"):
        find_mesh_cells(Mesh([[0, 0, 0], [3e6, 0, 0], [0, 1, 0]], [[0, 1, 2]]), grid())


def test_cell_beyond_20_bits_is_refused():
    with refused(UsageError, 1 << 20):
        GridCells([[0, 0, 1 << 20]])


def test_cell_of_part_numbers_is_refused():
    with refused(UsageError, "shape", 3):
        GridCells([[0.5, 1, 2]])


def test_cells_of_a_box_beyond_the_grid_are_counted_apart():
    on = grid(shape=(6, 6, 6))
    found = measure_cells(placed(samples.box(low=(2.5,) * 3, size=(5.0,) * 3), on), GridCells([[2, 2, 2]]), on)
    inside = {cell for cell in shell(2, 7) if max(cell) < 6}
    assert found.cells_outside == found.cells - len(inside)
    assert found.common_cells == 1  # (2, 2, 2) is the first corner of the box


def test_search_for_cells_tells_its_progress_in_triangles():
    told = []
    on = grid()
    find_mesh_cells(placed(samples.box(), on), on, progress=lambda *what: told.append(what))
    assert told == [("cells", 0, 12), ("cells", 12, 12)]  # a box has 12


def test_index_steps_of_a_millimetre_are_those_of_the_narrowest_slices():
    assert _steps_per_mm(grid(affine=np.diag((0.5, 2.0, 0.8, 1.0)))) == pytest.approx(2.0)
    narrow = uneven()  # 0.25 mm, where the mean step is 1.8 and a pixel 0.5
    assert _steps_per_mm(narrow) == pytest.approx(1 / 0.25)
    assert _steps_per_mm(narrow[:3]) == pytest.approx(1 / 0.5)  # of a pixel: these slices are farther apart
