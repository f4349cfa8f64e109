#!/usr/bin/env python3
"""Read harmed input for a given time, and count what comes of it.

    python scripts/fuzz/fuzz.py [--seconds 60 | --cases 100000] [--seed 1] [--jobs 2] [--families values,bytes]
    python scripts/fuzz/fuzz.py --case values:117 [--seed 1]

A case depends on its family, its number and the seed alone, and is run again by --case.  The families are values of
geometry and pixel elements, bytes and ends of DICOM files, volumes and label maps of other formats, clouds of points
and `clrecon cloud` on them, options of the command line, and environments.  Workers are processes of their own: one
that dies or hangs is a fault of its case.  The exit status is 1 if there was a fault.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

sys.path.insert(0, str(Path(__file__).parent))

from trials import FAULTS, GOOD, TIME_LIMIT_S, Outcome  # noqa: E402

SHARES = {
    "values": 25, "bytes": 20, "ends": 5, "volumes": 10, "labels": 5, "clouds": 10, "options": 15, "environment": 10,
}  # fmt: skip
"""Families, and their shares of the time in percent."""
WORKER = Path(__file__).with_name("worker.py")
WORKER_LIMIT_S = 6 * TIME_LIMIT_S
START_LIMIT_S = 120.0
"""Processor time after which a worker is ended."""
STALL_LIMIT_S = 300.0
"""Time after which a worker that does not answer is ended, whatever it does: it waits for something."""
LONGEST_LOOK_S = 2.0
"""What counts of the time between two looks at the workers: with the machine, the campaign itself may have stood."""


@dataclass(frozen=True)
class Case:
    """A case by its family and number."""

    family: str
    number: int

    def __str__(self) -> str:
        return f"{self.family}:{self.number}"


@dataclass
class Worker:
    """A process that runs cases, and the case that it runs."""

    process: subprocess.Popen[bytes]
    errors: IO[bytes]
    case: Case
    started: float
    answered: int = 0
    worked: float = 0.0
    waited: float = 0.0
    start_limit_s: float = START_LIMIT_S
    stall_limit_s: float = STALL_LIMIT_S

    @classmethod
    def start(cls, case: Case, seed: str, *, program: Path = WORKER, **limits: Any) -> Worker:
        """Start a process with its first case; `limits` are those of the class."""
        environment = {**os.environ, "CLRECON_REQUIRE_TESTS": "", "OPENBLAS_NUM_THREADS": "1"}
        errors = tempfile.TemporaryFile()
        process = subprocess.Popen(
            [sys.executable, str(program)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
        )
        worker = cls(process, errors, case, time.monotonic(), **limits)
        worker.give(case, seed)
        return worker

    def give(self, case: Case, seed: str) -> None:
        """Give the next case."""
        self.case, self.started = case, time.monotonic()
        self.worked, self.waited = processor_s(self.process.pid), 0.0
        assert self.process.stdin is not None
        self.process.stdin.write(f"{case.family} {case.number} {seed}\n".encode())
        self.process.stdin.flush()

    def take(self) -> Outcome | None:
        """Read the outcome of the case; None if the process has ended."""
        line = self.answers.readline()
        if not line.endswith(b"\n"):
            return None
        self.answered += 1
        return Outcome(**json.loads(line))

    @property
    def limit_s(self) -> float:
        """Processor time that a case may take: the first one imports, and environments build kernels."""
        return WORKER_LIMIT_S if self.answered and self.case.family != "environment" else self.start_limit_s

    def find_delay(self, look_s: float) -> str:
        """Return in what the case goes beyond what any may take, `look_s` after the last look; empty if it does not."""
        self.waited += min(look_s, LONGEST_LOOK_S)
        if processor_s(self.process.pid) - self.worked > self.limit_s:
            return f"over {self.limit_s:.0f} s of processor time"
        return f"no answer in {self.stall_limit_s:.0f} s" if self.waited > self.stall_limit_s else ""

    @property
    def answers(self) -> IO[bytes]:
        """The outcomes, a line each."""
        assert self.process.stdout is not None
        return self.process.stdout

    def end(self) -> str:
        """End the process; returns how it ended, and its last words."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        try:
            status = self.process.wait(timeout=2)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        self.errors.seek(0)
        words = self.errors.read().decode(errors="replace")[-1000:]
        self.errors.close()
        self.answers.close()
        how = signal.Signals(-status).name if status < 0 else f"exit {status}"
        return f"{how}; {words}" if words else how


def processor_s(process: int) -> float:
    """Processor time of a process and of those that it has waited for; 0 where the system does not say."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


@dataclass
class Campaign:
    """What was run so far: counts by family and kind of outcome, and every fault."""

    counts: dict[str, Counter[str]] = field(default_factory=dict)
    faults: list[tuple[Case, Outcome]] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, case: Case, outcome: Outcome) -> None:
        """Count an outcome."""
        self.counts.setdefault(case.family, Counter())[outcome.kind] += 1
        if outcome.kind in FAULTS:
            self.faults.append((case, outcome))

    @property
    def total(self) -> int:
        """Cases that were run."""
        return sum(counter.total() for counter in self.counts.values())

    def table(self) -> str:
        """Counts by family and kind, for people."""
        kinds = [*GOOD, *FAULTS]
        rows = [["family", *kinds]]
        rows += [[family, *(str(counter[kind]) for kind in kinds)] for family, counter in self.counts.items()]
        sums = [sum(counter[kind] for counter in self.counts.values()) for kind in kinds]
        rows.append(["all", *map(str, sums)])
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)

    def as_dict(self) -> dict[str, object]:
        """The campaign as JSON."""
        return {
            "cases": self.total,
            "seconds": round(self.seconds, 1),
            "counts": {family: dict(counter) for family, counter in self.counts.items()},
            "faults": [{"case": str(case), **outcome.as_dict()} for case, outcome in self.faults],
        }


@dataclass
class Schedule:
    """Which case comes next: of the family that has had the least of its share of the time.

    most: Number of cases after which there is none.
    """

    families: Sequence[str]
    most: int = sys.maxsize
    begun: Counter[str] = field(default_factory=Counter)
    spent: dict[str, float] = field(default_factory=dict)

    def draw(self) -> Case | None:
        """Return the next case; None if there is none."""
        if self.begun.total() >= self.most:
            return None
        family = min(self.families, key=lambda name: self.spent.get(name, 0.0) / SHARES[name])
        case = Case(family, self.begun[family])
        self.begun[family] += 1
        self.spend(case, 0.001)  # not all workers on one family
        return case

    def spend(self, case: Case, seconds: float) -> None:
        """Count the time of a case."""
        self.spent[case.family] = self.spent.get(case.family, 0.0) + seconds


@dataclass
class NamedCases:
    """The schedule of cases that are named, one after the other."""

    cases: list[Case]

    def draw(self) -> Case | None:
        """Return the next case; None if there is none."""
        return self.cases.pop(0) if self.cases else None

    def spend(self, case: Case, seconds: float) -> None:
        """Time changes nothing."""


def run_campaign(
    schedule: Schedule | NamedCases,
    *,
    seconds: float,
    seed: str = "1",
    jobs: int = 1,
    start_worker: Callable[[Case, str], Worker] = Worker.start,
) -> Campaign:
    """Run cases in `jobs` processes until the time or the cases are over.

    seconds: Time after which no case is begun.
    seed: Without spaces.
    start_worker: Starts a process with a case and the seed.
    """
    campaign, start = Campaign(), time.monotonic()
    workers: list[Worker] = []
    try:
        while True:
            while len(workers) < jobs and time.monotonic() - start < seconds:
                case = schedule.draw()
                if case is None:
                    break
                workers.append(start_worker(case, seed))
            if not workers:
                break
            looked = time.monotonic()
            ready, _, _ = select.select([worker.answers for worker in workers], [], [], 1.0)
            look_s = time.monotonic() - looked
            for worker in list(workers):
                if worker.answers in ready:
                    outcome = worker.take()
                elif delay := worker.find_delay(look_s):
                    outcome = Outcome("hang", "", delay)
                else:
                    continue
                schedule.spend(worker.case, time.monotonic() - worker.started)
                following = None
                if outcome is not None and outcome.trial and time.monotonic() - start < seconds:
                    following = schedule.draw()
                if following is None:
                    workers.remove(worker)
                    how = worker.end()
                    outcome = outcome or Outcome("crash", "", f"the worker died: {how}")
                assert outcome is not None
                campaign.add(worker.case, outcome)
                if following is not None:
                    worker.give(following, seed)
    except KeyboardInterrupt:
        print("interrupted: what was run so far", file=sys.stderr)
    finally:
        for worker in workers:
            worker.process.kill()
            worker.end()
    campaign.seconds = time.monotonic() - start
    return campaign


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, metavar="S", help="time (default: 60, without a limit with --cases)")
    parser.add_argument("--cases", type=int, metavar="N", help="number of cases")
    parser.add_argument("--seed", default="1", help="text without spaces (default: %(default)s)")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes (default: all cores)"
    )
    parser.add_argument("--families", default=",".join(SHARES), help="comma list (default: %(default)s)")
    parser.add_argument("--case", metavar="FAMILY:NUMBER", help="run this case alone")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write counts and faults")
    options = parser.parse_args(argv)
    families = options.families.split(",")
    unknown = [family for family in families if family not in SHARES]
    if unknown:
        parser.error(f"no family {unknown[0]!r}: there are {', '.join(SHARES)}")
    schedule: Schedule | NamedCases = Schedule(families, options.cases if options.cases is not None else sys.maxsize)
    if options.case:
        family, _, number = options.case.partition(":")
        if family not in SHARES or not number.isdigit():
            parser.error(f"no case {options.case!r}: write it as values:117")
        schedule = NamedCases([Case(family, int(number))])
    seconds = options.seconds or (1e9 if options.case or options.cases is not None else 60.0)
    campaign = run_campaign(schedule, seconds=seconds, seed=options.seed, jobs=max(options.jobs, 1))
    for case, outcome in campaign.faults:
        print(f"{outcome.kind} {case} ({outcome.trial})\n    {outcome.text}")
    print(campaign.table())
    print(f"{campaign.total} cases in {campaign.seconds:.0f} s: {len(campaign.faults)} faults")
    if options.json:
        options.json.write_text(json.dumps(campaign.as_dict(), indent=1) + "\n")
    return 1 if campaign.faults else 0


if __name__ == "__main__":
    sys.exit(main())
