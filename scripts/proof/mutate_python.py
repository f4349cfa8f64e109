#!/usr/bin/env python3
"""Change the Python code in one place at a time, and count the changes that the tests of the same room notice.

    python scripts/proof/mutate_python.py [--rooms mesh,geometry] [--changes 200] [--seed 1] [--seconds S]
                                    [--json FILE [--resume]]

It needs the extras `test` and `mutation`.  A room is a folder of clrecon/ with its tests in the folder of that name in
tests/ and those of ROOM_TESTS.  The changes are made in a private copy of the project.  The tests of a room are traced
once.  Each change is then tried with the tests that run the changed line, those of the files that import the changed
one first, and of each file the shortest, until one fails.  Tests marked slow or fuzz are left out, and so are the last
where all together would take more than a minute.  A change that no test notices survives, unless
`equivalent_changes.json` says why it changes nothing.  A line that none of the tests runs is a survivor too.  Time is
that of the processor: a busy machine makes no change look caught.

With --resume, changes that FILE calls caught stay caught while their file is the same; survivors are tried again.
The exit status is 1 if more than 5 % of the changes of a room survive.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from python_changes import Change, Equivalent, choose_changes, read_equivalents, statement_lines  # noqa: E402
from room_traces import Imports, Trace  # noqa: E402
from warm_tests import PYTEST_OPTIONS, Run, WarmTests  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
ROOMS = (
    *("mesh", "geometry", "labels", "reading", "operators", "points", "anatomy", "spine", "exchange", "rendering"),
    *("viewer", "jobs", "opencl", "system", "cli"),
)
"""All but proof, whose checks `mutate_kernels.py` tries."""
EQUIVALENTS = Path(__file__).with_name("equivalent_changes.json")
ROOM_TESTS = {
    "labels": ("tests/operators/surface/test_label_masks.py", "tests/operators/surface/test_label_surfaces.py"),
    "geometry": ("tests/jobs/test_cropping.py",),
    "exchange": ("tests/points/test_reader.py", "tests/mesh/test_mesh_reader.py"),
    "jobs": ("tests/cli/test_info.py",),
    "system": (
        *("tests/cli/test_foreign_words.py", "tests/guards/test_wrong_arguments.py"),
        "tests/rendering/looks/test_color_scale.py",
    ),
    "anatomy": ("tests/operators/rays/test_smooth_light.py",),
    "cli": ("tests/jobs/test_inside_job.py", "tests/jobs/test_stats_job.py", "tests/proof/compare/test_compare_job.py"),
}
"""Further tests of a room: those of the only code that uses a part of it, which ask this part too."""
MOST_SURVIVORS = 0.05
TIMES_WALL, AND_WALL_SECONDS = 20.0, 60.0
"""Seconds after which a change is given up: so many times what its tests may take of the processor, and this more."""
FIRST_TESTS = 5
"""So many tests are tried before the files of the others are imported."""
CHECKED_SECONDS = 20.0
UNNOTICED = ("survived", "not run", "late")


class BrokenRoomError(Exception):
    """The tests of a room fail without a change, or there are none."""


@dataclass
class Copy:
    """A private copy of a project, in which files are changed.

    root: Folder of the copy.
    package: Folder and name of the package in it.
    warm: The process that runs its tests, begun with the first change.
    first_tests: Tests that are tried before all others.
    times_wall, and_wall_s: Seconds on the clock: so many times those on the processor, and these.
    """

    root: Path
    package: str = "clrecon"
    warm: WarmTests | None = None
    first_tests: int = FIRST_TESTS
    times_wall: float = TIMES_WALL
    and_wall_s: float = AND_WALL_SECONDS

    @classmethod
    def make(cls, project: Path, folder: Path, package: str = "clrecon") -> Copy:
        """Copy a project without what git, environments and builds keep in it."""
        ignored = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist", "clrecon-demo")
        root = shutil.copytree(project, folder / "copy", ignore=ignored, symlinks=True).resolve()
        if (root / "cl").is_dir():
            # An editable installation would give `clrecon.cl` the kernels of its own folder.
            (root / package / "cl").symlink_to(root / "cl")
        return cls(root, package)

    def environment(self, writes_bytecode: bool, **more: str) -> dict[str, str]:
        """Variables of a run.  Bytecode is written by the traced run alone, in which nothing is changed."""
        paths = [str(self.root), str(Path(__file__).parent)]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "PYTHONPYCACHEPREFIX": str(self.root.parent / "bytecode"),
            "PYTHONDONTWRITEBYTECODE": "" if writes_bytecode else "1",
            "CLRECON_CHANGED_PACKAGE": self.package,
            **more,
        }
        for name in ("CLRECON_COVERAGE", "CLRECON_REQUIRE_TESTS"):
            environment.pop(name, None)
        return environment

    def trace(self, room: str) -> Trace:
        """Run the tests of a room without a change, and see which lines they run."""
        trace = self._trace(room, [f"tests/{room}", *ROOM_TESTS.get(room, ())])
        trace = replace(trace, imports=Imports.read(self.root, [self.package, "tests"]))
        self._check_order(room, trace)
        return trace

    def _trace(self, room: str, tests: Sequence[str]) -> Trace:
        target = self.root.parent / f"trace-{room}.json"
        traced = {"CLRECON_TRACE_TO": str(target), "CLRECON_TRACED": str(self.root / self.package / room)}
        command = [sys.executable, "-m", "pytest", *PYTEST_OPTIONS, "-p", "traced_tests", *tests]
        ended = subprocess.run(
            [*command, f"--basetemp={self.root.parent / 'tests'}"],
            cwd=self.root,
            env=self.environment(True, **traced),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            check=False,
        )
        if ended.returncode:
            said = ended.stdout.decode(errors="replace")[-3000:]
            raise BrokenRoomError(f"the tests in {tests} fail without a change (status {ended.returncode}):\n{said}")
        return Trace.from_json(json.loads(target.read_text(encoding="utf-8")))

    def _check_order(self, room: str, trace: Trace) -> None:
        """Run the shortest tests as for a change, but without one: neither order nor warm start must make one fail."""
        status = self._run_chosen(trace.shortest(trace.seconds, CHECKED_SECONDS), trace)
        if status:
            said = self._said.read_text(errors="replace")[-3000:]
            raise BrokenRoomError(f"tests of {room} fail in another order (status {status}):\n{said}")

    @property
    def _said(self) -> Path:
        return self.root.parent / "said.txt"

    def _run_chosen(self, tests: Sequence[str], trace: Trace) -> int:
        """Run tests in a fork of a process that has imported what they need; returns `Outcome.status`."""
        if self.warm is None:
            self.warm = WarmTests(self.root, self.environment(False), trace.modules)
        stages = [list(part) for part in (tests[: self.first_tests], tests[self.first_tests :]) if part]
        limits_s = [trace.limit_s(part) for part in stages]
        files = str(self.root.parent / "tests"), str(self._said)
        wall_s = self.times_wall * sum(limits_s) + self.and_wall_s
        return self.warm.run(Run(stages, limits_s, wall_s, *files)).status

    def close(self) -> None:
        """End the process that runs the tests."""
        if self.warm is not None:
            self.warm.close()
            self.warm = None

    def try_change(self, change: Change, trace: Trace) -> tuple[str, int]:
        """Try a change with the tests that run its line.

        Returns caught, time, crash, survived, late (ended before its time on the processor was used up: nothing is
        known) or not run; and the number of tests tried.
        """
        path = self.root / change.file
        original, kept = path.read_bytes(), path.stat()
        tests = trace.tests_of(change.file, statement_lines(original.decode(), change.line))
        if not tests:
            return "not run", 0
        try:
            path.write_text(change.text, encoding="utf-8")
            # Bytecode of the unchanged file is told apart by size and time: the time is another one for certain.
            os.utime(path, ns=(kept.st_atime_ns, kept.st_mtime_ns - 10**10))
            code = self._run_chosen(tests, trace)
        finally:
            path.write_bytes(original)
            os.utime(path, ns=(kept.st_atime_ns, kept.st_mtime_ns))
        if code in (-signal.SIGXCPU, -signal.SIGALRM):
            return "time" if code == -signal.SIGXCPU else "late", len(tests)
        if code < 0:
            return "crash", len(tests)
        return "survived" if code in (0, 5) else "caught", len(tests)


@dataclass
class RoomResult:
    """The changes of a room that were tried.

    rows: A change as in `Change.as_dict`, with ``room``, ``outcome``, ``tests`` (it was tried with so many), ``digest``
    (of the file without the change) and, for an equivalent change, ``why``.
    """

    room: str
    rows: list[dict[str, Any]] = field(default_factory=list)

    @property
    def counts(self) -> Counter[str]:
        """Number of changes by outcome."""
        return Counter(row["outcome"] for row in self.rows)

    @property
    def survivors(self) -> list[dict[str, Any]]:
        """Changes that no test noticed and that are not named as equivalent."""
        return [row for row in self.rows if row["outcome"] in UNNOTICED]

    @property
    def is_good(self) -> bool:
        """True if few enough survive."""
        return len(self.survivors) <= MOST_SURVIVORS * len(self.rows)

    def sentence(self) -> str:
        """The result in a line."""
        counts, tried = self.counts, len(self.rows)
        caught = counts["caught"] + counts["time"] + counts["crash"]
        return (
            f"{self.room}: {tried} changes, {caught} caught ({counts['time']} by time, {counts['crash']} by a crash),"
            f" {counts['equivalent']} equivalent, {len(self.survivors)} survive ({counts['not run']} of them in lines"
            f" that no test of the room runs, {counts['late']} ended early)"
        )


def digest(text: str) -> str:
    """A short name of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def room_texts(root: Path, package: str, room: str) -> dict[str, str]:
    """Read the files of a room: path below the root -> text."""
    files = sorted((root / package / room).rglob("*.py"))
    return {path.relative_to(root).as_posix(): path.read_text(encoding="utf-8") for path in files}


def try_room(
    copy: Copy,
    room: str,
    changes: Sequence[Change],
    *,
    equivalents: Sequence[Equivalent] = (),
    known: Sequence[dict[str, Any]] = (),
    until: float = float("inf"),
) -> Iterator[dict[str, Any]]:
    """Try changes of a room one after the other.

    equivalents: Changes that are not tried.
    known: Earlier rows; what was caught then is not tried again while its file is the same.
    until: Time of `time.monotonic` after which no change is begun.
    Yields rows of `RoomResult`.
    """
    earlier = {
        (row["file"], row["digest"], row["operator"], row["occurrence"]): row
        for row in known
        if row["outcome"] not in (*UNNOTICED, "equivalent")
    }
    trace: Trace | None = None
    digests = {file: digest(text) for file, text in room_texts(copy.root, copy.package, room).items()}
    for change in changes:
        row = {"room": room, **change.as_dict(), "digest": digests[change.file]}
        found = earlier.get((change.file, row["digest"], change.operator, change.occurrence))
        same = next((entry for entry in equivalents if entry.names(change)), None)
        if same is not None:
            yield {**row, "outcome": "equivalent", "tests": 0, "why": same.why}
        elif found is not None:
            yield {**row, "outcome": found["outcome"], "tests": found["tests"]}
        elif time.monotonic() < until:
            trace = trace or copy.trace(room)
            outcome, tests = copy.try_change(change, trace)
            yield {**row, "outcome": outcome, "tests": tests}


def read_options(argv: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rooms", default=",".join(ROOMS), help="comma list (default: %(default)s)")
    parser.add_argument("--changes", type=int, default=200, metavar="N", help="for each room (default: %(default)s)")
    parser.add_argument("--seed", default="1", help="text that decides the choice (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=float("inf"), metavar="S", help="no change is begun later")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every change and what came of it")
    parser.add_argument("--resume", action="store_true", help="go on with what FILE says")
    options = parser.parse_args(argv)
    options.rooms = options.rooms.split(",")
    for room in options.rooms:
        if not (ROOT / "clrecon" / room).is_dir() or not (ROOT / "tests" / room).is_dir():
            parser.error(f"no room {room!r}: it needs the folders clrecon/{room} and tests/{room}")
    if options.changes < 1:
        parser.error(f"--changes is a number from 1, not {options.changes}")
    if options.resume and options.json is None:
        parser.error("--resume needs --json FILE")
    return options


def main(argv: Sequence[str] | None = None) -> int:
    options = read_options(argv)
    until = time.monotonic() + options.seconds
    known = json.loads(options.json.read_text("utf-8")) if options.resume and options.json.exists() else []
    rest = [row for row in known if row["room"] not in options.rooms]
    equivalents = read_equivalents(EQUIVALENTS)
    results = []
    with tempfile.TemporaryDirectory(prefix="clrecon-changes-") as folder:
        copy = Copy.make(ROOT, Path(folder))
        for room in options.rooms:
            result = RoomResult(room)
            results.append(result)
            changes = choose_changes(room_texts(copy.root, copy.package, room), options.changes, options.seed)
            tried = try_room(copy, room, changes, equivalents=equivalents, known=known, until=until)
            try:
                for row in tried:
                    result.rows.append(row)
                    if row["outcome"] in UNNOTICED:
                        print(f"{row['outcome']} ({row['tests']} tests): {row['file']}:{row['line']} {row['operator']}")
                        print(f"    - {row['before']}\n    + {row['after']}", flush=True)
                    if options.json:
                        rows = [*rest, *(row for one in results for row in one.rows)]
                        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
            except BrokenRoomError as error:
                print(error, file=sys.stderr)
                return 2
            finally:
                copy.close()
            print(result.sentence(), flush=True)
    return 0 if all(result.is_good for result in results) else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
