"""A volume larger than the memory that its surface may take: from a memory-mapped file, slab by slab."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

SHAPE = (600, 1024, 1024)
BUDGET = 128 * 2**20

CHILD = """
import json, sys
import numpy as np
import clrecon

def peak_kib():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))

path, device, budget = sys.argv[1], sys.argv[2], int(sys.argv[3])
volume = clrecon.Volume(np.load(path, mmap_mode="r"), np.diag((0.2, 0.2, 0.2, 1.0)))
small = clrecon.Volume(np.arange(1000, dtype=np.int16).reshape(10, 10, 10), np.eye(4))
clrecon.extract_isosurface(small, 500, device=device)  # drivers and kernels are loaded
before = peak_kib()
mesh = clrecon.extract_isosurface(volume, 500, device=device, memory=budget)
quality = mesh.quality()
print(json.dumps({"grown_mib": (peak_kib() - before) / 1024, "slabs": mesh.report["slabs"],
                  "volume_ml": quality["volume_ml"], "closed": quality["closed"], "components": quality["components"]}))
"""


@pytest.mark.release
@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="peak memory is read from /proc")
def test_surface_of_a_file_of_a_gigabyte_is_made_within_a_few_times_the_memory_allowed(device, tmp_path):
    """Two balls of 50 voxels' radius in 1.2 GiB of air: a hole in the file, so that it takes no room on the disk."""
    path = tmp_path / "huge.npy"
    voxels = np.lib.format.open_memmap(path, mode="w+", dtype=np.int16, shape=SHAPE)
    distance = np.linalg.norm(np.indices((120, 120, 120)).reshape(3, -1) - 60.0, axis=0).reshape(120, 120, 120)
    ball = np.rint(500 + 10 * (50 - distance)).clip(0, 1000).astype(np.int16)
    voxels[3:123, 5:125, 7:127] = ball
    voxels[290:410, 900:1020, 450:570] = ball
    voxels.flush()
    del voxels
    child = subprocess.run(
        [sys.executable, "-c", CHILD, str(path), str(device.index), str(BUDGET)], capture_output=True, text=True
    )
    assert child.returncode == 0, child.stderr
    result = json.loads(child.stdout)
    assert result["slabs"] > 2 * np.prod(SHAPE) / BUDGET  # voxels of two bytes
    assert result["closed"]
    assert result["components"] == 2
    radius_mm = 0.2 * (50 + 0.5 / 10)  # the level is 499.5 HU, which fall by 10 a voxel
    assert result["volume_ml"] == pytest.approx(2 * 4 / 3 * np.pi * radius_mm**3 / 1000, rel=1e-4)  # measured 3e-5
    copies = 2 if device.shares_host_memory else 4  # llvmpipe's own memory, and what goes there, are the computer's too
    assert result["grown_mib"] < copies * BUDGET / 2**20  # measured 114, less than one
