"""Constants in mm and HU: the table of docs/limits.md has them all, as they are."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import pytest
from house import ROOT
from refusals import refused

import make_constants_table  # isort: skip
import marked_tables  # isort: skip


def test_page_of_limits_has_the_table_of_constants_of_the_code() -> None:
    text = make_constants_table.PAGE.read_text(encoding="utf-8")
    table = marked_tables.find_table(text, make_constants_table.NAME)
    assert table == make_constants_table.make_table(), "python scripts/guide/make_constants_table.py"


@pytest.mark.parametrize(
    ("source", "constants"),
    [
        ('A_MM, B = 1.0, 2\n"""How far.  And more."""\n', [("A_MM, B", "(1.0, 2)", "How far")]),
        ("C_HU: float = -3.0\n", [("C_HU", "-3.0", "")]),
        ("BONE_HU_MOST = 6\n", [("BONE_HU_MOST", "6", "")]),
        ("D = 4\n", []),
        ("_E_MM = 5\n", []),
    ],
    ids=["two with a docstring", "annotated", "unit within the name", "no unit", "private"],
)
def test_public_constant_with_a_unit_in_its_name_is_found_with_its_first_sentence(
    source: str, constants: list[tuple[str, str, str]]
) -> None:
    assert list(make_constants_table.find_constants(source)) == constants


class Row(NamedTuple):
    """A row of the table: its module, the units in the names of its constants, and what its values follow."""

    module: str
    units: frozenset[str]
    follows: str

    @classmethod
    def read(cls, line: str) -> Row:
        module, names, _, _, follows = (cell.strip() for cell in line.strip("|").split(" | "))
        matches = map(make_constants_table.UNITS.match, names.split(", "))
        return cls(f"{module}.py", frozenset(match[1] for match in matches if match), follows)


ROWS = [Row.read(line) for line in make_constants_table.make_table().splitlines()[2:]]
WITH_LENGTHS = {row.module for row in ROWS if row.units != {"HU"}}
WITH_VALUES = {row.module for row in ROWS if "HU" in row.units}


def test_rows_of_constants_say_what_values_follow_exactly_where_one_is_in_hu() -> None:
    assert [row.module for row in ROWS if ("values:" in row.follows) != ("HU" in row.units)] == []


def test_rows_of_constants_say_what_lengths_follow_exactly_where_one_is_not_in_hu() -> None:
    words = ("voxel", "object", "files", "nothing")
    says_lengths = [any(word in row.follows for word in words) for row in ROWS]
    assert says_lengths == [row.units != {"HU"} for row in ROWS]


def test_modules_of_which_lengths_or_values_are_explained_are_those_with_such_constants() -> None:
    assert set(make_constants_table.LENGTHS) == WITH_LENGTHS
    assert set(make_constants_table.VALUES) <= WITH_VALUES


def test_modules_whose_constants_are_said_to_follow_the_scan_have_a_test_that_shows_it() -> None:
    lengths = make_constants_table.LENGTHS
    following = {module for module, text in lengths.items() if re.search(r"voxel|step|spacing|share", text)}
    assert set(make_constants_table.SHOWN_BY) == following | set(make_constants_table.VALUES)


def test_tests_that_show_what_constants_follow_exist() -> None:
    places = [place.split("::") for place in sorted(set(make_constants_table.SHOWN_BY.values()))]
    texts = {file: (ROOT / "tests" / file).read_text(encoding="utf-8") for file, _ in places}
    assert [name for file, name in places if f"def {name}(" not in texts[file]] == []


def test_module_with_constants_that_is_not_explained_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "anatomy").mkdir()
    (tmp_path / "anatomy" / "new.py").write_text("A_MM = 1\n", encoding="utf-8")
    with refused(KeyError, "new.py"):
        make_constants_table.make_table(tmp_path)
