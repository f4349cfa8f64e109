"""Volumes as pyvista images: every voxel at its place, contours where clrecon's own are, and what is refused."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import AIR_HU, Volume, compose_affine
from clrecon.geometry.grid import DEVICE_DTYPES
from clrecon.geometry.resample import regular_grid, shear_degrees
from clrecon.mesh import Mesh
from clrecon.proof.surface.extract import extract_isosurface

pyvista = pytest.importorskip("pyvista")

SHAPE = (15, 22, 19)
"""(nk, nj, ni); with `SPACING` about 13 x 11 x 14 mm."""
SPACING = np.array([0.7, 0.5, 0.95])
ORIGIN = np.array([-120.0, 83.0, -210.5])
OBLIQUE = rotation((25.0, -40.0, 70.0))
RADIUS = 3.3


def affine_of_axes(steps: np.ndarray) -> np.ndarray:
    i, j, k = (steps * SPACING).T
    return compose_affine(i, j, k, ORIGIN)


AFFINES = {
    "straight": affine_of_axes(np.eye(3)),
    "oblique": affine_of_axes(OBLIQUE),
    "mirrored": affine_of_axes(np.diag([1.0, 1.0, -1.0])),
    "oblique, mirrored": affine_of_axes(OBLIQUE @ np.diag([-1.0, 1.0, 1.0])),
}
TILTED = affine_of_axes(OBLIQUE @ np.array([[1, 0, 0], [0, 1, np.sin(0.3)], [0, 0, np.cos(0.3)]]))


def indices(shape=SHAPE) -> np.ndarray:
    """(i, j, k) of every voxel, i fastest."""
    k, j, i = np.mgrid[tuple(slice(n) for n in shape)]
    return np.stack([i, j, k], axis=-1).reshape(-1, 3)


def off_centre(volume: Volume) -> np.ndarray:
    return volume.ijk_to_lps([(np.array(volume.shape_ijk) - 1) / 2])[0] + (0.9, -0.6, 0.3)


def sphere_volume(affine: np.ndarray, dtype=np.float32, positions=None) -> Volume:
    """A sphere of RADIUS at 200 HU, off the centre along each axis: 100 HU a mm."""
    empty = Volume(np.zeros(SHAPE, dtype), affine, slice_positions=positions)
    distance = np.linalg.norm(empty.ijk_to_lps(indices()) - off_centre(empty), axis=1)
    return empty.with_voxels((200.0 + 100.0 * (RADIUS - distance)).reshape(SHAPE).astype(dtype))


def our_surface(volume: Volume) -> Mesh:
    vertices, _, triangles = extract_isosurface(volume, 200.0, closed=False)
    return Mesh(vertices, triangles)


def uneven_positions(affine: np.ndarray) -> np.ndarray:
    steps = np.linspace(0.6, 1.4, SHAPE[0] - 1)
    return ORIGIN + np.concatenate([[0.0], np.cumsum(steps)])[:, None] * affine[:3, 2]


@pytest.fixture(scope="module", params=AFFINES)
def numbers_and_image(request):
    """The name of an affine, a volume of random numbers on it, and its image in pyvista."""
    values = np.random.default_rng(1).integers(-1000, 2000, SHAPE, dtype=np.int16)
    volume = Volume(values, AFFINES[request.param])
    return request.param, volume, volume.to_pyvista()


def test_each_point_of_an_image_lies_at_a_voxel_of_its_own_and_has_its_value(numbers_and_image):
    _, volume, image = numbers_and_image
    ijk = np.rint(volume.lps_to_ijk(image.points)).astype(int)
    assert len(np.unique(ijk, axis=0)) == volume.voxels.size
    assert np.abs(image.points - volume.ijk_to_lps(ijk)).max() <= tolerances.IMAGE_POINT_MM
    assert np.array_equal(image.point_data["HU"], volume.voxels[tuple(ijk.T[::-1])])


def test_an_image_has_the_size_and_spacing_of_its_volume_and_is_right_handed(numbers_and_image):
    _, _, image = numbers_and_image
    assert image.dimensions == SHAPE[::-1]
    assert image.spacing == pytest.approx(SPACING, abs=tolerances.FLOAT64_PLACE_MM)
    direction = np.array([image.GetDirectionMatrix().GetElement(r, c) for r in range(3) for c in range(3)])
    assert np.linalg.det(direction.reshape(3, 3)) == pytest.approx(1.0)


def test_an_image_names_its_values_frame_and_unit(numbers_and_image):
    _, _, image = numbers_and_image
    assert image.active_scalars_name == "HU"
    assert (image.field_data["SPACE"][0], image.field_data["UNIT"][0]) == ("LPS", "mm")


def test_an_image_of_a_mirrored_volume_names_the_turned_order_of_its_slices(numbers_and_image):
    name, _, image = numbers_and_image
    assert ("SLICES" in image.field_data) == ("mirrored" in name)


def test_an_image_that_is_not_resampled_has_no_note_of_resampling(numbers_and_image):
    _, _, image = numbers_and_image
    assert "RESAMPLED" not in image.field_data


@pytest.mark.parametrize("dtype", DEVICE_DTYPES, ids=str)
def test_an_image_shares_the_memory_of_its_volume_in_every_type(dtype):
    volume = Volume(np.arange(24, dtype=dtype).reshape(2, 3, 4), AFFINES["oblique"])
    image = volume.to_pyvista()
    assert np.shares_memory(image["HU"], volume.voxels)
    assert image["HU"].dtype == dtype
    assert np.array_equal(image["HU"], np.arange(24))


@pytest.mark.release
def test_an_image_outlives_its_volume():
    image = Volume(np.arange(60_000, dtype=np.int32).reshape(20, 30, 100), AFFINES["oblique"]).to_pyvista()
    gc.collect()
    assert np.array_equal(image["HU"], np.arange(60_000))


def test_an_image_of_a_mirrored_volume_is_a_copy_with_its_slices_in_reverse():
    volume = Volume(np.arange(24, dtype=np.int16).reshape(2, 3, 4), AFFINES["mirrored"])
    image = volume.to_pyvista()
    assert not np.shares_memory(image["HU"], volume.voxels)
    assert image["HU"].tolist() == [*range(12, 24), *range(12)]


@pytest.fixture(scope="module", params=AFFINES)
def contour_and_surface(request):
    """A sphere, its contour by pyvista, and our own surface, both at 200 HU."""
    volume = sphere_volume(AFFINES[request.param])
    contour = volume.to_pyvista().contour([200.0], method="flying_edges", compute_normals=True)
    return volume, contour, our_surface(volume)


def test_vertices_of_a_contour_of_pyvista_are_those_of_our_surface(contour_and_surface):
    from scipy.spatial import cKDTree

    _, contour, surface = contour_and_surface
    assert contour.n_points == len(surface.vertices)
    distances, _ = cKDTree(surface.vertices).query(contour.points)
    assert distances.max() <= tolerances.IMAGE_SURFACE_MM


def test_normals_of_a_contour_of_pyvista_point_outward(contour_and_surface):
    volume, contour, _ = contour_and_surface
    outward = contour.points - off_centre(volume)
    assert ((contour.point_data["Normals"] * outward).sum(axis=1) > 0.0).all()


def test_triangles_of_a_contour_of_pyvista_enclose_the_volume_of_our_surface(contour_and_surface):
    volume, contour, surface = contour_and_surface
    corners = np.asarray(contour.points, dtype=np.float64)[contour.faces.reshape(-1, 4)[:, 1:]]
    enclosed_mm3 = np.linalg.det(corners - off_centre(volume)).sum() / 6.0
    assert enclosed_mm3 == pytest.approx(surface.volume, rel=tolerances.IMAGE_VOLUME)


def test_an_image_of_a_sheared_volume_is_refused_with_its_angle():
    with refused(UsageError, "to_pyvista", "resample=True", 17.19):  # 0.3 radians
        sphere_volume(TILTED).to_pyvista()


def test_an_image_of_an_uneven_volume_is_refused_with_its_shortest_and_longest_step():
    uneven = sphere_volume(AFFINES["oblique"], positions=uneven_positions(AFFINES["oblique"]))
    with refused(UsageError, "to_pyvista", "resample=True", 0.57, 1.33):  # 0.6 and 1.4 times 0.95 mm
        uneven.to_pyvista()


def test_an_image_of_a_volume_sheared_by_less_than_a_hundredth_of_a_degree_has_its_points():
    affine = affine_of_axes(np.eye(3))
    affine[0, 2] = SPACING[2] * np.tan(np.radians(0.008))
    assert shear_degrees(affine) == pytest.approx(0.008)
    volume = Volume(np.zeros(SHAPE, np.int16), affine)
    assert np.abs(volume.to_pyvista().points - volume.ijk_to_lps(indices())).max() <= tolerances.IMAGE_POINT_MM


def irregular_volumes() -> dict[str, Volume]:
    affine = AFFINES["oblique, mirrored"]
    crooked = affine_of_axes(OBLIQUE @ np.array([[1, 0.2, 0.1], [0, 1, -0.3], [0, 0, -1]]))
    return {
        "tilted": sphere_volume(TILTED),
        "crooked": sphere_volume(crooked),
        "uneven": sphere_volume(AFFINES["oblique"], positions=uneven_positions(AFFINES["oblique"])),
        "uneven, mirrored": sphere_volume(affine, positions=uneven_positions(affine)),
    }


RAMP_A_MM = np.array([17.0, -11.0, 9.0])


@pytest.fixture(scope="module", params=irregular_volumes())
def resampled_ramp(request):
    """A volume whose HU rise evenly in space, its image, the indices of the points of the image, and the true HU."""
    volume = irregular_volumes()[request.param]
    values = (volume.ijk_to_lps(indices()) - ORIGIN) @ RAMP_A_MM
    volume = volume.with_voxels(values.reshape(SHAPE))
    image = volume.to_pyvista(resample=True)
    return volume, image, volume.lps_to_ijk(image.points), (np.asarray(image.points) - ORIGIN) @ RAMP_A_MM


def test_a_resampled_ramp_is_the_ramp_within_the_volume(resampled_ramp):
    volume, image, ijk, expected = resampled_ramp
    is_within = ((ijk >= 0.0) & (ijk <= np.array(volume.shape_ijk) - 1)).all(axis=1)
    assert is_within.sum() > 2500  # points of the image; measured 5004 to 9013
    assert np.abs(image["HU"] - expected)[is_within].max() <= tolerances.RESAMPLED_RAMP_HU


def test_a_resampled_volume_has_air_from_half_a_voxel_beyond_it_on_and_nowhere_else(resampled_ramp):
    volume, image, ijk, _ = resampled_ramp
    is_beyond = ((ijk < -0.5) | (ijk > np.array(volume.shape_ijk) - 0.5)).any(axis=1)
    assert (image["HU"][is_beyond] == AIR_HU).all()
    assert image["HU"][~is_beyond].min() >= volume.voxels.min() - tolerances.RESAMPLED_RAMP_HU


def test_a_resampled_image_has_a_note_of_its_regular_grid(resampled_ramp):
    _, image, _, _ = resampled_ramp
    assert "regular grid" in image.field_data["RESAMPLED"][0]


@pytest.fixture(scope="module", params=irregular_volumes())
def volume_and_grid(request):
    """A volume that is sheared or uneven, and its regular grid."""
    volume = irregular_volumes()[request.param]
    return volume, regular_grid(volume, volume.slice_origins())


def test_a_regular_grid_is_right_handed_and_square_with_the_spacing_of_rows_and_columns(volume_and_grid):
    volume, grid = volume_and_grid
    assert shear_degrees(grid.affine) < 1e-6  # rounding; measured 6e-15
    assert np.linalg.det(grid.affine[:3, :3]) > 0.0
    assert np.linalg.norm(grid.affine[:3, :2], axis=0) == pytest.approx(volume.spacing[:2])


def test_a_regular_grid_covers_all_voxels_with_less_than_a_step_to_spare(volume_and_grid):
    volume, grid = volume_and_grid
    ijk = (volume.ijk_to_lps(indices()) - grid.affine[:3, 3]) @ np.linalg.inv(grid.affine[:3, :3]).T
    last = np.array(grid.shape_ijk) - 1
    assert ijk.min() >= -1e-6  # of a step
    assert (ijk.max(axis=0) <= last + 1e-6).all()
    assert (ijk.max(axis=0) > last - 1).all()


def test_slices_of_a_tilted_volume_are_planes_of_its_grid_which_has_more_rows():
    volume = sphere_volume(TILTED)
    grid = regular_grid(volume, volume.slice_origins())
    assert grid.shape_ijk[2] == SHAPE[0]
    assert grid.shape_ijk[1] > SHAPE[1]
    plane_of_slice = (volume.slice_origins() - grid.affine[:3, 3]) @ np.linalg.inv(grid.affine[:3, :3]).T[:, 2]
    assert plane_of_slice == pytest.approx(np.arange(SHAPE[0]), abs=1e-9)


@pytest.mark.parametrize("name", irregular_volumes())
def test_contours_of_a_resampled_sphere_lie_on_it_but_for_its_sagitta(name):
    """The distance to a point is convex: interpolated between points h apart it is at most h^2 / 8 R too long, never
    too short, and it is interpolated twice here.
    """
    volume = irregular_volumes()[name]
    image = volume.to_pyvista(resample=True)
    contour = image.contour([200.0], method="flying_edges", compute_normals=True)
    radii = np.linalg.norm(contour.points - off_centre(volume), axis=1)
    assert len(radii) > 300  # points of the contour; measured 438 to 608
    gaps = np.linalg.norm(np.diff(volume.slice_origins(), axis=0), axis=1)
    too_long = sum(np.square([*volume.spacing[:2], gaps.max()])) + sum(np.square(image.spacing))
    assert radii.max() <= RADIUS + tolerances.IMAGE_SURFACE_MM
    assert radii.min() >= RADIUS - too_long / (8.0 * (RADIUS - 1.0))  # cells reach 1 mm into the sphere


def test_a_resampled_volume_of_unsigned_integers_keeps_its_type_with_0_for_air():
    volume = Volume(np.full((3, 4, 5), 7, np.uint8), TILTED)
    values = volume.to_pyvista(resample=True)["HU"]
    assert values.dtype == np.uint8
    assert set(values.tolist()) == {0, 7}


def test_a_regular_volume_is_not_resampled_where_that_is_allowed():
    volume = Volume(np.zeros((2, 3, 4), np.int16), AFFINES["oblique"])
    image = volume.to_pyvista(resample=True)
    assert np.shares_memory(image["HU"], volume.voxels)
    assert "RESAMPLED" not in image.field_data
