"""Volumes that do not fit go through slab by slab, in the order of the rays: the same picture."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from raycast_scenes import (
    DeviceCaster,
    blobs,
    even_volume,
    look,
    premultiplied,
    uneven_volume,
)
from soft_function import SOFT

from clrecon.reference.rays.render import MODES
from clrecon.rendering import Lighting


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("towards", [(0.1, 0.3, 1.0), (-0.1, 0.2, -1.0), (0.5, 1.0, 0.05)])
@pytest.mark.parametrize("even", [True, False])
def test_slabs_give_the_picture_of_the_whole(device, mode, towards, even):
    volume = even_volume(blobs, "oblique", 30.0, np.int16) if even else uneven_volume(blobs)
    settings = {"mode": mode, "camera": look(volume, towards, 16.0, perspective=True), "size": (32, 24)}
    if mode == "dvr":
        settings |= {"transfer_function": SOFT, "lighting": Lighting()}
    whole, parts = (
        DeviceCaster(device)(volume, **settings, memory=memory) for memory in (None, 3 * volume.voxels.nbytes // 5)
    )
    assert np.abs(premultiplied(whole.image) - premultiplied(parts.image)).max() <= tolerances.RAY_SAME_255
    for name in ("depth", "expected_depth", "values"):
        assert np.allclose(getattr(whole, name), getattr(parts, name), atol=1e-3, rtol=1e-5, equal_nan=True)
