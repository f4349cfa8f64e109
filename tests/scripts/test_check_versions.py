"""scripts/proof/check_versions.py: the page has the table of the kept figures, and setup.cfg names only what ran."""

from __future__ import annotations

import json
import re

import check_versions
import pytest
from house import ROOT
from marked_tables import find_table

FIGURES = json.loads(check_versions.FIGURES.read_text(encoding="utf-8"))


def test_page_has_the_table_of_the_kept_figures() -> None:
    page = check_versions.PAGE.read_text(encoding="utf-8")
    assert find_table(page, "versions") == check_versions.make_table(FIGURES)


def test_pythons_of_setup_cfg_are_those_whose_quick_tests_passed() -> None:
    named = re.findall(r"Programming Language :: Python :: (3\.\d+)", (ROOT / "setup.cfg").read_text(encoding="utf-8"))
    assert named == [run["python"] for run in FIGURES if run["libraries"] == "newest" and run.get("passed")]


@pytest.mark.parametrize(
    ("run", "cell"),
    [
        (
            {"failed": 1, "passed": 20, "versions": {"numpy": "1.24.1"}},
            "1.24.1 | - | - | - | - | 20 passed, 1 failed |",
        ),
        ({"not_run": "no Python here"}, "- | - | - | - | - | not run: no Python here |"),
    ],
    ids=["failed", "not run"],
)
def test_row_of_a_run_says_what_failed_or_that_it_did_not_run(run: dict[str, object], cell: str) -> None:
    table = check_versions.make_table([{"python": "3.10", "libraries": "oldest", **run}])
    assert table.splitlines()[-1] == f"| 3.10 | oldest | {cell}"
