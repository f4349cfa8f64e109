"""The coverage of clrecon by a session of pytest, in one line before pytest's own last line.

Tracing makes loops of plain Python take four to nine times as long.  Tests marked ``slow`` or ``fuzz`` repeat what
others do once, or stand for long searches; those marked ``untraced`` are long loops over functions that other tests run
too; tests on further devices repeat what those on the first one have run; guards and tests of scripts read the project
or start programs.  They are not traced, and neither are the processes that tests start.  Many parameters of a test run
much the same lines: once those that ran nothing new have taken `BARREN_SECONDS`, the others are not traced.  Of a test
its fixtures and its body are traced, not what pytest does around them.  The true coverage is therefore a little higher
than the figure.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import coverage
import pytest

ROOT = Path(__file__).resolve().parents[2]
UNTRACED = ("slow", "fuzz", "untraced", "further_device")
UNTRACED_ROOMS = (ROOT / "tests" / "guards", ROOT / "tests" / "scripts")
BARREN_SECONDS = 0.25
"""Processor time of traced parameters that ran nothing new, after which a process traces no more of their test."""


def make_coverage(folder: Path, suffix: str | None = None) -> coverage.Coverage:
    """A coverage as pyproject.toml describes it, with its data in `folder`."""
    return coverage.Coverage(str(folder / "data"), data_suffix=suffix, config_file=str(ROOT / "pyproject.toml"))


def read_figure(folder: Path) -> str:
    """The line about all data in `folder`."""
    total = make_coverage(folder)
    total.combine([str(folder)])
    with tempfile.TemporaryDirectory() as place:
        report = Path(place) / "coverage.json"
        total.json_report(outfile=str(report), ignore_errors=True)
        totals = json.loads(report.read_text(encoding="utf-8"))["totals"]
    lines = 100 * totals["covered_lines"] / totals["num_statements"]
    branches = 100 * totals["covered_branches"] / totals["num_branches"]
    return (
        f"coverage of clrecon: {lines:.1f} % of {totals['num_statements']} lines and {branches:.1f} % of"
        f" {totals['num_branches']} branches (slow and fuzz tests, parameters after others that ran nothing new,"
        " further devices and processes apart not counted)"
    )


def name_of(item: pytest.Item) -> str:
    """A test without its parameters."""
    return item.nodeid.partition("[")[0]


class CoverageFigure:
    """A plugin of pytest; with pytest-xdist each worker traces, and the first process combines."""

    def __init__(self, folder: Path, traces: str | None, combines: bool):
        """`traces` is the name of this process among those that trace, None where it runs no test."""
        self.folder = folder
        self.combines = combines
        self.traces_test = False
        self.depth = 0  # fixtures ask for each other
        self.barren: defaultdict[str, float] = defaultdict(float)  # seconds by test
        self.coverage = make_coverage(folder, traces) if traces else None
        if self.coverage:
            self.coverage.start()

    def count_steps(self) -> int:
        """How many steps from line to line have been seen."""
        collector = self.coverage._collector if self.coverage else None
        assert collector is not None
        return sum(map(len, collector.data.values()))

    def is_traced(self, item: pytest.Item) -> bool:
        """Whether a test is, see above."""
        marked = any(item.get_closest_marker(name) for name in UNTRACED)
        apart = any(item.path.is_relative_to(room) for room in UNTRACED_ROOMS)
        return not (marked or apart or self.barren[name_of(item)] > BARREN_SECONDS)

    @contextmanager
    def tracing(self) -> Iterator[None]:
        """A part of a test, traced if the test is."""
        if not (self.coverage and self.traces_test):
            yield
            return
        self.depth += 1
        if self.depth == 1:
            self.coverage.start()
        try:
            yield
        finally:
            self.depth -= 1
            if self.depth == 0:
                self.coverage.stop()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self) -> Generator[None, object, object]:
        """All tests; what was imported for them has been traced until here."""
        if self.coverage:
            self.coverage.stop()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Run a test, traced or not."""
        self.traces_test = self.coverage is not None and self.is_traced(item)
        if not self.traces_test:
            return (yield)
        seen, since = self.count_steps(), time.process_time()
        try:
            return (yield)
        finally:
            if self.count_steps() == seen:
                self.barren[name_of(item)] += time.process_time() - since

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self) -> Generator[None, object, object]:
        """Make a fixture."""
        with self.tracing():
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self) -> Generator[None, object, object]:
        """Run the body of a test."""
        with self.tracing():
            return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_sessionfinish(self) -> Generator[None, object, object]:
        """Keep what this process has traced."""
        if self.coverage:
            self.coverage.stop()
            self.coverage.save()
        return (yield)

    @pytest.hookimpl(trylast=True)
    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say the figure."""
        if self.combines:
            terminalreporter.write_line(read_figure(self.folder))
