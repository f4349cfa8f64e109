"""Surfaces of ranges of HU, and of what lies below a level: against the twin, against analysis, and on any data."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from slab_surfaces import assert_same, extract_in_slabs
from surface_volumes import MIRRORED, OBLIQUE, SHAPES, assert_sound, random_volume, smooth_volume
from variants import daily, daily_rows

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.mesh.compare.iso_distance import measure_iso_distances, rule_of_report
from clrecon.operators.surface.extract import SurfaceExtractor, extract_isosurface
from clrecon.proof.surface import extract as twin

CASES = [((30, 60), {}), ((30.5, 60.2), {}), ((-5, 40), {}), ((50, 300_000), {}), (40, {"below": True}),
         (40.5, {"below": True, "topology": "trilinear"})]  # fmt: skip
"""Levels within values from 0 to 99: both ends, one end beyond the data, the type or the integers."""


def assert_equals_twin(volume, level, device, **options) -> None:
    vertices, normals, triangles = twin.extract_isosurface(volume, level, **options)
    mesh = extract_isosurface(volume, level, device=device, **options)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(volume.lps_to_ijk(mesh.vertices) - volume.lps_to_ijk(vertices)).max() <= tolerances.TWIN_VERTEX_VOXEL
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_CELL_NORMAL


def vertex_bytes(vertices: np.ndarray) -> set[bytes]:
    return {row.tobytes() for row in vertices}


def ball(radius: float, size: int = 33) -> Volume:
    """Minus the distance from the middle, in voxels, of a cube of 0.7 x 0.5 x 0.9 mm a voxel."""
    k, j, i = np.indices((size,) * 3) - (size - 1) / 2 - 0.137
    affine = np.diag((0.7, 0.5, 0.9, 1.0))
    return Volume((radius - np.sqrt(i * i + j * j + k * k)).astype(np.float32), affine)


@pytest.mark.parametrize(
    ("dtype", "affine"),
    daily_rows(
        1, [("int16", OBLIQUE), ("float32", MIRRORED), ("int16", MIRRORED), ("uint8", OBLIQUE), ("int32", MIRRORED)]
    ),
)
@pytest.mark.parametrize(("level", "options"), CASES)
def test_surface_of_a_range_equals_its_twin_for_voxel_types(device, dtype, affine, level, options):
    """Of whole numbers one of each kind: with a sign, without one, and beyond what float32 holds."""
    volume = random_volume((5, 6, 37), dtype=dtype, high=100, affine=affine)
    assert_equals_twin(volume, level, device, **options)


@pytest.mark.every_device
@pytest.mark.parametrize("closed", daily(1, [True, False]))
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("level", "options"), [((2, 3), {}), (3, {"below": True})], ids=["range", "below"])
def test_surfaces_of_a_range_and_below_a_level_equal_their_twin_at_word_borders(device, shape, closed, level, options):
    assert_equals_twin(random_volume(shape), level, device, closed=closed, **options)


@pytest.mark.parametrize("high", daily(2, [3, 12, 2, 6]))
@pytest.mark.parametrize(("seed", "shape"), [(0, (7, 9, 11)), (1, (5, 4, 35))], ids=["short rows", "long rows"])
def test_surfaces_of_random_integers_below_every_level_and_in_every_range_are_sound(device, high, seed, shape):
    volume = random_volume(shape, high=high, seed=seed)
    for low in range(1, high):
        assert_sound(extract_isosurface(volume, low, device=device, below=True))
        assert_sound(extract_isosurface(volume, low, device=device, below=True, topology="trilinear"))
        assert_sound(extract_isosurface(volume, (low - 0.5, low + 0.5), device=device))
        assert_sound(extract_isosurface(volume, (low, low + 1), device=device))


@pytest.mark.parametrize("band", [(1.0, 2.0), (0.5, 2.0), (1.0, 2.5), (0.0, 1.0)])
def test_surfaces_of_random_floats_in_ranges_are_sound(device, band):
    assert_sound(extract_isosurface(random_volume((7, 8, 40), dtype="float32", high=4), band, device=device))


@pytest.mark.parametrize("dtype", ["int16", "float32"])
@pytest.mark.parametrize("topology", ["separated", "trilinear"])
def test_open_surface_below_a_level_is_that_of_the_iso_value_with_faces_and_normals_reversed(device, dtype, topology):
    volume = random_volume((7, 9, 40), dtype=dtype, high=50)
    above = extract_isosurface(volume, 20, device=device, closed=False, topology=topology)
    below = extract_isosurface(volume, 20, device=device, closed=False, topology=topology, below=True)
    assert np.array_equal(below.vertices, above.vertices)
    assert np.array_equal(below.triangles, above.triangles[:, ::-1])
    assert np.array_equal(below.normals, -above.normals)


@pytest.fixture(scope="module")
def range_and_its_ends(device):
    """Open surfaces of a smooth field from -200 to 400 HU, and at both ends: no edge jumps across the range."""
    return [
        extract_isosurface(smooth_volume(), level, device=device, closed=False) for level in ((-200, 400), -200, 401)
    ]


def test_a_range_has_the_vertices_of_both_its_ends(range_and_its_ends):
    mesh, lower, upper = range_and_its_ends
    assert vertex_bytes(mesh.vertices) == vertex_bytes(lower.vertices) | vertex_bytes(upper.vertices)


def test_lower_end_of_a_range_faces_as_the_iso_value_does_and_the_upper_end_the_other_way(range_and_its_ends):
    mesh, lower, upper = range_and_its_ends
    normal_at = {row.tobytes(): normal for row, normal in zip(mesh.vertices, mesh.normals, strict=True)}
    for end, sign in ((lower, 1.0), (upper, -1.0)):
        found = np.array([normal_at[row.tobytes()] for row in end.vertices])
        assert np.array_equal(found, sign * end.normals)


def test_an_edge_crosses_the_end_of_a_range_that_its_outer_voxel_lies_beyond(device):
    """Also where the inner voxel is nearer to the other end: 110 of 100 to 300 beside 500, and beside 0."""
    voxels = np.zeros((3, 3, 5), np.int16)
    voxels[1, 1] = (0, 0, 110, 500, 500)
    mesh = extract_isosurface(Volume(voxels, np.eye(4)), (100, 300), device=device)
    along_the_row = mesh.vertices[(mesh.vertices[:, 1:] == 1.0).all(axis=1), 0]
    from_0_to_110, from_110_to_500 = 1.0 + 99.5 / 110.0, 2.0 + (300.5 - 110.0) / (500 - 110)  # half a HU beyond
    assert sorted(along_the_row) == pytest.approx([from_0_to_110, from_110_to_500], abs=2e-7)  # float32; measured 4e-8


def test_surface_of_a_range_of_depths_of_a_ball_is_a_shell_with_its_volume(device):
    volume = ball(12.0)  # values are the depth under the surface of radius 12
    found = extract_isosurface(volume, (2.0, 7.0), device=device).quality()
    assert found["components"] == 2
    assert found["outward"]
    voxel_ml = 0.7 * 0.5 * 0.9 / 1000.0
    # Chords; measured 0.0034.
    assert found["volume_ml"] == pytest.approx(4.0 / 3.0 * np.pi * (10.0**3 - 5.0**3) * voxel_ml, rel=0.01)


@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_volumes_below_and_above_a_level_add_up_to_that_of_the_box(device, dtype):
    field = 100.0 * np.maximum(ball(10.0).voxels, -2.0)
    volume = Volume(field.astype(dtype), np.diag((0.7, 0.5, 0.9, 1.0)))
    empty = volume.with_voxels(np.full_like(volume.voxels, -200))

    def ml(volume, below):
        return extract_isosurface(volume, 100, device=device, below=below).quality()["volume_ml"]

    assert ml(volume, below=False) + ml(volume, below=True) == pytest.approx(
        ml(empty, below=True), rel=1e-7
    )  # measured 3e-15


def test_surface_below_a_level_of_an_empty_volume_ends_half_a_voxel_beyond_it(device):
    """Edges and corners are cut off."""
    empty = Volume(np.full((33, 33, 33), -200, np.int16), np.diag((0.7, 0.5, 0.9, 1.0)))
    box_ml = extract_isosurface(empty, 100, device=device, below=True).quality()["volume_ml"]
    assert box_ml == pytest.approx(33**3 * 0.7 * 0.5 * 0.9 / 1000.0, rel=2e-3)  # measured 0.0014


@pytest.mark.parametrize(("level", "options"), [((2, 3), {}), (3, {"below": True})], ids=["range", "below"])
@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32"])
@pytest.mark.parametrize("slices", [1, 2, 3, 5])
def test_slabs_of_one_to_five_slices_give_the_same_surface_of_a_range(device, dtype, level, options, slices):
    volume = random_volume((9, 7, 40), dtype=dtype, affine=MIRRORED if dtype == "uint8" else OBLIQUE)
    mesh = extract_in_slabs(volume, level, device, slices=slices, **options)
    assert mesh.report["slabs"] == -(-(9 + 2) // slices)  # with a border at both ends
    assert_same(mesh, extract_isosurface(volume, level, device=device, **options))


@pytest.mark.every_device
@pytest.mark.parametrize(("level", "options"), [((30, 60), {}), (40, {"below": True})], ids=["range", "below"])
def test_surface_of_a_range_in_uneven_slices_equals_the_twin(device, level, options):
    positions = np.array([0.0, 1.0, 1.4, 3.3, 4.0, 6.5])[:, None] * (0.1, 0.2, 0.9)
    affine = np.array([[0.7, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1.3, 0], [0, 0, 0, 1.0]])
    affine[:3, 2] = (positions[-1] - positions[0]) / 5
    volume = Volume(random_volume((6, 7, 37), high=100).voxels, affine, slice_positions=positions)
    assert_equals_twin(volume, level, device, **options)


def test_surfaces_of_a_resident_volume_by_level_range_and_below_in_turn_are_those_of_the_volume(device):
    volume = smooth_volume()
    asked = [(100, {}), ((-50, 120), {}), (-50, {"below": True}), (100, {}), ((-50, 120), {})]
    with SurfaceExtractor(volume, device=device) as extractor:
        for level, options in asked:
            assert_same(
                extractor.extract(level, **options), extract_isosurface(volume, level, device=device, **options)
            )


@pytest.mark.release
@pytest.mark.parametrize(("level", "options"), [((-100, 100), {}), (100, {"below": True})], ids=["range", "below"])
def test_surface_of_a_range_by_the_kernels_of_gpus_equals_the_twin(device, monkeypatch, level, options):
    volume = smooth_volume((9, 11, 75), affine=MIRRORED)
    monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": "1", "WORDS_PER_ITEM": "1"})
    assert_equals_twin(volume, level, device, **options)


def test_surface_of_a_range_is_the_same_at_a_large_scale_of_float_values(device):
    scale = 2.0**80
    voxels = smooth_volume((9, 10, 40)).voxels.astype(np.float32)
    expected = extract_isosurface(Volume(voxels, OBLIQUE), (-100.0, 100.0), device=device, closed=False)
    large = Volume(voxels * np.float32(scale), OBLIQUE)
    scaled = extract_isosurface(large, (-100 * scale, 100 * scale), device=device, closed=False)
    assert np.array_equal(scaled.vertices, expected.vertices)
    assert np.array_equal(scaled.normals, expected.normals)


def test_closed_surface_of_a_range_has_more_triangles_than_the_open_one(device):
    volume = smooth_volume((9, 10, 40))
    closed, opened = (
        extract_isosurface(volume, (-100, 100), device=device, closed=closed).triangle_count for closed in (True, False)
    )
    assert closed > opened


@pytest.mark.parametrize(("level", "options"), [((-100, 150), {}), (100, {"below": True})], ids=["range", "below"])
def test_vertices_of_a_range_lie_on_the_nearer_end_as_distances_measure_it(device, level, options):
    volume = smooth_volume()
    mesh = extract_isosurface(volume, level, device=device, **options)
    (found,) = measure_iso_distances([mesh], volume, rule_of_report(mesh.report))
    assert found["vertices_voxel"]["max"] < 2e-4  # held off samples; measured 6e-5
    assert found["not_found"] == 0


@pytest.mark.parametrize(
    ("level", "options", "said"),
    [
        ((300, 100), {}, "the range 300 to 100 HU holds nothing"),
        ((100, 100), {}, "holds nothing"),
        ((1, 2, 3), {}, "has two ends"),
        ((100, float("nan")), {}, "finite"),
        ((100, 300), {"below": True}, "below takes one iso value"),
        ((100, 300), {"topology": "trilinear"}, "follows one level, a range has two"),
    ],
)
def test_levels_that_are_no_range_are_refused(device, level, options, said):
    with pytest.raises(UsageError, match=said):
        extract_isosurface(random_volume((3, 4, 5), high=500), level, device=device, **options)


SMALL = random_volume((5, 6, 7), high=6)  # whole HU from 0 to 5


@pytest.mark.parametrize("level", [(8, 9), (-9, -8), (3.2, 3.8), (40_000, 50_000)])
def test_a_range_without_a_voxel_is_refused_with_the_range_of_the_data(device, level):
    with refused(NoSurfaceError, 0, 5):
        extract_isosurface(SMALL, level, device=device)


def test_an_open_surface_of_a_range_of_all_voxels_is_refused(device):
    with refused(NoSurfaceError, "voxel", 5):
        extract_isosurface(SMALL, (0, 5), device=device, closed=False)


def test_a_closed_surface_of_a_range_of_all_voxels_is_sound(device):
    assert_sound(extract_isosurface(SMALL, (0, 5), device=device))


def test_a_surface_below_the_lowest_value_is_refused(device):
    with refused(NoSurfaceError, 0, "surface"):
        extract_isosurface(SMALL, 0, device=device, below=True)


def test_a_range_whose_ends_are_one_number_of_float32_is_refused(device):
    with refused(UsageError, "float32"):
        extract_isosurface(random_volume((3, 4, 5), dtype="float32"), (1.0, 1.0 + 1e-12), device=device)


@pytest.mark.parametrize(
    ("level", "options", "inside", "inside_hu", "inside_levels_hu", "iso_value_hu", "iso_level_hu"),
    [
        (3, {}, "above", [3.0, None], [2.5, None], 3.0, 2.5),
        (3, {"below": True}, "below", [None, 3.0], [None, 2.5], 3.0, 2.5),
        ((2, 3), {}, "between", [2.0, 3.0], [1.5, 3.5], None, None),
    ],
    ids=["above", "below", "between"],
)
def test_report_tells_which_hu_are_inside_and_the_levels_half_way_to_the_next_whole_number(
    device, level, options, inside, inside_hu, inside_levels_hu, iso_value_hu, iso_level_hu
):
    report = extract_isosurface(random_volume((5, 6, 7)), level, device=device, **options).report
    assert (report["inside"], report["inside_hu"]) == (inside, inside_hu)
    assert report["inside_levels_hu"] == inside_levels_hu
    assert (report["iso_value_hu"], report["iso_level_hu"]) == (iso_value_hu, iso_level_hu)


@pytest.mark.oclgrind
@pytest.mark.parametrize("shape", [(3, 4, 33), (2, 3, 5)], ids=["a word and more", "less than a word"])
@pytest.mark.parametrize(("level", "options"), [((2, 3), {}), (3, {"below": True})], ids=["range", "below"])
def test_surface_of_a_range_in_a_small_volume_equals_the_twin(device, shape, level, options):
    assert_equals_twin(random_volume(shape), level, device, **options)


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_a_range_without_an_upper_end_has_the_surface_of_its_lower_end(device, dtype):
    volume = random_volume((5, 6, 37), dtype=dtype, high=100)
    assert_same(extract_isosurface(volume, (40, None), device=device), extract_isosurface(volume, 40, device=device))


@pytest.mark.parametrize(
    ("dtype", "next_value"), [("int16", 41), ("float32", np.nextafter(np.float32(40), np.float32(np.inf)))]
)
def test_a_range_without_a_lower_end_has_the_surface_below_the_next_value(device, dtype, next_value):
    volume = random_volume((5, 6, 37), dtype=dtype, high=100)
    up_to = extract_isosurface(volume, (None, 40), device=device)
    assert_same(up_to, extract_isosurface(volume, next_value, below=True, device=device))


def test_a_range_with_neither_end_is_refused(device):
    with refused(UsageError, "leaves"):  # a range leaves one end open at most
        extract_isosurface(SMALL, (None, None), device=device)


def test_a_range_is_refused_where_a_surface_below_a_level_is_asked_for(device):
    with refused(UsageError, "below", "value"):
        extract_isosurface(SMALL, (None, 4), below=True, device=device)
