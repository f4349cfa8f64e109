"""Broken kernels: four of them, others with each commit, and what the script says of those that nobody notices."""

from __future__ import annotations

import hashlib
import random
import subprocess
import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest

from clrecon.opencl import Device, kernel_files, read_kernel_source

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts" / "proof"))

from kernel_mutations import EQUIVALENT, all_mutations  # noqa: E402
from mutate_kernels import judge, key_of, report, run_mutations  # noqa: E402

DRAWN = 2


def commit() -> str:
    """The number of the commit; without git a hash of the kernels."""
    try:
        asked = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
        return asked.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return hashlib.sha256("".join(read_kernel_source(file) for file in kernel_files()).encode()).hexdigest()


@pytest.mark.slow
@pytest.mark.fault_row(57)
def test_broken_kernels_are_noticed(device: Device) -> None:
    drawn = random.Random(commit()).sample([m for m in all_mutations() if not m.reason], DRAWN)
    outcomes = {mutation: judge(mutation, result) for mutation, result in run_mutations(drawn, device.index)}
    assert outcomes == dict.fromkeys(drawn, "caught")


@pytest.mark.fault_row(57)
def test_what_is_not_noticed_is_told(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """With results that are known already nothing is run."""
    noticed, survivor, unbuilt = [mutation for mutation in all_mutations() if not mutation.reason][:3]
    same, wrongly_named = [mutation for mutation in all_mutations() if mutation.reason][:2]
    results: dict[Any, bool | None] = {noticed: True, survivor: False, unbuilt: None, same: False, wrongly_named: True}
    known = {key_of(m): {"caught": caught, "by": "compact", "words": "why"} for m, caught in results.items()}
    options = Namespace(results=None, seconds=0.0, device="0")
    assert report(list(results), known, options) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == ["caught", "SURVIVED", "BROKEN", "equivalent", "CAUGHT"]
    assert EQUIVALENT[same.kernel, same.name] in lines[3] and "compact: why" in lines[1]
    assert lines[-1].startswith("5 of 5 mutations run, 3 not as they should be")
    assert report([noticed, same], known, options) == 0
