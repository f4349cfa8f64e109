"""Which error is raised where a device finds no surface: that there is none, or that the device is wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from clrecon.errors import DeviceError, NoSurfaceError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.operators.surface.extraction import _refuse_level


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("marked", [0, 1, 2, 26, 27])
def test_a_range_has_a_surface_where_voxels_lie_within_and_without(device: Any, marked: int, closed: bool) -> None:
    """Without a border a volume whose voxels all lie within has none."""
    voxels = np.zeros(27, np.int16)
    voxels[:marked] = 100
    volume = Volume(voxels.reshape(3, 3, 3), np.eye(4))
    error = _refuse_level(device, volume, choose_iso_rule(volume, (50, 150), closed=closed))
    has_surface = 0 < marked < 27 or (marked == 27 and closed)
    assert isinstance(error, DeviceError if has_surface else NoSurfaceError)
    words = "it computes wrongly" if has_surface else f"{'every' if marked else 'no'} voxel lies within"
    assert words in str(error)
