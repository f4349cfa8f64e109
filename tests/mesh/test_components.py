"""Choosing components by area rank and by enclosed volume."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from refusals import refused

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.mesh import Mesh, select_components, split_components
from clrecon.mesh.connectivity import label_components
from clrecon.mesh.quality import measure_components
from clrecon.mesh.triangles import enclosed_ml

pytestmark = pytest.mark.unit

SMALL, LARGE, MIDDLE = 0, 1, 2


def three_boxes() -> Mesh:
    """1 mm3, 60 mm3 and 8 mm3, their vertices and faces interleaved; one vertex is not used."""
    vertices, triangles = samples.join(
        samples.box((500, 0, 0)), samples.box((-3, 2, 1), (3, 4, 5)), samples.box((9, 9, 9), (2, 2, 2))
    )
    order = np.arange(24).reshape(3, 8).T.ravel()  # new place -> old number
    place = np.empty(24, dtype=int)
    place[order] = np.arange(24)
    faces = place[triangles].reshape(3, 12, 3).transpose(1, 0, 2).reshape(-1, 3)
    shuffled = np.concatenate([vertices[order], [[0.0, 0.0, 0.0]]])
    normals = np.arange(75, dtype=np.float32).reshape(25, 3)
    return Mesh(shuffled, faces, normals, {"iso_value_hu": 250.0})


@pytest.mark.parametrize("edge", [10.0, 20.0])
def test_a_cube_of_10_mm_holds_a_millilitre(edge):
    # Figures of cubes are exact in float64, whichever way they are summed up.
    mesh = Mesh(*samples.box((1000, -2000, 500), (edge, edge, edge)))
    volume_ml = (edge / 10.0) ** 3
    assert enclosed_ml(mesh.vertices, mesh.triangles) == volume_ml
    assert mesh.quality()["volume_ml"] == volume_ml
    for areas, volumes in ((True, True), (True, False), (False, True), (False, False)):
        figures = measure_components(
            mesh.vertices, mesh.triangles, np.zeros(12, np.int64), 1, areas=areas, volumes=volumes
        )
        assert [part.tolist() for part in figures] == [[6.0 * edge**2 * areas], [volume_ml * volumes]]


def test_keep_largest_keeps_the_component_of_the_largest_area():
    mesh = three_boxes()
    kept = select_components(mesh, keep_largest=1)
    assert (kept.vertex_count, kept.triangle_count) == (8, 12)
    rows = 3 * np.arange(8) + LARGE
    np.testing.assert_array_equal(kept.vertices, mesh.vertices[rows])
    np.testing.assert_array_equal(kept.normals, mesh.normals[rows])
    np.testing.assert_array_equal(kept.triangles, (mesh.triangles[LARGE::3] - LARGE) // 3)
    assert kept.report == {"iso_value_hu": 250.0, "components_found": 3, "components_kept": 1}
    assert mesh.report == {"iso_value_hu": 250.0}
    assert kept.quality()["volume_ml"] == pytest.approx(0.060)
    assert kept.triangles.dtype == np.uint32


def test_keep_largest_2_keeps_two_components():
    kept = select_components(three_boxes(), keep_largest=2)
    assert kept.quality()["volume_ml"] == pytest.approx(0.068)
    assert kept.report["components_kept"] == 2


@pytest.mark.parametrize(("least", "volume"), [(0.0079, 0.068), (0.0081, 0.060), (0.0, 0.069)])
def test_components_below_the_least_volume_are_removed(least, volume):
    kept = select_components(three_boxes(), min_volume_ml=least)
    assert kept.quality()["volume_ml"] == pytest.approx(volume)


def test_number_and_least_volume_apply_together():
    kept = select_components(three_boxes(), keep_largest=2, min_volume_ml=0.01)
    assert kept.report["components_kept"] == 1
    assert kept.quality()["volume_ml"] == pytest.approx(0.060)


def test_nothing_to_drop_gives_the_mesh_itself():
    mesh = three_boxes()
    assert select_components(mesh, keep_largest=3) is mesh
    assert mesh.report["components_found"] == mesh.report["components_kept"] == 3
    assert select_components(mesh) is mesh


def test_rank_is_by_area_not_volume():
    flat = samples.box((0, 0, 0), (40, 40, 0.01))  # 3201.6 mm2, 16 mm3
    cube = samples.box((100, 0, 0), (10, 10, 10))  # 600 mm2, 1000 mm3
    kept = select_components(Mesh(*samples.join(cube, flat)), keep_largest=1)
    assert kept.quality()["area_mm2"] == pytest.approx(3201.6, rel=1e-6)


def test_equal_areas_keep_the_first():
    kept = select_components(Mesh(*samples.join(samples.box((7, 0, 0)), samples.box())), keep_largest=1)
    assert kept.vertices[:, 0].min() == 7.0


def test_cavity_counts_without_its_sign():
    vertices, triangles = samples.join(samples.box((0, 0, 0), (9, 9, 9)), samples.box((3, 3, 3), (3, 3, 3)))
    triangles[12:] = triangles[12:, ::-1]
    mesh = Mesh(vertices, triangles)
    assert select_components(mesh, min_volume_ml=0.026) is mesh
    filled = select_components(mesh, min_volume_ml=0.028)
    assert filled.quality()["volume_ml"] == pytest.approx(0.729)


def test_volume_of_an_open_component_does_not_depend_on_its_place():
    vertices, triangles = samples.box((5000, -3000, 800), (10, 10, 10))
    opened = (vertices, np.delete(triangles, 4, axis=0))
    mesh = Mesh(*samples.join(opened, samples.box((0, 0, 0), (30, 30, 30))))
    with refused(NoSurfaceError, 27):
        select_components(mesh, min_volume_ml=27.1)
    # 1/12 of the faces is missing: the pyramid over it is not counted.
    assert select_components(mesh, min_volume_ml=0.8).report["components_kept"] == 2
    assert select_components(mesh, min_volume_ml=1.0).report["components_kept"] == 1


def test_components_are_refused_where_none_is_left():
    with refused(NoSurfaceError, 3, 1, 0.06):
        select_components(three_boxes(), min_volume_ml=1.0)
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
def test_wrong_limits_are_refused(arguments):
    with pytest.raises(UsageError, match="keep_largest is a whole number|min_volume_ml is a volume"):
        select_components(three_boxes(), **arguments)


def test_split_gives_each_component_as_it_is_alone():
    mesh = three_boxes()
    pieces = split_components(mesh)
    assert [len(piece.triangles) for piece in pieces] == [12, 12, 12]
    for place, piece in zip((LARGE, MIDDLE, SMALL), pieces, strict=True):
        rows = 3 * np.arange(8) + place
        np.testing.assert_array_equal(piece.vertices, mesh.vertices[rows])
        np.testing.assert_array_equal(piece.normals, mesh.normals[rows])
        np.testing.assert_array_equal(piece.triangles, (mesh.triangles[place::3] - place) // 3)
        assert piece.report == {"iso_value_hu": 250.0, "components_found": 3, "components_kept": 3}
        assert piece.triangles.dtype == np.uint32
    assert mesh.report == {"iso_value_hu": 250.0}


def test_split_leaves_out_what_is_not_kept():
    pieces = split_components(three_boxes(), keep_largest=2, min_volume_ml=0.01)
    assert [piece.report["components_kept"] for piece in pieces] == [1]
    assert pieces[0].quality()["volume_ml"] == pytest.approx(0.060)
    assert len(split_components(Mesh(*samples.box()))) == 1


def test_split_of_equal_sizes_keeps_their_order():
    places = (7.0, 0.0, 3.0)
    pieces = split_components(Mesh(*samples.join(*(samples.box((x, 0, 0)) for x in places))))
    assert [piece.vertices[:, 0].min() for piece in pieces] == list(places)


def test_split_refuses_more_than_most():
    assert len(split_components(three_boxes(), most=3)) == 3
    with refused(UsageError, "min_volume_ml=ML", 3, 0.1, 2):
        split_components(three_boxes(), most=2)


@pytest.mark.parametrize(
    ("seeds", "kept", "distances"),
    [
        ([(0, 4, 3)], [LARGE], [0.0]),
        ([(499, 0, 0)], [SMALL], [1.0]),
        ([(499, 0, 0), (9, 9, 14), (500, 0, -2)], [SMALL, MIDDLE], [1.0, 3.0, 2.0]),
    ],
)
def test_seeds_keep_the_nearest(seeds, kept, distances):
    chosen = select_components(three_boxes(), seeds=seeds)
    expected = np.concatenate([three_boxes().vertices[3 * np.arange(8) + place] for place in kept])
    assert set(map(tuple, chosen.vertices)) == set(map(tuple, expected))
    assert chosen.report["seed_distances_mm"] == pytest.approx(distances)
    assert chosen.report["components_kept"] == len(kept)


def test_small_ones_are_dropped_before_seeds_and_large_ones_ranked_after():
    beside = [(8.5, 10, 10), (0, 5, 6)]  # next to the middle one; between both
    mesh = three_boxes()
    assert select_components(mesh, seeds=beside, min_volume_ml=0.01).quality()["volume_ml"] == pytest.approx(0.060)
    assert select_components(mesh, seeds=beside[:1], keep_largest=1).quality()["volume_ml"] == pytest.approx(0.008)
    assert select_components(mesh, seeds=beside, keep_largest=1).quality()["volume_ml"] == pytest.approx(0.060)
    (piece,) = split_components(mesh, seeds=beside[:1])
    assert piece.quality()["volume_ml"] == pytest.approx(0.008)


def test_a_seed_far_from_everything_is_refused_with_its_distance():
    with refused(UsageError, "LPS", 531, 0.5, 30.0):
        select_components(three_boxes(), seeds=[(0, 4, 3), (531, 0.5, 0.5)])
    assert select_components(three_boxes(), seeds=[(520.5, 0.5, 0.5)]).report["components_kept"] == 1


@pytest.mark.parametrize("seed", [(1.0, 2.0), (1.0, 2.0, float("nan")), (1, 2, 3, 4)])
def test_a_seed_is_a_point(seed):
    with pytest.raises(UsageError, match="point of three numbers"):
        select_components(three_boxes(), seeds=[seed])


def test_many_components_are_measured_as_few():
    """More components than triangles in a piece: the pieces grow with them."""
    count = 20_000
    vertices, triangles = samples.box()
    places = np.arange(count) * 3.0
    many = (vertices[None] + places[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    faces = (triangles[None] + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    many[8 * 777 : 8 * 778] = samples.box((places[777], 0, 0), (2, 2, 2))[0]
    kept = select_components(Mesh(many, faces), keep_largest=1, min_volume_ml=0.002)
    assert (kept.report["components_found"], kept.vertices[:, 0].min()) == (count, places[777])


def test_labels_that_are_known_are_used():
    mesh = three_boxes()
    labelled = label_components(mesh.triangles, mesh.vertex_count)
    kept = select_components(mesh, keep_largest=1, labelled=labelled)
    np.testing.assert_array_equal(kept.vertices, select_components(mesh, keep_largest=1).vertices)
    as_one = (1, np.zeros(mesh.vertex_count, dtype=np.int64))
    assert select_components(mesh, keep_largest=1, labelled=as_one) is mesh


@pytest.mark.parametrize("reach", [400.0, 3000.0, 50_000.0])
def test_equal_components_are_in_the_order_of_the_mesh_wherever_they_lie(reach):
    """Coordinates are rounded differently at each place, and so are areas."""
    rng = np.random.default_rng(3)
    vertices, triangles = samples.sphere((0, 0, 0), 7.3, 3)
    for _ in range(6):
        places = rng.uniform(-reach, reach, (4, 3))
        if reach > 4096:  # float64 vertices were computed in float32 from a point near their centre
            places = places[0] + places / 100
        mesh = Mesh(*samples.join(*[((vertices + place).astype(np.float64), triangles) for place in places]))
        kept = select_components(mesh, keep_largest=2)
        np.testing.assert_array_equal(kept.vertices, mesh.vertices[: 2 * len(vertices)])
        for place, part in enumerate(split_components(mesh)):
            np.testing.assert_array_equal(part.vertices, mesh.vertices[place * len(vertices) :][: len(vertices)])


def test_components_that_differ_by_more_than_rounding_are_in_the_order_of_size():
    """A hundredth of a per mille of the area, 400 mm from the origin; the order is no chain of equal neighbours."""
    vertices, triangles = samples.sphere((400, 0, 0), 10.0, 3)
    scales = 1.0 + 5e-6 * np.arange(40)
    mesh = Mesh(*samples.join(*[(vertices * scale, triangles) for scale in scales]))
    kept = select_components(mesh, keep_largest=1)
    first = int(np.flatnonzero((mesh.vertices == kept.vertices[0]).all(axis=1))[0]) // len(vertices)
    assert first >= 36


def test_a_component_of_exactly_the_least_volume_is_kept_wherever_it_lies():
    vertices, triangles = samples.box((0.05, 0.05, 0.05), (10, 10, 10))
    for place in np.random.default_rng(5).uniform(-900, 900, (20, 3)):
        mesh = Mesh(vertices + place, triangles)
        assert select_components(mesh, min_volume_ml=1.0) is mesh
        with pytest.raises(NoSurfaceError):
            select_components(mesh, min_volume_ml=1.001)
