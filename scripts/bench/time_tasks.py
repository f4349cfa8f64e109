#!/usr/bin/env python3
"""Lines and seconds of the tasks of docs/tasks.md, in clrecon and in SimpleITK with VTK.

    python scripts/bench/time_tasks.py [--levels T11-L5] [--size 192]

The blocks run in order, twice, on a phantom in a folder of their own; seconds are wall time of the second run, in which
kernels are built already.  Blocks that need a package that is not installed are left out, and said.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tasks.md"
FOUND = re.compile(r"^## (.*?)$|^(With SimpleITK)|^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)

Task = tuple[str, bool]
"""A heading, and whether a block is clrecon's."""


def read_blocks(text: str) -> list[tuple[Task, str]]:
    """Return the blocks of Python; after the words "With SimpleITK" they are those of others."""
    heading, ours, blocks = "", True, []
    for found in FOUND.finditer(text):
        if found[3]:
            blocks.append(((heading, ours), found[3]))
        else:
            heading, ours = found[1] or heading, not found[2]
    return blocks


def count_lines(block: str) -> int:
    """Lines that are no imports, no comments and not empty."""
    return sum(bool(re.match(r"\s*(?!#|import |from )\S", line)) for line in block.splitlines())


def run_blocks(blocks: list[tuple[Task, str]]) -> dict[Task, float | str]:
    """Return the seconds of each task, or what is not installed."""
    taken: dict[Task, float | str] = {}
    space: dict[str, Any] = {"__name__": "tasks"}
    for task, block in blocks:
        started, before = time.perf_counter(), taken.get(task, 0.0)
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(block, "docs/tasks.md", "exec"), space)
            taken[task] = before if isinstance(before, str) else before + time.perf_counter() - started
        except ModuleNotFoundError as error:
            taken[task] = f"no {error.name}"
    return taken


def main() -> None:
    from clrecon.proof.phantom import PhantomSettings, write_phantom

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", default="T11-L5")
    parser.add_argument("--size", type=int, default=192)
    options = parser.parse_args()
    blocks = read_blocks(PAGE.read_text(encoding="utf-8"))
    lines: dict[Task, int] = defaultdict(int)
    for task, block in blocks:
        lines[task] += count_lines(block)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        step = 180.0 / options.size
        settings = PhantomSettings(levels=options.levels, size=(options.size,) * 2, spacing=(step, step, 1.5))
        write_phantom("CT_FOLDER", settings)
        Path("spine.nrrd").write_bytes(Path("CT_FOLDER/levels.nrrd").read_bytes())
        renamed = [(task, block.replace("spine.nii.gz", "spine.nrrd")) for task, block in blocks]
        run_blocks(renamed)
        taken = run_blocks(renamed)
        os.chdir("/")
    for heading in dict.fromkeys(heading for (heading, _), _ in blocks if heading):
        cells = []
        for ours in (True, False):
            seconds = taken.get((heading, ours), "-")
            said = f"{seconds:.2f}" if isinstance(seconds, float) else seconds
            cells += [str(lines[heading, ours] or "-"), said]
        print(f"| {heading} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
