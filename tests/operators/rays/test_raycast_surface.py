"""Mode surface against analysis and against the extracted mesh: asked of the twin and of every device that has it."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from raycast_scenes import (
    GAPS,
    STEPS,
    TURN,
    TwinCaster,
    blobs,
    casters,
    centre_of,
    distances_from,
    even_volume,
    look,
    uneven_volume,
)
from variants import daily

from clrecon.geometry import Volume
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.proof.surface.extract import extract_isosurface as extract_twin
from clrecon.rendering import Lighting
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

MATT = Lighting(ambient=0.2, diffuse=0.8, specular=0.0)
SLOPE = TURN @ np.array([0.35, -0.2, 0.9])
SLOPE /= np.linalg.norm(SLOPE)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "cast" in metafunc.fixturenames:
        metafunc.parametrize("cast", casters())


def make_volume(field, steps: str, *, extent: float) -> Volume:
    """`field` in a volume of about `extent` mm along each axis, or in 21 slices that lie unevenly."""
    if steps == "uneven":
        return uneven_volume(field, shape=(34, 30), gaps=GAPS[10:30])
    return even_volume(field, steps, extent=extent)


@pytest.mark.parametrize("perspective", daily(1, [False, True]))
@pytest.mark.parametrize("steps", daily(3, ["uneven", *STEPS]))
def test_depth_and_light_of_a_plane_are_those_of_its_place_and_slope(cast, steps, perspective):
    volume, size = make_volume(lambda p: 200.0 - 40.0 * (p @ SLOPE), steps, extent=24.0), (32, 32)
    camera = look(volume, -SLOPE + (0.3, 0.2, 0.0), half_height=5.0, perspective=perspective)
    shot = cast(volume, "surface", iso_value=200.0, camera=camera, size=size, lighting=MATT)
    origins, directions = camera.rays(size)
    truth = ((centre_of(volume) - origins) @ SLOPE) / (directions @ SLOPE)
    assert np.abs(shot.depth - truth).max() <= 0.01 * max(volume.spacing)  # a linear field is linear between voxels
    light = 255.0 * (MATT.ambient + MATT.diffuse * np.abs(directions @ SLOPE))
    rounding = tolerances.RAY_SAME_255 + 0.5  # the truth is no whole number, the picture is
    assert np.abs(shot.image[..., :3] - light[..., None]).max() <= rounding
    assert (shot.image[..., 3] == 255).all()


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("steps", daily(2, [*STEPS, "uneven"]))
def test_outline_and_depth_of_a_ball_are_those_of_analysis(cast, steps, perspective):
    radius, size = 9.0, (40, 40)
    volume = make_volume(lambda p: 300.0 + 30.0 * (radius - np.linalg.norm(p, axis=1)), steps, extent=24.0)
    longest = max(GAPS) if steps == "uneven" else max(volume.spacing)
    camera = look(volume, (0.5, 1.0, -0.3), half_height=11.0, perspective=perspective)

    shot = cast(volume, "surface", iso_value=300.0, camera=camera, size=size)

    passing, along = distances_from(centre_of(volume), camera, size)
    edge = np.abs(passing - radius) < tolerances.RAY_SILHOUETTE_VOXEL * longest
    assert np.array_equal(np.isfinite(shot.depth)[~edge], (passing < radius)[~edge])
    off_edge = passing < 0.8 * radius
    truth = along[off_edge] - np.sqrt(radius**2 - passing[off_edge] ** 2)
    assert np.abs(shot.depth[off_edge] - truth).max() <= tolerances.RAY_DEPTH_VOXEL * longest


def mesh_depths(cast, volume: Volume, iso_value: float, camera: Camera, size) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the closed mesh along each ray by VTK, NaN without, and |cosine| there between ray and normal."""
    import pyvista

    if isinstance(cast, TwinCaster):
        vertices, _, triangles = extract_twin(volume, iso_value)
    else:
        mesh = extract_isosurface(volume, iso_value, device=cast.device)
        vertices, triangles = np.asarray(mesh.vertices, np.float64), mesh.triangles
    surface = pyvista.PolyData.from_regular_faces(np.asarray(vertices, np.float64), triangles.astype(np.int64))
    origins, directions = camera.rays(size)
    depth, cosine = np.full(origins.shape[:2], np.nan), np.zeros(origins.shape[:2])
    normals = surface.face_normals
    for at in np.ndindex(*depth.shape):
        points, cells = surface.ray_trace(origins[at], origins[at] + 400.0 * directions[at])
        if len(points):
            ways = (points - origins[at]) @ directions[at]
            nearest = int(ways.argmin())
            depth[at], cosine[at] = ways[nearest], abs(normals[cells[nearest]] @ directions[at])
    return depth, cosine


@pytest.mark.parametrize("dtype", daily(1, [np.int16, np.float32]))
@pytest.mark.parametrize("steps", daily(1, ["sheared", "uneven", "anisotropic", "mirrored"]))
def test_depths_of_a_surface_and_of_its_caps_are_those_of_the_extracted_mesh(cast, steps, dtype):
    volume, size = make_volume(blobs, steps, extent=12.0), (32, 32)
    volume = volume.with_voxels(np.rint(volume.voxels).astype(dtype))
    camera = look(volume, (0.5, 1.0, 0.4), half_height=7.0, perspective=True)
    shot = cast(volume, "surface", iso_value=100.0, camera=camera, size=size, ray_step=0.1)
    depth, cosine = mesh_depths(cast, volume, 100.0, camera, size)
    both = np.isfinite(depth) & np.isfinite(shot.depth)
    assert both.mean() > 0.4  # of the pixels: enough to judge; measured 0.91
    assert (np.isfinite(depth) != np.isfinite(shot.depth)).mean() <= tolerances.RAY_OUTLINE_SHARE
    steep = both & (cosine > 0.4)
    longest = max(GAPS) if steps == "uneven" else max(volume.spacing)
    away = np.abs(shot.depth - depth)[steep] * cosine[steep] / longest
    assert (away <= tolerances.RAY_DEPTH_VOXEL).mean() >= 1.0 - tolerances.RAY_OUTLINE_SHARE
    assert np.median(away) <= 0.2 * tolerances.RAY_DEPTH_VOXEL  # most rays are far nearer than the bar: measured 7e-4


@pytest.mark.parametrize("iso_value", [400.0, -800.0])
@pytest.mark.parametrize(
    ("axis", "towards", "up"), [(0, (1, 0, 0), (0, 0, 1)), (1, (0, 1, 0), (0, 0, 1)), (2, (0, 0, 1), (0, 1, 0))]
)
def test_a_full_volume_is_closed_where_its_hu_fall_to_air_in_a_step_beyond_it(cast, axis, towards, up, iso_value):
    """Voxels of 976 HU in air of -1024: the surface lies 0.288 or 0.888 of a step beyond the outermost centres."""
    spacing, hu, air = np.array([0.7, 0.5, 2.5]), 976.0, -1024.0
    voxels = np.full((4, 5, 6), hu, np.float32)
    voxels[-1, -1, -1] = -2000.0  # outside is the volume's lowest value where that is above air
    volume = Volume(voxels, np.diag([*spacing, 1.0]))
    camera = look(volume, towards, half_height=0.2, up=up, distance=50.0)
    shot = cast(volume, "surface", iso_value=iso_value, camera=camera, size=(4, 4))
    beyond = (hu - iso_value) / (hu - air)
    truth = 50.0 - (0.5 * (volume.shape_ijk[axis] - 1) + beyond) * spacing[axis]
    assert np.abs(shot.depth - truth).max() <= 2e-3 * spacing[axis]  # of a crossing that is searched for


def test_surface_cut_by_a_clip_plane_has_a_cap_with_the_depth_and_light_of_the_plane(cast):
    radius, size = 9.0, (40, 40)
    volume = even_volume(lambda p: 300.0 + 30.0 * (radius - np.linalg.norm(p, axis=1)), "mirrored", extent=24.0)
    normal = np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2])
    clip = Clip.plane(centre_of(volume) + 2.0 * normal, normal)
    camera = look(volume, (-0.2, 1.0, -0.3), half_height=11.0, perspective=True)
    shot = cast(volume, "surface", iso_value=300.0, camera=camera, size=size, clip=clip, lighting=MATT)
    origins, directions = camera.rays(size)
    truth = (centre_of(volume) + 2.0 * normal - origins) @ normal / (directions @ normal)
    points = origins + truth[..., None] * directions - centre_of(volume)
    on_cap = np.linalg.norm(points, axis=-1) < radius - 0.2
    assert on_cap.sum() > 300  # pixels; measured 593
    assert np.abs(shot.depth - truth)[on_cap].max() <= tolerances.SLICE_DEPTH_MM
    light = 255.0 * (MATT.ambient + MATT.diffuse * np.abs(directions @ normal))
    assert np.abs(shot.image[..., 0] - light)[on_cap].max() <= tolerances.RAY_SAME_255


def test_a_camera_inside_a_surface_sees_a_cap_at_its_own_place(cast):
    across_the_view = lambda p: 500.0 + 20.0 * p[:, 0]  # noqa: E731
    volume = even_volume(across_the_view, "even", extent=12.0, dtype=np.int16)
    centre = centre_of(volume)
    camera = Camera(tuple(centre), tuple(centre + (0.0, 1.0, 0.0)), (0, 0, 1), view_angle=40.0)
    shot = cast(volume, "surface", iso_value=300.0, camera=camera, size=(8, 8), lighting=MATT)
    assert np.abs(shot.depth).max() <= 1e-6  # mm; measured 0
    assert (shot.image == 255).all()  # a cap faces its ray: ambient and diffuse light, 0.2 + 0.8


TOWARDS_LIGHT = np.array([0.5, 0.3, 1.0]) / np.linalg.norm([0.5, 0.3, 1.0])
BALL_RADIUS, FLOOR_Z = 3.0, -5.0


def ball_over_a_floor(points: np.ndarray) -> np.ndarray:
    radius = np.linalg.norm(points, axis=1)
    return 300.0 + 50.0 * np.maximum(BALL_RADIUS - radius, FLOOR_Z - points[:, 2])


def test_a_ball_throws_its_shadow_on_a_floor_where_its_line_to_the_light_meets_it(cast):
    volume, size = even_volume(ball_over_a_floor, "even", extent=30.0), (48, 48)
    lighting = Lighting(ambient=0.3, diffuse=0.7, specular=0.0, direction=tuple(TOWARDS_LIGHT))
    camera = look(volume, (0.0, 0.6, -1.0), half_height=9.0)
    settings = {"iso_value": 300.0, "camera": camera, "size": size, "lighting": lighting}
    plain, shadowed = (cast(volume, "surface", shadows=shadows, **settings) for shadows in (False, True))
    assert np.array_equal(plain.depth, shadowed.depth)

    origins, directions = camera.rays(size)
    points = origins + plain.depth[..., None] * directions - centre_of(volume)
    floor = (np.abs(points[..., 2] - FLOOR_Z) < 0.05) & (np.abs(points[..., :2]) < 12.0).all(axis=-1)
    to_line = np.linalg.norm(points - (points @ TOWARDS_LIGHT)[..., None] * TOWARDS_LIGHT, axis=-1)
    in_shadow = floor & (to_line < BALL_RADIUS - 0.3)  # 0.3 mm off the rim of the shadow
    in_light = floor & (to_line > BALL_RADIUS + 0.3)
    assert in_shadow.sum() > 50  # pixels; measured 148
    assert in_light.sum() > 500  # pixels; measured 1746

    lit = 255.0 * (lighting.ambient + lighting.diffuse * TOWARDS_LIGHT[2])
    rounding = tolerances.RAY_SAME_255 + 0.5
    in_ambient_light = 255.0 * lighting.ambient
    assert np.abs(shadowed.image[in_shadow, 0] - in_ambient_light).max() <= tolerances.RAY_SAME_255
    assert np.abs(shadowed.image[in_light, 0] - lit).max() <= rounding
    assert np.abs(plain.image[in_shadow | in_light, 0] - lit).max() <= rounding


def test_picture_of_a_surface_of_no_voxels_is_empty(cast):
    volume = even_volume(lambda p: np.zeros(len(p)), "even", extent=8.0, dtype=np.int16)
    shot = cast(volume, "surface", iso_value=300.0, camera=look(volume, (0, 1, 0), half_height=6.0), size=(8, 8))
    assert not shot.image.any() and np.isnan(shot.depth).all() and np.isnan(shot.expected_depth).all()
