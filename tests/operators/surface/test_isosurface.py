"""The isosurface operator against its twin, against topology, and against other programs."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from scipy.spatial import cKDTree
from slab_surfaces import assert_same
from surface_volumes import MIRRORED, OBLIQUE, SHAPES, assert_sound, random_volume, smooth_volume
from variants import VOXEL_TYPES, daily, daily_rows

from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume, compose_affine, iso_rule
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.extract import SurfaceExtractor, extract_isosurface, extract_isosurfaces
from clrecon.operators.surface.marching_cubes import LONGEST_ROW
from clrecon.proof.run import CHECKS, run_check
from clrecon.proof.surface import extract as twin


@pytest.mark.every_device
@pytest.mark.parametrize("closed", daily(1, [True, False]))
@pytest.mark.parametrize("shape", SHAPES)
def test_surface_equals_its_twin_at_word_borders(device, shape, closed):
    volume = random_volume(shape)
    vertices, normals, triangles = twin.extract_isosurface(volume, 3, closed=closed)
    mesh = extract_isosurface(volume, 3, device=device, closed=closed)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(volume.lps_to_ijk(mesh.vertices) - volume.lps_to_ijk(vertices)).max() <= tolerances.TWIN_VERTEX_VOXEL
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@pytest.mark.parametrize("affine", daily(1, [MIRRORED, OBLIQUE]), ids=["left-handed", "right-handed"])
@pytest.mark.parametrize("iso_value", [1, 40, 40.5, 99])
def test_surface_equals_its_twin_for_every_voxel_type(device, dtype, affine, iso_value):
    volume = random_volume((6, 7, 37), dtype=dtype, high=100, affine=affine)
    vertices, normals, triangles = twin.extract_isosurface(volume, iso_value)
    mesh = extract_isosurface(volume, iso_value, device=device)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= tolerances.float32_unit(mesh.vertices)
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


@pytest.mark.every_device
@pytest.mark.parametrize("shape", [(2, 700, 40), (2, 3, 1000), (9, 3, 40)])
def test_vertices_are_rounded_once(device, shape):
    """Far from the origin and after many steps, a vertex is the float32 next to the true one, or its neighbour."""
    awkward = OBLIQUE + 1e-5 / 3.0 * (OBLIQUE != 0.0)  # no step and no coordinate of the origin is a float32
    awkward[3] = OBLIQUE[3]
    volume = random_volume(shape, affine=awkward)
    vertices, _, _ = twin.extract_isosurface(volume, 3)
    error = np.abs(extract_isosurface(volume, 3, device=device).vertices - vertices).max()
    assert error <= tolerances.VERTEX_ROUNDING_UNITS * tolerances.float32_unit(vertices)


@pytest.mark.parametrize("along", ["i + j + k", "i", "k"])
def test_normals_of_checkerboards_are_unit_vectors_equal_to_those_of_the_twin(device, along):
    """Central differences cancel there: the edge itself says which way is down."""
    k, j, i = np.indices((5, 6, 34))
    index = {"i + j + k": i + j + k, "i": i, "k": k}[along]
    volume = Volume((index % 2).astype(np.int16), OBLIQUE)
    mesh = extract_isosurface(volume, 1, device=device)
    _, normals, _ = twin.extract_isosurface(volume, 1)
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)  # float32; measured 2e-7
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


@pytest.mark.parametrize("scale", [1e-20, 1e-6, 1e6, 1e29])
def test_surface_is_the_same_at_any_scale_of_float_values(device, scale):
    voxels = smooth_volume((9, 10, 40)).voxels.astype(np.float32)
    expected = extract_isosurface(Volume(voxels, OBLIQUE), 100.0, device=device, closed=False)
    scaled = Volume(voxels / 1000 * np.float32(scale), OBLIQUE)
    mesh = extract_isosurface(scaled, 100.0 / 1000 * scale, device=device, closed=False)
    assert np.array_equal(mesh.triangles, expected.triangles)
    rounding = 1e-3  # of scaled float32 values, where an edge is nearly flat
    assert np.abs(mesh.normals - expected.normals).max() < rounding
    assert np.abs(mesh.vertices - expected.vertices).max() < rounding


@pytest.mark.every_device
@pytest.mark.parametrize("high", [2, 3, 6, 12])
@pytest.mark.parametrize(("seed", "shape"), [(0, (7, 9, 11)), (1, (5, 4, 35))], ids=["short rows", "long rows"])
def test_surfaces_of_random_integers_at_every_iso_value_are_sound(device, high, seed, shape):
    volume = random_volume(shape, high=high, seed=seed)
    for iso_value in range(1, high):
        assert_sound(extract_isosurface(volume, iso_value, device=device))


@pytest.mark.every_device
@pytest.mark.parametrize("high", [4096, 65536])
@pytest.mark.parametrize("level", ["lowest", "second", "middle", "highest"])
def test_surfaces_of_steep_integers_far_from_the_origin_are_sound(device, high, level):
    """Vertices next to a sample would fall together in float32 millimetres without the margin."""
    affine = compose_affine((0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.5), (-900, 900, 1800))
    volume = random_volume((9, 11, 40), dtype="uint16", high=high, affine=affine)
    iso_value = {"lowest": 1, "second": 2, "middle": high // 2, "highest": int(volume.voxels.max())}[level]
    assert_sound(extract_isosurface(volume, iso_value, device=device))


def test_surface_of_floats_that_equal_the_iso_value_is_sound(device):
    assert_sound(extract_isosurface(random_volume((7, 8, 40), dtype="float32", high=4), 2.0, device=device))


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 7), (4, 1, 40), (3, 4, 1), (2, 2, 2), (9, 10, 33)])
def test_surface_of_a_volume_that_is_all_inside_is_a_closed_box_within_a_voxel_of_its_ends(device, shape):
    volume = Volume(np.full(shape, 700, np.int16), OBLIQUE)
    mesh = extract_isosurface(volume, 300, device=device)
    assert_sound(mesh)
    assert mesh.quality()["euler_number"] == 2  # as of a sphere
    ijk = volume.lps_to_ijk(mesh.vertices)
    low, high, last = ijk.min(axis=0), ijk.max(axis=0), np.array(volume.shape_ijk) - 1
    assert ((-1 < low) & (low < 0)).all()
    assert ((last < high) & (high < last + 1)).all()


@pytest.fixture
def beam() -> Volume:
    """A beam through all slices of a volume."""
    voxels = np.zeros((9, 9, 9), np.int16)
    voxels[:, 3:6, 3:6] = 100
    return Volume(voxels, OBLIQUE)


def test_an_object_that_leaves_the_volume_is_closed_at_its_ends(device, beam):
    quality = extract_isosurface(beam, 50, device=device).quality()
    assert quality["closed"]
    assert quality["boundary_edges"] == 0


def test_an_object_that_leaves_the_volume_is_left_open_on_request(device, beam):
    quality = extract_isosurface(beam, 50, device=device, closed=False).quality()
    assert not quality["closed"]
    assert quality["boundary_edges"] > 0
    assert quality["nonmanifold_edges"] == 0


@pytest.mark.every_device
def test_order_of_vertices_and_triangles_is_the_same_on_every_run(device):
    volume = smooth_volume()
    first, second = (extract_isosurface(volume, 100, device=device) for _ in range(2))
    assert np.array_equal(first.triangles, second.triangles)
    assert np.array_equal(first.vertices, second.vertices)
    assert np.array_equal(first.normals, second.normals)


@pytest.mark.parametrize("affine", [OBLIQUE, MIRRORED], ids=["oblique", "mirrored"])
def test_normals_point_to_the_side_that_their_faces_do(device, affine):
    mesh = extract_isosurface(smooth_volume(affine=affine), 100, device=device)
    corners = mesh.vertices.astype(np.float64)[mesh.triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    along = np.einsum("ij,ij->i", faces, mesh.normals.astype(np.float64)[mesh.triangles].sum(axis=1))
    assert (along > 0).mean() > 0.97  # measured 0.984; others are slivers: the field's gradient is not square to them
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)  # float32; measured 2e-7


@pytest.mark.parametrize("axes", [(0, 1, 2), (2, 1, 0), (1, 2, 0)], ids=str)
@pytest.mark.parametrize("flipped", [(), (0,), (1, 2)], ids=str)
def test_flips_and_permutations_of_the_index_axes_give_the_same_surface(device, axes, flipped):
    volume = smooth_volume()
    expected = extract_isosurface(volume, 100, device=device)
    voxels = np.flip(volume.voxels, flipped).transpose(axes)
    unflip = np.eye(4)
    for axis in flipped:  # array axis a is index axis 2 - a
        unflip[2 - axis, 2 - axis], unflip[2 - axis, 3] = -1.0, volume.voxels.shape[axis] - 1.0
    reorder = np.eye(4)[[*(2 - np.argsort(axes)[::-1]), 3]]

    mesh = extract_isosurface(Volume(voxels, volume.affine @ unflip @ reorder), 100, device=device)

    assert len(mesh.vertices) == len(expected.vertices)
    distances, _ = cKDTree(expected.vertices).query(mesh.vertices)
    assert distances.max() <= tolerances.FRAME_MM
    # Other fans of the same loops; measured 3e-4.
    assert mesh.quality()["volume_ml"] == pytest.approx(expected.quality()["volume_ml"], rel=1e-3)


OTHER_PROGRAM_MM = 5e-4  # vertices are held off samples by 2e-4 of a step of up to 2.5 mm


def test_scikit_image_finds_the_same_vertices_and_area(device):
    from skimage.measure import marching_cubes

    volume = smooth_volume()
    mesh = extract_isosurface(volume, 100, device=device)
    # Closed: a voxel of the lowest value around the volume; whole numbers from 100 on are inside, from 99.5.
    padded = np.pad(volume.voxels, 1, constant_values=int(mesh.report["outside_hu"])).astype(np.float32)
    points, faces, _, _ = marching_cubes(padded, 99.5, method="lorensen")
    expected = volume.ijk_to_lps(points[:, ::-1] - 1.0)

    assert len(mesh.vertices) == len(expected)
    distances, _ = cKDTree(expected).query(mesh.vertices)
    assert distances.max() <= OTHER_PROGRAM_MM
    assert mesh.quality()["area_mm2"] == pytest.approx(
        _area(expected, faces), rel=1e-4
    )  # other fans of the same loops; measured 5e-5


def test_flying_edges_of_vtk_finds_the_same_vertices_and_as_many_triangles(device):
    pyvista = pytest.importorskip("pyvista")
    volume = smooth_volume()
    mesh = extract_isosurface(volume, 100, device=device, closed=False)
    image = pyvista.ImageData(dimensions=volume.shape_ijk)
    image["hu"] = volume.voxels.ravel()
    contour = image.contour([99.5], method="flying_edges")  # whole numbers from 100 on are inside
    expected = volume.ijk_to_lps(contour.points)

    assert len(mesh.vertices) == contour.n_points
    assert len(mesh.triangles) == contour.n_cells
    distances, _ = cKDTree(expected).query(mesh.vertices)
    assert distances.max() <= OTHER_PROGRAM_MM


def _area(points, faces) -> float:
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize(
    ("iso_value", "closed", "where"),
    [(6, True, "above"), (40_000, True, "above"), (1e9, False, "above"), (0, False, "lowest"), (-1e6, False, "lowest")],
)  # fmt: skip
def test_an_iso_value_outside_the_data_is_refused_with_the_range(device, iso_value, closed, where):
    volume = random_volume((5, 6, 7), high=6)  # 0 to 5
    with refused(NoSurfaceError, 0, 5, where):
        extract_isosurface(volume, iso_value, device=device, closed=closed)


def test_an_iso_value_that_is_no_number_is_refused(device):
    with refused(UsageError, "finite"):
        extract_isosurface(random_volume((3, 4, 5)), float("nan"), device=device)


def test_an_open_surface_of_one_slice_is_refused(device):
    with refused(NoSurfaceError, "cells"):
        extract_isosurface(random_volume((1, 4, 5)), 3, device=device, closed=False)


def test_a_volume_of_a_column_more_than_a_row_holds_is_refused_with_the_most(device):
    most = LONGEST_ROW - 2  # with a sample outside of either end
    with refused(UsageError, most + 1, most, "columns"):
        extract_isosurface(Volume(np.zeros((1, 1, most + 1), np.int8), np.eye(4)), 1, device=device)


def test_surface_of_an_array_is_refused(device):
    with refused(UsageError, "Volume", "clrecon.Volume"):
        extract_isosurface(np.zeros((3, 4, 5)), 1, device=device)


@pytest.fixture
def finds_no_surface(device, monkeypatch):
    """The device marks no voxel as inside."""

    def find_nothing(classifier, *_):
        slab = classifier.slab
        mask = np.zeros(slab.mask_rows * slab.grid.words, np.uint32)
        extents = np.zeros(2 * slab.mask_rows, np.uint16)
        return marching_cubes.Classified(*(marching_cubes.ocl.upload(device, array) for array in (mask, extents)))

    monkeypatch.setattr(marching_cubes.Classifier, "mark_rest", find_nothing)


@pytest.mark.usefixtures("finds_no_surface")
@pytest.mark.parametrize(
    ("level", "facts"), [(3, (3, 5)), ((2, 3), (2, 3))], ids=["level, and the highest value", "range"]
)
def test_a_device_that_finds_no_surface_where_one_must_be_is_refused(device, level, facts):
    with refused(DeviceError, "computes", *facts):
        extract_isosurface(random_volume((5, 6, 7), high=6), level, device=device)


@pytest.mark.usefixtures("finds_no_surface")
def test_a_device_that_finds_no_surface_fails_its_check(device):
    check = next(check for check in CHECKS if check.name == "extract_isosurface")
    outcome = run_check(device, check)
    assert not outcome["passed"]
    assert "it computes wrongly" in outcome["detail"]


@pytest.mark.release
@pytest.mark.parametrize(("lanes", "words"), daily_rows(1, [("1", "1"), ("8", "3")]))
def test_kernels_of_gpus_and_those_of_three_words_an_item_give_the_mesh_of_the_twin(device, lanes, words, monkeypatch):
    """One lane and one word an item are for GPUs, which need not be there; by default a CPU takes eight words."""
    volume = smooth_volume((23, 27, 75), affine=MIRRORED)
    vertices, normals, triangles = twin.extract_isosurface(volume, 100)
    variants = {**device.kernel_variants, "LANES": lanes, "WORDS_PER_ITEM": words}
    monkeypatch.setattr(device, "kernel_variants", variants)
    mesh = extract_isosurface(volume, 100, device=device)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= tolerances.float32_unit(mesh.vertices)
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


@pytest.mark.parametrize(("place", "iso_value"), [(0, 100), (1, -50.5), (2, 100)])
def test_each_of_several_iso_values_has_the_surface_that_it_has_alone(device, place, iso_value):
    volume = smooth_volume()
    mesh = extract_isosurfaces(volume, [100, -50.5, 100], device=device)[place]
    assert mesh.report["iso_value_hu"] == iso_value
    assert_same(mesh, extract_isosurface(volume, iso_value, device=device))


def test_surfaces_of_no_iso_value_are_refused(device):
    with refused(UsageError, "iso", "value"):
        extract_isosurfaces(smooth_volume(), [], device=device)


@pytest.mark.parametrize(("dtype", "looks"), [("int16", 1), ("int32", 2), ("float32", 1)])
def test_values_of_a_resident_volume_are_looked_through_once_for_three_surfaces(device, dtype, looks, monkeypatch):
    """Whole numbers of 32 bits are looked through for their range too: float32 must hold it."""
    calls = []
    for name in ("data_range", "_lowest_value"):
        true_look = getattr(iso_rule, name)
        monkeypatch.setattr(iso_rule, name, lambda volume, look=true_look: calls.append(1) or look(volume))
    volume = Volume(smooth_volume().voxels.astype(dtype), OBLIQUE)
    with SurfaceExtractor(volume, device=device) as extractor:
        for iso_value in (50, 100, 150):
            extractor.extract(iso_value)
    assert len(calls) == looks


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32"])
def test_second_surface_of_a_resident_volume_is_that_of_the_volume(device, dtype):
    volume = Volume(smooth_volume().voxels.astype(dtype), OBLIQUE)
    with SurfaceExtractor(volume, device=device) as extractor:
        extractor.extract(50)
        assert_same(extractor.extract(100), extract_isosurface(volume, 100, device=device))


def test_a_resident_volume_is_uploaded_once_for_three_surfaces(device):
    volume = smooth_volume()
    with DeviceVolume(volume, device=device) as resident, SurfaceExtractor(resident) as extractor:
        for iso_value in (50, 100, 150):
            extractor.extract(iso_value)
        assert resident.uploaded_bytes == volume.voxels.nbytes


@pytest.fixture(scope="module")
def small_mesh(device):
    """The surface of random whole numbers at 3."""
    return extract_isosurface(random_volume((5, 6, 7)), 3, device=device)


def test_report_of_a_surface_names_its_level_affine_and_device(device, small_mesh):
    report = small_mesh.report
    assert (report["iso_value_hu"], report["iso_level_hu"]) == (3.0, 2.5)  # half way to the whole number below
    assert report["affine_ijk_to_lps_mm"] == OBLIQUE.tolist()
    assert report["device"] == device.label


def test_report_of_a_surface_counts_slabs_and_bytes_of_its_output(small_mesh):
    place_and_normal, corners = 2 * 3 * 4, 3 * 4
    output = place_and_normal * len(small_mesh.vertices) + corners * len(small_mesh.triangles)
    assert small_mesh.report["slabs"] == 1
    assert small_mesh.report["device_bytes"]["output"] == output


def test_report_of_a_surface_has_the_seconds_of_its_steps_and_kernels(small_mesh):
    kernels = {"classify_samples", "count_rows", "emit_vertices", "emit_triangles"}
    assert set(small_mesh.report["seconds"]) == {"upload", "build", "kernels", "download"}
    assert kernels <= small_mesh.report["kernel_seconds"].keys()


@pytest.mark.oclgrind
@pytest.mark.parametrize("shape", [(3, 4, 33), (2, 3, 5)], ids=["a word and more", "less than a word"])
def test_triangles_of_a_small_volume_equal_the_twin(device, shape):
    volume = random_volume(shape)
    _, _, triangles = twin.extract_isosurface(volume, 3)
    assert np.array_equal(extract_isosurface(volume, 3, device=device).triangles, triangles)
