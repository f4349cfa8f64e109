#!/usr/bin/env python3
"""Compile every kernel for graphics cards, without one, and hold what the compilers say against recorded figures.

    python scripts/proof/check_gpu.py [--record] [--only TEXT] [--targets sm_86,tgllp] [--tools FOLDER [--fetch]]

Every variant that the self-test runs is compiled in the variant of GPUs, as follows.

- syntax: every extension switched off, as on the poorest device; no double, no warning.
- gfx90a, gfx1030, gfx1100 (AMD) and sm_86, sm_90 (NVIDIA): nothing spilled; no more stack than recorded, which is what
  arrays with indices of run time take; at most 8 registers more.  LLVM stands in for the vendors' own compilers, and
  without ptxas the stack of sm_86 is what the text for it declares.
- tgllp, dg2 (Intel): no fewer lanes and no more scratch than recorded.
- spirv: valid for OpenCL 1.2, of ALLOWED capabilities.

It needs clang and libclc of LLVM 15, which the drivers of `.ci/run` bring, and ptxas, ocloc, llvm-spirv and spirv-val.
--fetch brings these from Debian 12 and PyPI into FOLDER and registers nothing.  Figures are compared where they are of
the same version of a tool; a tool that is missing is a failure unless --targets leaves it out.  --record writes them to
tests/opencl/gpu_figures.json.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TypedDict

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
RECORD = ROOT / "tests" / "opencl" / "gpu_figures.json"

MORE_REGISTERS = 8
"""Registers that a kernel may take beyond those recorded."""

ALLOWED = {1: "Matrix", 4: "Addresses", 5: "Linkage", 6: "Kernel", 7: "Vector16", 11: "Int64", 22: "Int16", 39: "Int8"}
"""Capabilities of SPIR-V that every device has, by number (8: half_as_a_type is FP16, 10: Float64)."""

LIBCLC = Path("/usr/lib/clc")
CLANG = ("clang-15", "-x", "cl", "-nogpulib")
WARNINGS = ("-Wall", "-Wextra", "-Wno-unused-function", "-Wno-unused-parameter", "-Wno-bitwise-instead-of-logical")
ROUNDED = "-cl-fp32-correctly-rounded-divide-sqrt"

FROM_DEBIAN = (
    *("intel-opencl-icd", "libigc1", "libigdfcl1", "libigdgmm12", "libopencl-clang14", "libllvmspirvlib14"),
    *("spirv-tools", "llvm-spirv-15", "libllvmspirvlib15"),
)
FROM_PYPI = "nvidia-cuda-nvcc-cu12==12.9.86"

Figures = dict[str, dict[str, int]]
"""What a compiler says of each kernel of a file."""


class Record(TypedDict):
    """Versions of tools, and figures by target and variant."""

    tools: dict[str, str]
    figures: dict[str, dict[str, Figures]]


class CompileError(Exception):
    """A kernel file that a compiler refuses, in its words."""


class NoToolError(Exception):
    """A tool that is not there."""


@dataclass(frozen=True)
class Variant:
    """A kernel file with the macros of one of its variants."""

    file: str
    macros: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return " ".join([self.file, *self.macros])

    def options(self) -> list[str]:
        given = {"LANES": "1", "WORDS_PER_ITEM": "1", "LABEL": "uchar", **dict.fromkeys(self.macros, "1")}
        if "LEAST_VALUE" in given:
            given["LEAST_VALUE"] = "(-1000)"
        return [f"-D{macro}={value}" for macro, value in given.items()]


def find_variants() -> list[Variant]:
    """Every kernel file as it is, and with each set of macros that a check of the self-test names."""
    from clrecon.opencl.sources import kernel_files
    from clrecon.proof.run import CHECKS

    named = {Variant(file, tuple(macros)) for check in CHECKS for file, macros in check.variants.items()}
    return sorted({*map(Variant, kernel_files()), *named}, key=lambda variant: variant.name)


@dataclass(frozen=True)
class Text:
    """A text to compile, with the options of its variant and a folder for what comes of it."""

    path: Path
    options: list[str]

    @classmethod
    def write(cls, folder: Path, source: str, options: Sequence[str] = ()) -> Text:
        path = folder / "kernels.cl"
        path.write_text(source, encoding="utf-8")
        return cls(path, list(options))


# --- tools ------------------------------------------------------------------------------------------------------------

_tools_folder: list[Path] = []


@cache
def find_tool(name: str) -> str:
    """Return the path of a tool: in the folder of --tools, else of the system."""
    for folder in _tools_folder:
        for path in sorted(folder.rglob(name)):
            if os.access(path, os.X_OK) and path.is_file():
                return str(path)
    if found := shutil.which(name):
        return found
    raise NoToolError(name)


def run_tool(name: str, *arguments: str | Path) -> str:
    """Run a tool and return what it says; CompileError with its words if it fails."""
    libraries = Path(find_tool(name)).parents[1] / "lib" / "x86_64-linux-gnu"
    environment = {**os.environ, "LD_LIBRARY_PATH": str(libraries)} if _tools_folder else None
    done = subprocess.run([find_tool(name), *map(str, arguments)], capture_output=True, text=True, env=environment)
    said = done.stdout + done.stderr
    if done.returncode:
        raise CompileError(f"{name} exits with {done.returncode}: {said.strip()[:600]}")
    return said


def fetch_tools(folder: Path) -> None:
    """Bring the tools that are not part of the system into a folder, from Debian and PyPI."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["apt-get", "download", "-qq", *FROM_DEBIAN], cwd=folder, check=True)
    for package in sorted(folder.glob("*.deb")):
        subprocess.run(["dpkg", "-x", package, folder], check=True)
        package.unlink()
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", "--target", folder / "nvcc", FROM_PYPI], check=True)


VERSIONS = {"clang-15": r"clang version (\S+)", "ptxas": r"V([\d.]+)", "ocloc": r"(\S+)"}


@cache
def version_of(tool: str) -> str:
    """Return the version of a tool whose figures are recorded; of ocloc the size of its compiler, which tells none."""
    if tool == "ocloc":
        library = next(iter(Path(find_tool(tool)).parents[1].rglob("libigc.so.1.*")), Path(find_tool(tool)))
        return f"{library.name} of {library.stat().st_size} bytes"
    found = re.search(VERSIONS[tool], run_tool(tool, "--version"))
    return found[1] if found else "unknown"


# --- targets ----------------------------------------------------------------------------------------------------------


def check_syntax(text: Text) -> Figures:
    """Compile without any extension: an error or a warning is a CompileError."""
    said = run_tool(
        *CLANG, "-cl-std=CL1.2", "-fsyntax-only", *WARNINGS, "-Xclang", "-cl-ext=-all",
        "--target=spir64-unknown-unknown", *text.options, text.path,
    )  # fmt: skip
    if "warning:" in said:
        raise CompileError(said.strip()[:600])
    return {}


def compile_amd(text: Text, chip: str) -> Figures:
    made = text.path.with_suffix(f".{chip}")
    run_tool(
        *CLANG, "-cl-std=CL1.2", "-O3", ROUNDED, "--target=amdgcn-amd-amdhsa", f"-mcpu={chip}", "-S",
        "-Xclang", "-mlink-builtin-bitcode", "-Xclang", LIBCLC / "amdgcn--amdhsa.bc", "-Wno-linker-warnings",
        "-mllvm", "-amdgpu-limit-to-128-vgprs=0",  # LLVM 15 limits gfx1100, later versions do not
        *text.options, text.path, "-o", made,
    )  # fmt: skip
    figures: Figures = {}
    told = made.read_text().partition(".amdgpu_metadata")[2]
    for kernel in told.split("\n  - ")[1:]:
        # the kernel's own entries, not those of its arguments, which stand deeper
        entries = dict(re.findall(r"(?m)^(?:    )?\.(\w+): +(\S+)$", kernel))
        if "vgpr_count" in entries:
            figures[entries["name"]] = {
                "registers": int(entries["vgpr_count"]),
                "stack": int(entries["private_segment_fixed_size"]),
                "spills": int(entries["vgpr_spill_count"]),
            }
    return figures


def compile_ptx(text: Text) -> tuple[Path, Figures]:
    """Return the text for NVIDIA's assembler, and the stack that it declares; doubles in it are a CompileError."""
    made = text.path.with_suffix(".ptx")
    if not made.exists():
        run_tool(
            *CLANG, "-cl-std=CL1.2", "-O3", ROUNDED, "--target=nvptx64--nvidiacl", "-march=sm_86", "-S",
            "-Xclang", "-mlink-builtin-bitcode", "-Xclang", LIBCLC / "nvptx64--nvidiacl.bc", "-Wno-linker-warnings",
            *text.options, text.path, "-o", made,
        )  # fmt: skip
    figures: Figures = {}
    for kernel in made.read_text().split(".entry ")[1:]:
        name = kernel.partition("(")[0].strip()
        if ".f64" in kernel:
            raise CompileError(f"kernel {name} computes in double")
        depot = re.search(r"__local_depot\d+\[(\d+)\]", kernel)
        figures[name] = {"stack": int(depot[1]) if depot else 0}
    return made, figures


def compile_nvidia(text: Text, chip: str) -> Figures:
    ptx, figures = compile_ptx(text)
    try:
        said = run_tool("ptxas", "-v", f"-arch={chip}", ptx, "-o", text.path.with_suffix(".cubin"))
    except NoToolError:
        if chip != "sm_86":
            raise
        return figures
    for part in said.split("Compiling entry function '")[1:]:
        sizes = re.search(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", part)
        registers = re.search(r"Used (\d+) registers", part)
        if sizes is None or registers is None:
            raise CompileError(f"ptxas tells no registers or stack: {part[:300]}")
        figures[part.partition("'")[0]] = {
            "registers": int(registers[1]), "stack": int(sizes[1]), "spills": int(sizes[2]) + int(sizes[3])
        }  # fmt: skip
    return figures


def compile_intel(text: Text, chip: str) -> Figures:
    from clrecon.opencl.quirks import language_option

    made = text.path.parent / chip
    made.mkdir()
    language = language_option("Intel(R) OpenCL HD Graphics", "gpu", (22, 43))
    run_tool(
        "ocloc", "compile", "-q", "-file", text.path, "-device", chip, "--format", "zebin", "-out_dir", made,
        "-options", " ".join([language, *text.options]),
    )  # fmt: skip
    binary = next(made.glob("*.bin")).read_bytes()
    told = binary[binary.index(b"---\nversion:") :].partition(b"\nkernels_misc_info:")[0].decode(errors="replace")
    figures: Figures = {}
    for kernel in re.split(r"(?m)^  - name: +", told)[1:]:
        simd = re.search(r"simd_size: +(\d+)", kernel)
        buffers = kernel.partition("per_thread_memory_buffers:")[2]
        if kernel.startswith("Intel_Symbol_Table"):  # no kernel, where one calls functions
            continue
        if simd is None:
            raise CompileError(f"ocloc tells no lanes: {kernel[:300]}")
        figures[kernel.split()[0]] = {
            "lanes": int(simd[1]),
            "scratch": sum(int(size) for size in re.findall(r"(?m)^ +size: +(\d+)", buffers)),
        }
    return figures


def compile_spirv(text: Text) -> Figures:
    bitcode, made = text.path.with_suffix(".bc"), text.path.with_suffix(".spv")
    run_tool(
        *CLANG, "-cl-std=CL1.2", "-O1", "-Xclang", "-disable-llvm-passes", "--target=spir64-unknown-unknown",
        "-emit-llvm", "-c", *text.options, text.path, "-o", bitcode,
    )  # fmt: skip
    run_tool("llvm-spirv-15", "--spirv-max-version=1.0", bitcode, "-o", made)
    run_tool("spirv-val", "--target-env", "opencl1.2", made)
    if surplus := [number for number in capabilities(made.read_bytes()) if number not in ALLOWED]:
        raise CompileError(f"it needs capabilities {surplus} of SPIR-V; every device has {', '.join(ALLOWED.values())}")
    return {}


def capabilities(module: bytes) -> Iterator[int]:
    """Yield the numbers of the OpCapability instructions, which begin a module."""
    words = struct.unpack(f"<{len(module) // 4}I", module)
    at = 5
    while at < len(words) and words[at] & 0xFFFF == 17:
        yield words[at + 1]
        at += words[at] >> 16


TARGETS: dict[str, tuple[str, Callable[[Text], Figures]]] = {
    "syntax": ("", check_syntax),
    **{chip: ("clang-15", partial(compile_amd, chip=chip)) for chip in ("gfx90a", "gfx1030", "gfx1100")},
    **{chip: ("ptxas", partial(compile_nvidia, chip=chip)) for chip in ("sm_86", "sm_90")},
    **{chip: ("ocloc", partial(compile_intel, chip=chip)) for chip in ("tgllp", "dg2")},
    "spirv": ("", compile_spirv),
}
"""By name: the tool whose figures they are, empty where none are recorded, and what compiles for it."""


# --- the check --------------------------------------------------------------------------------------------------------


def compare(figures: Figures, recorded: Figures | None) -> list[str]:
    """Return what is wrong with figures: anything spilled, and what grew; without a record only the first."""
    wrong = []
    for kernel, told in figures.items():
        if told.get("spills"):
            wrong.append(f"{kernel} spills {told['spills']} bytes or registers")
        if recorded is None:
            continue
        before = recorded.get(kernel)
        if before is None:
            wrong.append(f"{kernel} is not recorded")
            continue
        for what, slack, sign in (
            ("stack", 0, 1), ("scratch", 0, 1), ("registers", MORE_REGISTERS, 1), ("lanes", 0, -1)
        ):  # fmt: skip
            if what in told and what in before and sign * (told[what] - before[what]) > slack:
                wrong.append(f"{kernel} has {told[what]} {what}, recorded are {before[what]}")
    gone = [] if recorded is None else sorted(recorded.keys() - figures.keys())
    return [*wrong, *(f"{kernel} is recorded and not there" for kernel in gone)]


def read_record() -> Record:
    record: Record = json.loads(RECORD.read_text()) if RECORD.exists() else {"tools": {}, "figures": {}}
    return record


def check_variant(variant: Variant, target: str, folder: Path) -> Figures:
    """Compile a variant for a target."""
    from clrecon.opencl.sources import read_kernel_source

    with tempfile.TemporaryDirectory(dir=folder) as made:
        text = Text.write(Path(made), read_kernel_source(variant.file), variant.options())
        return TARGETS[target][1](text)


def is_recorded(record: Record, target: str) -> bool:
    """True where the figures of a target are those of the tool that is here."""
    tool = TARGETS[target][0]
    return bool(tool) and record["tools"].get(tool) == version_of(tool)


def run_targets(variants: Sequence[Variant], targets: Sequence[str], record: Record) -> tuple[list[str], Record]:
    """Compile variants for targets; return what is wrong, and what was found as a record."""
    wrong: list[str] = []
    found: Record = {"tools": {}, "figures": {}}
    for target in targets:
        tool = TARGETS[target][0]
        try:
            known = is_recorded(record, target)
            if tool:
                found["tools"][tool] = version_of(tool)
                if not known:
                    print(f"{target}: {tool} is {version_of(tool)}, recorded is {record['tools'].get(tool)}")
            with tempfile.TemporaryDirectory(prefix="clrecon-gpu-") as folder:
                for variant in variants:
                    try:
                        figures = check_variant(variant, target, Path(folder))
                    except CompileError as error:
                        wrong.append(f"{target}: {variant.name}: {error}")
                        continue
                    before = record["figures"].get(target, {}).get(variant.name, {}) if known and tool else None
                    wrong += [f"{target}: {variant.name}: {text}" for text in compare(figures, before)]
                    if tool:
                        found["figures"].setdefault(target, {})[variant.name] = figures
        except NoToolError as error:
            wrong.append(f"{target}: {error} is not installed: --tools FOLDER --fetch brings it")
    return wrong, found


def write_record(found: Record, record: Record, whole: bool) -> None:
    """Write what was found into the record; with `whole` what is no longer there is left out."""
    record["tools"] |= found["tools"]
    for target, variants in found["figures"].items():
        record["figures"][target] = variants if whole else record["figures"].get(target, {}) | variants
    lines = []
    for target, variants in sorted(record["figures"].items()):
        rows = [f"   {json.dumps(name)}: {json.dumps(variants[name], sort_keys=True)}" for name in sorted(variants)]
        lines.append(f"  {json.dumps(target)}: {{\n" + ",\n".join(rows) + "\n  }")
    tools = json.dumps(record["tools"], sort_keys=True)
    RECORD.write_text(f'{{\n "tools": {tools},\n "figures": {{\n' + ",\n".join(lines) + "\n }\n}\n")


def list_worst(found: Record) -> Iterator[str]:
    """Yield the kernels with a stack, or with few lanes, most first."""
    for target, variants in found["figures"].items():
        rows = {(kernel, variant): told for variant, figures in variants.items() for kernel, told in figures.items()}
        stacks = {row: told.get("stack", told.get("scratch", 0)) for row, told in rows.items()}
        for (kernel, variant), size in sorted(stacks.items(), key=lambda item: -item[1]):
            if size:
                figures = ", ".join(f"{what} {number}" for what, number in rows[kernel, variant].items())
                yield f"{target}: {kernel} ({variant}): {figures}"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--record", action="store_true", help="write the figures in place of those recorded")
    parser.add_argument("--only", default="", metavar="TEXT", help="variants with this in their names")
    parser.add_argument("--targets", default=",".join(TARGETS), help=f"some of {','.join(TARGETS)}")
    parser.add_argument("--tools", type=Path, metavar="FOLDER", help="where tools are looked for first")
    parser.add_argument("--fetch", action="store_true", help="bring missing tools into the folder of --tools")
    parser.add_argument("--list", action="store_true", help="print the kernels with arrays in memory")
    options = parser.parse_args(argv)
    targets = options.targets.split(",")
    if unknown := [target for target in targets if target not in TARGETS]:
        parser.error(f"no target {unknown[0]!r}: there are {', '.join(TARGETS)}")
    if options.fetch and options.tools is None:
        parser.error("--fetch needs --tools FOLDER")
    if options.tools is not None:
        _tools_folder[:] = [options.tools.resolve()]
        if options.fetch and not list(options.tools.rglob("ptxas")):
            fetch_tools(options.tools.resolve())
    variants = [variant for variant in find_variants() if options.only in variant.name]
    record = read_record()
    wrong, found = run_targets(variants, targets, {"tools": {}, "figures": {}} if options.record else record)
    if options.list:
        print(*list_worst(found), sep="\n")
    print(*wrong, sep="\n", file=sys.stderr)
    if options.record:
        write_record(found, record, whole=not options.only)
    print(f"{len(variants)} variants for {', '.join(targets)}: {len(wrong)} faults")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
