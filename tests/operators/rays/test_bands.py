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


def make_ball():
    axis = np.arange(24) - 11.5
    distance = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
    return clrecon.Volume(np.rint(100.0 * (8.0 - distance)).astype(np.int16), np.diag((1.0, 1.0, 1.5, 1.0)))


@pytest.mark.parametrize(
    ("kind", "own_memory", "rays"),
    [("gpu", False, SAMPLES_A_LAUNCH // 1000), ("gpu", True, 8 * SAMPLES_A_LAUNCH // 1000), ("cpu", False, None)],
)
def test_a_launch_on_a_gpu_has_as_many_rays_as_a_display_can_wait_for(kind, own_memory, rays):
    camera, nothing = Camera.fit(make_ball()), np.empty((0, 4), np.float32)
    view = RayView(camera, SIZE, 0.5, nothing, 0, np.zeros(3), 1000.0)
    assert view.rays_a_launch(SimpleNamespace(type=kind, has_own_memory=own_memory)) == rays


@pytest.mark.every_device
@pytest.mark.parametrize(
    "style", [VolumeLook("bone"), Projection("mip"), SurfaceLook(0.0)], ids=lambda style: style.mode
)
def test_bands_make_the_same_picture(device, monkeypatch, style):
    volume = make_ball()
    monkeypatch.setattr(device, "type", "gpu")

    def take():
        with counting_calls() as counts:
            made = clrecon.render(volume, style, size=SIZE, device=device, view=(30, 20))
        return [made.image, made.depth, made.values], counts["launches"]

    whole, once = take()
    monkeypatch.setattr(RayView, "rays_a_launch", lambda view, device: 140)
    bands, launches = take()
    assert once + 3 <= launches <= once + 31
    for one, other in zip(whole, bands, strict=True):
        assert (one is None and other is None) or np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def test_only_gpus_need_bands_and_cards_take_longer_ones(device, monkeypatch):
    monkeypatch.setattr(device, "type", "cpu")
    box = (np.full(3, -0.5), np.full(3, 23.5))
    camera = Camera.fit(make_ball())
    view = RayView.of(make_ball(), camera, SIZE, 0.5, box=box, focus=box)
    assert view.rays_a_launch(device) is None
    monkeypatch.setattr(device, "type", "gpu")
    rays = []
    for has_own_memory in (False, True):
        monkeypatch.setattr(device, "has_own_memory", has_own_memory)
        rays.append(view.rays_a_launch(device))
    assert 1 << 20 < rays[0] < 1 << 22 and abs(rays[1] - 8 * rays[0]) <= 8
