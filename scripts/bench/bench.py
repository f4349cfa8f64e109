#!/usr/bin/env python3
"""Run a bench and print its figures; with --json keep them.

Needs the extra `bench` (SimpleITK; VTK comes with pyvista): pip install '.[bench]'.
Machines are noisy: read the ratio, and the spread beside it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from cases import CASES  # noqa: E402
from measure import describe_machine, write_json  # noqa: E402


def _show(name: str, value: object, depth: int = 0) -> None:
    indent = "  " * depth
    if isinstance(value, dict):
        print(f"{indent}{name}")
        for key, inner in value.items():
            _show(key, inner, depth + 1)
    elif isinstance(value, float):
        print(f"{indent}{name:<24}{value:.4g}")
    else:
        print(f"{indent}{name:<24}{value}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=sorted(CASES), help="what to measure")
    parser.add_argument("--input", type=Path, help="CT folder (default: a spine phantom of 512 x 512 x 149)")
    parser.add_argument("--hu", type=float, default=226.0, help="iso value in HU (default 226)")
    parser.add_argument("--pairs", type=int, default=7, help="timed pairs of clrecon and peer (default 7)")
    parser.add_argument("--device", help="as in `clrecon devices`")
    parser.add_argument("--json", type=Path, help="keep the result in this file")
    arguments = parser.parse_args()
    result = {
        "case": arguments.case,
        "machine": describe_machine(),
        **CASES[arguments.case](arguments.input, arguments.hu, arguments.pairs, arguments.device),
    }
    for name, value in result.items():
        _show(name, value)
    if arguments.json:
        write_json(arguments.json, result)


if __name__ == "__main__":
    main()
