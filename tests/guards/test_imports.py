"""Importing clrecon, asking for help and reading files cost little and need no OpenCL driver."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from refusals import refused
from variants import daily

import clrecon

HEAVY = {
    "imagecodecs", "numpy", "pydicom", "pyopencl", "pyvista", "scipy", "skimage", "trimesh", "vtk",
    "vtkmodules",
}  # fmt: skip
LOADED = "import json, sys; print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
HELP = """
import contextlib, io
from clrecon.cli.main import main
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as out:
    main(["--help"])
assert "mesh" in out.getvalue()
"""
NO_PYOPENCL = "import sys; sys.modules['pyopencl'] = None"


def run_python(code: str, tmp_path: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OCL_ICD_VENDORS": str(tmp_path)}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)


def loaded_after(code: str, tmp_path: Path) -> set[str]:
    done = run_python(f"{code}\n{LOADED}", tmp_path)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_import_of_clrecon_loads_no_heavy_package(tmp_path: Path) -> None:
    assert loaded_after("import clrecon", tmp_path) & HEAVY == set()


def test_help_loads_no_heavy_package(tmp_path: Path) -> None:
    assert loaded_after(HELP, tmp_path) & HEAVY == set()


def test_help_of_clouds_with_the_kinds_of_points_loads_no_heavy_package(tmp_path: Path) -> None:
    code = HELP.replace('"--help"', '"cloud", "--help"').replace('"mesh"', '"surface|cortex|shell|voxels"')
    assert loaded_after(code, tmp_path) & HEAVY == set()


def test_use_of_a_volume_loads_numpy_and_no_other_heavy_package(tmp_path: Path) -> None:
    assert loaded_after("import clrecon; clrecon.Volume", tmp_path) & HEAVY == {"numpy"}


@pytest.mark.parametrize(
    "package", ["clrecon.reading.dicom.reader", "clrecon.mesh", "clrecon.proof.phantom", "clrecon.proof"]
)
def test_reading_meshes_and_phantoms_are_imported_without_pyopencl(package: str, tmp_path: Path) -> None:
    done = run_python(f"{NO_PYOPENCL}\nimport clrecon, {package}\nprint(clrecon.Volume)", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Volume" in done.stdout


def test_devices_without_pyopencl_are_a_device_error_that_names_it(tmp_path: Path) -> None:
    done = run_python(f"{NO_PYOPENCL}\nimport clrecon\nclrecon.devices()", tmp_path)
    assert done.returncode == 1
    assert "DeviceError: pyopencl cannot be imported" in done.stderr.splitlines()[-1]
    assert "apt install ocl-icd-libopencl1" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("name", clrecon.__all__)
def test_public_name_is_the_same_object_each_time_and_is_listed(name: str) -> None:
    assert getattr(clrecon, name) is getattr(clrecon, name)
    assert name in dir(clrecon)


def test_unknown_name_raises_an_attribute_error_that_names_it() -> None:
    name = "read_volumes"
    with refused(AttributeError, name):
        getattr(clrecon, name)


def test_use_of_surfaces_loads_no_label_maps_no_dicom_and_no_scipy(tmp_path: Path) -> None:
    """Label maps load pydicom, a quarter of a second that a surface need not wait for."""
    code = "import clrecon; clrecon.extract_isosurface, clrecon.SurfaceExtractor, clrecon.DeviceVolume"
    modules = set(run_python(f"{code}\nimport sys; print(*sys.modules)", tmp_path).stdout.split())
    assert "numpy" in modules
    assert modules & {"pydicom", "scipy", "clrecon.labels", "clrecon.reading.dicom"} == set()


@pytest.mark.first_device
@pytest.mark.parametrize("hu", daily(1, [226.0, (200.0, 3000.0)]))
def test_preparing_a_device_for_a_cloud_loads_numpy_and_pyopencl_and_no_other_heavy_package(
    device: Any, hu: object
) -> None:
    """scipy takes as long to load as the scan takes to read, beside which the device is prepared."""
    # a device is checked at its first use, which needs more, and that is remembered
    subprocess.run([sys.executable, "-c", f"import clrecon; clrecon.device({device.index})"], check=True)
    code = f"""
import sys, clrecon
from clrecon.jobs.cloud.steps import try_steps
from clrecon.jobs.cloud.settings import CloudSettings, Clustering
try_steps(clrecon.device({device.index}), CloudSettings(hu={hu}, clusters=Clustering()), is_cloud=False)
"""
    done = subprocess.run([sys.executable, "-c", f"{code}\n{LOADED}"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert set(json.loads(done.stdout.splitlines()[-1])) & HEAVY == {"numpy", "pyopencl"}
