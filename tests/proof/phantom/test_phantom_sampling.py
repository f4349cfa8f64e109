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
    Sphere(MIDDLE, 9.5),
    Torus(MIDDLE, AXIS, 8.0, 3.6),
    Cylinder(MIDDLE, AXIS, 5.5, 14.0),
    Box(MIDDLE, AXIS, 7.0, 13.0, 11.0),
]
IDS = ["sphere", "torus", "cylinder", "box"]


@pytest.mark.parametrize("body", BODIES, ids=IDS)
def test_partial_volumes_add_up_to_the_analytic_volume(body) -> None:
    share = sample_occupancy(body, SHEARED, SHAPE)
    assert share.dtype == np.float32 and share.shape == SHAPE
    assert share.min() == 0.0 and share.max() == 1.0
    assert ((share > 0.0) & (share < 1.0)).sum() > 1000
    assert not any(face.any() for axis in range(3) for face in (share.take(0, axis), share.take(-1, axis)))
    voxel_ml = abs(np.linalg.det(SHEARED[:3, :3])) / 1000.0
    total = float(share.sum(dtype=np.float64)) * voxel_ml
    assert total == pytest.approx(body.volume_ml, rel=tolerances.PHANTOM_VOLUME_RATIO)


def test_small_sphere_still_adds_up() -> None:
    affine = compose_affine((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.4, 1.0), (0.0, 0.0, 0.0))
    body = Sphere(apply_affine(affine, [(8.2, 7.9, 7.6)])[0], 5.0)
    total = float(sample_occupancy(body, affine, (16, 17, 18)).sum(dtype=np.float64)) / 1000.0
    assert total == pytest.approx(body.volume_ml, rel=tolerances.PHANTOM_VOLUME_RATIO)


class HalfSpace(Sphere):
    """Everything below a plane, as a body without end."""

    def __init__(self, point: tuple[float, float, float], normal: tuple[float, float, float]):
        self.point, self.normal = np.array(point), np.array(normal)

    def signed_distance(self, points_mm: Any) -> Any:
        return (self.point - points_mm) @ self.normal

    @property
    def bounds_mm(self) -> Any:
        return np.array(((-np.inf,) * 3, (np.inf,) * 3))


def test_plane_gives_the_exact_share_of_a_voxel() -> None:
    affine = compose_affine((0.5, 0.0, 0.0), (0.0, 0.7, 0.0), (0.0, 0.0, 2.5), (0.0, 0.0, 0.0))
    for height in np.linspace(-1.2, 1.2, 9):
        share = sample_occupancy(HalfSpace((0.0, 0.0, height), (0.0, 0.0, 1.0)), affine, (3, 4, 5))
        assert share[0] == pytest.approx(0.5 + height / 2.5, abs=1e-6)
        assert share[2].max() == 0.0
    oblique = HalfSpace((0.1, -0.05, 0.3), AXIS)
    fine = (np.arange(60) + 0.5) / 60.0 - 0.5
    points = apply_affine(affine, np.array(list(itertools.product(fine, fine, fine))))
    counted = (oblique.signed_distance(points) >= 0.0).mean()
    assert 0.2 < counted < 0.8
    assert sample_occupancy(oblique, affine, (1, 1, 1))[0, 0, 0] == pytest.approx(
        counted, abs=tolerances.PHANTOM_PLANE_SHARE
    )


@pytest.mark.parametrize("body", BODIES[:3], ids=IDS[:3])
def test_marching_cubes_finds_area_and_volume(body) -> None:
    measure = pytest.importorskip("skimage.measure")
    affine = compose_affine((0.48, 0.36, 0.0), (-0.42, 0.56, 0.0), (0.1, 0.25, 0.9), (5.0, 6.0, 7.0))
    shape = (45, 60, 63)
    moved = {"center": apply_affine(affine, [(31.2, 29.6, 22.3)])[0]}
    if isinstance(body, Sphere):
        body = Sphere(radius=9.5, **moved)
    elif isinstance(body, Torus):
        body = Torus(axis=AXIS, major=9.0, minor=4.6, **moved)
    else:
        body = Cylinder(axis=AXIS, radius=6.5, length=16.0, **moved)
    share = sample_occupancy(body, affine, shape)
    corners, faces, _, _ = measure.marching_cubes(share, 0.5)
    triangles = apply_affine(affine, corners[:, ::-1])[faces]
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(cross, axis=1).sum() / 2.0
    volume = abs(np.einsum("ij,ij->", triangles[:, 0] - moved["center"], cross)) / 6000.0
    assert area == pytest.approx(body.area_mm2, rel=2.5 * tolerances.PHANTOM_MESH_AREA_RATIO)
    assert volume == pytest.approx(body.volume_ml, rel=tolerances.PHANTOM_MESH_VOLUME_RATIO)
    off = np.abs(body.signed_distance(apply_affine(affine, corners[:, ::-1])))
    assert np.sqrt((off**2).mean()) < 0.1


def test_point_spread_equals_scipy_and_keeps_the_sum() -> None:
    affine = compose_affine((0.7, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 2.5), (0.0, 0.0, 0.0))
    voxels = np.random.default_rng(6).normal(0.0, 1000.0, (13, 21, 17)).astype(np.float32)
    expected = gaussian_filter(voxels.astype(np.float64), (0.9 / 2.5, 0.9 / 0.5, 0.9 / 0.7), mode="nearest")
    blurred = apply_point_spread(voxels.copy(), affine, 0.9)
    assert np.abs(blurred - expected).max() < tolerances.PHANTOM_BLUR_HU
    assert np.array_equal(apply_point_spread(voxels.copy(), affine, 0.0), voxels)
    with refused(UsageError, -1):
        apply_point_spread(voxels, affine, -1.0)


def test_noise_has_the_asked_deviation_and_depends_on_the_seed() -> None:
    first, again, other = (add_noise(np.zeros((9, 64, 71), np.float32), 25.0, seed) for seed in (1, 1, 2))
    assert first.std() == pytest.approx(25.0, rel=0.02) and abs(first.mean()) < 0.5
    assert np.array_equal(first, again)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(first[0].ravel(), first[1].ravel())[0, 1]) < 0.06


def test_slices_report_progress_in_order() -> None:
    told: list[tuple[str, int, int]] = []
    map_slices(lambda k: None, 4, "draw", lambda *what: told.append(what))
    assert told == [("draw", 1, 4), ("draw", 2, 4), ("draw", 3, 4), ("draw", 4, 4)]


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(UsageError, match="singular"):
        sample_occupancy(BODIES[0], np.diag((1.0, 0.0, 1.0, 1.0)), SHAPE)
    with pytest.raises(UsageError, match="at least 1"):
        sample_occupancy(BODIES[0], SHEARED, (3, 0, 3))
    with pytest.raises(UsageError, match="subsamples"):
        sample_occupancy(BODIES[0], SHEARED, SHAPE, subsamples=0)
