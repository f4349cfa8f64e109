"""scripts/proof/check_gpu.py: registers, stack and spills of the kernels by the compilers for graphics cards.

The compilers of LLVM are installed with the drivers of `.ci/run`; the tests of a missing tool are skipped, unless
CLRECON_REQUIRE_GPU_TOOLS=1.  All kernels for all targets are compiled before a release."""

from __future__ import annotations

import os
from pathlib import Path

import check_gpu
import pytest
from check_gpu import CompileError, NoToolError, Text, Variant
from kernel_mutations import find_kernels

from clrecon.opencl.sources import definitions_of, find_signatures, kernel_files, read_kernel_source

PLAIN = "__kernel void run(__global const float *in, __global float *out) { STATEMENT }"
INDEXED = (
    "float a[64]; const uint n = get_global_id(0); for (uint i = 0; i < 64; ++i) a[i] = in[n + 64 * i];"
    " for (uint i = 0; i < 64; ++i) a[(uint)in[i] & 63] += a[i]; out[n] = a[(uint)in[n] & 63];"
)
COPY = "out[get_global_id(0)] = in[get_global_id(0)];"


def compile_for(target: str, text: Text) -> check_gpu.Figures:
    """The figures of kernels by their names; skips where the compiler of a target is not installed."""
    _, compile_text = check_gpu.TARGETS[target]
    try:
        return compile_text(text)
    except NoToolError as error:
        if os.environ.get("CLRECON_REQUIRE_GPU_TOOLS"):
            raise
        pytest.skip(f"{error} is not installed")


def many_values(count: int) -> str:
    """Statements with `count` floats that are all needed at the end."""
    lines = [f"float v{n} = in[i + {n} * s];" for n in range(count)]
    sums = [f"v{n} = v{n} * v{(n * 7 + 1) % count} + v{(n + 1) % count};" for n in range(count)]
    outs = [f"out[i + {n} * s] = v{n};" for n in range(count)]
    turns = "for (uint k = 0; k < s; ++k) {" + " ".join(sums) + "}"
    return " ".join(["const uint i = get_global_id(0), s = (uint)in[0];", *lines, turns, *outs])


def compile_kernel(target: str, statement: str, folder: Path) -> check_gpu.Figures:
    """Compile a kernel `run` of one statement, which has the arrays `in` and `out`."""
    folder.mkdir(exist_ok=True)
    return compile_for(target, Text.write(folder, PLAIN.replace("STATEMENT", statement)))


@pytest.mark.parametrize("target", ["gfx1030", "sm_86"])
def test_array_with_indices_known_at_run_time_alone_raises_the_stack_above_its_record(
    tmp_path: Path, target: str
) -> None:
    recorded = compile_kernel(target, COPY, tmp_path / "copy")
    figures = compile_kernel(target, INDEXED, tmp_path / "indexed")
    assert any("stack, recorded are 0" in fault for fault in check_gpu.compare(figures, recorded))


def test_more_numbers_at_once_than_registers_are_found_to_spill(tmp_path: Path) -> None:
    registers_of_gfx1030, more = 256, 44
    figures = compile_kernel("gfx1030", many_values(registers_of_gfx1030 + more), tmp_path)
    assert any("run spills" in fault for fault in check_gpu.compare(figures, recorded=None))


@pytest.mark.parametrize(
    ("statement", "fault"),
    [("out[0] = (float)((double)in[0] / 3.0);", "double"), ("int unused; out[0] = in[0];", "unused variable")],
)
def test_kernel_with_double_precision_or_a_warning_is_not_compiled(tmp_path: Path, statement: str, fault: str) -> None:
    with pytest.raises(CompileError, match=fault):
        compile_kernel("syntax", statement, tmp_path)


RECORDED = {"run": {"registers": 40, "stack": 0, "spills": 0}, "walk": {"lanes": 16, "scratch": 0}}


@pytest.mark.parametrize(
    ("kernel", "figures", "faults"),
    [
        pytest.param("run", {"registers": 48}, [], id="8 more registers: a compiler's newer version"),
        pytest.param("run", {"registers": 49}, ["run has 49 registers, recorded are 40"], id="9 more registers"),
        pytest.param("walk", {"lanes": 32}, [], id="more lanes"),
        pytest.param("walk", {"lanes": 8}, ["walk has 8 lanes, recorded are 16"], id="fewer lanes"),
        pytest.param("walk", {"scratch": 64}, ["walk has 64 scratch, recorded are 0"], id="scratch memory"),
    ],
)
def test_figure_of_a_kernel_that_is_worse_than_its_record_is_a_fault(
    kernel: str, figures: dict[str, int], faults: list[str]
) -> None:
    found = {**RECORDED, kernel: {**RECORDED[kernel], **figures}}
    assert check_gpu.compare(found, RECORDED) == faults


def test_kernels_of_the_source_or_the_record_alone_are_faults() -> None:
    assert check_gpu.compare({"other": {"stack": 0}}, RECORDED) == [
        "other is not recorded", "run is recorded and not there", "walk is recorded and not there"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (CompileError("no such word"), "syntax: primitives/scan.cl: no such word"),
        (NoToolError("ptxas"), "syntax: ptxas is not installed"),
    ],
    ids=["compile error", "missing tool"],
)
def test_kernel_that_does_not_compile_and_missing_tool_are_printed_as_faults(
    error: Exception, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(text: Text) -> check_gpu.Figures:
        raise error

    monkeypatch.setitem(check_gpu.TARGETS, "syntax", ("", fail))
    assert check_gpu.main(["--only", "primitives/scan.cl", "--targets", "syntax"]) == 1
    output = capsys.readouterr()
    assert line in output.err
    assert output.out.endswith("1 faults\n")


@pytest.fixture(scope="module")
def variants_and_kernels() -> set[tuple[str, str]]:
    """The name of each variant of a kernel file with that of each of its kernels."""
    return {
        (variant.name, kernel)
        for variant in check_gpu.find_variants()
        for kernel in find_signatures(read_kernel_source(variant.file), definitions_of(tuple(variant.options())))
    }


def test_variants_that_are_compiled_have_every_kernel(variants_and_kernels: set[tuple[str, str]]) -> None:
    assert {kernel for _, kernel in variants_and_kernels} == set(find_kernels())


FIGURES = check_gpu.read_record()["figures"]


@pytest.mark.parametrize("target", FIGURES)
def test_every_kernel_of_every_variant_is_recorded_for_a_target(
    target: str, variants_and_kernels: set[tuple[str, str]]
) -> None:
    recorded = {(variant, kernel) for variant, figures in FIGURES[target].items() for kernel in figures}
    assert recorded == variants_and_kernels, "scripts/proof/check_gpu.py --record --only FILE"


CARDS = ["gfx90a", "gfx1030", "gfx1100", "sm_86", "sm_90"]

WITH_A_STACK = {"fit_profiles", "collapse_edges", "find_near_faces"}
"""fit_profiles calls a function four times, whose results the compilers of card makers put in its place; the kernels of
decimation walk over lists of faces and over pieces that wait.
"""


@pytest.mark.parametrize("target", CARDS)
def test_kernels_with_a_stack_on_record_are_the_known_ones(target: str) -> None:
    kernels = [kernel for variant in FIGURES[target].values() for kernel in variant.items()]

    assert len(kernels) > 100  # the record has 192 of each target; of an empty one nothing would be looked at
    assert {name for name, figures in kernels if figures["stack"]} <= WITH_A_STACK


@pytest.mark.parametrize("target", CARDS)
def test_no_kernel_but_fit_profiles_spills_on_record(target: str) -> None:
    kernels = [kernel for variant in FIGURES[target].values() for kernel in variant.items()]

    assert len(kernels) > 100  # the record has 192 of each target; of an empty one nothing would be looked at
    assert {name for name, figures in kernels if figures["spills"]} <= {"fit_profiles"}


SAMPLE = [Variant("surface/marching_cubes.cl"), Variant("surface/cells.cl"), Variant("rays/surface.cl", ("UNEVEN",))]
"""Those that had most in memory."""


@pytest.mark.parametrize("variant", SAMPLE, ids=lambda variant: variant.name)
@pytest.mark.parametrize("target", ["gfx1030", "sm_86"])
def test_compiled_figures_of_the_largest_kernels_are_no_worse_than_their_record(
    tmp_path: Path, target: str, variant: Variant
) -> None:
    text = Text.write(tmp_path, read_kernel_source(variant.file), variant.options())
    record = check_gpu.read_record()
    recorded = record["figures"][target][variant.name]
    try:
        figures = compile_for(target, text)
        known = check_gpu.is_recorded(record, target)
    except NoToolError:
        known = True  # the stack that clang declares
    assert check_gpu.compare(figures, recorded if known else None) == []


@pytest.mark.parametrize("file", kernel_files())
def test_kernel_file_compiles_without_extensions_of_opencl(file: str, tmp_path: Path) -> None:
    """Their variants do too, before a release."""
    text = Text.write(tmp_path, read_kernel_source(file), Variant(file).options())
    assert compile_for("syntax", text) == {}
