"""Plugin of pytest for `mutate_python.py`: which tests run which lines.

Each test is a context of coverage.  What a fixture of a wider scope runs counts for every test that uses the fixture,
and the caches of functions in tests/ and in the room are emptied before each test: the order of tests decides neither.
"""

from __future__ import annotations

import functools
import gc
import importlib.util
import json
import os
import sys
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
        File for the result: ``lines`` (file -> line -> tests), ``seconds`` (test -> s), ``start`` (s before the first
        test) and ``modules`` (imported from outside of the project).  All seconds are of the processor.
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
        self.begun = processor_seconds()
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
        self.start = self.start or processor_seconds() - self.begun
        for name in getattr(item, "fixturenames", ()):
            self.users.setdefault(name, []).append(item.nodeid)
        for kept in gc.get_objects():
            if isinstance(kept, functools._lru_cache_wrapper):
                module = sys.modules.get(getattr(kept, "__module__", None) or "")
                if self.emptied & set(Path(getattr(module, "__file__", None) or os.sep).parents):
                    kept.cache_clear()
        self._switch(item.nodeid)
        begun = processor_seconds()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = processor_seconds() - begun
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
        result = {"lines": lines, "seconds": seconds, "start": self.start, "modules": outer_modules(self.root)}
        self.target.write_text(json.dumps(result))


def processor_seconds() -> float:
    """Processor time of this process and of those that it has waited for, in seconds."""
    return sum(os.times()[:4])


def outer_modules(root: Path) -> list[str]:
    """Names of imported modules whose files lie neither in a folder nor beside this file, in the order of imports."""
    own = {root, Path(__file__).parent}
    return [
        name
        for name, module in list(sys.modules.items())
        if name.partition(".")[0] not in ("__main__", "coverage")
        and getattr(module, "__file__", None)
        and not own & set(Path(module.__file__ or os.sep).parents)
    ]


def pytest_configure(config: pytest.Config) -> None:
    """Trace, if clrecon is that of the copy."""
    package = os.environ["CLRECON_CHANGED_PACKAGE"]
    config.pluginmanager.register(Tracer(Path(os.environ["CLRECON_TRACE_TO"]), os.environ["CLRECON_TRACED"]))
    found = importlib.util.find_spec(package)
    if found is None or Path.cwd() not in Path(found.origin or os.sep).parents:
        raise pytest.UsageError(f"{package} is not that of {Path.cwd()}: {found}")
