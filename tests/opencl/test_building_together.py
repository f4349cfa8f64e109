"""Kernel files that are built together, as one program: PoCL reads its own headers once for all of them."""

from __future__ import annotations

import pytest

from clrecon.opencl import building_together, load_program, read_kernel_source
from clrecon.opencl.device import Device
from clrecon.opencl.sources import find_signatures

VOXELS = {"VOXEL": "short", "VALUE": "int", "LANES": "8", "WORDS_PER_ITEM": "8", "SCAN_GROUP": "64"}
SURFACE = ("primitives/scan.cl", "surface/cells.cl", "masks/classify.cl", "surface/marching_cubes.cl")
MESH = (*SURFACE, "primitives/compact.cl", "primitives/union_find.cl", "surface/cortex.cl")
PICTURE = ("rays/leaps.cl", "rays/tiles.cl", "rays/composite.cl")


@pytest.fixture
def bare_device(device):
    """The device as a new process has it: nothing is built."""
    return Device(device.index, device.cl_device.platform, device.cl_device)


def test_files_loaded_in_a_block_are_one_program(bare_device):
    with building_together(bare_device):
        load_program(bare_device, "primitives/compact.cl")
        load_program(bare_device, "primitives/union_find.cl")
    assert load_program(bare_device, "primitives/compact.cl") is load_program(bare_device, "primitives/union_find.cl")


def test_file_that_a_variant_of_another_would_change_is_refused(bare_device):
    with (
        pytest.raises(AssertionError, match=r"masks/classify.cl would be built with VOXEL"),
        building_together(bare_device),
    ):
        load_program(bare_device, "masks/classify.cl", {"VOXEL": "short"})
        load_program(bare_device, "surface/marching_cubes.cl", {"VOXEL": "float"})
    assert not bare_device.programs


@pytest.mark.parametrize(
    ("names", "variants"),
    [
        pytest.param(MESH, {}, id="mesh"),
        pytest.param(MESH, {"RANGE": "1"}, id="mesh of a range"),
        pytest.param(MESH, {"GROWN": "1", "UNEVEN": "1"}, id="grown mesh of uneven slices"),
        pytest.param(SURFACE, {"BORDER_INSIDE": "1"}, id="mesh below a level"),
        pytest.param(PICTURE, {}, id="picture"),
        pytest.param(PICTURE, {"BETWEEN": "1", "GRADIENT_OPACITY": "1", "UNEVEN": "1"}, id="picture with all variants"),
    ],
)
def test_kernels_built_together_have_the_arguments_that_they_have_alone(names, variants):
    definitions = {**VOXELS, **variants}
    alone = {}
    for name in names:
        alone |= find_signatures(read_kernel_source(name), definitions)
    assert find_signatures(read_kernel_source(*names), definitions) == alone
