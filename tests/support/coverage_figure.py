"""The coverage of clrecon by a session of pytest, in one line before pytest's own last line.

Tracing costs a Python program half of its time again, or far more where one function is called a million times.  Tests
marked ``slow`` or ``fuzz`` repeat what others do once, or stand for long searches; tests on further devices repeat what
those on the first one have run, and a test that has many parameters runs much the same lines with each.  They are not
traced, and neither are the processes that tests start.  The true coverage is therefore a little higher than the figure.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Generator
from pathlib import Path

import coverage
import pytest

ROOT = Path(__file__).resolve().parents[2]
UNTRACED = ("slow", "fuzz", "further_device")
MOST_TRACED = 4
"""Parameters of one test that a process traces."""


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
        f" {totals['num_branches']} branches (slow and fuzz tests, all but {MOST_TRACED} parameters of a test, further"
        " devices and processes apart not counted)"
    )


class CoverageFigure:
    """A plugin of pytest; with pytest-xdist each worker traces, and the first process combines."""

    def __init__(self, folder: Path, traces: str | None, combines: bool):
        """`traces` is the name of this process among those that trace, None where it runs no test."""
        self.folder = folder
        self.combines = combines
        self.traced: Counter[str] = Counter()
        self.coverage = make_coverage(folder, traces) if traces else None
        if self.coverage:
            self.coverage.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Run a test, untraced where it is marked so or has been traced with other parameters."""
        test = item.nodeid.partition("[")[0]
        pauses = self.traced[test] >= MOST_TRACED or any(item.get_closest_marker(name) for name in UNTRACED)
        self.traced[test] += 1
        if self.coverage and pauses:
            self.coverage.stop()
        try:
            return (yield)
        finally:
            if self.coverage and pauses:
                self.coverage.start()

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
