"""What cannot be rendered is refused in one line that says what, the numbers and what to do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from raycast_scenes import blobs, even_volume
from refusals import assert_one_line, refused

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.rendering import TransferFunction
from clrecon.rendering.views.camera import Camera

AHEAD = Camera((0.0, -100.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=20.0)
FOG = TransferFunction([(-100, 1, 1, 1, 0.1), (100, 1, 1, 1, 0.1)])

REFUSED: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no width": ({"size": (0, 10)}, ["size", "0"]),
    "negative": ({"size": (10, -4)}, ["size", "-4"]),
    "absurd size": ({"size": (2_000_000, 2_000_000)}, ["size", "2000000"]),
    "one number": ({"size": 512}, ["size", "512"]),
    "fractions": ({"size": (10.5, 4)}, ["size", "10.5"]),
    "step 0": ({"ray_step": 0.0}, ["ray step", "0"]),
    "step below 0": ({"ray_step": -1.0}, ["ray step", "-1"]),
    "step nan": ({"ray_step": float("nan")}, ["ray step", "nan"]),
    "step inf": ({"ray_step": float("inf")}, ["ray step", "inf"]),
    "step too fine": ({"ray_step": 1e-4}, ["ray step", "0.0001"]),
    "step of text": ({"ray_step": "fine"}, ["ray step", "fine"]),
    "iso value": ({"mode": "surface", "iso_value": float("nan")}, ["iso value", "nan"]),
    "light on a mean": ({"mode": "mean", "shadows": True}, ["shadows", "mean"]),
    "shadows of a light at the camera": ({"mode": "surface", "shadows": True}, ["shadows", "light"]),
    "no such option": ({"zooom": 2}, ["zooom"]),
    "mode": ({"mode": "xray"}, ["xray", "dvr", "mip", "minip", "mean"]),
    "preset": ({"preset": "bones"}, ["bones", "bone"]),
    "view": ({"view": "front"}, ["front", "anterior", "inferior"]),
    "view of nothing": ({"view": ""}, ["anterior"]),
    "zoom": ({"zoom": 0.0}, ["zoom"]),
    "background": ({"background": "no such colour"}, ["no such colour"]),
    "two functions": ({"preset": "bone", "transfer_function": FOG}, ["preset", "transfer function"]),
    "camera of text": ({"camera": "anterior"}, ["camera"]),
    "camera and view": ({"camera": AHEAD, "view": "anterior"}, ["leave out view, or the camera"]),
    "camera and zoom": ({"camera": AHEAD, "zoom": 2.0, "mode": "mip"}, ["leave out zoom, or the camera"]),
    "camera and more": (
        {"camera": AHEAD, "view": (30, 15), "up": "left", "view_angle": 20.0},
        ["leave out view, up and view_angle, or the camera"],
    ),
    "camera and up of a slice": ({"camera": AHEAD, "up": (0, 0, 1), "mode": "slice"}, ["leave out up, or"]),
    "zoom of a curve": ({"mode": "cpr", "zoom": 2.0}, ["zoom does not apply to mode cpr"]),
    "lighting": ({"lighting": 3}, ["lighting"]),
    "clip": ({"clip": [(0, 0, 1)]}, ["clip"]),
    "function of numbers": ({"transfer_function": [(0, 1, 1, 1, 1)]}, ["transfer function"]),
    "window": ({"mode": "mip", "window": (100, 100)}, ["window", "100"]),
}


@pytest.mark.parametrize("name", REFUSED)
def test_impossible_pictures_are_refused_in_one_line(device, name):
    from clrecon.operators.rays.render import render

    settings, words = REFUSED[name]
    volume = even_volume(blobs, "even", extent=8.0, dtype=np.int16)
    with pytest.raises(UsageError) as error:
        render(volume, device=device, **{"size": (8, 8), **settings})
    message = str(error.value)
    assert "\n" not in message and len(message) < 400  # the longest, with all options, has 372
    assert [word for word in words if word.lower() not in message.lower()] == []


@pytest.mark.parametrize("what", [None, np.zeros((4, 4, 4)), "folder"])
def test_picture_of_what_is_no_volume_is_refused(device, what):
    from clrecon.operators.rays.render import render

    with refused(UsageError, "Volume"):
        render(what, size=(8, 8), device=device)


def test_a_volume_with_a_voxel_of_nan_is_refused_in_one_line(device):
    """NaN must not end in a driver, nor spread over pixels whose rays do not meet it."""
    from clrecon.operators.rays.render import render

    volume = even_volume(lambda p: np.zeros(len(p)), "even", extent=12.0)
    voxels = volume.voxels.copy()
    voxels[3, 5, 7] = np.nan
    with refused(UsageError, "NaN", "voxels") as caught:
        render(Volume(voxels, volume.affine), transfer_function=FOG, size=(16, 16), device=device)
    assert_one_line(caught.value)
