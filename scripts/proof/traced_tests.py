"""Plugin of pytest for `mutate_python.py`: which tests run which lines.

Lines are kept for each test without its parameters.  Many parameters of a test run much the same lines: once those that
ran nothing new have taken `BARREN_SECONDS`, the others are not traced.  What a fixture of a wider scope runs counts for
every test that uses the fixture.  The caches of functions in the room are emptied before each test, those in tests/
before each file: the order of the files does not decide which of them run a line.
"""

from __future__ import annotations

import functools
import gc
import importlib.util
import json
import os
import sys
from collections import defaultdict
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import coverage
import pytest

BARREN_SECONDS = 0.25
"""Processor time of traced parameters that ran nothing new, after which no more parameters of their test are traced."""

Lines = dict[str, set[int]]
"""File -> lines."""


class Tracer:
    """Measures lines and seconds of each test, and keeps them as JSON.

    target: File for the result: ``lines`` (file -> line -> tests without parameters), ``seconds`` (test -> s),
    ``start`` (s before the first test) and ``modules`` (imported from outside of the project).  All seconds are of the
    processor.
    sources: Folder whose files are traced.
    """

    def __init__(self, target: Path, sources: str):
        self.target, self.root = target, Path.cwd()
        self.sources = Path(sources)
        self.coverage = coverage.Coverage(data_file=None, source=[sources], config_file=False)
        self.coverage.set_option("run:core", "ctrace")  # that of sys.monitoring sees a line once
        self.coverage.set_option("run:disable_warnings", ["no-data-collected"])
        self.begun = processor_seconds()
        self.start = 0.0
        self.seconds: dict[str, float] = {}
        self.skipped: set[str] = set()
        self.users: dict[str, set[str]] = {}
        self.caches = Caches()
        self.imported: Lines = {}
        self.of_test: dict[str, Lines] = {}
        self.of_fixture: dict[str, Lines] = {}
        self.barren: defaultdict[str, float] = defaultdict(float)
        self.file = self.test = ""
        self.traces = True
        self.coverage.start()

    def _take(self) -> Lines:
        """End tracing, and take the lines that were run since it began."""
        self.coverage.stop()
        data = self.coverage.get_data()
        lines = {file: set(data.lines(file) or ()) for file in data.measured_files()}
        self.coverage.erase()
        return lines

    @contextmanager
    def _apart(self, into: dict[str, Lines], name: str, outer: dict[str, Lines], outer_name: str) -> Iterator[None]:
        """Trace a part of a test for another name."""
        if self.traces:
            add_lines(outer.setdefault(outer_name, {}), self._take())
        self.coverage.start()
        try:
            yield
        finally:
            add_lines(into.setdefault(name, {}), self._take())
            if self.traces:
                self.coverage.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self) -> Generator[None, object, object]:
        """All tests; what was imported for them has been traced until here."""
        self.imported = self._take()
        self.traces = False
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Run a test, traced or not, without what other tests have left in caches."""
        self.start = self.start or processor_seconds() - self.begun
        self.test = without_parameters(item.nodeid)
        for name in getattr(item, "fixturenames", ()):
            self.users.setdefault(name, set()).add(self.test)
        file = item.nodeid.partition("::")[0]
        folders = {self.sources} if file == self.file else {self.sources, self.root / "tests"}
        self.file = file
        self.caches.empty(folders)
        self.traces = self.barren[self.test] <= BARREN_SECONDS
        kept = self.of_test.setdefault(self.test, {})
        before = count_lines(kept)
        begun = processor_seconds()
        if self.traces:
            self.coverage.start()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = processor_seconds() - begun
            if self.traces:
                add_lines(kept, self._take())
                if count_lines(kept) == before:
                    self.barren[self.test] += self.seconds[item.nodeid]
            self.traces = False

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Generator[None, object, object]:
        """Trace a fixture that several tests share for all of them."""
        if fixturedef.scope == "function":
            return (yield)
        with self._apart(self.of_fixture, fixturedef.argname, self.of_test, self.test):
            return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember skipped tests."""
        if report.skipped:
            self.skipped.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        """Write the result."""
        seconds = {test: value for test, value in self.seconds.items() if test not in self.skipped}
        run = {without_parameters(test) for test in seconds}
        rows: defaultdict[str, defaultdict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
        parts = [(self.imported, set()), *((lines, {test}) for test, lines in self.of_test.items())]
        parts += [(lines, self.users.get(name, set())) for name, lines in self.of_fixture.items()]
        for found, tests in parts:
            for file, numbers in found.items():
                of_file = rows[str(Path(file).relative_to(self.root))]
                for number in numbers:
                    of_file[number] |= tests & run
        lines = {file: {line: sorted(tests) for line, tests in of_file.items()} for file, of_file in rows.items()}
        result = {"lines": lines, "seconds": seconds, "start": self.start, "modules": outer_modules(self.root)}
        self.target.write_text(json.dumps(result))


class Caches:
    """The caches of functions (`functools.lru_cache`) in the memory of this process."""

    def __init__(self) -> None:
        self._found: list[tuple[Any, set[Path]]] = []
        self._modules = 0

    def empty(self, folders: set[Path]) -> None:
        """Empty those of functions whose modules lie in one of the folders."""
        if len(sys.modules) != self._modules:
            self._modules = len(sys.modules)
            self._found = list(self._find())
        for cache, parents in self._found:
            if folders & parents:
                cache.cache_clear()

    def _find(self) -> Iterator[tuple[Any, set[Path]]]:
        frozen = gc.get_freeze_count()
        gc.unfreeze()  # frozen objects are not listed
        for kept in gc.get_objects():
            if isinstance(kept, functools._lru_cache_wrapper):
                module = sys.modules.get(getattr(kept, "__module__", None) or "")
                yield kept, set(Path(getattr(module, "__file__", None) or os.sep).parents)
        if frozen:
            gc.freeze()


def without_parameters(test: str) -> str:
    """A test's name in pytest without its parameters."""
    return test.partition("[")[0]


def add_lines(to: Lines, more: Lines) -> None:
    """Add lines to others, in place."""
    for file, numbers in more.items():
        to.setdefault(file, set()).update(numbers)


def count_lines(lines: Lines) -> int:
    """How many lines there are."""
    return sum(map(len, lines.values()))


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
