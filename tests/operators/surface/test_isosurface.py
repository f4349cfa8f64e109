"""The isosurface operator against its twin, against topology, and against other programs."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from scipy.spatial import cKDTree
from surface_volumes import MIRRORED, OBLIQUE, SHAPES, assert_sound, random_volume, smooth_volume
from variants import VOXEL_TYPES, daily, daily_rows

from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume, compose_affine, iso_rule
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.extract import SurfaceExtractor, extract_isosurface, extract_isosurfaces
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
def test_surface_equals_its_twin_for_every_voxel_type(device, dtype, affine):
    volume = random_volume((6, 7, 37), dtype, high=100, affine=affine)
    for iso_value in (1, 40, 40.5, 99):
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
    vertices = twin.extract_isosurface(volume, 3)[0]
    error = np.abs(extract_isosurface(volume, 3, device=device).vertices - vertices).max()
    assert error <= tolerances.VERTEX_ROUNDING_UNITS * tolerances.float32_unit(vertices)


def test_checkerboards_have_the_normals_of_their_edges(device):
    """Central differences cancel there: the edge itself says which way is down."""
    k, j, i = np.indices((5, 6, 34))
    for voxels in ((i + j + k) % 2, i % 2, k % 2):
        volume = Volume(voxels.astype(np.int16), OBLIQUE)
        mesh = extract_isosurface(volume, 1, device=device)
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
        assert np.abs(mesh.normals - twin.extract_isosurface(volume, 1)[1]).max() <= tolerances.TWIN_NORMAL


@pytest.mark.parametrize("scale", [1e-20, 1e-6, 1e6, 1e29])
def test_the_scale_of_float_values_does_not_matter(device, scale):
    voxels = smooth_volume((9, 10, 40)).voxels.astype(np.float32)
    expected = extract_isosurface(Volume(voxels, OBLIQUE), 100.0, device=device, closed=False)
    mesh = extract_isosurface(
        Volume(voxels / 1000 * np.float32(scale), OBLIQUE), 0.1 * scale, device=device, closed=False
    )
    assert np.array_equal(mesh.triangles, expected.triangles)
    assert np.abs(mesh.normals - expected.normals).max() < 1e-3
    assert np.abs(mesh.vertices - expected.vertices).max() < 1e-3


@pytest.mark.every_device
@pytest.mark.parametrize("high", [2, 3, 6, 12])
def test_random_integers_at_every_iso_value_are_sound(device, high):
    for seed, shape in enumerate([(7, 9, 11), (5, 4, 35)]):
        volume = random_volume(shape, high=high, seed=seed)
        for iso_value in range(1, high):
            assert_sound(extract_isosurface(volume, iso_value, device=device))


@pytest.mark.every_device
@pytest.mark.parametrize("high", [4096, 65536])
def test_steep_integers_far_from_the_origin_are_sound(device, high):
    """Vertices next to a sample would fall together in float32 millimetres without the margin."""
    affine = compose_affine((0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.5), (-900, 900, 1800))
    volume = random_volume((9, 11, 40), "uint16", high, affine)
    for iso_value in (1, 2, high // 2, int(volume.voxels.max())):
        assert_sound(extract_isosurface(volume, iso_value, device=device))


def test_floats_that_equal_the_iso_value_are_sound(device):
    assert_sound(extract_isosurface(random_volume((7, 8, 40), "float32", 4), 2.0, device=device))


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 7), (4, 1, 40), (3, 4, 1), (2, 2, 2), (9, 10, 33)])
def test_a_volume_that_is_all_inside_is_a_closed_box(device, shape):
    volume = Volume(np.full(shape, 700, np.int16), OBLIQUE)
    mesh = extract_isosurface(volume, 300, device=device)
    assert_sound(mesh)
    assert mesh.quality()["euler_number"] == 2
    low, high = volume.lps_to_ijk(mesh.vertices).min(axis=0), volume.lps_to_ijk(mesh.vertices).max(axis=0)
    upper = np.array(volume.shape_ijk) - 1
    assert (low > -1).all() and (low < 0).all() and (high > upper).all() and (high < upper + 1).all()


def test_an_object_that_leaves_the_volume_is_closed_or_left_open(device):
    voxels = np.zeros((9, 9, 9), np.int16)
    voxels[:, 3:6, 3:6] = 100
    closed = extract_isosurface(Volume(voxels, OBLIQUE), 50, device=device).quality()
    opened = extract_isosurface(Volume(voxels, OBLIQUE), 50, device=device, closed=False).quality()
    assert closed["closed"] and closed["boundary_edges"] == 0
    assert not opened["closed"] and opened["boundary_edges"] > 0 and opened["nonmanifold_edges"] == 0


@pytest.mark.every_device
def test_order_of_vertices_and_triangles_is_the_same_on_every_run(device):
    volume = smooth_volume()
    first, second = (extract_isosurface(volume, 100, device=device) for _ in range(2))
    assert np.array_equal(first.triangles, second.triangles)
    assert np.array_equal(first.vertices, second.vertices)
    assert np.array_equal(first.normals, second.normals)


def test_normals_look_the_way_the_faces_do(device):
    for affine in (OBLIQUE, MIRRORED):
        mesh = extract_isosurface(smooth_volume(affine=affine), 100, device=device)
        corners = mesh.vertices.astype(np.float64)[mesh.triangles]
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        along = np.einsum("ij,ij->i", faces, mesh.normals.astype(np.float64)[mesh.triangles].sum(axis=1))
        assert (along > 0).mean() > 0.97
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)


def test_flips_and_permutations_of_the_index_axes_give_the_same_surface(device):
    volume = smooth_volume()
    expected = extract_isosurface(volume, 100, device=device)
    tree = cKDTree(expected.vertices)
    for axes in [(0, 1, 2), (2, 1, 0), (1, 2, 0)]:
        for flipped in [(), (0,), (1, 2)]:
            voxels = np.flip(volume.voxels, flipped).transpose(axes)
            ijk = np.eye(4)
            for axis in flipped:  # array axis a is index axis 2 - a
                ijk[2 - axis, 2 - axis], ijk[2 - axis, 3] = -1.0, volume.voxels.shape[axis] - 1.0
            order = np.eye(4)[[*(2 - np.argsort(axes)[::-1]), 3]]
            mesh = extract_isosurface(Volume(voxels, volume.affine @ ijk @ order), 100, device=device)
            assert len(mesh.vertices) == len(expected.vertices)
            assert tree.query(mesh.vertices)[0].max() <= tolerances.FRAME_MM
            assert mesh.quality()["volume_ml"] == pytest.approx(expected.quality()["volume_ml"], rel=1e-3)


def test_scikit_image_finds_the_same_points(device):
    from skimage.measure import marching_cubes

    volume = smooth_volume()
    mesh = extract_isosurface(volume, 100, device=device)
    padded = np.pad(volume.voxels, 1, constant_values=int(mesh.report["outside_hu"])).astype(np.float32)
    points, faces, _, _ = marching_cubes(padded, 99.5, method="lorensen")
    expected = volume.ijk_to_lps(points[:, ::-1] - 1.0)
    assert len(mesh.vertices) == len(expected)
    assert cKDTree(expected).query(mesh.vertices)[0].max() <= 5e-4
    assert mesh.quality()["area_mm2"] == pytest.approx(_area(expected, faces), rel=2e-3)


def test_flying_edges_finds_the_same_points_and_as_many_triangles(device):
    pyvista = pytest.importorskip("pyvista")
    volume = smooth_volume()
    mesh = extract_isosurface(volume, 100, device=device, closed=False)
    image = pyvista.ImageData(dimensions=volume.shape_ijk)
    image["hu"] = volume.voxels.ravel()
    contour = image.contour([99.5], method="flying_edges")
    expected = volume.ijk_to_lps(contour.points)
    assert len(mesh.vertices) == contour.n_points
    assert len(mesh.triangles) == contour.n_cells
    assert cKDTree(expected).query(mesh.vertices)[0].max() <= 5e-4


def _area(points, faces) -> float:
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize(
    ("iso_value", "closed", "where"),
    [(6, True, "above"), (40_000, True, "above"), (1e9, False, "above"), (0, False, "lowest"), (-1e6, False, "lowest")],
)  # fmt: skip
def test_an_iso_value_outside_the_data_is_refused_with_the_range(device, iso_value, closed, where):
    volume = random_volume((5, 6, 7))
    with refused(NoSurfaceError, 0, 5, where):
        extract_isosurface(volume, iso_value, device=device, closed=closed)


def test_values_that_cannot_be_used_are_refused(device):
    with pytest.raises(UsageError, match="finite"):
        extract_isosurface(random_volume((3, 4, 5)), float("nan"), device=device)
    with pytest.raises(NoSurfaceError, match="no cells"):
        extract_isosurface(random_volume((1, 4, 5)), 3, device=device, closed=False)
    with pytest.raises(UsageError, match="13,999 columns"):
        extract_isosurface(Volume(np.zeros((1, 1, 13_999), np.int8), np.eye(4)), 1, device=device)


def test_surface_of_what_is_no_volume_is_refused(device):
    with refused(UsageError, "Volume", "clrecon.Volume"):
        extract_isosurface(np.zeros((3, 4, 5)), 1, device=device)


def test_a_device_that_finds_nothing_is_not_believed(device, monkeypatch):
    """A surface that must be there and is not is the device's fault, not the iso value's."""

    def find_nothing(device, slab, *_):
        mask = np.zeros(slab.mask_rows * slab.grid.words, np.uint32)
        extents = np.zeros(2 * slab.mask_rows, np.uint16)
        return marching_cubes.Classified(*(marching_cubes.ocl.upload(device, array) for array in (mask, extents)))

    monkeypatch.setattr(marching_cubes, "classify", find_nothing)
    with refused(DeviceError, "computes", 3, 5):
        extract_isosurface(random_volume((5, 6, 7)), 3, device=device)
    check = next(check for check in CHECKS if check.name == "extract_isosurface")
    outcome = run_check(device, check)
    assert not outcome["passed"] and "it computes wrongly" in outcome["detail"]


@pytest.mark.release
@pytest.mark.parametrize(("lanes", "words"), daily_rows(1, [("1", "1"), ("8", "3")]))
def test_every_variant_of_the_kernels_gives_the_same_mesh(device, lanes, words, monkeypatch):
    """What runs on GPUs is tested where there is none."""
    volume = smooth_volume((23, 27, 75), affine=MIRRORED)
    vertices, normals, triangles = twin.extract_isosurface(volume, 100)
    variants = {**device.kernel_variants, "LANES": lanes, "WORDS_PER_ITEM": words}
    monkeypatch.setattr(device, "kernel_variants", variants)
    mesh = extract_isosurface(volume, 100, device=device)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= tolerances.float32_unit(mesh.vertices)
    assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL


def test_several_iso_values_are_as_each_alone(device):
    volume = smooth_volume()
    meshes = extract_isosurfaces(volume, [100, -50.5, 100], device=device)
    for mesh, iso_value in zip(meshes, [100, -50.5, 100], strict=True):
        alone = extract_isosurface(volume, iso_value, device=device)
        assert mesh.report["iso_value_hu"] == iso_value
        assert np.array_equal(mesh.vertices, alone.vertices)
        assert np.array_equal(mesh.normals, alone.normals)
        assert np.array_equal(mesh.triangles, alone.triangles)
    with pytest.raises(UsageError, match="no iso value"):
        extract_isosurfaces(volume, [], device=device)


@pytest.mark.parametrize("dtype", ["int16", "int32", "float32"])
def test_the_values_of_a_resident_volume_are_looked_at_once(device, dtype, monkeypatch):
    looks = []
    for name in ("data_range", "_lowest_value"):
        true_look = getattr(iso_rule, name)
        monkeypatch.setattr(iso_rule, name, lambda volume, look=true_look: looks.append(1) or look(volume))
    volume = Volume(smooth_volume().voxels.astype(dtype), OBLIQUE)
    with SurfaceExtractor(volume, device=device) as extractor:
        meshes = [extractor.extract(iso_value) for iso_value in (50, 100, 150)]
    assert len(looks) == (2 if dtype == "int32" else 1)
    monkeypatch.undo()
    assert np.array_equal(meshes[1].vertices, extract_isosurface(volume, 100, device=device).vertices)


def test_the_volume_is_uploaded_once(device):
    volume = smooth_volume()
    with DeviceVolume(volume, device=device) as resident, SurfaceExtractor(resident) as extractor:
        for iso_value in (50, 100, 150):
            extractor.extract(iso_value)
        assert resident.uploaded_bytes == volume.voxels.nbytes


def test_the_report_says_how_the_mesh_was_made(device):
    mesh = extract_isosurface(random_volume((5, 6, 7)), 3, device=device)
    assert mesh.report["iso_value_hu"] == 3.0
    assert mesh.report["iso_level_hu"] == 2.5
    assert mesh.report["affine_ijk_to_lps_mm"] == OBLIQUE.tolist()
    assert mesh.report["device"] == device.label
    assert mesh.report["slabs"] == 1
    assert mesh.report["device_bytes"]["output"] == 24 * len(mesh.vertices) + 12 * len(mesh.triangles)
    assert set(mesh.report["seconds"]) == {"upload", "build", "kernels", "download"}
    assert mesh.report["kernel_seconds"].keys() >= {"classify_samples", "count_rows", "emit_vertices", "emit_triangles"}


@pytest.mark.oclgrind
def test_every_pass_over_a_small_volume_equals_the_twin(device):
    """Small enough for a checking simulator: whole words, a word's rest, and rows shorter than a word."""
    for shape in [(3, 4, 33), (2, 3, 5)]:
        volume = random_volume(shape)
        mesh = extract_isosurface(volume, 3, device=device)
        assert np.array_equal(mesh.triangles, twin.extract_isosurface(volume, 3)[2])
