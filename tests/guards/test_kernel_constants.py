"""A number that Python and the kernels both know is written once: Python reads it from the kernel's source.

Rooms that may not import the layer of OpenCL write theirs a second time; they are listed here and compared.
"""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import import_module

import pytest
from house import PACKAGE, ROOT
from refusals import refused

from clrecon.opencl import kernel_constant, kernel_number
from clrecon.operators.rays.ray_pictures import PROJECTIONS
from clrecon.operators.reformat.sheets import COMBINATIONS

PAIRS = [
    ("clrecon.labels.label_levels.REACH", "surface/label_masks.h", "REACH"),
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
def test_constants_of_python_and_kernels_are_equal(python: str, file: str, macro: str) -> None:
    module, _, name = python.rpartition(".")
    assert kernel_number(file, macro) == getattr(import_module(module), name)


def test_no_other_constant_is_written_twice() -> None:
    known = {name for name, _, _ in PAIRS}
    found = {
        f"{'.'.join(path.relative_to(ROOT).with_suffix('').parts)}.{name}"
        for path in PACKAGE.rglob("*.py")
        for name in written_twice(path.read_text(encoding="utf-8"))
    }
    assert found - known == set()


def test_no_comment_says_as_in_a_kernel_file() -> None:
    said = [
        path.name for path in PACKAGE.rglob("*.py") if re.search(r"as in cl/\w+/\w+\.(cl|h)", path.read_text("utf-8"))
    ]
    assert said == []


def test_modes_and_combinations_have_numbers_of_their_own() -> None:
    assert sorted(COMBINATIONS.values()) == [0, 1, 2]
    assert sorted(PROJECTIONS.values()) == [0, 1, 2, 3]


def test_numbers_are_read_as_the_compiler_reads_them() -> None:
    assert kernel_constant("rays/leap.h", "BRICK_CELLS") == 4
    assert isinstance(kernel_constant("rays/leap.h", "BRICK_CELLS"), int)
    assert kernel_number("rays/project.cl", "AIR_HU") == -1000.0
    assert kernel_number("rays/project.cl", "WATER_PER_HU") == 0.001
    with pytest.raises(KeyError, match=r"cl/rays/leap.h defines no number NODES"):
        kernel_constant("rays/leap.h", "NODES")
    with pytest.raises(KeyError, match="NO_HIT"):
        kernel_number("rays/surface.cl", "NO_HIT")
    with pytest.raises(ValueError, match="no whole number"):
        kernel_constant("rays/project.cl", "WATER_PER_HU")


def test_a_number_that_depends_on_the_variant_is_refused(tmp_path, monkeypatch) -> None:
    (tmp_path / "rays").mkdir()
    (tmp_path / "rays/a.h").write_text("#ifdef WIDE\n#define LENGTH 8\n#else\n#define LENGTH 4 /* narrow */\n#endif\n")
    monkeypatch.setattr("clrecon.opencl.sources.kernel_root", lambda: tmp_path)
    with refused(KeyError, "LENGTH", 4, 8):
        kernel_number("rays/a.h", "LENGTH")


def test_importing_clrecon_reads_no_kernel_file() -> None:
    code = (
        "import sys, clrecon, clrecon.cli.main;"
        "sources = sys.modules.get('clrecon.opencl.sources');"
        "print(sources._list_numbers.cache_info().misses if sources else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"


def test_a_constant_that_is_written_twice_would_be_seen() -> None:
    assert written_twice('BRICK = 8\n"""Voxels along a side, see cl/include/bricks.h."""\n') == {"BRICK"}
    assert written_twice('BRICK = 8\n"""Voxels along a side."""\n') == set()
    assert written_twice('BRICK = kernel_constant("a.h", "B")\n"""Voxels, see cl/include/bricks.h."""\n') == set()
