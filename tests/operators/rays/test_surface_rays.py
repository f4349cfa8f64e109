"""Rays to the closed iso surface on a device: against the twin, slabs, light; analysis is test_raycast_surface.py's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tolerances
from raycast_scenes import blobs, centre_of, look, make_volume, premultiplied
from refusals import refused
from variants import daily

from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.operators.rays.picture_buffers import Shot
from clrecon.operators.rays.surface_pictures import cast_surface
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.rays.surface import cast_surface as cast_twin
from clrecon.rendering import Lighting, Rendering
from clrecon.rendering.pictures.styles import SurfaceLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

SIZE = (56, 48)
LEVEL_HU = 100.0  # of `blobs`
UNLIT = Lighting(ambient=1.0, diffuse=0.0, specular=0.0)
MATT = Lighting(ambient=0.2, diffuse=0.8, specular=0.0)
TOWARDS_LIGHT = np.array((0.5, -0.8, 0.6))
FIXED = Lighting(ambient=0.2, diffuse=0.7, specular=0.3, specular_power=20.0, direction=tuple(TOWARDS_LIGHT))


def cast_rays(
    device, volume: Volume, camera: Camera, *, iso_value: float, size=SIZE, memory=None, **settings
) -> Rendering:
    step = settings.pop("ray_step", 0.5 * min(volume.spacing))
    background = settings.pop("background", None)
    style = SurfaceLook(iso_value, **{"lighting": UNLIT, "color": "white", **settings})
    resident = DeviceVolume(volume, device=device, memory=memory)
    return cast_surface(resident, style, Shot(camera, size, background), step)


def assert_alike(found: Rendering, expected: Rendering, share: float = tolerances.SURFACE_TWIN_SHARE) -> None:
    away = np.abs(premultiplied(found.image) - premultiplied(expected.image)).max(axis=-1)
    assert (away <= 2.0).mean() >= 1.0 - share
    both = np.isfinite(found.depth) & np.isfinite(expected.depth)
    assert both.mean() > 0.1  # enough pixels to judge: measured 0.21 on
    assert (np.isfinite(found.depth) != np.isfinite(expected.depth)).mean() <= share
    assert (np.abs(found.depth - expected.depth)[both] <= tolerances.SURFACE_TWIN_MM).mean() >= 1.0 - share


def half_of(volume: Volume, size: tuple[int, int]) -> int:
    """Bytes that hold a picture, 12 a pixel and 32 for its ray, and about half of a volume."""
    return (12 + 32) * size[0] * size[1] + volume.voxels.nbytes * 9 // 20


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
    volume = make_volume(blobs, grid, extent=14.0, dtype=dtype)
    perspective = settings.pop("perspective", False)
    settings["camera"] = look(volume, (0.4, 1.0, -0.3), half_height=9.0, perspective=perspective)
    if settings.pop("cut", False):
        centre = centre_of(volume)
        settings["clip"] = Clip.box(centre - 5.0, centre + (6.0, 5.0, 4.0)) & Clip.plane(centre, (0.5, 0.4, 1.0))
    return volume, settings


@pytest.mark.parametrize("name", SCENES)
def test_surface_of_every_scene_equals_its_twin(device, name):
    volume, settings = scene(name)
    camera = settings["camera"]
    look_of_scene = {name: value for name, value in settings.items() if name != "camera"}
    style = SurfaceLook(LEVEL_HU, color="white", **look_of_scene)
    expected = cast_twin(volume, style, camera, SIZE)
    truth = Rendering(expected.image(), expected.depth, expected.depth, None)
    assert_alike(cast_rays(device, volume, **settings, iso_value=LEVEL_HU), truth)


@pytest.mark.release
@pytest.mark.usefixtures("users_kernels")
@pytest.mark.parametrize("name", daily(1, ["soft", "clipped", "uneven"]))
def test_surface_found_by_one_sample_at_a_time_looks_as_by_eight(device, name, monkeypatch):
    volume, settings = scene(name)
    found = cast_rays(device, volume, **settings, iso_value=LEVEL_HU)
    monkeypatch.setitem(device.kernel_variants, "LANES", "1")
    assert_alike(found, cast_rays(device, volume, **settings, iso_value=LEVEL_HU))


@pytest.mark.parametrize("towards", [(0.1, 0.3, 1.0), (-0.1, 0.2, -1.0), (0.5, 1.0, 0.05)])
@pytest.mark.parametrize("grid", ["oblique", "uneven"])
def test_surface_in_slabs_has_the_picture_of_the_whole(device, grid, towards):
    volume = make_volume(blobs, grid, extent=22.0, dtype=np.int16)
    camera, size = look(volume, towards, half_height=13.0, perspective=True), (24, 16)
    how = {"iso_value": LEVEL_HU, "size": size, "lighting": MATT}
    whole = cast_rays(device, volume, camera, **how)
    parts = cast_rays(device, volume, camera, **how, memory=half_of(volume, size))
    assert whole.report["slabs"] == 1 and parts.report["slabs"] > 2
    assert np.abs(whole.image.astype(int) - parts.image).max() <= 1
    assert np.allclose(whole.depth, parts.depth, atol=1e-3, equal_nan=True)  # mm; measured 0


def test_a_ray_step_longer_than_slabs_allow_is_shortened_with_a_warning(device):
    volume = make_volume(blobs, "even", extent=22.0, dtype=np.int16)
    camera, size = look(volume, (0.1, 0.3, 1.0), half_height=13.0), (16, 12)
    memory, spacing = half_of(volume, size), min(volume.spacing)
    parts = cast_rays(device, volume, camera, iso_value=LEVEL_HU, size=size, ray_step=5.0, memory=memory)
    assert parts.report["ray_step_mm"] == pytest.approx(spacing)
    assert f"in slabs: the ray step is {spacing:g} mm in place of 5" in parts.report["warnings"][0]


def test_surface_of_a_single_slice_lies_where_its_values_fall_to_the_level_towards_the_outside(device):
    volume = Volume(np.full((1, 9, 9), 1000, np.int16), np.diag([1.0, 1.0, 2.0, 1.0]))
    found = cast_rays(device, volume, look(volume, (0.0, 0.01, -1.0), half_height=3.0), iso_value=500.0, size=(8, 8))
    # A step of 2 mm beyond the slice its 1000 HU have fallen to 499, the outside of a volume that has no air itself;
    # whole numbers from 500 on are inside, so the level lies half way to 499.
    above_the_slice = 2.0 * (1000.0 - 499.5) / (1000.0 - 499.0)
    camera_mm = 200.0  # from the middle of the slice
    assert np.abs(found.depth - (camera_mm - above_the_slice)).max() < 0.04  # the view leans by 0.01


def test_nearer_surface_is_brighter_with_a_depth_cue(device):
    volume = make_volume(lambda p: 300.0 - 40.0 * (p @ (0.0, -1.0, 0.5)), "even", extent=18.0)
    camera = look(volume, (0.0, 1.0, -0.2), half_height=6.0)
    plain, cued = (cast_rays(device, volume, camera, iso_value=300.0, depth_cue=cue) for cue in (0.0, 0.6))
    assert (plain.image == 255).all()
    corners = np.array(list(np.ndindex(2, 2, 2))) * volume.shape_ijk - 0.5  # of the box of voxels
    ends = (volume.ijk_to_lps(corners) - camera.position) @ camera.basis().forward
    share = 1.0 - 0.6 * (cued.depth - ends.min()) / np.ptp(ends)
    assert np.ptp(share) > 0.05  # measured 0.1007
    assert np.abs(cued.image[..., 0] - 255.0 * share).max() <= tolerances.RAY_SAME_255


@pytest.mark.first_device
def test_the_length_of_the_direction_of_a_light_changes_nothing(device):
    volume = make_volume(blobs, "even", extent=18.0, dtype=np.int16)
    camera = look(volume, (0.4, 1.0, -0.3), half_height=12.0)

    def take_image(length, shadows=True):
        lighting = replace(FIXED, direction=tuple(length * TOWARDS_LIGHT))
        return cast_rays(device, volume, camera, iso_value=LEVEL_HU, shadows=shadows, lighting=lighting).image

    image = take_image(1.0)
    assert (image != take_image(1.0, shadows=False)).any()
    for length in (0.25, 8.0):
        np.testing.assert_array_equal(take_image(length), image)


@pytest.mark.oclgrind
@pytest.mark.parametrize("grid", daily(1, ["sheared", "uneven"]))
def test_small_clipped_surface_in_shadow_is_seen(device, grid):
    volume = make_volume(blobs, grid, extent=6.0, dtype=np.int16)
    camera = look(volume, (0.4, 1.0, -0.3), half_height=4.0, perspective=True)
    clip = Clip.plane(centre_of(volume), (0.3, 1.0, 0.2))
    how = {"lighting": FIXED, "shadows": True, "clip": clip}
    found = cast_rays(device, volume, camera, iso_value=LEVEL_HU, size=(10, 9), **how)
    assert 20 < np.isfinite(found.depth).sum()  # of 90 pixels; measured 55 and 63


def test_rays_to_a_surface_of_no_voxels_show_the_background(device):
    volume = make_volume(lambda p: np.zeros(len(p)), "even", extent=8.0, dtype=np.int16)
    camera = look(volume, (0, 1, 0), half_height=6.0)
    found = cast_rays(device, volume, camera, iso_value=300.0, size=(8, 8), background="red")
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
    volume = make_volume(blobs, "even", extent=8.0, dtype=np.int16)
    with pytest.raises(UsageError, match=words):
        cast_rays(device, volume, Camera.fit(volume), iso_value=iso_value, **options)


def test_shadows_of_a_volume_beyond_the_memory_are_refused(device):
    volume = make_volume(blobs, "even", extent=22.0, dtype=np.int16)
    how = {"size": (8, 8), "lighting": FIXED, "shadows": True, "memory": half_of(volume, (8, 8))}
    with refused(DeviceError, "shadows", "volume", "memory"):
        cast_rays(device, volume, Camera.fit(volume), iso_value=LEVEL_HU, **how)
