"""Constants in mm and HU: the table of docs/limits.md has them all, as they are."""

from __future__ import annotations

import re
from pathlib import Path

from house import ROOT
from refusals import refused

import make_constants_table  # isort: skip
import marked_tables  # isort: skip


def test_the_page_has_the_constants_as_they_are() -> None:
    text = make_constants_table.PAGE.read_text(encoding="utf-8")
    found = marked_tables.find_table(text, make_constants_table.NAME)
    assert found == make_constants_table.make_table(), "python scripts/guide/make_constants_table.py"
    assert found.count("\n") > 90


def test_constants_are_found_with_their_first_sentence() -> None:
    source = 'A_MM, B = 1.0, 2\n"""How far.  And more."""\nC_HU: float = -3.0\nD = 4\n_E_MM = 5\nBONE_HU_MOST = 6\n'
    assert list(make_constants_table.find_constants(source)) == [
        ("A_MM, B", "(1.0, 2)", "How far"),
        ("C_HU", "-3.0", ""),
        ("BONE_HU_MOST", "6", ""),
    ]


def test_what_is_said_to_follow_is_there_in_its_unit_and_shown_by_a_test() -> None:
    units: dict[str, set[str]] = {}
    for row in make_constants_table.make_table().splitlines()[2:]:
        module, names, _, _, follows = (cell.strip() for cell in row.strip("|").split(" | "))
        own = {match[1] for match in map(make_constants_table.UNITS.match, names.split(", ")) if match}
        units.setdefault(f"{module}.py", set()).update(own)
        assert ("values:" in follows) == ("HU" in own), row
        assert any(word in follows for word in ("voxel", "object", "files", "nothing")) == (own != {"HU"}), row
    lengths, values = make_constants_table.LENGTHS, make_constants_table.VALUES
    assert set(lengths) == {module for module, own in units.items() if own != {"HU"}}
    assert all("HU" in units[module] for module in values)
    follow = {module for module, text in lengths.items() if re.search(r"voxel|step|spacing|share", text)} | set(values)
    assert set(make_constants_table.SHOWN_BY) == follow
    for place in make_constants_table.SHOWN_BY.values():
        file, name = place.split("::")
        assert f"def {name}(" in (ROOT / "tests" / file).read_text(encoding="utf-8"), place


def test_a_module_that_nothing_is_said_of_is_found(tmp_path: Path) -> None:
    (tmp_path / "anatomy").mkdir()
    (tmp_path / "anatomy" / "new.py").write_text("A_MM = 1\n", encoding="utf-8")
    with refused(KeyError, "new.py"):
        make_constants_table.make_table(tmp_path)
