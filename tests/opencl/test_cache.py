"""Drivers work, with a warning, where they cannot keep what they build."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest

CODE = """
import json, sys
import numpy as np
import clrecon
voxels = np.random.default_rng(0).integers(0, 6, (4, 5, 6)).astype(np.int16)
mesh = clrecon.extract_isosurface(clrecon.Volume(voxels, np.eye(4)), 3, device=int(sys.argv[1]))
kept = [device.keeps_binaries for device in clrecon.devices()]
print(json.dumps([len(mesh.triangles), mesh.report["warnings"], kept]))
"""


@pytest.mark.parametrize("variables", [{"HOME": "/proc/nowhere"}, {"POCL_CACHE_DIR": "/proc/nowhere"}])
def test_no_place_for_built_kernels(device, variables, tmp_path):
    environment = {key: text for key, text in os.environ.items() if key not in ("XDG_CACHE_HOME", "POCL_CACHE_DIR")}
    environment.update(variables, TMPDIR=str(tmp_path))
    command = [sys.executable, "-c", CODE, str(device.index)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    triangles, warnings, kept = json.loads(done.stdout)
    assert triangles > 0 and not any(kept)
    assert warnings == ["the cache folder cannot be written: kernels are built anew by every process"]
    assert not list(tmp_path.iterdir())


def test_a_cache_that_works_is_no_warning(device):
    from clrecon.opencl.quirks import cache_warnings

    assert cache_warnings() == ()


def test_a_folder_that_a_driver_still_writes_to_is_removed(tmp_path):
    """Mesa's cache has a thread of its own: a file that appears meanwhile makes the removal of its folder fail."""
    from clrecon.opencl import quirks

    folder = tmp_path / "built"
    folder.mkdir()
    removed = []

    def remove_all_but_a_newer_file(path, ignore_errors=False):
        removed.append(path)
        shutil.rmtree(path, ignore_errors=ignore_errors)
        if len(removed) < 3:
            folder.mkdir()
            (folder / "newer").write_bytes(b"kernel")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quirks, "shutil", SimpleNamespace(rmtree=remove_all_but_a_newer_file))
        quirks._remove_tree(str(folder))
    assert len(removed) == 3 and not folder.exists()


def test_where_nothing_can_be_kept_no_driver_is_asked_to(monkeypatch):
    from clrecon.opencl import quirks

    for name in (*quirks._NO_CACHES, "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, "")  # what was not there is noted too, and taken away in the end
        monkeypatch.delenv(name)
    monkeypatch.setenv("POCL_CACHE_DIR", "/proc/nowhere")
    leaving = []
    monkeypatch.setattr(quirks, "atexit", SimpleNamespace(register=lambda *call: leaving.append(call)))
    assert len(quirks.cache_warnings.__wrapped__()) == 1
    [(remove, folder)] = leaving
    assert os.environ["POCL_CACHE_DIR"] == os.environ["XDG_CACHE_HOME"] == folder
    assert os.environ["MESA_SHADER_CACHE_DISABLE"] == "true" and os.environ["PYOPENCL_NO_CACHE"] == "1"
    remove(folder)
    assert not os.path.exists(folder)
