"""Volumes that do not fit go through slab by slab, in the order of the rays: the same picture."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tolerances
from raycast_scenes import DeviceCaster, blobs, even_volume, look, premultiplied, uneven_volume
from soft_function import SOFT

from clrecon.operators.rays.ray_slabs import BRICK_CELLS, MOST_VOXELS, plan_ray_slabs
from clrecon.rendering import Lighting
from clrecon.rendering.pictures.styles import PROJECTIONS


@pytest.mark.parametrize("mode", ["dvr", *PROJECTIONS])
@pytest.mark.parametrize("towards", [(0.1, 0.3, 1.0), (-0.1, 0.2, -1.0), (0.5, 1.0, 0.05)])
@pytest.mark.parametrize("even", [True, False])
def test_slabs_give_the_picture_depths_and_values_of_the_whole(device, mode, towards, even):
    volume = even_volume(blobs, "oblique", extent=30.0, dtype=np.int16) if even else uneven_volume(blobs)
    settings = {"mode": mode, "camera": look(volume, towards, half_height=16.0, perspective=True), "size": (32, 24)}
    if mode == "dvr":
        settings |= {"transfer_function": SOFT, "lighting": Lighting()}
    share = 2.0 if mode == "dvr" else 0.6  # of the voxels' bytes; smoothed light takes three times as many as a whole
    cast = DeviceCaster(device)
    whole = cast(volume, **settings)
    parts = cast(volume, **settings, memory=int(share * volume.voxels.nbytes))
    assert cast.slabs >= 3
    assert np.abs(premultiplied(whole.image) - premultiplied(parts.image)).max() <= tolerances.RAY_SAME_255
    for name in ("depth", "expected_depth", "values"):
        # Float32 of values and mm; measured 0.
        assert np.allclose(getattr(whole, name), getattr(parts, name), atol=1e-3, rtol=1e-5, equal_nan=True)


@pytest.mark.parametrize("lanes", ["1", "8"])
@pytest.mark.parametrize(("most_slices", "most"), [(19, 19 - 5), (20, 20), (21, 21)])
def test_a_slab_of_rays_needs_its_slices_with_two_before_and_three_behind_up_to_the_most_voxels(
    lanes, most_slices, most
):
    """By hand: 20 large slices with voxels of two bytes; kernels with several lanes have a bound on their voxels."""
    ni, nj, nk = 10_000, MOST_VOXELS // (10_000 * most_slices), 20
    asked: dict[str, Any] = {}
    resident = SimpleNamespace(
        volume=SimpleNamespace(shape_ijk=(ni, nj, nk), spacing=(1.0, 1.0, 1.0)),
        dtype=np.dtype(np.int16),
        device=SimpleNamespace(kernel_variants={"LANES": lanes}),
        plan=lambda purpose, slices, needs, **more: asked.update(more, slices=slices, needs=needs) or 3,
    )
    labels = SimpleNamespace(voxels=np.zeros(1, np.uint16))
    assert plan_ray_slabs(resident, {"picture": 11}, {"rays": 13}, labels) == 3
    assert asked["slices"] == nk and asked["most"] == (None if lanes == "1" else most)
    bricks = -(-ni // BRICK_CELLS) * -(-nj // BRICK_CELLS)
    for slices, held, rest in ((3, 8, {"rays": 13}), (19, 24, {"rays": 13}), (20, 20, {})):
        assert asked["needs"](slices) == {
            "volume": 2 * ni * nj * held,
            "labels": 4 * ni * nj * held,
            "bricks": 8 * bricks * -(-held // BRICK_CELLS),
            "picture": 11,
            **rest,
        }
