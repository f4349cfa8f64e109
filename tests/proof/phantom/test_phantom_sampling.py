"""Partial volume, point spread and noise under anisotropic, oblique and sheared affines."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused
from scipy.ndimage import gaussian_filter

from clrecon.errors import UsageError
from clrecon.geometry import apply_affine, compose_affine
from clrecon.proof.phantom.sampling import add_noise, apply_point_spread, map_slices, sample_occupancy
from clrecon.proof.phantom.shapes import Box, Cylinder, Sphere, Torus

# left-handed, sheared and oblique, 0.7 x 0.5 x 1.9 mm: nothing is parallel to anything
SHEARED = compose_affine((0.42, 0.56, 0.0), (0.4, -0.3, 0.0), (0.3, 0.5, 1.8), (-31.3, -20.2, 100.7))
SHAPE = (27, 95, 71)
MIDDLE = apply_affine(SHEARED, [(35.3, 46.8, 13.1)])[0]
AXIS = (0.36, -0.48, 0.8)
BODIES = [
    Sphere(MIDDLE, radius=9.5),
    Torus(MIDDLE, AXIS, major=8.0, minor=3.6),
    Cylinder(MIDDLE, AXIS, radius=5.5, length=14.0),
    Box(MIDDLE, AXIS, thickness=7.0, width=13.0, height=11.0),
]
IDS = ["sphere", "torus", "cylinder", "box"]


@pytest.fixture(scope="module", params=BODIES, ids=IDS)
def sampled_body(request: pytest.FixtureRequest) -> tuple[Any, np.ndarray]:
    """A body, and the share of it in each voxel of the sheared grid."""
    return request.param, sample_occupancy(request.param, SHEARED, SHAPE)


def test_partial_volumes_add_up_to_the_analytic_volume(sampled_body: tuple[Any, np.ndarray]) -> None:
    body, share = sampled_body
    voxel_ml = abs(np.linalg.det(SHEARED[:3, :3])) / 1000.0
    total_ml = float(share.sum(dtype=np.float64)) * voxel_ml
    assert total_ml == pytest.approx(body.volume_ml, rel=tolerances.PHANTOM_VOLUME_RATIO)


def test_shares_of_voxels_are_float32_from_0_to_1_with_parts_at_the_surface(
    sampled_body: tuple[Any, np.ndarray],
) -> None:
    _, share = sampled_body
    assert share.dtype == np.float32
    assert (share.min(), share.max()) == (0.0, 1.0)
    assert ((share > 0.0) & (share < 1.0)).sum() > 1000  # of bodies of some 10 voxels; measured 1498 to 2734


def test_body_within_the_grid_has_no_share_of_the_outermost_voxels(sampled_body: tuple[Any, np.ndarray]) -> None:
    _, share = sampled_body
    assert share.shape == SHAPE
    assert not np.delete(share, slice(1, -1), axis=0).any()
    assert not np.delete(share, slice(1, -1), axis=1).any()
    assert not np.delete(share, slice(1, -1), axis=2).any()


def test_partial_volumes_of_a_sphere_of_five_voxels_add_up_to_its_volume() -> None:
    affine = compose_affine((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.4, 1.0), (0.0, 0.0, 0.0))  # voxels of 1 mm3
    sphere = Sphere(apply_affine(affine, [(8.2, 7.9, 7.6)])[0], radius=5.0)
    total_ml = float(sample_occupancy(sphere, affine, (16, 17, 18)).sum(dtype=np.float64)) / 1000.0
    assert total_ml == pytest.approx(sphere.volume_ml, rel=tolerances.PHANTOM_VOLUME_RATIO)


class HalfSpace(Sphere):
    """Everything below a plane, as a body without end."""

    def __init__(self, point: tuple[float, float, float], normal: tuple[float, float, float]):
        self.point, self.normal = np.array(point), np.array(normal)

    def signed_distance(self, points_mm: Any) -> Any:
        return (self.point - points_mm) @ self.normal

    @property
    def bounds_mm(self) -> Any:
        return np.array(((-np.inf,) * 3, (np.inf,) * 3))


@pytest.mark.parametrize("height", np.linspace(-1.2, 1.2, 9))
def test_share_of_a_voxel_below_a_level_plane_is_exact(height: float) -> None:
    gap = 2.5  # between slices, mm; the first reaches from -1.25 to 1.25
    affine = np.diag((0.5, 0.7, gap, 1.0))
    share = sample_occupancy(HalfSpace((0.0, 0.0, height), (0.0, 0.0, 1.0)), affine, (3, 4, 5))
    assert share[0] == pytest.approx(0.5 + height / gap, abs=1e-6)  # float32
    assert share[2].max() == 0.0


def test_share_of_a_voxel_below_an_oblique_plane_is_that_of_points_within_it() -> None:
    affine = np.diag((0.5, 0.7, 2.5, 1.0))
    below = HalfSpace((0.1, -0.05, 0.3), AXIS)
    fine = (np.arange(60) + 0.5) / 60.0 - 0.5  # places in a voxel along one axis
    points = apply_affine(affine, np.array(list(itertools.product(fine, fine, fine))))

    share = sample_occupancy(below, affine, (1, 1, 1)).item()

    counted = (below.signed_distance(points) >= 0.0).mean()
    assert 0.2 < counted < 0.8  # the plane passes through the middle of the voxel: 0.65 was measured
    assert share == pytest.approx(counted, abs=tolerances.PHANTOM_PLANE_SHARE)


TURNED = compose_affine((0.48, 0.36, 0.0), (-0.42, 0.56, 0.0), (0.1, 0.25, 0.9), (5.0, 6.0, 7.0))
TURNED_SHAPE = (45, 60, 63)
TURNED_MIDDLE = apply_affine(TURNED, [(31.2, 29.6, 22.3)])[0]


@pytest.mark.parametrize(
    "body",
    [
        pytest.param(Sphere(TURNED_MIDDLE, radius=9.5), id="sphere"),
        pytest.param(Torus(TURNED_MIDDLE, AXIS, major=9.0, minor=4.6), id="torus"),
        pytest.param(Cylinder(TURNED_MIDDLE, AXIS, radius=6.5, length=16.0), id="cylinder"),
    ],
)
def test_half_share_surface_of_a_body_has_its_area_and_volume_and_lies_on_it(body) -> None:
    measure = pytest.importorskip("skimage.measure")
    share = sample_occupancy(body, TURNED, TURNED_SHAPE)

    corners_kji, faces, _, _ = measure.marching_cubes(share, 0.5)

    corners = apply_affine(TURNED, corners_kji[:, ::-1])
    triangles = corners[faces]
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area_mm2 = np.linalg.norm(cross, axis=1).sum() / 2.0
    volume_mm3 = abs(np.einsum("ij,ij->", triangles[:, 0] - TURNED_MIDDLE, cross)) / 6.0
    assert area_mm2 == pytest.approx(body.area_mm2, rel=2.5 * tolerances.PHANTOM_MESH_AREA_RATIO)  # edges, a torus
    assert volume_mm3 / 1000.0 == pytest.approx(body.volume_ml, rel=tolerances.PHANTOM_MESH_VOLUME_RATIO)
    rms_distance_mm = np.sqrt((body.signed_distance(corners) ** 2).mean())
    assert rms_distance_mm < 0.06  # a tenth of a pixel; measured 0.034


def draw_noise_volume() -> tuple[np.ndarray, np.ndarray]:
    """White noise of 1000 HU in voxels of 0.7 x 0.5 x 2.5 mm, and their affine."""
    voxels = np.random.default_rng(6).normal(0.0, 1000.0, (13, 21, 17)).astype(np.float32)
    return voxels, np.diag((0.7, 0.5, 2.5, 1.0))


def test_point_spread_is_the_gaussian_filter_of_scipy_in_mm() -> None:
    voxels, affine = draw_noise_volume()
    expected = gaussian_filter(voxels.astype(np.float64), (0.9 / 2.5, 0.9 / 0.5, 0.9 / 0.7), mode="nearest")
    blurred = apply_point_spread(voxels.copy(), affine, sigma_mm=0.9)
    assert np.abs(blurred - expected).max() < tolerances.PHANTOM_BLUR_HU


def test_point_spread_of_0_mm_changes_no_voxel() -> None:
    voxels, affine = draw_noise_volume()
    assert np.array_equal(apply_point_spread(voxels.copy(), affine, sigma_mm=0.0), voxels)


def test_negative_point_spread_is_refused_with_its_value() -> None:
    voxels, affine = draw_noise_volume()
    with refused(UsageError, -1):
        apply_point_spread(voxels, affine, sigma_mm=-1.0)


def draw_noise(seed: int) -> np.ndarray:
    """Noise of 25 HU alone."""
    return add_noise(np.zeros((9, 64, 71), np.float32), sigma_hu=25.0, seed=seed)


def test_noise_has_the_asked_deviation_about_0() -> None:
    noise = draw_noise(1)
    assert noise.std() == pytest.approx(25.0, rel=0.02)  # of 40,000 values: the standard error is 0.4 %
    assert abs(noise.mean()) < 0.5  # HU: four standard errors


def test_noise_of_one_seed_is_the_same_and_that_of_another_uncorrelated() -> None:
    first, again, other = draw_noise(1), draw_noise(1), draw_noise(2)
    assert np.array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.02  # four standard errors of 40,000 pairs


def test_noise_of_two_slices_is_uncorrelated() -> None:
    noise = draw_noise(1)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.06  # four standard errors of 4,500 pairs


def test_progress_of_slices_is_told_in_order_with_their_number() -> None:
    told: list[tuple[str, int, int]] = []
    map_slices(lambda k: None, 4, "draw", lambda *what: told.append(what))
    assert told == [("draw", 1, 4), ("draw", 2, 4), ("draw", 3, 4), ("draw", 4, 4)]


def test_shares_under_a_singular_affine_are_refused() -> None:
    with pytest.raises(UsageError, match="singular"):
        sample_occupancy(BODIES[0], np.diag((1.0, 0.0, 1.0, 1.0)), SHAPE)


def test_shares_of_a_grid_without_voxels_are_refused() -> None:
    with pytest.raises(UsageError, match="at least 1"):
        sample_occupancy(BODIES[0], SHEARED, (3, 0, 3))


def test_shares_from_no_subsamples_are_refused() -> None:
    with pytest.raises(UsageError, match="subsamples"):
        sample_occupancy(BODIES[0], SHEARED, SHAPE, subsamples=0)
