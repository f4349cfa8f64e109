"""The page of trust has the figures of its records, and silent faults of DICOM readers are counted rightly."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import make_trust_page  # isort: skip
import marked_tables  # isort: skip

TABLE = """\
| file | clrecon | other |
|---|---|---|
| a | 0 W | **2.6 S** |
| b | R; --phase 1: 0 W | crash (ValueError) |
| c | 0 | - |
| d | R |  |"""


@pytest.mark.parametrize("name", make_trust_page.make_tables())
def test_page_of_trust_has_the_table_of_the_records(name: str) -> None:
    page = make_trust_page.PAGE.read_text(encoding="utf-8")
    assert marked_tables.find_table(page, name) == make_trust_page.make_tables()[name]()


@pytest.mark.parametrize(
    ("reader", "cases", "silent_faults", "refusals"),
    [("clrecon", 4, 0, 2), ("other", 2, 1, 1)],  # "-" and empty cells are no cases, and a crash is a refusal
)
def test_cases_silent_faults_and_refusals_are_counted_by_reader(
    reader: str, cases: int, silent_faults: int, refusals: int
) -> None:
    assert make_trust_page.count_wrong(TABLE)[reader] == (cases, silent_faults, refusals)


def test_record_of_changed_code_is_condensed_to_counts_of_outcomes() -> None:
    rows = [{"room": "mesh", "outcome": outcome} for outcome in ("caught", "time", "equivalent", "survived", "late")]
    counts = {"tried": 5, "caught": 2, "equivalent": 1, "missed": 2}  # out of time is caught, too late is missed
    assert make_trust_page.condense("python", rows) == {"mesh": counts}


def test_record_of_the_fuzzer_is_condensed_to_counts_of_cases_and_faults() -> None:
    assert make_trust_page.condense("fuzz", {"cases": 3, "faults": [{}]}) == {"cases": 3, "faults": 1}


def test_new_record_of_the_fuzzer_is_written_to_the_page_of_trust(tmp_path: Path) -> None:
    page, checks, found = tmp_path / "trust.md", tmp_path / "checks.json", tmp_path / "fuzz.json"
    page.write_text(make_trust_page.PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    checks.write_text(make_trust_page.CHECKS.read_text(encoding="utf-8"), encoding="utf-8")
    found.write_text(json.dumps({"cases": 12_345, "faults": []}), encoding="utf-8")
    assert make_trust_page.main(["record", f"fuzz={found}"], page, checks) == 0
    assert "| damaged input | 12,345 | 0 faults" in page.read_text(encoding="utf-8")
