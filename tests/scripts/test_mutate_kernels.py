"""Mutated kernels: two of them, others with each commit, and what the script says of those that no check notices."""

from __future__ import annotations

import hashlib
import random
import subprocess
import sys
from argparse import Namespace
from dataclasses import dataclass
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
def test_mutated_kernels_drawn_by_the_commit_are_noticed_by_the_selftest(device: Device) -> None:
    drawn = random.Random(commit()).sample([m for m in all_mutations() if not m.reason], DRAWN)
    outcomes = {mutation: judge(mutation, result) for mutation, result in run_mutations(drawn, device.index)}
    assert outcomes == dict.fromkeys(drawn, "caught")


@dataclass(frozen=True)
class Known:
    """A mutation whose result is known already, so that nothing is run."""

    mutation: Any
    caught: bool | None
    """None for one that does not build."""

    def report(self) -> int:
        results = {key_of(self.mutation): {"caught": self.caught, "by": "compact", "words": "why"}}
        return report([self.mutation], results, Namespace(results=None, seconds=0.0, device="0"))


MUTATION = next(mutation for mutation in all_mutations() if not mutation.reason)
OF_EQUAL_RESULTS = next(mutation for mutation in all_mutations() if mutation.reason)
WHY_EQUAL = EQUIVALENT[OF_EQUAL_RESULTS.kernel, OF_EQUAL_RESULTS.name]


@pytest.mark.fault_row(57)
@pytest.mark.parametrize(
    ("known", "code", "word", "reason"),
    [
        pytest.param(Known(MUTATION, caught=True), 0, "caught", "compact: why", id="noticed"),
        pytest.param(Known(MUTATION, caught=False), 1, "SURVIVED", "compact: why", id="not noticed"),
        pytest.param(Known(MUTATION, caught=None), 1, "BROKEN", "why", id="does not build"),
        pytest.param(Known(OF_EQUAL_RESULTS, caught=False), 0, "equivalent", WHY_EQUAL, id="of equal results"),
        pytest.param(Known(OF_EQUAL_RESULTS, caught=True), 1, "CAUGHT", WHY_EQUAL, id="wrongly called equivalent"),
    ],
)
def test_mutated_kernel_is_reported_by_its_outcome_and_fails_the_run_unless_it_is_as_expected(
    known: Known, code: int, word: str, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert known.report() == code
    line, last = capsys.readouterr().out.splitlines()
    assert line.split()[0] == word
    assert reason in line
    assert last.startswith(f"1 of 1 mutations run, {code} not as they should be")
