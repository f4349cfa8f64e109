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


def place(steps: np.ndarray) -> np.ndarray:
    i, j, k = (steps * SPACING).T
    return compose_affine(i, j, k, ORIGIN)


AFFINES = {
    "straight": place(np.eye(3)),
    "oblique": place(OBLIQUE),
    "mirrored": place(np.diag([1.0, 1.0, -1.0])),
    "oblique, mirrored": place(OBLIQUE @ np.diag([-1.0, 1.0, 1.0])),
}
TILTED = place(OBLIQUE @ np.array([[1, 0, 0], [0, 1, np.sin(0.3)], [0, 0, np.cos(0.3)]]))


def indices(shape=SHAPE) -> np.ndarray:
    """(i, j, k) of every voxel, i fastest."""
    k, j, i = np.mgrid[tuple(slice(n) for n in shape)]
    return np.stack([i, j, k], axis=-1).reshape(-1, 3)


def off_centre(volume: Volume) -> np.ndarray:
    return volume.ijk_to_lps([(np.array(volume.shape_ijk) - 1) / 2])[0] + (0.9, -0.6, 0.3)


def sphere(affine: np.ndarray, dtype=np.float32, positions=None) -> Volume:
    """A sphere of RADIUS at 200 HU, off the centre along each axis: 100 HU a mm."""
    empty = Volume(np.zeros(SHAPE, dtype), affine, slice_positions=positions)
    distance = np.linalg.norm(empty.ijk_to_lps(indices()) - off_centre(empty), axis=1)
    return empty.with_voxels((200.0 + 100.0 * (RADIUS - distance)).reshape(SHAPE).astype(dtype))


def surface(volume: Volume) -> Mesh:
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


def test_every_point_is_its_voxel(numbers_and_image):
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


def test_an_image_names_frame_unit_and_the_turned_order_of_its_slices(numbers_and_image):
    name, _, image = numbers_and_image
    assert (image.field_data["SPACE"][0], image.field_data["UNIT"][0]) == ("LPS", "mm")
    assert ("SLICES" in image.field_data) == ("mirrored" in name)
    assert image.active_scalars_name == "HU" and "RESAMPLED" not in image.field_data


@pytest.mark.parametrize("dtype", ["int8", "uint8", "int16", "uint16", "int32", "float32"])
def test_the_image_shares_the_voxels(dtype):
    volume = Volume(np.arange(24, dtype=dtype).reshape(2, 3, 4), AFFINES["oblique"])
    image = volume.to_pyvista()
    assert np.shares_memory(image["HU"], volume.voxels) and image["HU"].dtype == dtype
    assert np.array_equal(image["HU"], np.arange(24))


@pytest.mark.release
def test_the_image_keeps_the_voxels_alive():
    image = Volume(np.arange(60_000, dtype=np.int32).reshape(20, 30, 100), AFFINES["oblique"]).to_pyvista()
    gc.collect()
    assert np.array_equal(image["HU"], np.arange(60_000))


def test_mirrored_volumes_are_copied_and_left_alone():
    volume = Volume(np.arange(24, dtype=np.int16).reshape(2, 3, 4), AFFINES["mirrored"])
    image = volume.to_pyvista()
    assert not np.shares_memory(image["HU"], volume.voxels)
    assert image["HU"].tolist() == [*range(12, 24), *range(12)]


@pytest.mark.parametrize("name", AFFINES)
def test_contours_lie_where_our_own_surface_does(name):
    from scipy.spatial import cKDTree

    volume = sphere(AFFINES[name])
    ours = surface(volume)
    theirs = volume.to_pyvista().contour([200.0], method="flying_edges", compute_normals=True)
    assert theirs.n_points == len(ours.vertices)
    apart, _ = cKDTree(ours.vertices).query(theirs.points)
    assert apart.max() <= tolerances.IMAGE_SURFACE_MM
    outward = theirs.points - off_centre(volume)
    assert ((theirs.point_data["Normals"] * outward).sum(axis=1) > 0.0).all()
    corners = np.asarray(theirs.points, dtype=np.float64)[theirs.faces.reshape(-1, 4)[:, 1:]]
    solid = np.linalg.det(corners - off_centre(volume)).sum() / 6.0
    assert solid == pytest.approx(ours.quality()["volume_ml"] * 1000.0, rel=tolerances.IMAGE_VOLUME)


def test_sheared_and_uneven_volumes_are_refused_with_their_numbers():
    with refused(UsageError, "to_pyvista", "resample=True", 17.19):
        sphere(TILTED).to_pyvista()
    with refused(UsageError, "to_pyvista", "resample=True", 0.57, 1.33):
        sphere(AFFINES["oblique"], positions=uneven_positions(AFFINES["oblique"])).to_pyvista()
    barely = place(np.eye(3))
    barely[0, 2] = 0.95 * np.tan(np.radians(0.008))
    assert shear_degrees(barely) == pytest.approx(0.008)
    volume = Volume(np.zeros(SHAPE, np.int16), barely)
    assert np.abs(volume.to_pyvista().points - volume.ijk_to_lps(indices())).max() <= tolerances.IMAGE_POINT_MM


def hard_volumes() -> dict[str, Volume]:
    affine = AFFINES["oblique, mirrored"]
    crooked = place(OBLIQUE @ np.array([[1, 0.2, 0.1], [0, 1, -0.3], [0, 0, -1]]))
    return {
        "tilted": sphere(TILTED),
        "crooked": sphere(crooked),
        "uneven": sphere(AFFINES["oblique"], positions=uneven_positions(AFFINES["oblique"])),
        "uneven, mirrored": sphere(affine, positions=uneven_positions(affine)),
    }


@pytest.mark.parametrize("name", hard_volumes())
def test_a_resampled_ramp_is_the_ramp_and_air_is_around_it(name):
    volume = hard_volumes()[name]
    ramp = np.array([17.0, -11.0, 9.0])
    values = (volume.ijk_to_lps(indices()) - ORIGIN) @ ramp
    volume = volume.with_voxels(values.reshape(SHAPE))
    image = volume.to_pyvista(resample=True)
    ijk = volume.lps_to_ijk(image.points)
    last = np.array(volume.shape_ijk) - 1
    within = ((ijk >= 0.0) & (ijk <= last)).all(axis=1)
    beyond = ((ijk < -0.5) | (ijk > last + 0.5)).any(axis=1)
    truth = (np.asarray(image.points) - ORIGIN) @ ramp
    assert within.sum() > 1000
    assert np.abs(image["HU"] - truth)[within].max() <= tolerances.RESAMPLED_RAMP_HU
    assert (image["HU"][beyond] == AIR_HU).all()
    assert image["HU"][~beyond].min() >= values.min() - tolerances.RESAMPLED_RAMP_HU
    assert "regular grid" in image.field_data["RESAMPLED"][0]


@pytest.mark.parametrize("name", hard_volumes())
def test_the_grid_covers_the_volume_with_its_spacing(name):
    volume = hard_volumes()[name]
    grid = regular_grid(volume, volume.slice_origins())
    assert shear_degrees(grid.affine) < 1e-6 and np.linalg.det(grid.affine[:3, :3]) > 0.0
    steps = np.linalg.norm(grid.affine[:3, :3], axis=0)
    assert steps[:2] == pytest.approx(volume.spacing[:2])
    ijk = (volume.ijk_to_lps(indices()) - grid.affine[:3, 3]) @ np.linalg.inv(grid.affine[:3, :3]).T
    assert ijk.min() >= -1e-6 and (ijk.max(axis=0) <= np.array(grid.shape_ijk) - 1 + 1e-6).all()
    assert (ijk.max(axis=0) > np.array(grid.shape_ijk) - 2).all()


def test_planes_of_a_tilted_volume_are_planes_of_its_grid():
    volume = sphere(TILTED)
    grid = regular_grid(volume, volume.slice_origins())
    assert grid.shape_ijk[2] == SHAPE[0] and grid.shape_ijk[1] > SHAPE[1]
    k = (volume.slice_origins() - grid.affine[:3, 3]) @ np.linalg.inv(grid.affine[:3, :3]).T[:, 2]
    assert k == pytest.approx(np.arange(SHAPE[0]), abs=1e-9)


@pytest.mark.parametrize("name", hard_volumes())
def test_contours_of_resampled_volumes_lie_on_the_sphere(name):
    volume = hard_volumes()[name]
    image = volume.to_pyvista(resample=True)
    theirs = image.contour([200.0], method="flying_edges", compute_normals=True)
    radii = np.linalg.norm(theirs.points - off_centre(volume), axis=1)
    assert theirs.n_points > 300
    # The distance to a point is convex: interpolated between points h apart it is at most h^2 / 8 R too long, never too
    # short, and it is interpolated twice here.
    gaps = np.linalg.norm(np.diff(volume.slice_origins(), axis=0), axis=1)
    too_long = sum(np.square([*volume.spacing[:2], gaps.max()])) + sum(np.square(image.spacing))
    assert radii.max() <= RADIUS + tolerances.IMAGE_SURFACE_MM
    assert radii.min() >= RADIUS - too_long / (8.0 * (RADIUS - 1.0))


def test_integers_are_rounded_and_unsigned_ones_have_no_air():
    volume = Volume(np.full((3, 4, 5), 7, np.uint8), TILTED)
    values = volume.to_pyvista(resample=True)["HU"]
    assert values.dtype == np.uint8 and set(values.tolist()) == {0, 7}


def test_a_regular_volume_is_not_resampled():
    volume = Volume(np.zeros((2, 3, 4), np.int16), AFFINES["oblique"])
    image = volume.to_pyvista(resample=True)
    assert np.shares_memory(image["HU"], volume.voxels) and "RESAMPLED" not in image.field_data
