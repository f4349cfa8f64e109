"""No kernel and no variant without a check of the self-test, and none whose breakage is not tried."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from clrecon.opencl.sources import kernel_files, read_kernel_source
from clrecon.proof.checking import Check
from clrecon.proof.run import CHECKS

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts" / "proof"))

from kernel_mutations import EQUIVALENT, INVERSIONS, all_mutations, find_kernels  # noqa: E402

OF_TYPES = {"VOXEL", "VALUE", "LABEL", "VOXEL_IS_SHORT"}
OF_DEVICES = {"LANES", "WORDS_PER_ITEM", "HAS_BUILTIN_PREFETCH", "SCAN_GROUP", "NO_WINDOWS", "CPU_NAME", "ATOMIC_LOADS"}
OF_COMPILERS = re.compile(r"__\w+__|CLRECON_\w+_H")
"""Macros that a check need not name: it runs with several types, and with what its device is given."""

NEVER_BUILT = {
    ("rays/composite.cl", "LEAST_VALUE"): "of rays/field.h: operators give it to project.cl alone",
    ("rays/surface.cl", "LEAST_VALUE"): "of rays/field.h: operators give it to project.cl alone",
    ("surface/trilinear.cl", "GOLDEN"): "of surface/vertex_group.h: operators build trilinear.cl by types alone",
    ("surface/trilinear.cl", "GOLDEN_SEARCH"): "of surface/vertex_group.h: operators build trilinear.cl by types alone",
    ("surface/trilinear.cl", "LABELS"): "of surface/vertex_group.h: operators build trilinear.cl by types alone",
    ("surface/trilinear.cl", "RANGE"): "of surface/vertex_group.h: operators build trilinear.cl by types alone",
    ("surface/trilinear.cl", "UNEVEN"): "of surface/vertex_group.h: operators build trilinear.cl by types alone",
}
"""Macros of headers that no operator gives to a file that includes them."""


def find_switches(source: str) -> set[str]:
    """Macros that conditions of a source ask for, other than those that it always defines itself."""
    asked = set()
    for directive, condition in re.findall(r"(?m)^[ \t]*#[ \t]*(if|ifdef|ifndef|elif)[ \t]+(.*)$", source):
        condition = re.sub(r"/\*.*?\*/", "", condition)
        asked |= {word for word in re.findall(r"[A-Za-z_]\w*", condition) if word != "defined" and directive}
    given = set(re.findall(r"(?m)^[ \t]*#[ \t]*define[ \t]+(\w+)", source))
    own = {name for name in given if not re.search(rf"(?m)^#ifndef {name}\n#define {name} 0", source)}
    return {name for name in asked if not OF_COMPILERS.fullmatch(name)} - own - OF_TYPES - OF_DEVICES


def find_gaps(checks: tuple[Check, ...], kernels: dict[str, str], switches: dict[str, set[str]]) -> list[str]:
    """Kernels and variants without a check, and checks of what is not there."""
    checked = {kernel for check in checks for kernel in check.kernels}
    gaps = [f"kernel {kernel} of cl/{kernels[kernel]} has no check" for kernel in sorted(kernels.keys() - checked)]
    gaps += [f"there is no kernel {kernel}" for kernel in sorted(checked - kernels.keys())]
    built: dict[str, set[str]] = {}
    for check in checks:
        for file, macros in check.variants.items():
            built.setdefault(file, set()).update(macros)
    for file in sorted(switches.keys() | built.keys()):
        known, checked_ones = switches.get(file, set()), built.get(file, set())
        gaps += [f"cl/{file} has no check with -D {macro}" for macro in sorted(known - checked_ones)]
        gaps += [f"cl/{file} knows no {macro}" for macro in sorted(checked_ones - known)]
    return gaps


SWITCHES = {
    file: {macro for macro in find_switches(read_kernel_source(file)) if (file, macro) not in NEVER_BUILT}
    for file in kernel_files()
}


@pytest.mark.fault_row(57)
def test_every_kernel_and_every_variant_has_a_check() -> None:
    assert find_gaps(CHECKS, find_kernels(), SWITCHES) == []
    assert all(macro in find_switches(read_kernel_source(file)) for file, macro in NEVER_BUILT)
    names = [check.name for check in CHECKS]
    assert len(set(names)) == len(names)
    assert {macro for macros in SWITCHES.values() for macro in macros} == {
        "BETWEEN", "BORDER_INSIDE", "GOLDEN", "GOLDEN_SEARCH", "GRADIENT_OPACITY", "GROWN", "LABELS",
        "LEAST_VALUE", "MASKS", "RANGE", "TAKES_PARTS", "UNEVEN",
    }  # fmt: skip


@pytest.mark.parametrize("kernel", ["trace_surface", "compact"])
@pytest.mark.fault_row(57)
def test_a_gap_is_found(kernel: str) -> None:
    kernels = find_kernels()
    fewer = tuple(check for check in CHECKS if kernel not in check.kernels and check.name != kernel)
    assert find_gaps(fewer, kernels, SWITCHES)
    without = {name: file for name, file in kernels.items() if name != "sum_blocks"}
    assert find_gaps(CHECKS, without, SWITCHES) == ["there is no kernel sum_blocks"]
    more = {**SWITCHES, "rays/slices.cl": {"BETWEEN", "UPSIDE_DOWN"}}
    assert find_gaps(CHECKS, kernels, more) == ["cl/rays/slices.cl has no check with -D UPSIDE_DOWN"]


@pytest.mark.fault_row(57)
def test_every_kernel_has_its_mutations() -> None:
    kernels = find_kernels()
    assert set(INVERSIONS) == set(kernels) and all(INVERSIONS.values())
    mutations = all_mutations()
    sources = {mutation: mutation.source() for mutation in mutations}  # every text is found
    assert len(mutations) >= 3 * len(kernels)
    assert all(text != read_kernel_source(mutation.file) for mutation, text in sources.items())
    assert len(set(sources.values())) == len(mutations)
    assert set(EQUIVALENT) <= {(mutation.kernel, mutation.name) for mutation in mutations}
