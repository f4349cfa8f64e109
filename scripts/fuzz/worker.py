"""A worker: reads lines of a family and a number on stdin, and answers each with one line of JSON on stdout."""

from __future__ import annotations

import json
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(Path(__file__).parent), str(ROOT / "tests" / "support")]

from clouds import clouds_trial  # noqa: E402
from commands import environment_trial, options_trial  # noqa: E402
from grids import labels_trial, volumes_trial  # noqa: E402
from slices import bytes_trial, ends_trial, values_trial  # noqa: E402
from trials import Judge, Outcome, Trial  # noqa: E402

FAMILIES: dict[str, Callable[[int, Path, random.Random], Trial]] = {
    "values": values_trial,
    "bytes": bytes_trial,
    "ends": ends_trial,
    "volumes": volumes_trial,
    "labels": labels_trial,
    "clouds": clouds_trial,
    "options": options_trial,
    "environment": environment_trial,
}


def run_case(judge: Judge, family: str, number: int, seed: str) -> Outcome:
    """Run one case; it depends on its family, number and seed alone."""
    folder = Path(tempfile.mkdtemp(prefix="clrecon-fuzz-"))
    try:
        trial = FAMILIES[family](number, folder, random.Random(f"{seed} {family} {number}"))
        return judge.judge(trial)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    judge = Judge()
    for line in sys.stdin:
        family, number, seed = line.split()
        outcome = run_case(judge, family, int(number), seed)
        print(json.dumps(outcome.as_dict()), file=answers, flush=True)


if __name__ == "__main__":
    main()
