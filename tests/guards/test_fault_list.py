"""Every row of the list of faults has a test, and the tests that the list names exist."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import pytest
from fault_rows import PENDING, ROWS
from house import ROOT, statements_of

LAST_ROW = 72
EXPECTED = [row for row in range(1, LAST_ROW + 1) if row not in PENDING]
ROW_IN_MARK = re.compile(r"^@pytest\.mark\.fault_row\(([\d, ]+)\)", re.MULTILINE)


@dataclass
class FoundTests:
    """The names of the tests of each file, and the rows that tests hold by their mark."""

    names: dict[str, set[str]] = field(default_factory=dict)
    held_rows: set[int] = field(default_factory=set)

    def add(self, file: str, source: str) -> None:
        functions = [node for node in statements_of(source) if isinstance(node, ast.FunctionDef)]
        self.names[file] = {function.name for function in functions if function.name.startswith("test_")}
        for rows in ROW_IN_MARK.findall(source):
            self.held_rows.update(map(int, rows.split(",")))


@cache
def read_tests(folder: Path) -> FoundTests:
    tests = FoundTests()
    for path in sorted(folder.rglob("test_*.py")):
        tests.add(path.relative_to(folder).as_posix(), path.read_text())
    return tests


def find_faults(rows: dict[int, tuple[str, tuple[str, ...]]], tests: FoundTests) -> list[str]:
    """What is wrong with the list; empty where every row has a test that exists."""
    faults = [f"row {row} is not in the list" for row in EXPECTED if row not in rows]
    for row, (_, listed) in rows.items():
        for test in listed:
            file, _, name = test.partition("::")
            if name not in tests.names.get(file, ()):
                faults.append(f"row {row}: {test} is not there")
        if not listed and row not in tests.held_rows:
            faults.append(f"row {row} has no test")
    return faults


def test_every_row_of_the_list_of_faults_has_a_test() -> None:
    assert find_faults(ROWS, read_tests(ROOT / "tests")) == []


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        pytest.param(
            {row: ROWS[row] for row in ROWS if row != 7}, "row 7 is not in the list", id="row missing in the list"
        ),
        pytest.param({**ROWS, 7: ("a fault", ())}, "row 7 has no test", id="row without a test"),
        pytest.param(
            {**ROWS, 7: ("a fault", ("reading/dicom/test_phases.py::test_gone",))},
            "row 7: reading/dicom/test_phases.py::test_gone is not there",
            id="test missing in its file",
        ),
    ],
)
def test_row_missing_or_without_an_existing_test_is_reported(
    rows: dict[int, tuple[str, tuple[str, ...]]], fault: str
) -> None:
    assert fault in find_faults(rows, read_tests(ROOT / "tests"))


def test_pending_rows_are_not_listed_and_give_a_reason() -> None:
    assert not set(PENDING) & set(ROWS)
    assert all(reason for reason in PENDING.values())


@pytest.mark.parametrize(
    "source",
    [
        "@pytest.mark.fault_row(40)\ndef test_streams(): pass\n\n@pytest.mark.fault_row(38)\ndef test_bombs(): pass",
        "@pytest.mark.fault_row(38, 40)\ndef test_streams(): pass",
    ],
    ids=["a row in each mark", "two rows in a mark"],
)
def test_rows_are_read_from_marks_of_tests(source: str) -> None:
    tests = FoundTests()
    tests.add("test_a.py", source)
    assert tests.held_rows == {38, 40}
