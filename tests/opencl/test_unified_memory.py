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
    """Return a volume of 2 MiB in whole pages, as readers make them."""
    voxels = aligned_empty((64, 128, 128), np.int16)
    axis = np.arange(128) - 60.3
    voxels[:] = 600 - 12 * np.sqrt(axis[:, None] ** 2 + axis**2) - 2 * np.arange(64)[:, None, None]
    return clrecon.Volume(voxels, np.diag((0.7, 0.5, 1.5, 1.0)))


@pytest.fixture
def part(device):
    """The device as a GPU that is a part of the processor, opened anew."""
    if device.is_simulator:
        pytest.skip("simulators take the driver's way, which checks more")
    gpu = Device(device.index, device.cl_device.platform, device.cl_device)
    gpu.type, gpu.has_own_memory, gpu.shares_host_memory, gpu.fault = "gpu", False, False, ""
    gpu.kernel_variants = device.kernel_variants
    return gpu


def extract(volume, device):
    with counting_calls() as counts:
        mesh = clrecon.extract_isosurface(volume, 100.0, device=device)
    return counts, b"".join(array.tobytes() for array in (mesh.vertices, mesh.normals, mesh.triangles))


@pytest.mark.seconds
@pytest.mark.every_device
def test_surface_on_part_of_processor_copies_no_volume_and_changes_no_bit(part, device):
    volume = make_cone()
    counts, mesh = extract(volume, part)
    assert counts["uploads, bytes"] < volume.voxels.nbytes / 100
    assert mesh == extract(volume, device)[1]


def test_driver_that_copies_arrays_gets_copies_of_volumes(part, monkeypatch):
    volume, ask = make_cone(), buffers.ask_driver
    sent = []

    def ask_for_copy(device, flags, size, host):
        sent.append(0 if host is None else host.nbytes)
        return ask(device, flags, size, None if host is None else host.copy())

    expected = extract(volume, part)[1]
    part.give_up()
    monkeypatch.setattr(buffers, "ask_driver", ask_for_copy)
    counts, mesh = extract(volume, part)
    assert counts["uploads, bytes"] > volume.voxels.nbytes and max(sent) == LEAST_BYTES
    assert mesh == expected


@pytest.mark.parametrize("fault", ["begins within a page", "ends within a line", "is read-only", "is small"])
def test_array_that_is_no_whole_page_is_copied(part, fault):
    memory = aligned_empty((LEAST_BYTES + 8192,), np.uint8)
    memory[:] = np.arange(len(memory)) % 251
    array = memory[: LEAST_BYTES + 4096]
    if fault == "begins within a page":
        array = memory[64 : LEAST_BYTES + 64]
    elif fault == "ends within a line":
        array = memory[: LEAST_BYTES + 4]
    elif fault == "is read-only":
        array.flags.writeable = False
    else:
        array = memory[: LEAST_BYTES - 4096]
    with counting_calls() as counts:
        array_d = upload(part, array)
    assert counts["uploads, bytes"] == array.nbytes
    assert np.array_equal(download(part, np.empty_like(array), array_d), array)


def test_array_in_whole_pages_is_used_where_it_is(part):
    array = aligned_empty((LEAST_BYTES,), np.uint8)
    array[:] = np.arange(len(array)) % 251
    with counting_calls() as counts:
        array_d = upload(part, array)
    assert not counts["uploads"]
    assert np.array_equal(download(part, np.empty_like(array), array_d), array)


@pytest.mark.parametrize("rows", [0, 5, 100_001])
def test_results_have_the_rows_that_were_asked_for(part, rows):
    array, array_d = empty_output(part, (rows, 3), np.float32)
    assert array.shape == (rows, 3) and array.dtype == np.float32 and array.flags.c_contiguous
    assert download(part, array, array_d) is array


CODE = """
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
def test_rusticl_as_gpu_copies_no_volume():
    """The only driver of continuous integration that can say that it is a GPU."""
    command = [sys.executable, "-c", CODE, str(ROOT / "scripts")]
    environment = {**os.environ, "RUSTICL_DEVICE_TYPE": "gpu"}
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    if run.stderr.strip() == "no rusticl" and "rusticl" not in os.environ.get("CLRECON_REQUIRE_PLATFORMS", ""):
        pytest.skip("there is no rusticl")
    assert run.returncode == 0, run.stderr
    kind, lanes, counts = json.loads(run.stdout)
    assert (kind, lanes) == ("gpu", "1")
    assert counts["uploads, bytes"] < 16384 and counts["blocking reads"] == 2 and counts.get("allocations", 0) == 0
