"""Surfaces from clouds: known shapes, holes, noise, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_shapes import cube_cloud, cube_distances, sphere_cloud
from refusals import refused
from tolerances import FAR_FIELD_MM, MEAN_SPACING

from clrecon import PointCloud, Volume, extract_isosurface, reconstruct_surface
from clrecon.errors import RefusedInputError, UsageError
from clrecon.proof.phantom import PhantomSettings, make_phantom

SPACING_MM = 0.65


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def sphere_error(mesh, *, radius):
    """The rms distance of the vertices from a sphere around the origin, mm."""
    return rms(np.linalg.norm(mesh.vertices.astype(float), axis=1) - radius)


def assert_closed(mesh, components=1):
    """The mesh is closed, manifold and of that many components."""
    quality = mesh.quality()
    assert quality.closed
    assert quality.manifold
    assert quality.components == components


@pytest.fixture(scope="module")
def sphere_mesh(device):
    """The surface of 12,000 points on a sphere of 20 mm."""
    return reconstruct_surface(sphere_cloud(12_000, radius=20.0), SPACING_MM, device=device)


def test_surface_of_a_sphere_without_noise_is_closed_and_near_it(sphere_mesh):
    assert_closed(sphere_mesh)
    assert sphere_error(sphere_mesh, radius=20.0) < 0.015  # measured 0.007
    ball_ml = 4 / 3 * np.pi * 2.0**3
    assert sphere_mesh.quality().volume_ml == pytest.approx(ball_ml, rel=5e-4)  # measured 3e-4


def test_normals_of_a_reconstructed_sphere_point_outward(sphere_mesh):
    outward = np.einsum("ij,ij->i", sphere_mesh.normals, sphere_mesh.vertices / 20.0)
    assert outward.min() > 0.8  # within 37 degrees


def test_report_of_a_reconstruction_names_its_lengths(sphere_mesh):
    report = sphere_mesh.report
    assert (report["spacing_mm"], report["spacing_from"]) == (SPACING_MM, "caller")
    assert (report["reach_mm"], report["bridge_mm"]) == (2 * SPACING_MM, 2 * SPACING_MM)
    assert report["smoothing_mm"] == pytest.approx(0.1 * SPACING_MM)


def test_report_of_a_reconstruction_counts_points_regions_slabs_and_votes(sphere_mesh):
    report = sphere_mesh.report
    inside_and_outside = 2
    assert (report["points"], report["regions"]) == (12_000, inside_and_outside)
    assert (report["slabs"], report["tries"]) == (1, 1)
    assert report["votes_against_share"] < 0.005  # measured 0


def test_report_of_a_reconstruction_has_no_iso_value(sphere_mesh):
    assert "iso_value_hu" not in sphere_mesh.report


def test_surface_of_a_cube_without_noise_is_closed_and_near_it(device):
    mesh = reconstruct_surface(cube_cloud(13_000, edge=30.0), spacing=0.64, device=device)
    assert_closed(mesh)
    away = cube_distances(mesh.vertices, edge=30.0)
    assert rms(away) < 0.046  # measured 0.034, at edges that nodes 0.64 mm apart round
    assert mesh.quality().volume_ml == pytest.approx(3.0**3, rel=1e-3)  # measured 1.2e-4


def test_noise_of_0p2_mm_is_averaged_in_the_surface_and_twice_as_much_where_the_cloud_is_noisy(device):
    cloud = sphere_cloud(12_000, radius=20.0, noise=0.2)
    clean, noisy = (reconstruct_surface(cloud, SPACING_MM, noisy=choice, device=device) for choice in (False, True))
    assert_closed(noisy)
    assert sphere_error(clean, radius=20.0) == pytest.approx(0.125, rel=0.1)  # measured
    assert sphere_error(noisy, radius=20.0) == pytest.approx(0.063, rel=0.1)  # measured


def test_lengths_for_a_noisy_cloud_are_three_spacings_of_reach_and_a_thousand_of_smoothing(device):
    mesh = reconstruct_surface(sphere_cloud(2000, radius=8.0), SPACING_MM, noisy=True, device=device)
    assert mesh.report["reach_mm"] == pytest.approx(3 * SPACING_MM)
    assert mesh.report["smoothing_mm"] == pytest.approx(1000 * SPACING_MM)


CUBE = cube_cloud(13_000, edge=30.0)
SHORT_BRIDGE = {"spacing": 0.64, "bridge": 1.2}  # mm: the outside leaks into the cube


def test_a_leak_is_refused_without_widenings(device):
    with refused(RefusedInputError, "votes", *SHORT_BRIDGE.values()):
        reconstruct_surface(CUBE, **SHORT_BRIDGE, widenings=0, device=device)


def test_a_leak_is_closed_by_a_bridge_wider_by_a_quarter(device):
    mesh = reconstruct_surface(CUBE, **SHORT_BRIDGE, device=device)
    assert_closed(mesh)
    assert rms(cube_distances(mesh.vertices, edge=30.0)) < 0.1  # mm; measured 0.074
    report = mesh.report
    assert report["tries"] == 2
    assert report["bridge_mm"] == pytest.approx(1.25 * SHORT_BRIDGE["bridge"])
    assert report["reach_mm"] >= report["bridge_mm"]
    assert "with a bridge of 1.2 mm 50 % of the votes" in report["warnings"][0]


def test_a_leak_that_most_votes_are_against_is_warned_of(device):
    """A whole ball outvotes a smaller one that is open at its top."""
    whole, small = sphere_cloud(6000, radius=10.0), sphere_cloud(720, radius=6.0, centre=(25.0, 0.0, 0.0))
    open_top = small.select(np.flatnonzero(small.points[:, 2] < 0.6 * 6.0))
    both = PointCloud(np.r_[whole.points, open_top.points], np.r_[whole.normals, open_top.normals])
    warnings = reconstruct_surface(both, SPACING_MM, device=device).report["warnings"]
    assert "votes are against the winner: parts of the cloud may be open" in warnings[0]


def test_a_whole_ball_is_not_warned_of(device):
    whole = sphere_cloud(6000, radius=10.0)
    assert reconstruct_surface(whole, SPACING_MM, device=device).report["warnings"] == []


def test_a_sphere_without_its_upper_quarter_is_refused_after_all_widenings(device):
    cloud = sphere_cloud(3000, radius=10.0)
    open_top = cloud.select(np.flatnonzero(cloud.points[:, 2] < 5.0))
    with refused(RefusedInputError, "tries", 1 + 3) as caught:
        reconstruct_surface(open_top, SPACING_MM, device=device)
    widest_bridge_mm = 2 * SPACING_MM * 1.25**3
    assert f"bridge {widest_bridge_mm:.3f} mm" in str(caught.value)


def test_normals_that_point_inward_are_refused(device):
    cloud = sphere_cloud(3000, radius=10.0)
    with refused(RefusedInputError, "votes", 100):  # per cent of them
        reconstruct_surface(cloud.changed(normals=-cloud.normals), SPACING_MM, device=device)


def test_the_spacing_is_estimated_from_the_points(device):
    """A square of that side has one of the points."""
    mesh = reconstruct_surface(sphere_cloud(2000, radius=8.0), device=device)
    assert_closed(mesh)
    assert mesh.report["spacing_from"] == "points"
    area_a_point = 4 * np.pi * 8.0**2 / 2000
    assert mesh.report["spacing_mm"] == pytest.approx(area_a_point**0.5, rel=MEAN_SPACING)


def test_points_that_coincide_are_refused_without_a_spacing(device):
    cloud = PointCloud(np.zeros((20, 3)), np.tile((0, 0, 1.0), (20, 1)))
    with refused(UsageError, "points", "coincide"):
        reconstruct_surface(cloud, device=device)


def test_a_cloud_far_from_the_origin_has_as_good_a_surface_in_float64(device):
    shift = np.array((100_000.0, -50_000.0, 70_000.0))
    near = sphere_cloud(2000, radius=8.0)
    far = PointCloud(near.points + shift, near.normals)
    near_mesh, far_mesh = (reconstruct_surface(cloud, SPACING_MM, device=device) for cloud in (near, far))
    assert_closed(far_mesh)
    assert far_mesh.vertices.dtype == np.float64
    far_error = rms(np.linalg.norm(far_mesh.vertices - shift, axis=1) - 8.0)
    assert far_error == pytest.approx(sphere_error(near_mesh, radius=8.0), abs=FAR_FIELD_MM)


def test_mesh_of_a_cloud_in_slabs_is_that_of_the_whole(device):
    cloud = sphere_cloud(3000, radius=12.0)
    whole = reconstruct_surface(cloud, spacing=0.5, device=device)
    parts = reconstruct_surface(cloud, spacing=0.5, device=device, memory=1_400_000)
    assert parts.report["slabs"] > 1
    assert np.array_equal(whole.vertices, parts.vertices)
    assert np.array_equal(whole.triangles, parts.triangles)


SPACING_AGAIN_MM = 0.9


@pytest.fixture(scope="module")
def torus_twice(device):
    """The surface of a torus in a noisy volume at 226 HU, and the one that is made again from its vertices."""
    settings = PhantomSettings(kind="torus", size=(72, 56), slices=31, spacing=(0.7, 0.7, 1.0), tilt=15.0, noise=20.0)
    voxels, affine, _ = make_phantom(settings)
    first = extract_isosurface(Volume(voxels, affine), 226, device=device)
    cloud = PointCloud(first.vertices, first.normals, report={"certificate": {"series": "torus"}})
    return first, reconstruct_surface(cloud, SPACING_AGAIN_MM, device=device)


def test_surface_of_vertices_lies_near_the_mesh_they_came_from(torus_twice):
    from scipy.spatial import cKDTree

    first, again = torus_twice
    assert_closed(again, first.quality().components)
    assert again.quality().volume_ml == pytest.approx(first.quality().volume_ml, rel=0.03)  # measured 0.016
    there, _ = cKDTree(again.vertices).query(first.vertices)
    back, _ = cKDTree(first.vertices).query(again.vertices)
    assert np.percentile(np.concatenate([there, back]), 95) <= 0.7 * SPACING_AGAIN_MM


def test_surface_of_vertices_keeps_the_certificate_of_their_cloud(torus_twice):
    _, again = torus_twice
    assert again.report["certificate"] == {"series": "torus"}


def test_normals_of_four_times_the_length_give_the_same_surface(device):
    cloud = sphere_cloud(2000, radius=8.0)
    long_normals = cloud.changed(normals=4.0 * cloud.normals)
    expected, found = (reconstruct_surface(each, SPACING_MM, device=device) for each in (cloud, long_normals))
    assert np.allclose(found.vertices, expected.vertices, atol=1e-5)  # mm, float32


CLOUD = sphere_cloud(500, radius=5.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"spacing": 0.0}, "spacing is a positive number of mm, not 0.0"),
        ({"spacing": -1.0}, "spacing is a positive number of mm, not -1.0"),
        ({"spacing": np.nan}, "spacing is a positive number of mm, not nan"),
        ({"spacing": 1e-4}, "take larger cells|nodes every 0.0001 mm"),
        ({"bridge": 0.5}, "a bridge of 0.5 mm is less than the spacing of 0.65 mm"),
        ({"reach": 1.0}, "a reach of 1 mm: with a spacing of 0.65 mm it is between the bridge, 1.3 mm, and 20.8 mm"),
        ({"reach": 21.0}, "a reach of 21 mm"),
        ({"smoothing": 1e-5}, "a smoothing of 1e-05 mm"),
        ({"smoothing": np.inf}, "smoothing is a positive number of mm, not inf"),
        ({"widenings": 4}, "widenings are a whole number from 0 to 3, not 4"),
        ({"memory": 0}, "memory is a whole number of bytes"),
    ],
)
def test_lengths_that_cannot_be_used_are_refused(device, change, words):
    with pytest.raises(UsageError, match=words):
        reconstruct_surface(CLOUD, **{"spacing": 0.65, "device": device, **change})


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (PointCloud(np.empty((0, 3))), "the cloud has 0 points: a closed surface needs at least 4"),
        (CLOUD.select([0]), "the cloud has 1 points"),
        (PointCloud(CLOUD.points), "the cloud has no normals"),
        (CLOUD.points, "cloud must be a PointCloud, not ndarray"),
        (CLOUD.changed(normals=np.where(np.arange(500)[:, None] < 3, 0.0, CLOUD.normals)), "3 of 500 normals are 0"),
    ],
    ids=["empty", "one point", "no normals", "an array", "normals of length 0"],
)
def test_clouds_that_cannot_be_used_are_refused(device, wrong, words):
    with pytest.raises(UsageError, match=words):
        reconstruct_surface(wrong, SPACING_MM, device=device)


def test_cloud_of_points_that_are_not_finite_is_refused():
    with refused(UsageError, "finite"):
        PointCloud(np.full((5, 3), np.nan))
