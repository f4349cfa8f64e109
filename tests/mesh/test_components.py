"""Choosing components by area rank and by enclosed volume."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from refusals import refused

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh import Mesh, select_components, split_components
from clrecon.mesh.components import SEED_REACH_MM
from clrecon.mesh.connectivity import label_components
from clrecon.mesh.quality import measure_components
from clrecon.mesh.triangles import enclosed_ml

pytestmark = pytest.mark.unit

SMALL, LARGE, MIDDLE = 0, 1, 2
"""The number of each of `three_boxes`: vertex and face n belong to box n % 3."""

SMALL_ML, LARGE_ML, MIDDLE_ML = 0.001, 0.060, 0.008


def three_boxes() -> Mesh:
    """1 mm3, 60 mm3 and 8 mm3, their vertices and faces interleaved; one vertex is not used.

    They reach from (500, 0, 0) to (501, 1, 1), from (-3, 2, 1) to (0, 6, 6), and from (9, 9, 9) to (11, 11, 11).
    """
    vertices, triangles = samples.join(
        samples.box((500, 0, 0)), samples.box((-3, 2, 1), size=(3, 4, 5)), samples.box((9, 9, 9), size=(2, 2, 2))
    )
    order = np.arange(24).reshape(3, 8).T.ravel()  # new place -> old number
    place = np.empty(24, dtype=int)
    place[order] = np.arange(24)
    faces = place[triangles].reshape(3, 12, 3).transpose(1, 0, 2).reshape(-1, 3)
    shuffled = np.concatenate([vertices[order], [[0.0, 0.0, 0.0]]])
    normals = np.arange(75, dtype=np.float32).reshape(25, 3)
    return Mesh(shuffled, faces, normals, {"iso_value_hu": 250.0})


def box_rows(number: int) -> np.ndarray:
    """The vertices of one of `three_boxes`."""
    return 3 * np.arange(8) + number


@pytest.mark.parametrize("edge_mm", [10.0, 20.0])
def test_volume_of_a_cube_is_exact_in_millilitres(edge_mm):
    mesh = Mesh(*samples.box((1000, -2000, 500), size=(edge_mm, edge_mm, edge_mm)))
    volume_ml = (edge_mm / 10.0) ** 3
    assert enclosed_ml(mesh.vertices, mesh.triangles) == volume_ml
    assert mesh.quality()["volume_ml"] == volume_ml


@pytest.mark.parametrize("areas", [True, False], ids=["area", "no area"])
@pytest.mark.parametrize("volumes", [True, False], ids=["volume", "no volume"])
def test_area_and_volume_of_a_component_are_measured_where_asked_for_and_else_zero(areas, volumes):
    mesh = Mesh(*samples.box((1000, -2000, 500), size=(20.0, 20.0, 20.0)))
    component_of_triangles = np.zeros(12, np.int64)
    area_mm2, volume_ml = measure_components(
        mesh.vertices, mesh.triangles, component_of_triangles, 1, areas=areas, volumes=volumes
    )
    assert area_mm2.tolist() == [6 * 20.0**2 if areas else 0.0]
    assert volume_ml.tolist() == [8.0 if volumes else 0.0]


def test_keep_largest_keeps_vertices_normals_and_triangles_of_the_component_of_the_largest_area():
    mesh = three_boxes()
    kept = select_components(mesh, keep_largest=1)
    np.testing.assert_array_equal(kept.vertices, mesh.vertices[box_rows(LARGE)])
    np.testing.assert_array_equal(kept.normals, mesh.normals[box_rows(LARGE)])
    np.testing.assert_array_equal(kept.triangles, (mesh.triangles[LARGE::3] - LARGE) // 3)
    assert kept.triangles.dtype == np.uint32


def test_report_of_kept_components_counts_them_and_that_of_the_given_mesh_stays():
    mesh = three_boxes()
    kept = select_components(mesh, keep_largest=1)
    assert kept.report == {"iso_value_hu": 250.0, "components_found": 3, "components_kept": 1}
    assert mesh.report == {"iso_value_hu": 250.0}


def test_keep_largest_2_keeps_the_two_largest_components():
    kept = select_components(three_boxes(), keep_largest=2)
    assert kept.report["components_kept"] == 2
    assert kept.quality()["volume_ml"] == pytest.approx(LARGE_ML + MIDDLE_ML)


@pytest.mark.parametrize(
    ("least_ml", "volume_ml"),
    [(0.0, SMALL_ML + MIDDLE_ML + LARGE_ML), (0.0079, MIDDLE_ML + LARGE_ML), (0.0081, LARGE_ML)],
    ids=["no limit", "just below the middle one", "just above the middle one"],
)
def test_components_below_the_least_volume_are_removed(least_ml, volume_ml):
    kept = select_components(three_boxes(), min_volume_ml=least_ml)
    assert kept.quality()["volume_ml"] == pytest.approx(volume_ml)


def test_number_and_least_volume_apply_together():
    kept = select_components(three_boxes(), keep_largest=2, min_volume_ml=0.01)
    assert kept.report["components_kept"] == 1
    assert kept.quality()["volume_ml"] == pytest.approx(LARGE_ML)


def test_a_mesh_without_components_to_remove_is_returned_itself_with_their_number():
    mesh = three_boxes()
    assert select_components(mesh, keep_largest=3) is mesh
    assert (mesh.report["components_found"], mesh.report["components_kept"]) == (3, 3)


def test_a_selection_without_limits_returns_the_mesh_itself():
    mesh = three_boxes()
    assert select_components(mesh) is mesh


def test_the_largest_component_is_that_of_the_largest_area_not_volume():
    flat = samples.box((0, 0, 0), size=(40, 40, 0.01))  # 3201.6 mm2, 16 mm3
    cube = samples.box((100, 0, 0), size=(10, 10, 10))  # 600 mm2, 1000 mm3
    kept = select_components(Mesh(*samples.join(cube, flat)), keep_largest=1)
    assert kept.quality()["area_mm2"] == pytest.approx(3201.6, rel=tolerances.MESH_VOLUME)


def test_of_components_of_equal_area_the_first_is_kept():
    kept = select_components(Mesh(*samples.join(samples.box((7, 0, 0)), samples.box())), keep_largest=1)
    assert kept.vertices[:, 0].min() == 7.0


def test_a_cavity_is_kept_by_its_volume_without_the_sign():
    outer, (corners, faces) = samples.box((0, 0, 0), size=(9, 9, 9)), samples.box((3, 3, 3), size=(3, 3, 3))
    mesh = Mesh(*samples.join(outer, (corners, faces[:, ::-1])))  # the cavity has -0.027 ml
    assert select_components(mesh, min_volume_ml=0.026) is mesh
    without_cavity = select_components(mesh, min_volume_ml=0.028)
    assert without_cavity.quality()["volume_ml"] == pytest.approx(0.729)


@pytest.mark.parametrize(("least_ml", "kept"), [(0.83, 2), (1.0, 1)], ids=["without a pyramid", "whole cube"])
def test_volume_of_an_open_component_lacks_the_pyramid_over_its_hole_wherever_it_lies(least_ml, kept):
    """A cube of 1 ml far from the origin without one of its 12 faces of 50 mm2, and a cube of 27 ml.

    From a point within the cube the pyramid over that face has at most 50 * 10 / 3 mm3, 0.167 ml.
    """
    vertices, triangles = samples.box((5000, -3000, 800), size=(10, 10, 10))
    opened = (vertices, np.delete(triangles, 4, axis=0))
    mesh = Mesh(*samples.join(opened, samples.box((0, 0, 0), size=(30, 30, 30))))
    assert select_components(mesh, min_volume_ml=least_ml).report["components_kept"] == kept


def test_a_cube_beside_an_open_component_is_refused_above_its_own_volume():
    vertices, triangles = samples.box((5000, -3000, 800), size=(10, 10, 10))
    opened = (vertices, np.delete(triangles, 4, axis=0))
    mesh = Mesh(*samples.join(opened, samples.box((0, 0, 0), size=(30, 30, 30))))
    with refused(NoSurfaceError, 27):
        select_components(mesh, min_volume_ml=27.1)


def test_a_least_volume_above_every_component_is_refused_with_the_largest_volume():
    with refused(NoSurfaceError, 3, 1, LARGE_ML):
        select_components(three_boxes(), min_volume_ml=1.0)


def test_components_of_an_empty_mesh_are_refused():
    with refused(NoSurfaceError, "surface"):
        select_components(Mesh([], []), keep_largest=1)


@pytest.mark.parametrize(
    "arguments",
    [
        {"keep_largest": 0},
        {"keep_largest": -2},
        {"keep_largest": 1.5},
        {"min_volume_ml": -1.0},
        {"min_volume_ml": float("nan")},
        {"min_volume_ml": float("inf")},
    ],
)
def test_a_number_below_1_and_a_volume_below_0_or_not_finite_are_refused(arguments):
    with pytest.raises(UsageError, match="keep_largest is a whole number|min_volume_ml is a volume"):
        select_components(three_boxes(), **arguments)


def test_split_returns_vertices_normals_and_triangles_of_each_component_the_largest_first():
    mesh = three_boxes()
    pieces = split_components(mesh)
    for number, piece in zip((LARGE, MIDDLE, SMALL), pieces, strict=True):
        np.testing.assert_array_equal(piece.vertices, mesh.vertices[box_rows(number)])
        np.testing.assert_array_equal(piece.normals, mesh.normals[box_rows(number)])
        np.testing.assert_array_equal(piece.triangles, (mesh.triangles[number::3] - number) // 3)
        assert piece.triangles.dtype == np.uint32


def test_report_of_each_split_component_counts_them_all_and_that_of_the_given_mesh_stays():
    mesh = three_boxes()
    pieces = split_components(mesh)
    counted = {"iso_value_hu": 250.0, "components_found": 3, "components_kept": 3}
    assert [piece.report for piece in pieces] == [counted] * 3
    assert mesh.report == {"iso_value_hu": 250.0}


def test_split_leaves_out_components_that_number_and_least_volume_remove():
    (piece,) = split_components(three_boxes(), keep_largest=2, min_volume_ml=0.01)
    assert piece.report["components_kept"] == 1
    assert piece.quality()["volume_ml"] == pytest.approx(LARGE_ML)


def test_split_of_a_single_component_is_one_mesh():
    assert len(split_components(Mesh(*samples.box()))) == 1


def test_split_components_of_equal_size_keep_their_order():
    x_of_boxes = [7.0, 0.0, 3.0]
    pieces = split_components(Mesh(*samples.join(*(samples.box((x, 0, 0)) for x in x_of_boxes))))
    assert [piece.vertices[:, 0].min() for piece in pieces] == x_of_boxes


def test_split_into_as_many_components_as_allowed_is_not_refused():
    assert len(split_components(three_boxes(), most=3)) == 3


def test_split_into_more_components_than_allowed_is_refused():
    found, allowed = 3, 2
    crumb_ml = 0.1  # all three boxes are below it, and are counted: no least volume can be advised
    with refused(UsageError, "min_volume_ml=ML", found, allowed, crumb_ml):
        split_components(three_boxes(), most=allowed)


@pytest.mark.parametrize(
    ("seeds", "kept", "distances_mm"),
    [
        ([(0, 4, 3)], [LARGE], [0.0]),
        ([(499, 0, 0)], [SMALL], [1.0]),
        ([(499, 0, 0), (9, 9, 14), (500, 0, -2)], [SMALL, MIDDLE], [1.0, 3.0, 2.0]),
    ],
    ids=["on the large box", "beside the small box", "two at the small box, one at the middle box"],
)
def test_the_component_nearest_to_each_seed_is_kept_and_its_distance_reported(seeds, kept, distances_mm):
    chosen = select_components(three_boxes(), seeds=seeds)
    expected = np.concatenate([three_boxes().vertices[box_rows(number)] for number in kept])
    assert set(map(tuple, chosen.vertices)) == set(map(tuple, expected))
    assert chosen.report["seed_distances_mm"] == pytest.approx(distances_mm)
    assert chosen.report["components_kept"] == len(kept)


BESIDE_THE_MIDDLE_BOX = (8.5, 10, 10)
ON_THE_LARGE_BOX = (0, 5, 6)


@pytest.mark.parametrize(
    ("seeds", "limits", "volume_ml"),
    [
        ([BESIDE_THE_MIDDLE_BOX, ON_THE_LARGE_BOX], {"min_volume_ml": 0.01}, LARGE_ML),
        ([BESIDE_THE_MIDDLE_BOX], {"keep_largest": 1}, MIDDLE_ML),
        ([BESIDE_THE_MIDDLE_BOX, ON_THE_LARGE_BOX], {"keep_largest": 1}, LARGE_ML),
    ],
    ids=["small ones go first", "largest of one", "largest of two"],
)
def test_small_components_are_removed_before_seeds_choose_and_the_largest_of_the_chosen_are_kept(
    seeds, limits, volume_ml
):
    kept = select_components(three_boxes(), seeds=seeds, **limits)
    assert kept.quality()["volume_ml"] == pytest.approx(volume_ml)


def test_split_returns_the_component_nearest_to_a_seed():
    (piece,) = split_components(three_boxes(), seeds=[BESIDE_THE_MIDDLE_BOX])
    assert piece.quality()["volume_ml"] == pytest.approx(MIDDLE_ML)


def test_a_seed_further_than_its_reach_from_every_component_is_refused_with_its_distance():
    end_of_the_small_box, beyond = 501.0, SEED_REACH_MM + 0.5
    with refused(UsageError, "LPS", beyond, SEED_REACH_MM):
        select_components(three_boxes(), seeds=[ON_THE_LARGE_BOX, (end_of_the_small_box + beyond, 0.5, 0.5)])


def test_a_seed_as_far_as_its_reach_from_a_component_keeps_it():
    end_of_the_small_box = 501.0
    kept = select_components(three_boxes(), seeds=[(end_of_the_small_box + SEED_REACH_MM, 0.5, 0.5)])
    assert kept.quality()["volume_ml"] == pytest.approx(SMALL_ML)


@pytest.mark.parametrize("seed", [(1.0, 2.0), (1.0, 2.0, float("nan")), (1, 2, 3, 4)], ids=["two", "nan", "four"])
def test_a_seed_that_is_not_three_finite_numbers_is_refused(seed):
    with refused(UsageError, "point", "three", "numbers"):
        select_components(three_boxes(), seeds=[seed])


def test_the_largest_of_more_components_than_a_piece_has_triangles_is_kept():
    """20,000 cubes of 1 mm along x, one of them of 2 mm: pieces of 16,384 triangles grow with the components."""
    count, large = 20_000, 777
    x_of_boxes = np.arange(count) * 3.0
    vertices, triangles = samples.box()
    row_of_boxes = (vertices[None] + x_of_boxes[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    faces = (triangles[None] + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    row_of_boxes[8 * large : 8 * large + 8] = samples.box((x_of_boxes[large], 0, 0), size=(2, 2, 2))[0]

    kept = select_components(Mesh(row_of_boxes, faces), keep_largest=1, min_volume_ml=0.002)

    assert kept.report["components_found"] == count
    assert kept.vertices[:, 0].min() == x_of_boxes[large]


def test_known_labels_choose_the_components_as_found_ones_do():
    mesh = three_boxes()
    labelled = label_components(mesh.triangles, mesh.vertex_count)
    kept = select_components(mesh, keep_largest=1, labelled=labelled)
    np.testing.assert_array_equal(kept.vertices, select_components(mesh, keep_largest=1).vertices)


def test_known_labels_are_taken_in_place_of_the_connection_of_triangles():
    mesh = three_boxes()
    one_label_for_all = (1, np.zeros(mesh.vertex_count, dtype=np.int64))
    assert select_components(mesh, keep_largest=1, labelled=one_label_for_all) is mesh


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("reach_mm", [400.0, 3000.0, 50_000.0])
def test_equal_components_are_in_the_order_of_the_mesh_wherever_they_lie(reach_mm, seed):
    """Coordinates are rounded differently at each place, and so are areas."""
    centres = np.random.default_rng(seed).uniform(-reach_mm, reach_mm, (4, 3))
    if reach_mm > 4096:  # mm: so far away a mesh lies around a point near to it, from which float32 counts
        centres = centres[0] + centres / 100
    vertices, triangles = samples.sphere((0, 0, 0), radius=7.3, rounds=3)
    mesh = Mesh(*samples.join(*[((vertices + centre).astype(np.float64), triangles) for centre in centres]))

    pieces = split_components(mesh)
    largest_two = select_components(mesh, keep_largest=2)

    in_order = mesh.vertices.reshape(4, len(vertices), 3)
    np.testing.assert_array_equal([piece.vertices for piece in pieces], in_order)
    np.testing.assert_array_equal(largest_two.vertices, np.concatenate(in_order[:2]))


def test_components_that_differ_by_more_than_rounding_are_in_the_order_of_size():
    """Areas grow by a hundredth of a per mille, 400 mm from the origin; the order is no chain of equal neighbours."""
    vertices, triangles = samples.sphere((400, 0, 0), radius=10.0, rounds=3)
    scales = 1.0 + 5e-6 * np.arange(40)
    mesh = Mesh(*samples.join(*[(vertices * scale, triangles) for scale in scales]))
    kept = select_components(mesh, keep_largest=1)
    row = int(np.flatnonzero((mesh.vertices == kept.vertices[0]).all(axis=1))[0])
    assert row // len(vertices) >= 36  # the last four are equal up to rounding, of which the first in order is kept


@pytest.mark.parametrize("seed", range(20))
def test_a_component_of_exactly_the_least_volume_is_kept_wherever_it_lies(seed):
    vertices, triangles = samples.box((0.05, 0.05, 0.05), size=(10, 10, 10))
    mesh = Mesh(vertices + np.random.default_rng(seed).uniform(-900, 900, 3), triangles)
    assert select_components(mesh, min_volume_ml=1.0) is mesh


def test_a_component_a_per_mille_below_the_least_volume_is_removed():
    one_ml = Mesh(*samples.box((0.05, 0.05, 0.05), size=(10, 10, 10)))
    with refused(NoSurfaceError, 1.001):
        select_components(one_ml, min_volume_ml=1.001)
