"""Ambient occlusion: hollows are darker, the open is not, and what is cut away or hidden hides nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import clrecon
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.opencl import Device
from clrecon.operators.rays.openness import OpenCells
from clrecon.rendering import UNSHADED
from clrecon.rendering.pictures.styles import Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.clip import Clip

SIDE = 48
PIT = slice(22, 26)
"""Columns (j, i) of a pit in a block, which is looked into from above."""
FLOOR_K, TOP_K = 12, 36
OPACITY = [(0, 1, 1, 1, 0.0), (100, 1, 1, 1, 1.0)]


def block_with_pit() -> Volume:
    """A block of 500 HU in air with a pit of 4 x 4 x 24 mm, open above."""
    voxels = np.full((SIDE, SIDE, SIDE), -1000, np.int16)
    voxels[4:TOP_K, 4:-4, 4:-4] = 500
    voxels[FLOOR_K:TOP_K, PIT, PIT] = -1000
    return Volume(voxels, np.eye(4))


def looks(**options: Any) -> list[Style]:
    """A surface and volume rendering of the same block, without light: what is darker is hidden."""
    surface = SurfaceLook(100.0, color="white", lighting=UNSHADED, **options)
    return [surface, VolumeLook(clrecon.TransferFunction(OPACITY), lighting=UNSHADED, **options)]


def look_into(volume: Volume, style: Style, device: Device, **how: Any) -> np.ndarray:
    """Return the greys of a picture from above; its rows are j from the back, its columns i."""
    picture = clrecon.render(volume, style, view="superior", size=volume.shape_ijk[:2], device=device, **how)
    return picture.image[..., 0].astype(float)


@pytest.mark.oclgrind
@pytest.mark.parametrize("kind", [0, 1], ids=["surface", "dvr"])
def test_floor_of_a_pit_is_darker_and_the_top_of_the_block_is_not(kind: int, device: Device) -> None:
    """A pit of 2 x 2 x 12 mm in a block of 24 mm: Oclgrind takes a minute for twice its side."""
    voxels = np.full((24, 24, 24), -1000, np.int16)
    voxels[2:18, 2:-2, 2:-2] = 500
    voxels[6:18, 11:13, 11:13] = -1000
    volume = Volume(voxels, np.eye(4))

    plain = look_into(volume, looks()[kind], device)
    darkened = look_into(volume, looks(ambient_occlusion=1.0)[kind], device)

    floor, top = (12, 12), (12, 5)
    assert plain[floor] == plain[top] == darkened[top] == 255
    assert 50 < darkened[floor] < 180  # walls 1 mm away hide exp(-1 / 2.1) of what comes from their sides


@pytest.mark.parametrize("kind", [0, 1], ids=["surface", "dvr"])
def test_half_of_ambient_occlusion_takes_half_of_what_the_whole_takes(kind: int, device: Device) -> None:
    volume = block_with_pit()

    whole, half = (look_into(volume, looks(ambient_occlusion=share)[kind], device)[24, 24] for share in (1.0, 0.5))

    assert 255 - half == pytest.approx(0.5 * (255 - whole), abs=1.0)  # a grey value is rounded


@pytest.mark.parametrize("kind", [0, 1], ids=["surface", "dvr"])
def test_block_cut_down_to_the_floor_of_its_pit_is_in_the_open(kind: int, device: Device) -> None:
    cut = Clip.plane((0, 0, FLOOR_K - 1.0), (0, 0, -1))

    flat = look_into(block_with_pit(), looks(ambient_occlusion=1.0, clip=cut)[kind], device)

    assert flat[24, 24] > 245  # of 255: samples lie up to half a step below the cut


@pytest.mark.parametrize("kind", [0, 1], ids=["surface", "dvr"])
def test_hidden_label_hides_no_light(kind: int, device: Device) -> None:
    volume = block_with_pit()
    walls = np.zeros(volume.voxels.shape, np.uint8)
    walls[FLOOR_K:TOP_K] = volume.voxels[FLOOR_K:TOP_K] > 0
    labels = LabelMap(walls, np.eye(4))
    hidden = {"labels": labels, "label_colors": {}, "label_opacity": {1: 0.0}}

    flat = look_into(volume, looks(ambient_occlusion=1.0, **hidden)[kind], device)

    assert flat[24, 24] > 240  # of 255: labels end between voxels


@pytest.mark.parametrize("kind", [0, 1], ids=["surface", "dvr"])
def test_volume_in_slabs_is_as_dark_as_a_whole_one(kind: int, device: Device) -> None:
    volume = block_with_pit()
    style = looks(ambient_occlusion=1.0)[kind]
    whole = look_into(volume, style, device)
    cells = OpenCells.of(volume).device_bytes(volume.voxels.itemsize)
    memory = cells + 32 * SIDE**2 + volume.voxels.nbytes // 2  # cells, states of rays, half of the volume

    in_slabs = clrecon.render(volume, style, view="superior", size=(SIDE, SIDE), device=device, memory=memory)

    assert in_slabs.report["slabs"] > 1
    assert np.abs(in_slabs.image[..., 0] - whole).max() <= 1  # grey values, rounded
