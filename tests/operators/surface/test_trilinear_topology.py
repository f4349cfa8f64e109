"""The topology of the trilinear field on the device: against its twin, against the field, and on any data."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from slab_surfaces import assert_same, extract_in_slabs
from surface_volumes import MIRRORED, OBLIQUE, SHAPES, assert_sound, random_volume, smooth_volume
from variants import VOXEL_TYPES, daily, daily_rows

from clrecon.errors import UsageError
from clrecon.geometry import Volume, compose_affine
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.operators.surface.extract import SurfaceExtractor, extract_isosurface
from clrecon.operators.surface.trilinear import LONGEST_ROW
from clrecon.proof.surface import extract as twin
from clrecon.proof.surface.trilinear_table import find_states


def extract_trilinear(volume, iso_value, device, **options):
    return extract_isosurface(volume, iso_value, device=device, topology="trilinear", **options)


def assert_equals_twin(volume, iso_value, device, closed=True) -> None:
    vertices, normals, triangles = twin.extract_isosurface(volume, iso_value, closed=closed, topology="trilinear")
    mesh = extract_trilinear(volume, iso_value, device, closed=closed)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(volume.lps_to_ijk(mesh.vertices) - volume.lps_to_ijk(vertices)).max() <= tolerances.TWIN_VERTEX_VOXEL
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_CELL_NORMAL


@pytest.mark.parametrize("closed", daily(1, [True, False]))
@pytest.mark.parametrize("shape", daily(8, SHAPES))
def test_trilinear_surface_equals_its_twin_at_word_borders(device, shape, closed):
    assert_equals_twin(random_volume(shape, high=50), 25, device, closed=closed)


@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@pytest.mark.parametrize("affine", daily(1, [MIRRORED, OBLIQUE]), ids=["left-handed", "right-handed"])
def test_trilinear_surface_equals_its_twin_for_every_voxel_type(device, dtype, affine):
    volume = random_volume((5, 6, 37), dtype=dtype, high=100, affine=affine)
    for iso_value in (30, 50.3):
        assert_equals_twin(volume, iso_value, device)


@pytest.mark.parametrize(("dtype", "low", "high"), daily_rows(1, [("int16", -32768, 32767), ("uint16", 0, 65535),
                                                    ("int32", -(2**23) + 1, 2**23 - 1)]))  # fmt: skip
def test_trilinear_surface_equals_its_twin_over_the_whole_range_of_integers(device, dtype, low, high):
    voxels = np.random.default_rng(4).integers(low, high, (4, 6, 33), endpoint=True).astype(dtype)
    for iso_value in (0.5 * (low + high) + 0.5, low / 2 + high / 2 + high / 5):
        assert_equals_twin(Volume(voxels, OBLIQUE), iso_value, device)


@pytest.mark.parametrize("scale", [1e-25, 1e-3, 1e25])
def test_trilinear_surface_is_the_same_at_any_scale_of_float_values(device, scale):
    voxels = np.random.default_rng(5).normal(size=(4, 5, 33)).astype(np.float32)
    expected = extract_trilinear(Volume(voxels, OBLIQUE), 0.0, device, closed=False)
    mesh = extract_trilinear(
        Volume(voxels * np.float32(2.0 ** round(np.log2(scale))), OBLIQUE), 0.0, device, closed=False
    )
    assert np.array_equal(mesh.triangles, expected.triangles)
    assert np.abs(mesh.vertices - expected.vertices).max() < tolerances.FRAME_MM


@pytest.mark.slow
def test_surface_of_cells_of_every_ambiguous_case_equals_the_twin(device):
    """One cell a case and drawing, apart from each other: thousands of decisions, among them all tunnels.

    Vertices inside of cells are more than those that the separated topology has.
    """
    rng = np.random.default_rng(6)
    cases = [case for case in range(256) if len(find_states(case)) > 1 or find_states(case)[0].tunnels]
    voxels = np.zeros((3, 3 * len(cases), 3 * 20), dtype=np.float32)
    for row, case in enumerate(cases):
        for column in range(20):
            sizes = rng.random(8) if column % 2 else np.exp(rng.normal(size=8))
            signs = np.array([1 if case >> corner & 1 else -1 for corner in range(8)])
            voxels[0:2, 3 * row : 3 * row + 2, 3 * column : 3 * column + 2] = (sizes * signs).reshape(2, 2, 2)
    volume = Volume(voxels, np.eye(4))
    rule = choose_iso_rule(volume, 1e-6, topology="trilinear")
    assert rule.topology == "trilinear"
    assert_equals_twin(volume, 1e-6, device)
    inner = (
        extract_trilinear(volume, 1e-6, device).vertex_count
        - extract_isosurface(volume, 1e-6, device=device).vertex_count
    )
    assert inner > 300  # measured 352


@pytest.mark.every_device
@pytest.mark.parametrize("high", daily(2, [2, 3, 6, 100]))
def test_trilinear_surfaces_of_random_integers_are_sound(device, high):
    for seed, shape in enumerate([(7, 9, 11), (5, 4, 35)]):
        volume = random_volume(shape, high=high, seed=seed)
        for iso_value in {1, high // 2, high - 1} - {0}:
            assert_sound(extract_trilinear(volume, iso_value, device))


@pytest.mark.parametrize("iso_value", [2, 20000, 32768, 60000])
def test_trilinear_surfaces_of_steep_integers_far_from_the_origin_are_sound(device, iso_value):
    """There the vertices inside cells keep a margin from faces and from each other."""
    affine = compose_affine((0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.5), (-900, 900, 1800))
    volume = random_volume((9, 11, 40), dtype="uint16", high=65536, affine=affine)
    assert_sound(extract_trilinear(volume, iso_value, device))


@pytest.mark.parametrize(("high", "seed", "level"), [(4, 0, 2.0), (3, 1, 1.0)])
def test_trilinear_surface_of_samples_and_saddles_at_the_level_is_sound(device, high, seed, level):
    assert_sound(extract_trilinear(random_volume((7, 8, 40), dtype="float32", high=high, seed=seed), level, device))


def test_surface_without_ambiguous_cells_is_the_same_with_both_topologies(device):
    k, j, i = np.indices((9, 10, 11))
    volume = Volume((100 - 9 * np.sqrt((i - 5.1) ** 2 + (j - 4.6) ** 2 + (k - 4.2) ** 2)).astype(np.float32), OBLIQUE)
    expected, mesh = extract_isosurface(volume, 70, device=device), extract_trilinear(volume, 70, device)
    assert np.array_equal(mesh.triangles, expected.triangles)
    assert np.array_equal(mesh.vertices, expected.vertices)
    assert np.array_equal(mesh.normals, expected.normals)


@pytest.mark.parametrize(("iso_value", "components"), [(40, 1), (60, 2)], ids=["below the saddle", "above it"])
def test_two_voxels_across_a_face_are_joined_below_their_saddle_and_apart_above_it(device, iso_value, components):
    """Of 100 HU in 0 HU: the saddle between them has 50."""
    voxels = np.zeros((3, 4, 4), np.int16)
    voxels[1, 1, 1] = voxels[1, 2, 2] = 100
    volume = Volume(voxels, OBLIQUE)
    assert extract_trilinear(volume, iso_value, device).quality()["components"] == components
    assert extract_isosurface(volume, iso_value, device=device).quality()["components"] == 2


@pytest.fixture(scope="module")
def corners_of_a_cell():
    """Two voxels of 20 across a cell of -1: the middle of the cell, the lowest point between them, is at 4.25."""
    voxels = np.full((4, 4, 4), -1.0, np.float32)
    voxels[1, 1, 1] = voxels[2, 2, 2] = 20.0
    assert (2 * 20.0 + 6 * -1.0) / 8 == 4.25
    return Volume(voxels, np.eye(4))


def test_two_voxels_across_a_cell_are_joined_by_a_tunnel_below_their_middle(device, corners_of_a_cell):
    quality = extract_trilinear(corners_of_a_cell, 3.9, device).quality()
    assert (quality["components"], quality["genus"]) == (1, 0)


def test_two_voxels_across_a_cell_are_apart_above_their_middle_or_with_the_separated_topology(
    device, corners_of_a_cell
):
    assert extract_trilinear(corners_of_a_cell, 4.4, device).quality()["components"] == 2
    assert extract_isosurface(corners_of_a_cell, 3.9, device=device).quality()["components"] == 2


@pytest.mark.parametrize("affine", [OBLIQUE, MIRRORED], ids=["oblique", "mirrored"])
def test_normals_of_a_trilinear_surface_point_to_the_side_that_most_faces_do(device, affine):
    mesh = extract_trilinear(random_volume((9, 9, 40), dtype="float32", high=1000, affine=affine), 500, device)
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    along = np.einsum("ij,ij->i", faces, mesh.normals.astype(np.float64)[mesh.triangles].sum(axis=1))
    assert (along > 0).mean() > 0.89  # measured 0.903: faces of random values are slivers, gradients turn in a cell
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)  # float32; measured 2e-7


@pytest.mark.every_device
def test_order_of_vertices_and_triangles_is_the_same_on_every_run(device):
    volume = random_volume((6, 9, 70), high=1000)
    first, second = (extract_trilinear(volume, 500, device) for _ in range(2))
    assert np.array_equal(first.triangles, second.triangles)
    assert np.array_equal(first.vertices, second.vertices)
    assert np.array_equal(first.normals, second.normals)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("slices", [1, 2, 3, 5])
def test_slabs_give_the_same_trilinear_surface(device, closed, slices):
    volume = random_volume((9, 7, 40), high=1000, affine=MIRRORED)
    mesh = extract_in_slabs(volume, 500, device, slices=slices, closed=closed, topology="trilinear")
    assert mesh.report["slabs"] > 1
    assert_same(mesh, extract_trilinear(volume, 500, device, closed=closed))


def test_forecast_of_the_trilinear_topology_needs_more_scratch_than_the_separated_one(device):
    with SurfaceExtractor(smooth_volume(), device=device) as extractor:
        trilinear, separated = extractor.forecast(topology="trilinear"), extractor.forecast()
    assert trilinear["scratch_bytes"] > separated["scratch_bytes"]


def test_report_of_a_surface_names_the_trilinear_topology(device):
    assert extract_trilinear(smooth_volume(), 100, device).report["topology"] == "trilinear"


def test_an_unknown_topology_is_refused(device):
    with refused(UsageError, "topology", "manifold"):
        extract_isosurface(random_volume((3, 3, 3)), 3, device=device, topology="manifold")


def test_trilinear_topology_of_a_column_more_than_a_row_holds_is_refused_with_the_most(device):
    most = LONGEST_ROW - 2  # with a sample outside of either end
    wide = Volume(np.zeros((1, 2, most + 1), np.int8), np.eye(4))
    with refused(UsageError, most + 1, most):
        extract_trilinear(wide, 1, device)


@pytest.mark.oclgrind
@pytest.mark.parametrize("closed", [True, False])
def test_trilinear_surface_of_a_small_volume_equals_the_twin(device, closed):
    assert_equals_twin(random_volume((3, 4, 34), high=50), 25, device, closed=closed)
