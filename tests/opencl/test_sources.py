"""Kernel files are found, their includes resolved, and each builds alone."""

from __future__ import annotations

import re
import shutil

import pytest
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl import kernel_files, load_program, read_kernel_source, sources


def test_kernel_files_are_found_in_every_folder():
    names = kernel_files()
    assert {name.split("/")[0] for name in names} == {
        "primitives",
        "resident",
        "masks",
        "surface",
        "filters",
        "points",
        "rays",
        "reformat",
    }
    assert all(name.endswith(".cl") for name in names)


@pytest.mark.parametrize("name", kernel_files())
def test_includes_are_inlined_once_with_line_marks(name):
    source = read_kernel_source(name)
    assert not re.search(r"^\s*#\s*include", source, re.MULTILINE)
    assert source.startswith('#line 1 "cl/include/exact.h"') and f'\n#line 1 "cl/{name}"\n' in source
    marks = re.findall(r'#line 1 "(cl/[^"]+\.h)"', source)
    assert len(marks) == len(set(marks))


def test_line_marks_point_to_the_true_line():
    name = "surface/marching_cubes.cl"
    true = sources.kernel_root().joinpath(name).read_text().splitlines()
    file, line, seen = "", 0, 0
    for text in read_kernel_source(name).splitlines():
        mark = re.match(r'#line (\d+) "cl/([^"]+)"', text)
        if mark:
            file, line = mark[2], int(mark[1])
            continue
        if file == name and text:
            assert true[line - 1] == text
            seen += 1
        line += 1
    assert seen > 100


@pytest.mark.release
@pytest.mark.parametrize("name", kernel_files())
def test_every_file_builds_alone(name, device):
    kernels = load_program(device, name).kernel_names
    declared = re.findall(r"^(?:void|__kernel void) (\w+)\(", read_kernel_source(name), re.MULTILINE)
    assert kernels == sorted(declared)


@pytest.mark.parametrize("voxel", ["char", "uchar", "short", "ushort", "int", "float"])
def test_every_voxel_type_builds(voxel, device):
    program = load_program(device, "surface/marching_cubes.cl", {"VOXEL": voxel})
    assert "emit_vertices" in program.kernel_names


@pytest.mark.every_device
def test_a_compiler_error_names_the_true_file_and_line(device, monkeypatch):
    text = '#line 1 "cl/theme/file.cl"\n__kernel void broken(__global int *a)\n{\n    a[0] = missing_name;\n}\n'
    monkeypatch.setattr("clrecon.opencl.program.read_kernel_source", lambda name: text)
    with refused(DeviceError, "file.cl") as caught:
        load_program(device, "theme/file.cl")
    log = str(caught.value) + str(caught.value.__cause__)
    assert "missing_name" in log
    assert "theme/file.cl:3" in log


@pytest.mark.parametrize("missing", ["primitives/compact.cl", "include/volume.h"])
@pytest.mark.fault_row(52)
def test_a_missing_kernel_file_is_a_damaged_installation(missing, tmp_path, monkeypatch):
    root = tmp_path / "cl"
    shutil.copytree(str(sources.kernel_root()), root)
    (root / missing).unlink()
    monkeypatch.setattr(sources, "kernel_root", lambda: root)
    name = missing if missing.endswith(".cl") else "surface/marching_cubes.cl"
    with refused(DeviceError, missing):
        sources.read_kernel_source.__wrapped__(name)


@pytest.mark.fault_row(52)
def test_an_installation_without_kernels_is_damaged(tmp_path, monkeypatch):
    monkeypatch.setattr(sources.resources, "files", lambda name: tmp_path)
    with refused(DeviceError, "volume.h", "kernels") as caught:
        sources.kernel_root.__wrapped__()
    assert caught.value.exit_code == 5
