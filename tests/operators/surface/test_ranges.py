"""Surfaces of ranges of HU, and of what lies below a level: against the twin, against analysis, and on any data."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from slab_surfaces import assert_same, extract_in_slabs
from surface_volumes import MIRRORED, OBLIQUE, SHAPES, assert_sound, random_volume, smooth_volume
from variants import daily, daily_rows

from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.mesh.compare.iso_distance import measure_iso_distances, rule_of_report
from clrecon.operators.surface import marching_cubes
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


def rows_of(vertices: np.ndarray) -> set[bytes]:
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
def test_surface_of_a_range_equals_its_twin_for_voxel_types(device, dtype, affine):
    """Of whole numbers one of each kind: with a sign, without one, and beyond what float32 holds."""
    volume = random_volume((5, 6, 37), dtype, high=100, affine=affine)
    for level, options in CASES:
        assert_equals_twin(volume, level, device, **options)


@pytest.mark.every_device
@pytest.mark.parametrize("closed", daily(1, [True, False]))
@pytest.mark.parametrize("shape", SHAPES)
def test_surface_of_a_range_equals_its_twin_at_word_borders(device, shape, closed):
    volume = random_volume(shape)
    assert_equals_twin(volume, (2, 3), device, closed=closed)
    assert_equals_twin(volume, 3, device, closed=closed, below=True)


@pytest.mark.parametrize("high", daily(2, [3, 12, 2, 6]))
def test_random_integers_in_every_range_are_sound(device, high):
    for seed, shape in enumerate([(7, 9, 11), (5, 4, 35)]):
        volume = random_volume(shape, high=high, seed=seed)
        for low in range(1, high):
            assert_sound(extract_isosurface(volume, low, device=device, below=True))
            assert_sound(extract_isosurface(volume, low, device=device, below=True, topology="trilinear"))
            assert_sound(extract_isosurface(volume, (low - 0.5, low + 0.5), device=device))
            assert_sound(extract_isosurface(volume, (low, low + 1), device=device))


def test_random_floats_in_ranges_are_sound(device):
    volume = random_volume((7, 8, 40), "float32", 4)
    for low, high in [(1.0, 2.0), (0.5, 2.0), (1.0, 2.5), (0.0, 1.0)]:
        assert_sound(extract_isosurface(volume, (low, high), device=device))


@pytest.mark.parametrize("dtype", ["int16", "float32"])
@pytest.mark.parametrize("topology", ["separated", "trilinear"])
def test_surface_below_a_level_is_that_of_the_iso_value_turned_round(device, dtype, topology):
    volume = random_volume((7, 9, 40), dtype, high=50)
    above = extract_isosurface(volume, 20, device=device, closed=False, topology=topology)
    below = extract_isosurface(volume, 20, device=device, closed=False, topology=topology, below=True)
    assert np.array_equal(below.vertices, above.vertices)
    assert np.array_equal(below.triangles, above.triangles[:, ::-1])
    assert np.array_equal(below.normals, -above.normals)


def test_a_range_has_the_vertices_of_both_its_ends(device):
    """In a smooth field no edge jumps across the range, so it has all of them."""
    volume = smooth_volume()
    mesh = extract_isosurface(volume, (-200, 400), device=device, closed=False)
    lower = extract_isosurface(volume, -200, device=device, closed=False)
    upper = extract_isosurface(volume, 401, device=device, closed=False)
    jumping = len(rows_of(lower.vertices) | rows_of(upper.vertices)) - len(rows_of(mesh.vertices))
    assert rows_of(mesh.vertices) <= rows_of(lower.vertices) | rows_of(upper.vertices)
    assert jumping == 0
    # The lower end faces as the iso value does, the upper end the other way.
    at = {row.tobytes(): normal for row, normal in zip(mesh.vertices, mesh.normals, strict=True)}
    assert all(np.array_equal(at[row.tobytes()], n) for row, n in zip(lower.vertices, lower.normals, strict=True))
    assert all(np.array_equal(at[row.tobytes()], -n) for row, n in zip(upper.vertices, upper.normals, strict=True))


def test_an_edge_crosses_the_end_that_its_outer_voxel_lies_beyond(device):
    """Also where the inner voxel is nearer the other end: 110 of 100 to 300 beside 500, and beside 0."""
    voxels = np.zeros((3, 3, 5), np.int16)
    voxels[1, 1] = (0, 0, 110, 500, 500)
    mesh = extract_isosurface(Volume(voxels, np.eye(4)), (100, 300), device=device)
    along = mesh.vertices[(mesh.vertices[:, 1:] == 1.0).all(axis=1), 0]
    assert sorted(along) == pytest.approx([1.0 + 99.5 / 110.0, 2.0 + (300.5 - 110.0) / 390.0], abs=1e-6)


def test_a_shell_between_two_spheres_has_their_volume(device):
    volume = ball(12.0)  # values are the depth under the surface of radius 12
    found = extract_isosurface(volume, (2.0, 7.0), device=device).quality()
    assert found["components"] == 2
    assert found["outward"]
    truth = 4.0 / 3.0 * np.pi * (10.0**3 - 5.0**3) * 0.7 * 0.5 * 0.9 / 1000.0
    assert found["volume_ml"] == pytest.approx(truth, rel=0.01)


@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_bodies_below_and_above_a_level_fill_the_box(device, dtype):
    field = 100.0 * np.maximum(ball(10.0).voxels, -2.0)
    volume = Volume(field.astype(dtype), np.diag((0.7, 0.5, 0.9, 1.0)))
    empty = volume.with_voxels(np.full_like(volume.voxels, -200))
    parts = [
        extract_isosurface(volume, 100, device=device, below=below).quality()["volume_ml"] for below in (False, True)
    ]
    box = extract_isosurface(empty, 100, device=device, below=True).quality()["volume_ml"]
    assert sum(parts) == pytest.approx(box, rel=1e-5)
    steps = 33**3 * 0.7 * 0.5 * 0.9 / 1000.0
    assert box == pytest.approx(steps, rel=2e-3)  # half a voxel beyond the last ones, edges and corners cut off


@pytest.mark.parametrize(("level", "options"), [((2, 3), {}), (3, {"below": True})])
@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32"])
def test_slabs_of_any_thickness_give_the_same_mesh(device, dtype, level, options):
    volume = random_volume((9, 7, 40), dtype, affine=MIRRORED if dtype == "uint8" else OBLIQUE)
    expected = extract_isosurface(volume, level, device=device, **options)
    for slices in (1, 2, 3, 5):
        mesh = extract_in_slabs(volume, level, device, slices, **options)
        assert mesh.report["slabs"] == -(-11 // slices)
        assert_same(mesh, expected)


@pytest.mark.every_device
def test_uneven_slices_equal_the_twin(device):
    positions = np.array([0.0, 1.0, 1.4, 3.3, 4.0, 6.5])[:, None] * (0.1, 0.2, 0.9)
    affine = np.array([[0.7, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1.3, 0], [0, 0, 0, 1.0]])
    affine[:3, 2] = (positions[-1] - positions[0]) / 5
    volume = Volume(random_volume((6, 7, 37), high=100).voxels, affine, slice_positions=positions)
    assert_equals_twin(volume, (30, 60), device)
    assert_equals_twin(volume, 40, device, below=True)


def test_a_resident_volume_gives_the_same_in_any_order(device):
    volume = smooth_volume()
    asked = [(100, {}), ((-50, 120), {}), (-50, {"below": True}), (100, {}), ((-50, 120), {})]
    with SurfaceExtractor(volume, device=device) as extractor:
        for level, options in asked:
            assert_same(
                extractor.extract(level, **options), extract_isosurface(volume, level, device=device, **options)
            )


@pytest.mark.release
def test_the_variant_of_gpus_gives_the_same_mesh(device, monkeypatch):
    volume = smooth_volume((9, 11, 75), affine=MIRRORED)
    monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": "1", "WORDS_PER_ITEM": "1"})
    assert_equals_twin(volume, (-100, 100), device)
    assert_equals_twin(volume, 100, device, below=True)


def test_the_scale_of_float_values_does_not_matter(device):
    voxels = smooth_volume((9, 10, 40)).voxels.astype(np.float32)
    expected = extract_isosurface(Volume(voxels, OBLIQUE), (-100.0, 100.0), device=device)
    large = Volume(voxels * np.float32(2.0**80), OBLIQUE)
    scaled = extract_isosurface(large, (-100 * 2.0**80, 100 * 2.0**80), device=device, closed=False)
    opened = extract_isosurface(Volume(voxels, OBLIQUE), (-100.0, 100.0), device=device, closed=False)
    assert np.array_equal(scaled.vertices, opened.vertices)
    assert np.abs(scaled.normals - opened.normals).max() < 1e-5
    assert expected.triangle_count > opened.triangle_count


@pytest.mark.parametrize(("level", "options"), [((-100, 150), {}), (100, {"below": True})])
def test_distances_are_those_to_the_nearer_end(device, level, options):
    volume = smooth_volume()
    mesh = extract_isosurface(volume, level, device=device, **options)
    found = measure_iso_distances([mesh], volume, rule_of_report(mesh.report))[0]
    assert found["vertices_voxel"]["max"] < 1e-3
    assert found["not_found"] < 0.01 * found["samples"]["centres"]


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
def test_what_is_no_range_is_refused(device, level, options, said):
    with pytest.raises(UsageError, match=said):
        extract_isosurface(random_volume((3, 4, 5), high=500), level, device=device, **options)


def test_a_range_that_holds_nothing_says_the_range_of_the_data(device):
    volume = random_volume((5, 6, 7))
    for level in [(8, 9), (-9, -8), (3.2, 3.8), (40_000, 50_000)]:
        with refused(NoSurfaceError, 0, 5):
            extract_isosurface(volume, level, device=device)
    with refused(NoSurfaceError, "voxel", 5):
        extract_isosurface(volume, (0, 5), device=device, closed=False)
    assert_sound(extract_isosurface(volume, (0, 5), device=device))
    with refused(NoSurfaceError, 0, "surface"):
        extract_isosurface(volume, 0, device=device, below=True)
    with refused(UsageError, "float32"):
        extract_isosurface(random_volume((3, 4, 5), "float32"), (1.0, 1.0 + 1e-12), device=device)


def test_a_device_that_finds_nothing_is_not_believed(device, monkeypatch):
    def find_nothing(device, slab, *_):
        mask = np.zeros(slab.mask_rows * slab.grid.words, np.uint32)
        extents = np.zeros(2 * slab.mask_rows, np.uint16)
        return marching_cubes.Classified(*(marching_cubes.ocl.upload(device, array) for array in (mask, extents)))

    monkeypatch.setattr(marching_cubes, "classify", find_nothing)
    with refused(DeviceError, "computes", 2, 3):
        extract_isosurface(random_volume((5, 6, 7)), (2, 3), device=device)


def test_the_report_says_what_is_inside(device):
    volume = random_volume((5, 6, 7))
    names = ("inside", "inside_hu", "inside_levels_hu", "iso_value_hu", "iso_level_hu")
    expected = [
        (3, {}, ("above", [3.0, None], [2.5, None], 3.0, 2.5)),
        (3, {"below": True}, ("below", [None, 3.0], [None, 2.5], 3.0, 2.5)),
        ((2, 3), {}, ("between", [2.0, 3.0], [1.5, 3.5], None, None)),
    ]
    for level, options, facts in expected:
        report = extract_isosurface(volume, level, device=device, **options).report
        assert tuple(report[name] for name in names) == facts


@pytest.mark.oclgrind
def test_every_pass_over_a_small_range_equals_the_twin(device):
    for shape in [(3, 4, 33), (2, 3, 5)]:
        assert_equals_twin(random_volume(shape), (2, 3), device)
        assert_equals_twin(random_volume(shape), 3, device, below=True)


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_an_open_end_of_a_range_is_none(device, dtype):
    volume = random_volume((5, 6, 37), dtype, high=100)
    above, up_to = (extract_isosurface(volume, level, device=device) for level in ((40, None), (None, 40)))
    assert_same(above, extract_isosurface(volume, 40, device=device))
    beyond = 41 if dtype == "int16" else np.nextafter(np.float32(40), np.float32(np.inf))
    assert_same(up_to, extract_isosurface(volume, beyond, below=True, device=device))
    with refused(UsageError, "leaves"):
        extract_isosurface(volume, (None, None), device=device)
    with refused(UsageError, "value"):
        extract_isosurface(volume, (None, 40), below=True, device=device)
