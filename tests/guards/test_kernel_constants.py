"""A number that Python and the kernels both know is written once: Python reads it from the kernel's source.

Rooms that may not import the layer of OpenCL write theirs a second time; they are listed here and compared.
"""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from house import PACKAGE, ROOT
from refusals import refused

from clrecon.opencl import kernel_constant, kernel_number
from clrecon.operators.rays.ray_pictures import PROJECTIONS
from clrecon.operators.reformat.sheets import COMBINATIONS

PAIRS = [
    ("clrecon.labels.label_levels.REACH", "surface/label_masks.h", "REACH"),
    ("clrecon.proof.surface.collapses.PULL", "surface/collapse.h", "PULL"),
    ("clrecon.proof.surface.collapses.SLENDER", "surface/collapse.h", "SLENDER"),
    ("clrecon.proof.surface.collapses.STEEPEST", "surface/collapse.h", "STEEPEST"),
    ("clrecon.rendering.looks.piecewise.DENSE", "rays/steep_segments.h", "DENSE"),
    ("clrecon.rendering.looks.piecewise.PARTS", "rays/steep_segments.h", "PARTS"),
    ("clrecon.rendering.looks.piecewise.STEEP", "rays/steep_segments.h", "STEEP"),
]
"""Name in Python, kernel file below cl/, name there: of rooms without OpenCL."""

_WRITTEN = re.compile(r'(?m)^([A-Z][A-Z_]*)\b[^\n]*= -?[0-9(][^\n]*\n"""[^"]*\bcl/[\w/]+\.(?:cl|h)\b')
"""A constant that is a number, and whose docstring names a kernel file."""


def written_twice(source: str) -> set[str]:
    """Constants of a module that are written there, and say that a kernel file has them too."""
    return set(_WRITTEN.findall(source))


@pytest.mark.parametrize(("python", "file", "macro"), PAIRS)
def test_constant_that_is_written_in_python_and_in_a_kernel_is_equal_in_both(
    python: str, file: str, macro: str
) -> None:
    module, _, name = python.rpartition(".")
    assert kernel_number(file, macro) == getattr(import_module(module), name)


def test_only_listed_constants_are_written_in_python_and_in_a_kernel() -> None:
    known = {name for name, _, _ in PAIRS}
    found = {
        f"{'.'.join(path.relative_to(ROOT).with_suffix('').parts)}.{name}"
        for path in PACKAGE.rglob("*.py")
        for name in written_twice(path.read_text(encoding="utf-8"))
    }
    assert found - known == set()


def test_no_comment_in_python_refers_to_a_number_as_in_a_kernel_file() -> None:
    comments = {path: path.read_text("utf-8") for path in PACKAGE.rglob("*.py")}
    assert len(comments) > 300  # the whole package was read: it has some 430 files
    assert [path for path, text in comments.items() if re.search(r"as in cl/\w+/\w+\.(cl|h)", text)] == []


@pytest.mark.parametrize("numbers", [COMBINATIONS, PROJECTIONS], ids=["combinations", "projections"])
def test_modes_that_kernels_tell_apart_are_numbered_from_0(numbers: dict[str, int]) -> None:
    assert sorted(numbers.values()) == list(range(len(numbers)))
    assert len(numbers) > 1


@pytest.fixture
def header(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a header with numbers, some of them of a variant."""
    (tmp_path / "rays").mkdir()
    (tmp_path / "rays/a.h").write_text(
        "#define CELLS 4\n#define AIR_HU -1000.0f\n#define SHARE 0.001f\n#define WORD uint\n"
        "#ifdef WIDE\n#define LENGTH 8\n#else\n#define LENGTH 4 /* narrow */\n#endif\n"
    )
    monkeypatch.setattr("clrecon.opencl.sources.kernel_root", lambda: tmp_path)
    return "rays/a.h"


def test_whole_number_of_a_kernel_is_read_as_an_integer(header: str) -> None:
    assert kernel_constant(header, "CELLS") == 4
    assert type(kernel_constant(header, "CELLS")) is int


@pytest.mark.parametrize(("macro", "number"), [("AIR_HU", -1000.0), ("SHARE", 0.001)])
def test_number_of_a_kernel_is_read_as_written_there(header: str, macro: str, number: float) -> None:
    assert kernel_number(header, macro) == number


@pytest.mark.parametrize("macro", ["NODES", "WORD"], ids=["not defined", "no number"])
def test_macro_of_a_kernel_that_is_no_number_is_refused(header: str, macro: str) -> None:
    with refused(KeyError, f"cl/{header}", macro):
        kernel_number(header, macro)


def test_fraction_in_place_of_a_whole_number_of_a_kernel_is_refused(header: str) -> None:
    with refused(ValueError, "SHARE", "whole"):
        kernel_constant(header, "SHARE")


def test_number_of_a_kernel_that_depends_on_the_variant_is_refused_with_its_values(header: str) -> None:
    with refused(KeyError, "LENGTH", 4, 8):
        kernel_number(header, "LENGTH")


def test_import_of_clrecon_reads_no_kernel_file() -> None:
    code = (
        "import sys, clrecon, clrecon.cli.main;"
        "sources = sys.modules.get('clrecon.opencl.sources');"
        "print(sources._list_numbers.cache_info().misses if sources else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"


@pytest.mark.parametrize(
    ("source", "constants"),
    [
        ('BRICK = 8\n"""Voxels along a side, see cl/include/bricks.h."""\n', {"BRICK"}),
        ('BRICK = 8\n"""Voxels along a side."""\n', set()),
        ('BRICK = kernel_constant("a.h", "B")\n"""Voxels, see cl/include/bricks.h."""\n', set()),
    ],
    ids=["number that names a kernel file", "number of Python alone", "number read from the kernel"],
)
def test_number_in_python_whose_docstring_names_a_kernel_file_is_found(source: str, constants: set[str]) -> None:
    assert written_twice(source) == constants
