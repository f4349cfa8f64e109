"""Every row of the list of faults has a test, and the tests that the list names are there."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest
from fault_rows import PENDING, ROWS
from house import ROOT, statements_of

LAST_ROW = 72
EXPECTED = [row for row in range(1, LAST_ROW + 1) if row not in PENDING]
NAMED = re.compile(r"test_rows?_(\d+(?:_and_\d+)*)_")


@cache
def list_tests(folder: Path) -> dict[str, set[str]]:
    found = {}
    for path in sorted(folder.rglob("test_*.py")):
        functions = (node for node in statements_of(path.read_text()) if isinstance(node, ast.FunctionDef))
        found[path.relative_to(folder).as_posix()] = {node.name for node in functions if node.name.startswith("test_")}
    return found


def find_faults(rows: dict[int, tuple[str, tuple[str, ...]]], tests: dict[str, set[str]]) -> list[str]:
    """What is wrong with the list; empty where every row has a test that is there."""
    named = {name for names in tests.values() for name in names}
    held = {int(row) for name in named if (match := NAMED.match(name)) for row in match[1].split("_and_")}
    faults = [f"row {row} is not in the list" for row in EXPECTED if row not in rows]
    for row, (_, listed) in rows.items():
        for test in listed:
            file, _, name = test.partition("::")
            if name not in tests.get(file, ()):
                faults.append(f"row {row}: {test} is not there")
        if not listed and row not in held:
            faults.append(f"row {row} has no test")
    return faults


def test_every_row_has_a_test() -> None:
    assert find_faults(ROWS, list_tests(ROOT / "tests")) == []


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        ({row: ROWS[row] for row in ROWS if row != 7}, "row 7 is not in the list"),
        ({**ROWS, 7: ("a fault", ())}, "row 7 has no test"),
        (
            {**ROWS, 7: ("a fault", ("reading/dicom/test_phases.py::test_gone",))},
            "row 7: reading/dicom/test_phases.py::test_gone is not",
        ),
    ],
)
def test_a_row_without_a_test_is_found(rows: dict[int, tuple[str, tuple[str, ...]]], fault: str) -> None:
    tests = list_tests(ROOT / "tests")
    assert any(found.startswith(fault) for found in find_faults(rows, tests))


def test_a_row_that_waits_has_no_test_and_says_why() -> None:
    assert not set(PENDING) & set(ROWS) and all(PENDING.values())


def test_rows_are_read_from_the_names_of_tests() -> None:
    tests = {"a.py": {"test_row_46_a_file", "test_rows_38_and_40_streams"}}
    rows = dict.fromkeys(EXPECTED, ("", ()))
    left = {int(fault.split()[1]) for fault in find_faults(rows, tests)}
    assert set(rows) - left == {38, 40, 46}
