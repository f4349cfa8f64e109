"""On GPUs pictures are taken in several launches: systems stop a kernel that blocks a display for seconds."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from counted_calls import counting_calls

import clrecon
from clrecon.operators.rays.picture_buffers import SAMPLES_A_LAUNCH, RayView
from clrecon.rendering.pictures.styles import Projection, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera

SIZE = (65, 50)


def ball_volume():
    """A ball of 8 voxels, 0 HU at its surface and 100 more a voxel inward."""
    axis = np.arange(24) - 11.5
    distance = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
    return clrecon.Volume(np.rint(100.0 * (8.0 - distance)).astype(np.int16), np.diag((1.0, 1.0, 1.5, 1.0)))


SAMPLES_A_RAY = 1000


@pytest.mark.parametrize(
    ("kind", "own_memory", "rays"),
    [
        ("gpu", False, SAMPLES_A_LAUNCH // SAMPLES_A_RAY),
        ("gpu", True, 8 * SAMPLES_A_LAUNCH // SAMPLES_A_RAY),
        ("cpu", False, None),
    ],
    ids=["built-in GPU", "graphics card", "CPU"],
)
def test_a_launch_on_a_gpu_has_as_many_rays_as_a_display_can_wait_for_and_eight_times_as_many_on_a_card(
    kind, own_memory, rays
):
    camera, nothing = Camera.fit(ball_volume()), np.empty((0, 4), np.float32)
    view = RayView(
        camera, SIZE, ray_step=0.5, table=nothing, planes=0, spread=np.zeros(3), longest=float(SAMPLES_A_RAY)
    )
    assert view.rays_a_launch(SimpleNamespace(type=kind, has_own_memory=own_memory)) == rays


@pytest.mark.every_device
@pytest.mark.parametrize(
    "style", [VolumeLook("bone"), Projection("mip"), SurfaceLook(0.0)], ids=lambda style: style.mode
)
def test_picture_taken_in_bands_on_a_gpu_is_the_same_in_more_launches(device, monkeypatch, style):
    volume = ball_volume()
    monkeypatch.setattr(device, "type", "gpu")

    def take_picture():
        with counting_calls() as counts:
            picture = clrecon.render(volume, style, size=SIZE, device=device, view=(30, 20))
        return [picture.image, picture.depth, picture.values], counts["launches"]

    whole, launches_of_whole = take_picture()
    monkeypatch.setattr(RayView, "rays_a_launch", lambda view, device: 140)
    bands, launches = take_picture()

    assert launches > launches_of_whole  # measured three more
    for one, other in zip(whole, bands, strict=True):
        assert (one is None and other is None) or np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def rays_of_ball(device, monkeypatch, kind, *, has_own_memory=False):
    """The most rays of a launch for a picture of the ball on a device of this kind."""
    monkeypatch.setattr(device, "type", kind)
    monkeypatch.setattr(device, "has_own_memory", has_own_memory)
    box = (np.full(3, -0.5), np.full(3, 23.5))
    volume = ball_volume()
    return RayView.of(volume, Camera.fit(volume), SIZE, ray_step=0.5, box=box, focus=box).rays_a_launch(device)


def test_pictures_of_a_cpu_are_taken_in_one_launch(device, monkeypatch):
    assert rays_of_ball(device, monkeypatch, "cpu") is None


def test_pictures_of_a_ball_are_taken_by_some_two_million_rays_a_launch_on_a_gpu_and_eight_times_on_a_card(
    device, monkeypatch
):
    built_in, card = (rays_of_ball(device, monkeypatch, "gpu", has_own_memory=own) for own in (False, True))
    assert 2**20 < built_in < 2**22  # two million to a factor of two: measured 2,685,575
    assert card == pytest.approx(8 * built_in, abs=8)  # rounded down before
