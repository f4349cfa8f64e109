"""The page of trust says what its records say, and faults without a word are counted rightly."""

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
| c | 0 | - |"""


@pytest.mark.parametrize("name", make_trust_page.make_tables())
def test_the_page_has_the_tables_of_the_records(name: str) -> None:
    page = make_trust_page.PAGE.read_text(encoding="utf-8")
    assert marked_tables.find_table(page, name) == make_trust_page.make_tables()[name]()


def test_silent_faults_and_refusals_are_counted_by_reader() -> None:
    assert make_trust_page.count_wrong(TABLE) == {"clrecon": (3, 0, 1), "other": (2, 1, 1)}


def test_records_of_changes_are_condensed_to_what_was_noticed() -> None:
    rows = [{"room": "mesh", "outcome": outcome} for outcome in ("caught", "time", "equivalent", "survived", "late")]
    found = make_trust_page.condense("python", rows)
    assert found == {"mesh": {"tried": 5, "caught": 2, "equivalent": 1, "missed": 2}}
    assert make_trust_page.condense("fuzz", {"cases": 3, "faults": [{}]}) == {"cases": 3, "faults": 1}


def test_a_record_is_kept_and_reaches_the_page(tmp_path: Path) -> None:
    page, checks, found = tmp_path / "trust.md", tmp_path / "checks.json", tmp_path / "fuzz.json"
    page.write_text(make_trust_page.PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    checks.write_text(make_trust_page.CHECKS.read_text(encoding="utf-8"), encoding="utf-8")
    found.write_text(json.dumps({"cases": 12_345, "faults": []}), encoding="utf-8")
    assert make_trust_page.main(["record", f"fuzz={found}"], page, checks) == 0
    assert "| damaged input | 12,345 | 0 faults" in page.read_text(encoding="utf-8")
