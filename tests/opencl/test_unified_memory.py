"""GPUs that are parts of a processor: volumes and results are used where they are, if the driver does so."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from counted_calls import counting_calls
from house import ROOT

import clrecon
from clrecon.opencl import buffers, download, empty_output, upload
from clrecon.opencl.device import Device
from clrecon.opencl.transfers import LEAST_BYTES
from clrecon.system.memory import aligned_empty


def make_cone():
    """A bone-like cone of 2 MiB of voxels in whole pages, as readers make them."""
    voxels = aligned_empty((64, 128, 128), np.int16)
    axis = np.arange(128) - 60.3
    voxels[:] = 600 - 12 * np.sqrt(axis[:, None] ** 2 + axis**2) - 2 * np.arange(64)[:, None, None]
    return clrecon.Volume(voxels, np.diag((0.7, 0.5, 1.5, 1.0)))


@pytest.fixture
def unified_gpu(device):
    """The device as a GPU that is a part of the processor, opened anew."""
    if device.is_simulator:
        pytest.skip("simulators take the driver's way, which checks more")
    gpu = Device(device.index, device.cl_device.platform, device.cl_device)
    gpu.type, gpu.has_own_memory, gpu.shares_host_memory, gpu.fault = "gpu", False, False, ""
    gpu.kernel_variants = device.kernel_variants
    return gpu


def surface_bytes(volume, device):
    mesh = clrecon.extract_isosurface(volume, 100.0, device=device)
    return b"".join(array.tobytes() for array in (mesh.vertices, mesh.normals, mesh.triangles))


@pytest.mark.seconds
@pytest.mark.every_device
def test_surface_on_a_gpu_of_the_processor_has_the_same_bytes_and_uploads_no_volume(unified_gpu, device):
    volume = make_cone()
    with counting_calls() as counts:
        mesh = surface_bytes(volume, unified_gpu)
    assert mesh == surface_bytes(volume, device)
    assert counts["uploads, bytes"] < volume.voxels.nbytes / 100  # tables alone: measured 9,568 bytes, a 219th


def test_volume_is_uploaded_where_the_driver_copies_the_arrays_of_the_host(unified_gpu, monkeypatch):
    volume = make_cone()
    ask_driver, host_bytes = buffers.ask_driver, []

    def ask_for_copy(device, flags, size, host):
        host_bytes.append(0 if host is None else host.nbytes)
        return ask_driver(device, flags, size, None if host is None else host.copy())

    expected = surface_bytes(volume, unified_gpu)
    unified_gpu.give_up()  # and tries anew what the driver does
    monkeypatch.setattr(buffers, "ask_driver", ask_for_copy)
    with counting_calls() as counts:
        mesh = surface_bytes(volume, unified_gpu)

    assert mesh == expected
    assert counts["uploads, bytes"] > volume.voxels.nbytes
    assert max(host_bytes) == LEAST_BYTES  # the trial, and never the volume


PAGE_BYTES = 4096


def numbered_bytes(size):
    array = aligned_empty((size,), np.uint8)
    array[:] = np.arange(size) % 251  # a prime: no page looks like the next
    return array


def read_only(array):
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    "array",
    [
        pytest.param(numbered_bytes(LEAST_BYTES + PAGE_BYTES)[64 : LEAST_BYTES + 64], id="begins within a page"),
        pytest.param(numbered_bytes(LEAST_BYTES + PAGE_BYTES)[: LEAST_BYTES + 4], id="ends within a line"),
        pytest.param(read_only(numbered_bytes(LEAST_BYTES)), id="is read-only"),
        pytest.param(numbered_bytes(LEAST_BYTES)[: LEAST_BYTES - PAGE_BYTES], id="is small"),
    ],
)
def test_array_that_is_not_of_whole_writable_pages_is_copied_to_a_gpu_of_the_processor(unified_gpu, array):
    with counting_calls() as counts:
        array_d = upload(unified_gpu, array)
    assert counts["uploads, bytes"] == array.nbytes
    assert np.array_equal(download(unified_gpu, np.empty_like(array), array_d), array)


def test_array_of_whole_pages_is_used_in_place_by_a_gpu_of_the_processor(unified_gpu):
    array = numbered_bytes(LEAST_BYTES)
    with counting_calls() as counts:
        array_d = upload(unified_gpu, array)
    assert not counts["uploads"]
    assert np.array_equal(download(unified_gpu, np.empty_like(array), array_d), array)


@pytest.mark.parametrize("rows", [0, 5, 100_001])
def test_output_array_is_contiguous_with_the_shape_and_type_that_were_asked_for(unified_gpu, rows):
    array, _ = empty_output(unified_gpu, (rows, 3), np.float32)
    assert (array.shape, array.dtype) == ((rows, 3), np.float32)
    assert array.flags.c_contiguous


@pytest.mark.parametrize("rows", [0, 5, 100_001])
def test_output_array_is_downloaded_into_itself(unified_gpu, rows):
    array, array_d = empty_output(unified_gpu, (rows, 3), np.float32)
    assert download(unified_gpu, array, array_d) is array


EXTRACT_ON_RUSTICL = """
import json, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
import clrecon
from clrecon.opencl import list_devices
from clrecon.system.memory import aligned_empty
from counted_calls import counting_calls
device = next((device for device in list_devices() if device.platform == "rusticl"), None)
if device is None:
    sys.exit("no rusticl")
device.fault, voxels = "", aligned_empty((32, 256, 256), np.int16)
voxels[:] = 10 * np.arange(256)
for _ in range(2):
    with counting_calls() as counts:
        clrecon.extract_isosurface(clrecon.Volume(voxels, np.eye(4)), 1285.0, device=device)
print(json.dumps([device.type, device.kernel_variants["LANES"], counts]))
"""


@pytest.mark.opencl
@pytest.mark.slow
def test_surface_on_rusticl_as_a_gpu_uploads_no_volume():
    """The only driver of continuous integration that can say that it is a GPU."""
    command = [sys.executable, "-c", EXTRACT_ON_RUSTICL, str(ROOT / "scripts")]
    environment = {**os.environ, "RUSTICL_DEVICE_TYPE": "gpu"}
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    if run.stderr.strip() == "no rusticl" and "rusticl" not in os.environ.get("CLRECON_REQUIRE_PLATFORMS", ""):
        pytest.skip("there is no rusticl")
    assert run.returncode == 0, run.stderr
    kind, lanes, counts = json.loads(run.stdout)
    assert (kind, lanes) == ("gpu", "1")
    volume_bytes = 32 * 256 * 256 * 2
    assert counts["uploads, bytes"] < volume_bytes / 256  # tables alone: measured 4,960 bytes, an 846th
    assert counts["blocking reads"] == 2  # the totals, then the arrays
    assert counts.get("allocations", 0) == 0
