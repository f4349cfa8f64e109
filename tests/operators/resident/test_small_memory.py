"""What does not fit the device goes through in slabs, labels and uneven slices too, with the same bytes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from device_work import WORK, mesh_arrays
from refusals import assert_one_line
from surface_volumes import OBLIQUE, smooth_volume
from variants import each_value

import clrecon
from clrecon.labels import LabelMap

SHAPE = (26, 30, 41)


def uneven_volume() -> clrecon.Volume:
    """The same voxels in slices that are not evenly apart, and not sheared alike."""
    steps = np.where(np.arange(SHAPE[0]) % 5 == 2, 1.7, 1.0).cumsum()
    positions = OBLIQUE[:3, 3] + steps[:, None] * OBLIQUE[:3, 2] + np.sin(steps)[:, None] * OBLIQUE[:3, 1]
    affine = OBLIQUE.copy()
    affine[:3, 2], affine[:3, 3] = (positions[-1] - positions[0]) / (SHAPE[0] - 1), positions[0]
    return clrecon.Volume(smooth_volume(SHAPE).voxels, affine, slice_positions=positions)


@pytest.fixture(scope="module")
def volumes():
    """The same smooth voxels in even and in uneven slices."""
    return {"even": smooth_volume(SHAPE), "uneven": uneven_volume()}


@pytest.fixture(scope="module")
def labels():
    """Two labels that do not share a slice."""
    numbers = np.zeros(SHAPE, np.uint8)
    numbers[3:6, 4:24, 5:30], numbers[20:23, 4:24, 5:30] = 1, 2
    return LabelMap(numbers, OBLIQUE)


SURFACES: dict[str, Callable] = {
    "surface": lambda volume, labels, **limits: [clrecon.extract_isosurface(volume, 100, **limits)],
    "trilinear": lambda volume, labels, **limits: [
        clrecon.extract_isosurface(volume, 100, topology="trilinear", **limits)
    ],
    "range": lambda volume, labels, **limits: [clrecon.extract_isosurface(volume, (50, 200), **limits)],
    "labels": lambda volume, labels, **limits: list(clrecon.extract_labels(volume, labels, 100, **limits).values()),
    "masks": lambda volume, labels, **limits: list(clrecon.extract_label_masks(labels, **limits).values()),
}


@pytest.mark.fault_row(53)
@pytest.mark.parametrize(("work", "spacing"), each_value(SURFACES, ["uneven", "even"]))
def test_surfaces_in_less_memory_have_the_same_bytes_in_slabs_until_memory_is_refused(
    device, volumes, labels, work, spacing
):
    """The limit falls until not even one slice or label fits; before that there are slabs."""
    volume, make_surfaces = volumes[spacing], SURFACES[work]
    if work == "masks" and spacing == "uneven":
        pytest.skip("label maps have a grid of their own")
    expected = make_surfaces(volume, labels, device=device)
    assert all(mesh.report["slabs"] == 1 for mesh in expected)
    memory = max(sum(mesh.report["device_bytes"].values()) for mesh in expected)

    slabs = set()
    for share in (0.95, 0.8, 0.55, 0.4):
        try:
            found = make_surfaces(volume, labels, device=device, memory=int(share * memory))
        except clrecon.DeviceError as error:
            assert_one_line(error, "memory")
            break
        is_parted = any("one label at a time" in text for text in found[0].report["warnings"])
        slabs.add(found[0].report["slabs"] + is_parted)
        for one, other in zip(mesh_arrays(*found), mesh_arrays(*expected), strict=True):
            assert np.array_equal(one, other)
    assert max(slabs) > 1


@pytest.mark.fault_row(53)
@pytest.mark.parametrize("work", ["slice", "thick slice", "cpr"])
def test_slices_through_uneven_volumes_are_the_same_in_slabs(device, volumes, work):
    volume = volumes["uneven"]
    with clrecon.DeviceVolume(volume, device=device) as resident:
        expected = WORK[work](resident, None)
    with clrecon.DeviceVolume(volume, device=device, memory=volume.voxels.nbytes // 3) as resident:
        found = WORK[work](resident, None)
        assert resident.uploaded_bytes > volume.voxels.nbytes  # slabs share slices
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
