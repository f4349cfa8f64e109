"""scripts/proof/check_gpu.py: what graphics cards' compilers make of the kernels, and that the check can fail.

The compilers of LLVM are there with the drivers of `.ci/run`; a tool that is not skips its tests, unless
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
    try:
        return check_gpu.TARGETS[target][1](text)
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


@pytest.mark.parametrize("target", ["gfx1030", "sm_86"])
def test_an_array_with_indices_of_run_time_raises_the_stack(tmp_path: Path, target: str) -> None:
    before = compile_for(target, Text.write(tmp_path, PLAIN.replace("STATEMENT", COPY)))
    (tmp_path / "more").mkdir()
    after = compile_for(target, Text.write(tmp_path / "more", PLAIN.replace("STATEMENT", INDEXED)))
    assert check_gpu.compare(before, before) == []
    assert any("stack, recorded are 0" in fault for fault in check_gpu.compare(after, before))


def test_three_hundred_living_numbers_spill(tmp_path: Path) -> None:
    figures = compile_for("gfx1030", Text.write(tmp_path, PLAIN.replace("STATEMENT", many_values(300))))
    assert any("run spills" in fault for fault in check_gpu.compare(figures, None))


@pytest.mark.parametrize(
    ("statement", "fault"),
    [("out[0] = (float)((double)in[0] / 3.0);", "double"), ("int unused; out[0] = in[0];", "unused variable")],
)
def test_a_double_and_a_warning_are_faults(tmp_path: Path, statement: str, fault: str) -> None:
    with pytest.raises(CompileError, match=fault):
        compile_for("syntax", Text.write(tmp_path, PLAIN.replace("STATEMENT", statement)))


def test_figures_that_grew_are_faults() -> None:
    recorded = {"run": {"registers": 40, "stack": 0, "spills": 0}, "walk": {"lanes": 16, "scratch": 0}}
    same = {"run": {"registers": 48, "stack": 0, "spills": 0}, "walk": {"lanes": 32, "scratch": 0}}
    assert check_gpu.compare(same, recorded) == []
    worse = {"run": {"registers": 49, "stack": 0, "spills": 0}, "walk": {"lanes": 8, "scratch": 64}}
    assert check_gpu.compare(worse, recorded) == [
        "run has 49 registers, recorded are 40",
        "walk has 64 scratch, recorded are 0",
        "walk has 8 lanes, recorded are 16",
    ]
    assert check_gpu.compare({"other": {"stack": 0}}, recorded) == [
        "other is not recorded", "run is recorded and not there", "walk is recorded and not there"
    ]  # fmt: skip


def test_a_missing_tool_and_a_kernel_that_does_not_build_are_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(text: Text) -> check_gpu.Figures:
        raise CompileError("no such word")

    def miss(text: Text) -> check_gpu.Figures:
        raise NoToolError("ptxas")

    for target, compile_text in {"syntax": refuse, "spirv": miss}.items():
        monkeypatch.setitem(check_gpu.TARGETS, target, ("", compile_text))
    assert check_gpu.main(["--only", "primitives/scan.cl", "--targets", "syntax,spirv"]) == 1
    said = capsys.readouterr()
    assert "syntax: primitives/scan.cl: no such word" in said.err
    assert "spirv: ptxas is not installed" in said.err and said.out.endswith("2 faults\n")


def test_every_kernel_of_every_variant_is_recorded() -> None:
    kernels = set()
    for variant in check_gpu.find_variants():
        named = find_signatures(read_kernel_source(variant.file), definitions_of(tuple(variant.options())))
        kernels |= {(variant.name, kernel) for kernel in named}
    assert {kernel for _, kernel in kernels} == set(find_kernels())
    for target, variants in check_gpu.read_record()["figures"].items():
        recorded = {(variant, kernel) for variant, figures in variants.items() for kernel in figures}
        assert recorded == kernels, f"{target}: scripts/proof/check_gpu.py --record --only FILE"


def test_no_kernel_keeps_an_array_in_memory() -> None:
    """But for the results of a function that one calls four times, which makers' compilers put in its place."""
    figures = check_gpu.read_record()["figures"]
    for target in ("gfx90a", "gfx1030", "gfx1100", "sm_86", "sm_90"):
        kernels = [kernel for variant in figures[target].values() for kernel in variant.items()]
        assert len(kernels) > 100
        assert {name for name, told in kernels if told["stack"] or told["spills"]} <= {"fit_profiles"}


SAMPLE = [Variant("surface/marching_cubes.cl"), Variant("surface/cells.cl"), Variant("rays/surface.cl", ("UNEVEN",))]
"""Those that had most in memory."""


@pytest.mark.parametrize("variant", SAMPLE, ids=lambda variant: variant.name)
@pytest.mark.parametrize("target", ["gfx1030", "sm_86"])
def test_the_largest_kernels_keep_to_their_record(tmp_path: Path, target: str, variant: Variant) -> None:
    text = Text.write(tmp_path, read_kernel_source(variant.file), variant.options())
    record = check_gpu.read_record()
    recorded = record["figures"][target][variant.name]
    try:
        figures = compile_for(target, text)
        known = check_gpu.is_recorded(record, target)
    except NoToolError:
        known = True  # the stack that clang declares
    assert check_gpu.compare(figures, recorded if known else None) == []


def test_all_kernels_build_without_extensions(tmp_path: Path) -> None:
    """Their variants do too, before a release."""
    files = kernel_files()
    for file in files:
        compile_for("syntax", Text.write(tmp_path, read_kernel_source(file), Variant(file).options()))
    assert len(files) > 40
