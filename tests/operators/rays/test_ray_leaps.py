"""Leaps over empty space hide nothing: pictures with them are those of rays that take every sample."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import refused
from variants import daily

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.opencl import upload
from clrecon.operators.rays import ray_pictures as composite
from clrecon.operators.rays import ray_slabs
from clrecon.operators.rays.render import VolumeRenderer, render
from clrecon.operators.resident.tables import volume_box
from clrecon.rendering import UNSHADED, Rendering, TransferFunction
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

BRIGHT = TransferFunction([(400.0, 1.0, 1.0, 1.0, 0.0), (500.0, 1.0, 0.5, 0.2, 1.0)])


def take_picture(volume: Volume, device, camera: Camera, **settings) -> Rendering:
    """Volume rendering by `BRIGHT` without light, over no background."""
    return render(
        volume, transfer_function=BRIGHT, camera=camera, device=device, lighting=UNSHADED, background="transparent",
        **settings,
    )  # fmt: skip


def take_every_sample(monkeypatch, *arguments, **settings) -> Rendering:
    """The same with all bricks shown from the first sample on."""

    def show_all(resident, slab, *_):
        bi, bj, bk = slab.bricks
        return ray_slabs.LeapMap(upload(resident.device, np.zeros((bk, bj, bi), np.uint8)), volume_box(resident.volume))

    def enter_at_once(resident, slab, view, leaps, output):
        return upload(resident.device, np.full(output.tiles, -np.inf, np.float32))

    with monkeypatch.context() as patch:
        patch.setattr(ray_slabs, "find_leaps", show_all)
        patch.setattr(composite, "enter_tiles", enter_at_once)
        return take_picture(*arguments, **settings)


def assert_same(one: Rendering, other: Rendering) -> None:
    """Two pictures that show something have the same colours but for rounding, and the same depths."""
    assert (other.image[..., 3] > 0).any()
    difference = np.abs(one.image.astype(int) - other.image.astype(int))
    assert difference.max() <= tolerances.RAY_SAME_255
    assert np.allclose(one.depth, other.depth, atol=1e-3, equal_nan=True)  # mm; measured 0


@pytest.mark.parametrize("seed", range(12))
def test_leaps_hide_no_thin_slice_of_wide_voxels_at_a_wide_angle(device, monkeypatch, seed):
    """Rays of a tile that are as far along are at other heights: some voxels where these are thin."""
    rng = np.random.default_rng(seed)
    voxels = np.zeros((300, 12, 12), np.int16)
    voxels[rng.integers(0, 300, 3)] = 1000
    thin = 10.0 ** rng.uniform(-1.3, -0.5)
    volume = Volume(voxels, np.diag([20.0, 20.0, thin, 1.0]))
    (middle,) = volume.ijk_to_lps([[5.5, 5.5, 150.0]])
    position = middle - (*rng.normal(0.0, 20.0, 2), 300 * thin * rng.uniform(0.6, 2))
    angle = float(rng.choice([100.0, 130.0, 150.0, 165.0]))
    camera = Camera(tuple(position), tuple(position + (0.0, 0.0, 1.0)), (0.0, 1.0, 0.0), view_angle=angle)
    settings = {"size": (16, 40), "ray_step": 2.0 * thin}
    assert_same(
        take_picture(volume, device, camera, **settings),
        take_every_sample(monkeypatch, volume, device, camera, **settings),
    )


def scattered(rng, *, uneven: bool) -> Volume:
    """Single bright voxels, rows and slices on a turned, anisotropic, sheared or uneven grid."""
    shape = rng.integers(3, 50, 3)
    voxels = np.zeros(shape, np.int16)
    for number in range(6):
        at: list = [int(rng.integers(0, n)) for n in shape]
        if number % 2:
            at[rng.integers(3)] = slice(None)
        voxels[tuple(at)] = 1000
    axes = rotation(rng.uniform(-180.0, 180.0, 3)) * rng.choice([-1.0, 1.0], 3)
    affine = np.eye(4)
    affine[:3, :3] = axes * 10.0 ** rng.uniform(-0.7, 0.7, 3)
    affine[:3, 2] += affine[:3, :2] @ rng.uniform(-1.0, 1.0, 2)
    affine[:3, 3] = rng.normal(0.0, 300.0, 3)
    if not uneven:
        return Volume(voxels, affine)
    heights = np.concatenate([[0.0], np.cumsum(10.0 ** rng.uniform(-1.0, 0.3, shape[0] - 1))])
    table = affine[:3, 3] + heights[:, None] * affine[:3, 2]
    affine[:3, 2] = (table[-1] - table[0]) / (shape[0] - 1)
    return Volume(voxels, affine, slice_positions=table)


@pytest.mark.parametrize("uneven", daily(1, [False, True]))
def test_leaps_hide_no_scattered_voxel_in_40_random_views(device, monkeypatch, uneven):
    """The last sample of a ray lies before its place in the row: with few samples a brick alone may hold it."""
    shown = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        volume = scattered(rng, uneven=uneven)
        ends = volume.ijk_to_lps([np.zeros(3), np.array(volume.shape_ijk) - 1.0])
        radius = 0.6 * float(np.linalg.norm(ends[1] - ends[0]))
        towards, middle = rng.normal(size=3), ends.mean(axis=0)
        position = tuple(middle - towards / np.linalg.norm(towards) * radius * rng.uniform(0.1, 3.0))
        lens = {"parallel_scale": radius} if seed % 3 else {"view_angle": float(rng.choice([20.0, 60.0, 150.0]))}
        camera = Camera(position, tuple(middle), tuple(rng.normal(size=3)), **lens)
        settings = {"size": (24, 17), "ray_step": radius * 10.0 ** rng.uniform(-2.3, 0.0)}
        whole = take_every_sample(monkeypatch, volume, device, camera, **settings)
        if (whole.image[..., 3] > 0).any():
            shown += 1
            assert_same(take_picture(volume, device, camera, **settings), whole)
    assert shown > 20  # measured 25


def larger(rng, affine) -> Volume:
    """Bright voxels, rows and slices, with room for rows of bricks between them."""
    voxels = np.zeros(rng.integers(20, 120, 3), np.int16)
    for number in range(8):
        at: list = [int(rng.integers(0, n)) for n in voxels.shape]
        if number % 2:
            at[rng.integers(3)] = slice(None)
        voxels[tuple(at)] = 1000
    return Volume(voxels, affine)


def scene(seed: int):
    """A volume, a camera near it or looking along one of its axes, and settings."""
    rng = np.random.default_rng(seed)
    volume = scattered(rng, uneven=False)
    if seed % 2:
        volume = larger(rng, volume.affine)
    ends = volume.ijk_to_lps([np.zeros(3), np.array(volume.shape_ijk) - 1.0])
    radius = 0.6 * float(np.linalg.norm(ends[1] - ends[0]))
    towards = rng.normal(size=3)
    if seed % 5 < 2:
        axis = volume.affine[:3, rng.integers(3)] * rng.choice([-1, 1])
        towards = 0.05 * (seed % 5) * towards + axis / np.linalg.norm(axis)
    middle = ends.mean(axis=0)
    position = tuple(middle - towards / np.linalg.norm(towards) * radius * rng.uniform(0.02, 3.0))
    lens = {"parallel_scale": radius} if seed % 3 == 0 else {"view_angle": float(rng.choice([20.0, 60.0, 150.0]))}
    camera = Camera(position, tuple(middle), tuple(rng.normal(size=3)), **lens)
    return volume, camera, {"size": (48, 35), "ray_step": radius * 10.0 ** rng.uniform(-2.3, -0.5)}


# Scenes that lost something once: what shows half a voxel before the first brick, rows beside one that end sooner.
LOST_ONCE = (4406, 7282, 8362, 9701, 13084)


@pytest.mark.release
@pytest.mark.seconds
def test_leaps_along_free_ways_hide_no_voxel_in_205_scenes(device, monkeypatch):
    shown = 0
    for seed in (*range(200), *LOST_ONCE):
        volume, camera, settings = scene(seed)
        whole = take_every_sample(monkeypatch, volume, device, camera, **settings)
        if (whole.image[..., 3] > 0).any():
            shown += 1
            assert_same(take_picture(volume, device, camera, **settings), whole)
    assert shown > 100  # of 205 scenes; measured 139


@pytest.mark.oclgrind
def test_opaque_voxels_are_opaque_in_a_last_segment_of_a_hundredth_of_a_step(device):
    """Rays enter at z = -0.5, and the last whole step ends at 9.5, where the HU reach 500: opaque from there on."""
    voxels = np.zeros((20, 6, 6), np.int16)
    voxels[10:] = 1000
    camera = Camera((2.5, 2.5, -20.0), (2.5, 2.5, 0.0), (0.0, -1.0, 0.0), parallel_scale=2.0)
    clip = Clip.plane((0.0, 0.0, 9.51), (0.0, 0.0, -1.0))  # what lies below stays
    picture = take_picture(Volume(voxels, np.eye(4)), device, camera, size=(4, 4), ray_step=1.0, clip=clip)
    assert (picture.image[..., 3] == 255).all()


@pytest.mark.parametrize("tilt", [2e-4, -2e-4])
def test_slabs_of_rays_almost_along_the_slices_give_the_picture_of_the_whole(device, monkeypatch, tilt):
    """Rays pass from slab to slab half way through: what they see first is in front all the same."""
    voxels = np.zeros((64, 40, 16), np.int16)
    voxels[:, :20] = 450
    voxels[:, 20:] = 1000
    volume = Volume(voxels, np.eye(4))
    camera = Camera((7.5, -50.0, 31.5 - 69.5 * tilt), (7.5, 19.5, 31.5), (0.0, 0.0, 1.0), parallel_scale=32.0)
    settings = {"size": (8, 64), "ray_step": 0.5}  # rows at whole k
    whole = take_picture(volume, device, camera, **settings)
    monkeypatch.setattr(ray_slabs, "plan_ray_slabs", lambda *_, **__: 8)
    parts = take_picture(volume, device, camera, **settings)
    assert parts.report["slabs"] == 8
    assert_same(parts, whole)


def test_labels_of_a_single_slice_colour_four_pictures_of_a_renderer_alike(device):
    """A single slice is doubled on its way to the device: CPU devices read the copy in place, and it must stay."""
    labels = LabelMap(np.ones((1, 1100, 1100), np.uint8), np.eye(4))
    volume = Volume(np.full((1, 1100, 1100), 1000, np.int16), np.eye(4))
    blue = (0.0, 0.0, 1.0)
    with VolumeRenderer(volume, device=device) as renderer:
        for _ in range(4):
            picture = renderer.render(
                transfer_function=BRIGHT, labels=labels, label_colors={1: blue}, view="superior",
                size=(96, 96), ray_step=2.0, lighting=UNSHADED,
            )  # fmt: skip
            middle = picture.image[10:-10, 10:-10].reshape(-1, 4)
            assert (middle == middle[0]).all()
            assert middle[0, 2] > 200  # measured 214


def test_more_samples_than_float32_counts_are_refused_with_the_least_step(device):
    """Rays of 4500 mm may have 2^15 samples of 0.137 mm."""
    volume = Volume(np.zeros((900, 4, 4), np.int16), np.diag([0.01, 0.01, 5.0, 1.0]))
    with refused(UsageError, "spacing", "volume", 0.137):
        render(volume, device=device, ray_step=1e-4, size=(4, 4))
