"""Which tests of a room run which lines, and which of them to try first."""

from __future__ import annotations

import ast
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any

TIMES_PLAIN, AND_SECONDS = 4.0, 10.0
"""A change may make its tests this many times slower, and this much more; a change that takes longer is caught."""
MOST_SECONDS = 60.0
"""Traced seconds of the tests that a change is tried with."""
FAR = 99
"""Steps to a file that no import leads to."""


class Imports:
    """How many imports lie between files of tests and files of the package.

    imported: File -> files that it imports.
    """

    def __init__(self, imported: Mapping[str, Iterable[str]]):
        self._importing: dict[str, set[str]] = {}
        for file, others in imported.items():
            for other in others:
                self._importing.setdefault(other, set()).add(file)
        self._known: dict[str, dict[str, int]] = {}

    @classmethod
    def read(cls, root: Path, folders: Sequence[str]) -> Imports:
        """Read what the files of some folders below the root import of each other."""
        files = {path.relative_to(root).as_posix() for folder in folders for path in (root / folder).rglob("*.py")}
        return cls({file: set(_imported((root / file).read_text(encoding="utf-8"), files)) for file in sorted(files)})

    def steps(self, file: str, test_file: str) -> int:
        """Imports from a file of tests to a file of the package: 1 if it imports it itself."""
        if file not in self._known:
            found, waiting = {file: 0}, deque([file])
            while waiting:
                here = waiting.popleft()
                for other in self._importing.get(here, ()):
                    if other not in found:
                        found[other] = found[here] + 1
                        waiting.append(other)
            self._known[file] = found
        return self._known[file].get(test_file, FAR)


def _imported(text: str, files: set[str]) -> Iterator[str]:
    """Files that a text imports, deferred imports too."""
    for node in ast.walk(ast.parse(text)):
        names = []
        if isinstance(node, ast.Import):
            names = [entry.name for entry in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module, *(f"{node.module}.{entry.name}" for entry in node.names)]
        # Helpers of tests are imported by their bare names.
        paths = {f"{folder}{name.replace('.', '/')}.py" for name in names for folder in ("", "tests/support/")}
        yield from paths & files


@dataclass(frozen=True)
class Trace:
    """What the tests of a room run without a change.

    lines: File below the root -> line -> tests, by their names in pytest without parameters.
    seconds: Test -> processor time in seconds.
    start: Processor time before the first test, in seconds.
    modules: Modules from outside of the project that the tests import.
    imports: Tests that import a changed file with fewer steps are tried before others.
    """

    lines: dict[str, dict[int, list[str]]]
    seconds: dict[str, float]
    start: float
    modules: list[str] = field(default_factory=list)
    imports: Imports = field(default_factory=lambda: Imports({}))

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Trace:
        """The trace that the plugin has written."""
        lines = {file: {int(line): tests for line, tests in rows.items()} for file, rows in data["lines"].items()}
        return cls(lines, data["seconds"], data["start"], data["modules"])

    def tests_of(self, file: str, lines: Sequence[int]) -> list[str]:
        """Tests that run one of the lines, and then the others of their files; as many as take MOST_SECONDS.

        The files with the fewest imports to the changed one come first, and of their tests the shortest.  The others
        of a file may use what the first has kept in a cache.  A line that is run when its module is imported (a
        constant, a default) belongs to no test: then all tests that run anything of this file.
        """
        rows = self.lines.get(file, {})
        if any(line in rows and not rows[line] for line in lines):
            lines = list(rows)
        running = {test for line in lines for test in rows.get(line, ())}
        near = {file_of(test): self.imports.steps(file, file_of(test)) for test in running}
        found = sorted(
            (test for test in self.seconds if file_of(test) in near),
            key=lambda test: (test.partition("[")[0] not in running, near[file_of(test)], self.seconds[test], test),
        )
        return self._first(found, MOST_SECONDS)

    def shortest(self, tests: Iterable[str], seconds: float) -> list[str]:
        """The shortest of these tests, one at least, as many as together take no longer than some seconds."""
        return self._first(sorted(tests, key=lambda test: (self.seconds[test], test)), seconds)

    def _first(self, tests: Sequence[str], seconds: float) -> list[str]:
        ends = list(accumulate(self.seconds[test] for test in tests))
        return list(tests[: max(1, bisect_right(ends, seconds))])

    def limit_s(self, tests: Sequence[str]) -> float:
        """Processor time that these tests may take with a change, in seconds."""
        return TIMES_PLAIN * (self.start + sum(self.seconds[test] for test in tests)) + AND_SECONDS


def file_of(test: str) -> str:
    """The file of a test."""
    return test.partition("[")[0].partition("::")[0]
