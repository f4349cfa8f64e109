"""On GPUs pictures are taken in several launches: systems stop a kernel that blocks a display for seconds."""

from __future__ import annotations

import numpy as np
import pytest
from counted_calls import counting_calls

import clrecon
from clrecon.operators.rays import picture_buffers
from clrecon.rendering.pictures.styles import Projection, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera

SIZE = (65, 50)


def make_ball():
    axis = np.arange(24) - 11.5
    distance = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
    return clrecon.Volume(np.rint(100.0 * (8.0 - distance)).astype(np.int16), np.diag((1.0, 1.0, 1.5, 1.0)))


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
    longest = np.linalg.norm((24.0, 24.0, 36.0)) / 0.5
    monkeypatch.setattr(picture_buffers, "SAMPLES_A_LAUNCH", int(140 * longest))
    bands, launches = take()
    assert once + 3 <= launches <= once + 31
    for one, other in zip(whole, bands, strict=True):
        assert (one is None and other is None) or np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def test_only_gpus_need_bands_and_cards_take_longer_ones(device, monkeypatch):
    monkeypatch.setattr(device, "type", "cpu")
    box = (np.full(3, -0.5), np.full(3, 23.5))
    camera = Camera.fit(make_ball())
    view = picture_buffers.RayView.of(make_ball(), camera, SIZE, 0.5, box=box, focus=box)
    assert view.rays_a_launch(device) is None
    monkeypatch.setattr(device, "type", "gpu")
    rays = []
    for has_own_memory in (False, True):
        monkeypatch.setattr(device, "has_own_memory", has_own_memory)
        rays.append(view.rays_a_launch(device))
    assert 1 << 20 < rays[0] < 1 << 22 and abs(rays[1] - 8 * rays[0]) <= 8
