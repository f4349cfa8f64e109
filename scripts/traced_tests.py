"""Plugin of pytest for `mutate_python.py`: which tests run which lines, and a run of chosen tests in a given order.

With CLRECON_TRACE_TO the run is traced.  Each test is a context of coverage.  What a fixture of a wider scope runs
counts for every test that uses the fixture, and the caches of functions in tests/ and in the room are emptied before
each test: the order of tests decides neither.  With CLRECON_RUN_ONLY only the tests in that file are run.
"""

from __future__ import annotations

import functools
import gc
import importlib.util
import json
import os
import sys
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import coverage
import pytest


class Tracer:
    """Measures lines and seconds of each test, and keeps them as JSON.

    Parameters
    ----------
    target : Path
        File for the result: ``lines`` (file -> line -> tests), ``seconds`` (test -> s), ``start`` (s before the tests).
    sources : str
        Folder whose files are traced.
    """

    def __init__(self, target: Path, sources: str):
        self.target, self.root = target, Path.cwd()
        self.emptied = {self.root / "tests", Path(sources)}
        self.coverage = coverage.Coverage(data_file=None, source=[sources], config_file=False)
        self.coverage.set_option(
            "run:core", "ctrace"
        )  # the one of sys.monitoring sees a line in its first context alone
        self.begun = time.monotonic()
        self.start = 0.0
        self.seconds: dict[str, float] = {}
        self.skipped: set[str] = set()
        self.users: dict[str, list[str]] = {}
        self.context = ""
        self.coverage.start()

    def _switch(self, context: str) -> str:
        before, self.context = self.context, context
        self.coverage.switch_context(context)
        return before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Run a test in a context of its own, without what other tests have left in caches."""
        self.start = self.start or time.monotonic() - self.begun
        for name in getattr(item, "fixturenames", ()):
            self.users.setdefault(name, []).append(item.nodeid)
        for kept in gc.get_objects():
            if isinstance(kept, functools._lru_cache_wrapper):
                module = sys.modules.get(getattr(kept, "__module__", None) or "")
                if self.emptied & set(Path(getattr(module, "__file__", None) or os.sep).parents):
                    kept.cache_clear()
        self._switch(item.nodeid)
        begun = time.monotonic()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = time.monotonic() - begun
            self._switch("")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Generator[None, object, object]:
        """Give a fixture that several tests share a context of its own."""
        if fixturedef.scope == "function":
            return (yield)
        before = self._switch(f"fixture {fixturedef.argname}")
        try:
            return (yield)
        finally:
            self._switch(before)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember skipped tests."""
        if report.skipped:
            self.skipped.add(report.nodeid)

    def _tests_of(self, context: str) -> list[str]:
        kind, _, name = context.partition("fixture ")
        return self.users.get(name, []) if not kind else [context]

    def pytest_sessionfinish(self) -> None:
        """Write the result."""
        self.coverage.stop()
        data = self.coverage.get_data()
        lines: dict[str, dict[int, list[str]]] = {}
        for file in data.measured_files():
            of_file = lines.setdefault(str(Path(file).relative_to(self.root)), {})
            for line, contexts in data.contexts_by_lineno(file).items():
                tests = {test for context in contexts if context for test in self._tests_of(context)}
                of_file[line] = sorted(tests - self.skipped)
        seconds = {test: value for test, value in self.seconds.items() if test not in self.skipped}
        self.target.write_text(json.dumps({"lines": lines, "seconds": seconds, "start": self.start}))


class Chooser:
    """Runs the tests of a list in its order.  A test that is no longer collected is left out."""

    def __init__(self, wanted: list[str]):
        self.order = {test: number for number, test in enumerate(wanted)}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep and sort."""
        items[:] = sorted(
            (item for item in items if item.nodeid in self.order), key=lambda item: self.order[item.nodeid]
        )


def pytest_configure(config: pytest.Config) -> None:
    """Trace or choose, as the environment says; clrecon must be that of the copy."""
    package = os.environ["CLRECON_CHANGED_PACKAGE"]
    if "CLRECON_TRACE_TO" in os.environ:
        tracer = Tracer(Path(os.environ["CLRECON_TRACE_TO"]), os.environ["CLRECON_TRACED"])
        config.pluginmanager.register(tracer)
    else:
        wanted = json.loads(Path(os.environ["CLRECON_RUN_ONLY"]).read_text())
        config.pluginmanager.register(Chooser(wanted))
    found = importlib.util.find_spec(package)
    if found is None or Path.cwd() not in Path(found.origin or os.sep).parents:
        raise pytest.UsageError(f"{package} is not that of {Path.cwd()}: {found}")
