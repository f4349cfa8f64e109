#!/usr/bin/env python3
"""Figures of the house: how long, in how many files, and how many of them one command goes through.

    python scripts/proof/house_figures.py [--json FILE] [--static]

The guard in tests/guards/test_grain.py holds the figures of `count_grain` against ceilings that only fall.  Without
--static a mesh of a small phantom is made as well, and the modules and frames on its way to a kernel are counted.
"""

from __future__ import annotations

import argparse
import ast
import gc
import json
import statistics
import subprocess
import sys
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "clrecon"
SMALL_LINES = 120
"""A module below this needs two readers."""

WALK = """
import json, sys
from pathlib import Path
files, depth = set(), []
package = sys.argv[1]

def watch(frame, event, argument):
    name = frame.f_code.co_filename
    if event != "call" or not name.startswith(package) or frame.f_code.co_name == "<module>":
        return
    files.add(name)
    if frame.f_code.co_name == "launch" and frame.f_locals["kernel"].name == "emit_vertices":
        stack, at = [], frame
        while at:
            if at.f_code.co_filename.startswith(package):
                stack.append(at.f_code.co_filename)
            at = at.f_back
        depth.append((len(stack), len(set(stack))))

from clrecon.cli.main import main
main([*sys.argv[3:5], "-o", sys.argv[2] + "/warm.stl"])
sys.setprofile(watch)
main([*sys.argv[3:5], "-o", sys.argv[2] + "/bone.stl"])
sys.setprofile(None)
modules = [name for name in sys.modules if name.split(".")[0] == "clrecon"]
frames, frame_files = max(depth)
print(json.dumps({"imported": len(modules), "visited": len(files), "frames": frames, "frame_files": frame_files}))
"""


COUNTED = (ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Call)


def _modules() -> dict[str, tuple[str, list[ast.AST]]]:
    """Texts of the modules by name, each with its nodes that something is counted of."""
    found: dict[str, tuple[str, list[ast.AST]]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        text = path.read_text(encoding="utf-8")
        found[name] = (text, [node for node in ast.walk(ast.parse(text)) if isinstance(node, COUNTED)])
    return found


def _readers(modules: dict[str, tuple[str, list[ast.AST]]]) -> dict[str, set[str]]:
    readers: dict[str, set[str]] = {name: set() for name in modules}
    for name, (_, nodes) in modules.items():
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    source = full if (full := f"{node.module}.{alias.name}") in modules else node.module
                    if source in readers:
                        readers[source].add(name)
    return readers


def _docstrings(nodes: list[ast.AST]) -> list[str]:
    kinds = (ast.FunctionDef, ast.ClassDef)
    return [text for node in nodes if isinstance(node, kinds) and (text := ast.get_docstring(node, clean=False))]


def _option_places(modules: dict[str, tuple[str, list[ast.AST]]]) -> Counter[str]:
    """Count in how many files each option of the command line is declared, by ``add_argument`` or as a field.

    A flag that is something else in another command counts too: ``--window`` of a picture is HU, of a view a face.
    """
    places: set[tuple[str, str]] = set()
    for name, (_, nodes) in modules.items():
        for node in nodes:
            called = getattr(node, "func", None)
            if getattr(called, "attr", "") == "add_argument" or getattr(called, "id", "").endswith("option"):
                texts = [getattr(word, "values", [word])[0] for word in getattr(node, "args", ())]
                words = [str(text.value).split() for text in texts if isinstance(text, ast.Constant)]
                places |= {(flag, name) for flag, *_ in filter(None, words) if flag.startswith("--")}
    return Counter(flag for flag, _ in places)


@cache
def count_grain() -> dict[str, int]:
    """Return what can be counted without running anything."""
    gc.disable()  # a search among the nodes of all trees takes longer than to parse them
    modules = _modules()
    gc.enable()
    readers = _readers(modules)
    lines = {name: text.count("\n") for name, (text, _) in modules.items()}
    inner = [name for name in modules if (PACKAGE.parent / Path(*name.split("."))).with_suffix(".py").exists()]
    functions = [node for _, nodes in modules.values() for node in nodes if isinstance(node, ast.FunctionDef)]
    texts = [text for _, nodes in modules.values() for text in _docstrings(nodes)]
    return {
        "lines": sum(lines.values()),
        "modules": len(modules),
        "median_lines": int(statistics.median(lines[name] for name in inner)),
        "longest_lines": max(lines.values()),
        "functions": len(functions),
        "small_modules_with_one_reader": sum(lines[name] < SMALL_LINES and len(readers[name]) == 1 for name in inner),
        "docstring_lines": sum(text.count("\n") + 1 for text in texts),
        "docstrings_with_raises": sum("\n    Raises\n" in text or "\n        Raises\n" in text for text in texts),
        "options_in_several_files": sum(number > 1 for number in _option_places(modules).values()),
        "modules_with_own_all": sum("\n__all__ = " in modules[name][0] for name in inner),
    }


def count_walk() -> dict[str, int]:
    """Return the modules that ``clrecon mesh`` goes through, and the frames from `main` to the kernel of vertices."""
    with tempfile.TemporaryDirectory() as folder:
        scan = str(Path(folder, "scan"))
        size = ["--size", "96x96", "--slices", "40", "--spacing", "2", "2", "2.5"]
        subprocess.run([sys.executable, "-m", "clrecon", "phantom", scan, *size], check=True, cwd=ROOT)
        command = [sys.executable, "-c", WALK, str(PACKAGE), folder, "mesh", scan]
        done = subprocess.run(command, check=True, cwd=ROOT, capture_output=True, text=True)
    found: dict[str, int] = json.loads(done.stdout.splitlines()[-1])
    return {f"mesh_{name}": value for name, value in found.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")
    parser.add_argument("--static", action="store_true", help="only what can be counted without a run")
    options = parser.parse_args()
    figures: dict[str, Any] = count_grain() | ({} if options.static else count_walk())
    for name, value in figures.items():
        print(f"{name:32} {value:>8,}")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
