"""Rays to the closed iso surface: depths, caps, shadows, slabs, and against the twin and the extracted mesh."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from ray_scenes import GRIDS, LONGEST_STEP, blobs, centre_of, look, make_volume, premultiplied
from refusals import refused
from variants import daily

from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.operators.rays.picture_buffers import Shot
from clrecon.operators.rays.surface_pictures import cast_surface
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.proof.rays.surface import cast_surface as cast_twin
from clrecon.rendering import Lighting, Rendering
from clrecon.rendering.pictures.styles import SurfaceLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

SIZE = (56, 48)
UNLIT = Lighting(1.0, 0.0, 0.0)
MATT = Lighting(0.2, 0.8, 0.0)
FIXED = Lighting(0.2, 0.7, 0.3, 20.0, direction=(0.5, -0.8, 0.6))
RADIUS = 7.0


def cast_rays(
    device, volume: Volume, iso_value: float, camera: Camera, size=SIZE, memory=None, **settings
) -> Rendering:
    step = settings.pop("ray_step", 0.5 * min(volume.spacing))
    background = settings.pop("background", None)
    style = SurfaceLook(iso_value, **{"lighting": UNLIT, "color": "white", **settings})
    resident = DeviceVolume(volume, device=device, memory=memory)
    return cast_surface(resident, style, Shot(camera, size, background), step)


def ball(points: np.ndarray) -> np.ndarray:
    return 300.0 + 30.0 * (RADIUS - np.linalg.norm(points, axis=1))


def assert_alike(found: Rendering, expected: Rendering, share: float = tolerances.SURFACE_TWIN_SHARE) -> None:
    away = np.abs(premultiplied(found.image) - premultiplied(expected.image)).max(axis=-1)
    assert (away <= 2.0).mean() >= 1.0 - share
    both = np.isfinite(found.depth) & np.isfinite(expected.depth)
    assert both.mean() > 0.1  # enough pixels to judge: measured 0.21 on
    assert (np.isfinite(found.depth) != np.isfinite(expected.depth)).mean() <= share
    assert (np.abs(found.depth - expected.depth)[both] <= tolerances.SURFACE_TWIN_MM).mean() >= 1.0 - share


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("grid", GRIDS)
def test_outline_depth_and_light_of_a_ball_are_those_of_analysis(device, grid, perspective):
    volume = make_volume(ball, grid, 20.0)
    camera = look(volume, (0.5, 1.0, -0.3), 9.0, perspective)
    found = cast_rays(device, volume, 300.0, camera, lighting=MATT)
    origins, directions = camera.rays(SIZE)
    to_centre = centre_of(volume) - origins
    along = (to_centre * directions).sum(axis=-1)
    passing = np.linalg.norm(to_centre - along[..., None] * directions, axis=-1)
    at_the_rim_mm = 0.1  # measured 0.068: between voxels the field bends
    assert np.isfinite(found.depth)[passing < RADIUS - at_the_rim_mm].all()
    assert np.isnan(found.depth)[passing > RADIUS + at_the_rim_mm].all()
    clear = passing < 0.8 * RADIUS
    chord = np.sqrt(np.maximum(RADIUS**2 - passing**2, 0.0))
    assert np.abs(found.depth - (along - chord))[clear].max() <= tolerances.SURFACE_RAY_VOXEL * LONGEST_STEP
    light = 255.0 * (0.2 + 0.8 * chord / RADIUS)
    if grid != "uneven":  # central differences over gaps of 0.4 and 1.9 mm are off in a field that bends
        assert np.abs(found.image[..., 0] - light)[clear].max() <= tolerances.SURFACE_LIGHT_255
    assert np.array_equal(found.image[..., 3] == 255, np.isfinite(found.depth))


def half_of(volume: Volume, size: tuple[int, int]) -> int:
    """Bytes that hold a picture and about half of a volume."""
    return 44 * size[0] * size[1] + volume.voxels.nbytes * 9 // 20


SCENES: dict[str, tuple[str, type, dict]] = {
    "soft": ("anisotropic", np.int16, {"lighting": MATT}),
    "fixed light": ("oblique", np.float32, {"lighting": FIXED, "perspective": True}),
    "shadows": ("sheared", np.int16, {"lighting": FIXED, "shadows": True}),
    "clipped": ("mirrored", np.float32, {"lighting": FIXED, "perspective": True, "cut": True, "shadows": True}),
    "coarse": ("even", np.int16, {"lighting": MATT, "ray_step": 1.7}),
    "uneven": ("uneven", np.int16, {"lighting": MATT, "perspective": True}),
    "uneven clipped": ("uneven", np.float32, {"lighting": FIXED, "cut": True, "shadows": True}),
}


def scene(name: str) -> tuple[Volume, dict]:
    grid, dtype, settings = SCENES[name]
    settings = dict(settings)
    volume = make_volume(blobs, grid, 14.0, dtype)
    settings["camera"] = look(volume, (0.4, 1.0, -0.3), 9.0, settings.pop("perspective", False))
    if settings.pop("cut", False):
        centre = centre_of(volume)
        settings["clip"] = Clip.box(centre - 5.0, centre + (6.0, 5.0, 4.0)) & Clip.plane(centre, (0.5, 0.4, 1.0))
    return volume, settings


@pytest.mark.parametrize("name", SCENES)
def test_surface_of_every_scene_equals_its_twin(device, name):
    volume, settings = scene(name)
    camera = settings["camera"]
    style = SurfaceLook(100.0, color="white", **{name: value for name, value in settings.items() if name != "camera"})
    expected = cast_twin(volume, style, camera, SIZE)
    truth = Rendering(expected.image(), expected.depth, expected.depth, None)
    assert_alike(cast_rays(device, volume, 100.0, **settings), truth)


@pytest.mark.release
@pytest.mark.usefixtures("users_kernels")
@pytest.mark.parametrize("name", daily(1, ["soft", "clipped", "uneven"]))
def test_surface_found_by_one_sample_at_a_time_is_the_same(device, name, monkeypatch):
    volume, settings = scene(name)
    found = cast_rays(device, volume, 100.0, **settings)
    monkeypatch.setitem(device.kernel_variants, "LANES", "1")
    assert_alike(found, cast_rays(device, volume, 100.0, **settings))


@pytest.mark.parametrize("towards", [(0.1, 0.3, 1.0), (-0.1, 0.2, -1.0), (0.5, 1.0, 0.05)])
@pytest.mark.parametrize("grid", ["oblique", "uneven"])
def test_slabs_give_the_picture_of_the_whole(device, grid, towards):
    volume = make_volume(blobs, grid, 22.0, np.int16)
    camera, size = look(volume, towards, 13.0, True), (24, 16)
    whole = cast_rays(device, volume, 100.0, camera, size, lighting=MATT)
    parts = cast_rays(device, volume, 100.0, camera, size, lighting=MATT, memory=half_of(volume, size))
    assert whole.report["slabs"] == 1 and parts.report["slabs"] > 2
    assert np.abs(whole.image.astype(int) - parts.image).max() <= 1
    assert np.allclose(whole.depth, parts.depth, atol=1e-3, equal_nan=True)  # mm; measured 0


def test_a_ray_step_longer_than_slabs_allow_is_shortened_with_a_warning(device):
    volume = make_volume(blobs, "even", 22.0, np.int16)
    camera, size = look(volume, (0.1, 0.3, 1.0), 13.0), (16, 12)
    parts = cast_rays(device, volume, 100.0, camera, size, ray_step=5.0, memory=half_of(volume, size))
    assert parts.report["ray_step_mm"] == pytest.approx(0.9)
    assert "in slabs: the ray step is 0.9 mm in place of 5" in parts.report["warnings"][0]


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("grid", daily(1, ["sheared", "uneven"]))
def test_depths_of_rays_to_a_surface_and_its_caps_are_those_of_the_extracted_mesh(device, grid):
    import pyvista

    volume, size = make_volume(blobs, grid, 12.0, np.int16), (24, 20)
    camera = look(volume, (0.5, 1.0, 0.4), 7.0, perspective=True)
    found = cast_rays(device, volume, 100.0, camera, size, ray_step=0.1)
    mesh = extract_isosurface(volume, 100.0, device=device)
    surface = pyvista.PolyData.from_regular_faces(mesh.vertices.astype(np.float64), mesh.triangles.astype(np.int64))
    origins, directions = camera.rays(size)
    away = []
    for at in np.ndindex(size[1], size[0]):
        points, cells = surface.ray_trace(origins[at], origins[at] + 300.0 * directions[at])
        if len(points) and np.isfinite(found.depth[at]):
            ways = (points - origins[at]) @ directions[at]
            cosine = abs(surface.face_normals[cells[ways.argmin()]] @ directions[at])
            away.append(abs(ways.min() - found.depth[at]) * cosine)
    assert len(away) > 0.3 * size[0] * size[1]  # enough pixels to judge: measured 0.86 of them
    near = np.array(away) <= tolerances.SURFACE_RAY_VOXEL * LONGEST_STEP
    assert near.mean() >= 1.0 - tolerances.SURFACE_OUTLINE_SHARE


@pytest.fixture(scope="module")
def clipped_ball(device):
    """A picture of a ball that a slanted plane 2 mm from its middle clips, and of each pixel on the cap:

    which these are, the depth of the plane, and the cosine between the ray and the normal of the plane.
    """
    volume = make_volume(ball, "mirrored", 20.0)
    normal = np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2])
    on_plane = centre_of(volume) + 2.0 * normal
    camera = look(volume, (-0.2, 1.0, -0.3), 9.0, perspective=True)
    picture = cast_rays(device, volume, 300.0, camera, clip=Clip.plane(on_plane, normal), lighting=MATT)
    origins, directions = camera.rays(SIZE)
    cosine = directions @ normal
    depth_of_plane = (on_plane - origins) @ normal / cosine
    hits = origins + depth_of_plane[..., None] * directions - centre_of(volume)
    on_cap = np.linalg.norm(hits, axis=-1) < RADIUS - 0.2  # mm: pixels at its rim are left out
    assert on_cap.sum() > 300  # measured 724
    return picture, on_cap, depth_of_plane, cosine


def test_cap_of_a_clipped_surface_lies_on_the_plane(clipped_ball):
    picture, on_cap, depth_of_plane, _ = clipped_ball
    assert np.abs(picture.depth - depth_of_plane)[on_cap].max() <= tolerances.SLICE_DEPTH_MM


def test_cap_of_a_clipped_surface_has_the_light_of_the_plane(clipped_ball):
    """The lamp is at the camera, so that light falls by the cosine between ray and normal."""
    picture, on_cap, _, cosine = clipped_ball
    light_of_255 = 255.0 * (MATT.ambient + MATT.diffuse * np.abs(cosine))
    assert np.abs(picture.image[..., 0] - light_of_255)[on_cap].max() <= tolerances.RAY_SAME_255


def test_a_camera_inside_of_bone_sees_a_white_cap_at_its_own_place(device):
    volume = make_volume(lambda p: np.full(len(p), 500.0), "even", 10.0, np.int16)
    centre = centre_of(volume)
    camera = Camera(tuple(centre), tuple(centre + (0.0, 1.0, 0.0)), (0, 0, 1), view_angle=40.0)
    found = cast_rays(device, volume, 300.0, camera, (8, 8), lighting=MATT)
    assert np.abs(found.depth).max() <= 1e-4  # mm; measured 0
    assert (found.image == 255).all()


def test_surface_of_a_single_slice_lies_half_way_to_the_values_around_it(device):
    volume = Volume(np.full((1, 9, 9), 1000, np.int16), np.diag([1.0, 1.0, 2.0, 1.0]))
    found = cast_rays(device, volume, 500.0, look(volume, (0.0, 0.01, -1.0), 3.0), (8, 8))
    # Outside is 499, as the volume has no air: half way between 499 and 1000 HU the level is 499.5.
    assert np.abs(found.depth - (150.0 - 2.0 * (1000.0 - 499.5) / 501.0)).max() < 0.04  # the view leans by 0.01


def test_a_ball_throws_its_shadow_on_a_floor_where_its_line_to_the_light_meets_it(device):
    """A ball of 3 mm over a floor at z = -5 mm."""

    def field(points: np.ndarray) -> np.ndarray:
        return 300.0 + 50.0 * np.maximum(3.0 - np.linalg.norm(points, axis=1), -5.0 - points[:, 2])

    volume = make_volume(field, "even", 26.0)
    towards = np.array([0.5, 0.3, 1.0]) / np.linalg.norm([0.5, 0.3, 1.0])
    camera = look(volume, (0.0, 0.6, -1.0), 9.0)
    light = Lighting(0.3, 0.7, 0.0, direction=tuple(towards))
    plain, dark = (cast_rays(device, volume, 300.0, camera, lighting=light, shadows=on) for on in (False, True))
    assert np.array_equal(plain.depth, dark.depth, equal_nan=True)
    origins, directions = camera.rays(SIZE)
    points = origins + plain.depth[..., None] * directions - centre_of(volume)
    floor = (np.abs(points[..., 2] + 5.0) < 0.05) & (np.abs(points[..., :2]) < 11.0).all(axis=-1)
    passing = np.linalg.norm(points - (points @ towards)[..., None] * towards, axis=-1)
    sure = floor & (np.abs(passing - 3.0) > 0.3)
    assert (sure & (passing < 3.0)).sum() > 50  # measured 149
    assert (sure & (passing > 3.0)).sum() > 500  # measured 1963
    truth = np.where(passing < 3.0, light.ambient, light.ambient + light.diffuse * towards[2]) * 255.0
    assert np.abs(dark.image[..., 0] - truth)[sure].max() <= tolerances.RAY_SAME_255 + 0.5


def test_nearer_surface_is_brighter_with_a_depth_cue(device):
    volume = make_volume(lambda p: 300.0 - 40.0 * (p @ (0.0, -1.0, 0.5)), "even", 18.0)
    camera = look(volume, (0.0, 1.0, -0.2), 6.0)
    plain, cued = (cast_rays(device, volume, 300.0, camera, depth_cue=cue) for cue in (0.0, 0.6))
    assert (plain.image == 255).all()
    centres = np.array([(i, j, k) for i in (-0.5, 19.5) for j in (-0.5, 19.5) for k in (-0.5, 19.5)])
    ends = (volume.ijk_to_lps(centres) - camera.position) @ camera.basis().forward
    share = 1.0 - 0.6 * (cued.depth - ends.min()) / np.ptp(ends)
    assert np.ptp(share) > 0.1  # measured 0.1007
    assert np.abs(cued.image[..., 0] - 255.0 * share).max() <= tolerances.RAY_SAME_255


@pytest.mark.first_device
def test_the_length_of_the_direction_of_a_light_changes_nothing(device):
    volume = make_volume(blobs, "even", 18.0, np.int16)
    camera, towards = look(volume, (0.4, 1.0, -0.3), 12.0), np.array((0.5, -0.8, 0.6))
    pictures = [
        cast_rays(
            device,
            volume,
            100.0,
            camera,
            shadows=True,
            lighting=Lighting(0.2, 0.7, 0.3, 20.0, direction=length * towards),
        )
        for length in (1.0, 0.25, 8.0)
    ]
    lit = cast_rays(device, volume, 100.0, camera, lighting=FIXED).image
    assert (pictures[0].image != lit).any()  # there are shadows
    for other in pictures[1:]:
        np.testing.assert_array_equal(other.image, pictures[0].image)


@pytest.mark.oclgrind
@pytest.mark.parametrize("grid", daily(1, ["sheared", "uneven"]))
def test_small_clipped_surface_in_shadow_is_seen(device, grid):
    volume = make_volume(blobs, grid, 6.0, np.int16)
    camera = look(volume, (0.4, 1.0, -0.3), 4.0, perspective=True)
    clip = Clip.plane(centre_of(volume), (0.3, 1.0, 0.2))
    width, height = 10, 9
    found = cast_rays(device, volume, 100.0, camera, (width, height), lighting=FIXED, shadows=True, clip=clip)
    assert 20 < np.isfinite(found.depth).sum() <= width * height  # measured 55 and 63


def test_rays_to_a_surface_of_no_voxels_have_no_colour_and_no_depth(device):
    volume = make_volume(lambda p: np.zeros(len(p)), "even", 8.0, np.int16)
    found = cast_rays(device, volume, 300.0, look(volume, (0, 1, 0), 6.0), (8, 8))
    assert not found.image.any()
    assert np.isnan(found.depth).all() and np.isnan(found.expected_depth).all()


def test_rays_to_a_surface_of_no_voxels_show_the_background(device):
    volume = make_volume(lambda p: np.zeros(len(p)), "even", 8.0, np.int16)
    found = cast_rays(device, volume, 300.0, look(volume, (0, 1, 0), 6.0), (8, 8), background="red")
    assert (found.image == (255, 0, 0, 255)).all()


@pytest.mark.parametrize(
    ("iso_value", "options", "words"),
    [
        (100.0, {"shadows": True}, "shadows need a light that stands still"),
        (100.0, {"depth_cue": 1.5}, "depth cue"),
        (np.nan, {}, "finite number of HU"),
    ],
    ids=["shadows of a headlight", "depth cue above 1", "iso value of nan"],
)
def test_wrong_arguments_of_rays_to_a_surface_are_refused(device, iso_value, options, words):
    volume = make_volume(blobs, "even", 8.0, np.int16)
    with pytest.raises(UsageError, match=words):
        cast_rays(device, volume, iso_value, Camera.fit(volume), **options)


def test_shadows_of_a_volume_beyond_the_memory_are_refused(device):
    volume = make_volume(blobs, "even", 22.0, np.int16)
    memory = half_of(volume, (8, 8))
    with refused(DeviceError, "shadows", "volume", "memory"):
        cast_rays(device, volume, 100.0, Camera.fit(volume), (8, 8), lighting=FIXED, shadows=True, memory=memory)
