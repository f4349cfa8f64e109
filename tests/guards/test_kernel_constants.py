"""A number that Python and the kernels both know has one value: each pair is listed here and compared."""

from __future__ import annotations

import re
from importlib import import_module

import pytest
from house import PACKAGE, ROOT

from clrecon.operators.reformat.sample import COMBINATIONS
from clrecon.operators.surface.mask_extraction import SAMPLES_PER_FLAGS

PAIRS = [
    ("clrecon.labels.occupancy.REACH", "surface/label_masks.h", "REACH"),
    ("clrecon.operators.resident.bricks.BRICK", "include/bricks.h", "BRICK"),
    ("clrecon.operators.primitives.compact.COMPACT_WORDS", "primitives/compact.cl", "COMPACT_WORDS"),
    ("clrecon.operators.primitives.scan.SCAN_PER_ITEM", "primitives/scan.cl", "SCAN_PER_ITEM"),
    ("clrecon.operators.rays.composite.GRADIENT_NODES", "rays/composite.cl", "GRADIENT_NODES"),
    ("clrecon.operators.rays.composite.NODES", "rays/steep_segments.h", "NODES"),
    ("clrecon.operators.rays.buffers.HIGHLIGHTS", "rays/phong.h", "HIGHLIGHTS"),
    ("clrecon.operators.rays.project.AIR_HU", "rays/project.cl", "AIR_HU"),
    ("clrecon.operators.rays.ray_view.BOX_ROW", "rays/view.h", "VIEW_BOX_LOW"),
    ("clrecon.operators.rays.ray_view.TILE", "rays/view.h", "TILE"),
    ("clrecon.operators.rays.slabs.BRICK_CELLS", "rays/leap.h", "BRICK_CELLS"),
    ("clrecon.operators.rays.slabs.FARTHEST", "rays/leap.h", "FARTHEST"),
    ("clrecon.operators.rays.leaps.ROWS_AT_ONCE", "rays/leaps.cl", "ROWS_AT_ONCE"),
    ("clrecon.operators.rays.slices.NODES", "rays/slices.cl", "BINS"),
    ("clrecon.rendering.looks.steepness.DENSE", "rays/steep_segments.h", "DENSE"),
    ("clrecon.rendering.looks.steepness.PARTS", "rays/steep_segments.h", "PARTS"),
    ("clrecon.rendering.looks.steepness.STEEP", "rays/steep_segments.h", "STEEP"),
]
"""Name in Python, kernel file below cl/, name there."""

_DOCUMENTED = re.compile(r'(?m)^([A-Z][A-Z_]*)\b[^\n]*= [^\n]*\n"""[^"]*\bcl/[\w/]+\.(?:cl|h)\b')
"""A constant whose docstring names a kernel file."""


def macro_value(text: str, name: str) -> float:
    """The number that ``#define name`` stands for in the source of a kernel file."""
    (value,) = re.findall(rf"(?m)^#define {name} +\(?(-?[0-9.]+)f?\)?(?= |$)", text)
    return float(value)


def listed_in(source: str) -> set[str]:
    """Constants of a module that say that a kernel file has them too."""
    return set(_DOCUMENTED.findall(source))


@pytest.mark.parametrize(("python", "file", "macro"), PAIRS)
def test_python_and_kernel_agree(python: str, file: str, macro: str) -> None:
    module, _, name = python.rpartition(".")
    kernel = macro_value((ROOT / "cl" / file).read_text(encoding="utf-8"), macro)
    assert kernel == getattr(import_module(module), name)


def test_combinations_have_the_numbers_of_the_kernel() -> None:
    text = (ROOT / "cl/reformat/sample.cl").read_text(encoding="utf-8")
    numbers = [macro_value(text, f"COMBINE_{name.upper()}") for name in COMBINATIONS]
    assert numbers == list(range(len(COMBINATIONS)))


def test_flags_of_strips_are_words_of_the_kernel() -> None:
    text = (ROOT / "cl/surface/label_masks.cl").read_text(encoding="utf-8")
    assert SAMPLES_PER_FLAGS == 32 * macro_value(text, "STRIP")


def test_every_constant_that_names_a_kernel_file_is_compared() -> None:
    known = {name for name, _, _ in PAIRS} | {
        "clrecon.operators.reformat.sample.COMBINATIONS",
        "clrecon.operators.surface.mask_extraction.SAMPLES_PER_FLAGS",
    }
    found = {
        f"{'.'.join(path.relative_to(ROOT).with_suffix('').parts)}.{name}"
        for path in PACKAGE.rglob("*.py")
        for name in listed_in(path.read_text(encoding="utf-8"))
    }
    assert len(found) > 10
    assert found - known == set()


def test_a_constant_that_drifted_would_be_seen() -> None:
    text = "#define OTHER 3\n#define PARTS 8 /* of a segment */\n#define AIR_HU (-1000.0f)\n#define STEEP 0.1f\n"
    assert [macro_value(text, name) for name in ("PARTS", "AIR_HU", "STEEP")] == [8, -1000, 0.1]
    with pytest.raises(ValueError, match="not enough values"):
        macro_value(text, "BRICK")
    assert listed_in('BRICK = 8\n"""Voxels along a side, as in cl/include/bricks.h."""\n') == {"BRICK"}
    assert listed_in('BRICK = 8\n"""Voxels along a side."""\n') == set()
