"""Kernel files are found, their includes resolved, and each builds alone."""

from __future__ import annotations

import re
import shutil

import pytest
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl import kernel_files, load_program, read_kernel_source, sources


def test_kernel_files_are_found_in_every_folder_of_kernels():
    names = kernel_files()
    folders = {name.split("/")[0] for name in names}
    assert folders == {"primitives", "resident", "masks", "surface", "filters", "points", "rays", "reformat"}
    assert all(name.endswith(".cl") for name in names)


@pytest.mark.parametrize("name", kernel_files())
def test_each_include_of_a_kernel_file_is_inlined_once_with_a_line_mark(name):
    source = read_kernel_source(name)
    assert not re.search(r"^\s*#\s*include", source, re.MULTILINE)
    first, *others = re.findall(r'^#line 1 "(cl/[^"]+)"$', source, re.MULTILINE)
    assert first == "cl/include/exact.h"  # stands before all kernels: it forbids inexact arithmetic
    assert f"cl/{name}" in others
    assert len({first, *others}) == 1 + len(others)


def test_line_marks_give_the_file_and_line_of_each_line_of_a_kernel():
    name = "surface/marching_cubes.cl"
    lines_of_file = sources.kernel_root().joinpath(name).read_text().splitlines()
    marked_lines = {}
    file, line = "", 0
    for text in read_kernel_source(name).splitlines():
        mark = re.match(r'#line (\d+) "cl/([^"]+)"', text)
        if mark:
            file, line = mark[2], int(mark[1])
            continue
        if file == name and text:
            marked_lines[line] = text
        line += 1

    is_include = re.compile(r"\s*#\s*include").match  # replaced by the header
    assert marked_lines == {
        line: text for line, text in enumerate(lines_of_file, start=1) if text and not is_include(text)
    }


@pytest.mark.release
@pytest.mark.parametrize("name", kernel_files())
def test_every_kernel_file_builds_alone_with_the_kernels_that_it_declares(name, device):
    kernels = load_program(device, name).kernel_names
    declared = re.findall(r"^(?:void|__kernel void) (\w+)\(", read_kernel_source(name), re.MULTILINE)
    assert kernels == sorted(declared)


@pytest.mark.parametrize("voxel", ["char", "uchar", "short", "ushort", "int", "float"])
def test_marching_cubes_build_for_voxels_of_8_to_32_bits(voxel, device):
    program = load_program(device, "surface/marching_cubes.cl", {"VOXEL": voxel})
    assert "emit_vertices" in program.kernel_names


@pytest.mark.every_device
def test_compiler_error_names_the_kernel_file_and_line(device, monkeypatch):
    text = '#line 1 "cl/theme/file.cl"\n__kernel void broken(__global int *a)\n{\n    a[0] = missing_name;\n}\n'
    monkeypatch.setattr("clrecon.opencl.program.read_kernel_source", lambda name: text)
    with refused(DeviceError, "file.cl") as caught:
        load_program(device, "theme/file.cl")
    log = str(caught.value) + str(caught.value.__cause__)
    assert "missing_name" in log
    assert "theme/file.cl:3" in log


@pytest.mark.parametrize(
    ("missing", "read"),
    [("primitives/compact.cl", "primitives/compact.cl"), ("include/volume.h", "surface/marching_cubes.cl")],
    ids=["kernel file", "header that it includes"],
)
@pytest.mark.fault_row(52)
def test_missing_kernel_file_or_header_is_refused_by_name(missing, read, tmp_path, monkeypatch):
    root = tmp_path / "cl"
    shutil.copytree(str(sources.kernel_root()), root)
    (root / missing).unlink()
    monkeypatch.setattr(sources, "kernel_root", lambda: root)
    with refused(DeviceError, missing):
        sources.read_kernel_source.__wrapped__(read)


@pytest.mark.fault_row(52)
def test_installation_without_kernels_is_refused_as_damaged(tmp_path, monkeypatch):
    monkeypatch.setattr(sources.resources, "files", lambda name: tmp_path)
    with refused(DeviceError, "volume.h", "kernels") as caught:
        sources.kernel_root.__wrapped__()
    assert caught.value.exit_code == 5  # devices, see docs/contract.md
