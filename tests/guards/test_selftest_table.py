"""Every kernel and every variant has a check of the self-test, and mutations that the checks must notice."""

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

from kernel_mutations import EQUIVALENT, INVERSIONS, Mutation, all_mutations, find_kernels  # noqa: E402

OF_TYPES = {"VOXEL", "VALUE", "LABEL", "VOXEL_IS_SHORT"}
OF_DEVICES = {"LANES", "WORDS_PER_ITEM", "HAS_BUILTIN_PREFETCH", "SCAN_GROUP", "NO_WINDOWS", "CPU_NAME", "ATOMIC_LOADS"}
OF_DEVICES |= {"HAS_WIDE_LANES", "TAKES_WIDE_LANES"}  # the second is defined by files that ask for the first
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


def test_macros_of_variants_are_read_from_the_kernels() -> None:
    assert set().union(*SWITCHES.values()) == {
        "BETWEEN", "BORDER_INSIDE", "CUBIC", "GOLDEN", "GOLDEN_SEARCH", "GRADIENT_OPACITY", "GROWN", "LABELS",
        "LEAST_VALUE", "MASKS", "OPENNESS", "RANGE", "TAKES_PARTS", "UNEVEN",
    }  # fmt: skip


@pytest.mark.parametrize(("file", "macro"), NEVER_BUILT)
def test_macro_that_no_operator_gives_to_a_file_is_one_that_the_file_asks_for(file: str, macro: str) -> None:
    assert macro in find_switches(read_kernel_source(file))


def test_checks_have_different_names() -> None:
    names = [check.name for check in CHECKS]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("kernel", ["trace_surface", "sum_blocks"])
@pytest.mark.fault_row(57)
def test_kernel_without_a_check_is_found(kernel: str) -> None:
    kernels = find_kernels()
    others = tuple(check for check in CHECKS if kernel not in check.kernels)
    assert f"kernel {kernel} of cl/{kernels[kernel]} has no check" in find_gaps(others, kernels, SWITCHES)


@pytest.mark.fault_row(57)
def test_check_of_a_kernel_that_does_not_exist_is_found() -> None:
    without = {name: file for name, file in find_kernels().items() if name != "sum_blocks"}
    assert find_gaps(CHECKS, without, SWITCHES) == ["there is no kernel sum_blocks"]


@pytest.mark.fault_row(57)
def test_variant_of_a_kernel_file_without_a_check_is_found() -> None:
    more = {**SWITCHES, "rays/slices.cl": {"BETWEEN", "UPSIDE_DOWN"}}
    assert find_gaps(CHECKS, find_kernels(), more) == ["cl/rays/slices.cl has no check with -D UPSIDE_DOWN"]


@pytest.fixture(scope="module")
def mutated_sources() -> dict[Mutation, str]:
    """The source of each mutation; its text is found in the kernel file, or this raises an error."""
    return {mutation: mutation.source() for mutation in all_mutations()}


@pytest.mark.fault_row(57)
def test_every_kernel_has_mutations_of_its_results_and_three_in_the_mean() -> None:
    kernels = find_kernels()
    assert set(INVERSIONS) == set(kernels)
    assert all(INVERSIONS.values())
    assert len(all_mutations()) >= 3 * len(kernels)


@pytest.mark.fault_row(57)
def test_every_mutation_changes_the_source_of_its_kernel_in_its_own_way(mutated_sources: dict[Mutation, str]) -> None:
    unchanged = [mutation for mutation, text in mutated_sources.items() if text == read_kernel_source(mutation.file)]
    assert unchanged == []
    assert len(set(mutated_sources.values())) == len(mutated_sources)


def test_mutations_listed_as_equivalent_exist(mutated_sources: dict[Mutation, str]) -> None:
    assert set(EQUIVALENT) <= {(mutation.kernel, mutation.name) for mutation in mutated_sources}
