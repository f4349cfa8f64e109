"""Which error is raised where a device finds no surface: that there is none, or that the device is wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from clrecon.errors import DeviceError, NoSurfaceError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.operators.surface.extraction import _refuse_level


def refusal_of_range(device: Any, marked: int, closed: bool, kind: type[Exception]) -> Exception:
    """The error of this kind where so many of 27 voxels lie in the range 50 to 150 HU."""
    voxels = np.zeros(27, np.int16)
    voxels[:marked] = 100
    volume = Volume(voxels.reshape(3, 3, 3), np.eye(4))
    error = _refuse_level(device, volume, choose_iso_rule(volume, (50, 150), closed=closed))
    assert isinstance(error, kind)
    return error


@pytest.mark.parametrize(
    ("marked", "closed"), [(1, True), (1, False), (2, True), (2, False), (26, True), (26, False), (27, True)]
)
def test_a_range_without_a_surface_although_voxels_lie_within_is_a_fault_of_the_device(
    device: Any, marked: int, closed: bool
) -> None:
    """Of 27 voxels so many lie within; an open volume of which all do has no surface."""

    assert "it computes wrongly" in str(refusal_of_range(device, marked, closed, DeviceError))


@pytest.mark.parametrize(
    ("marked", "closed", "words"),
    [(0, True, "no voxel lies within"), (0, False, "no voxel lies within"), (27, False, "every voxel lies within")],
    ids=["none, closed", "none, open", "all, open"],
)
def test_a_range_without_voxels_within_or_an_open_one_without_others_has_no_surface(
    device: Any, marked: int, closed: bool, words: str
) -> None:
    assert words in str(refusal_of_range(device, marked, closed, NoSurfaceError))
