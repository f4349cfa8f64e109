"""Drivers work, with a warning, where they cannot keep what they build."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

CODE = """
import json, sys
import numpy as np
import clrecon
voxels = np.random.default_rng(0).integers(0, 6, (4, 5, 6)).astype(np.int16)
mesh = clrecon.extract_isosurface(clrecon.Volume(voxels, np.eye(4)), 3, int(sys.argv[1]))
print(json.dumps([len(mesh.triangles), mesh.report["warnings"]]))
"""


@pytest.mark.parametrize("variables", [{"HOME": "/proc/nowhere"}, {"POCL_CACHE_DIR": "/proc/nowhere"}])
def test_no_place_for_built_kernels(device, variables, tmp_path):
    environment = {key: text for key, text in os.environ.items() if key not in ("XDG_CACHE_HOME", "POCL_CACHE_DIR")}
    environment.update(variables, TMPDIR=str(tmp_path))
    command = [sys.executable, "-c", CODE, str(device.index)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    triangles, warnings = json.loads(done.stdout)
    assert triangles > 0
    assert warnings == ["the cache folder cannot be written: kernels are built anew by every process"]
    assert not list(tmp_path.iterdir())


def test_a_cache_that_works_is_no_warning(device):
    from clrecon.opencl.quirks import cache_warnings

    assert cache_warnings() == ()
