"""The package grows no longer, no finer and no harder to read than it is: figures with ceilings that only fall."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from count_habits import find_habits
from house import ROOT
from house_figures import count_grain

CEILINGS = {
    "lines": 101_898,
    "modules": 440,
    "small_modules_with_one_reader": 7,
    "docstrings_with_raises": 139,
    "options_in_several_files": 9,
    "modules_with_own_all": 0,
}
"""Who takes something away lowers the figure in the same commit; who needs more says why in the commit."""

HABITS = {
    "functions_with_pronouns": 26,
    "functions_without_object": 43,
    "assignments_of_three": 18,
    "nested_conditionals": 0,
    "comprehensions_of_two_loops": 23,
    "positional_flags": 0,
    "functions_of_many_parameters": 29,
    "equal_functions": 0,
    "constants_of_one_file": 0,
    "kernels_with_branches": 0,
    "tests_of_wording": 315,
    "tables_without_ids": 0,
    "patches_of_private_names": 23,
}
"""Places of each habit that makes code hard to read; see scripts/proof/count_habits.py."""

BAD = {
    "clrecon/a.py": """\
def take(a, b, c, d, e, f, g, flag=True):
    found, low, high = a, b, c
    kind = 1 if d else 2 if e else 3
    return [x for y in found for x in y], low, high, kind
def f(own):
    return compare(own.first, own.second, own.third)
LENGTH = 3
""",
    "clrecon/b.py": "def g(other):\n    return compare(other.first, other.second, other.third)\n",
    "cl/a.cl": "__kernel void k()\n{\n#if A\n  a();\n#else\n  b();\n#endif\n}\n",
    "tests/test_a.py": """\
@pytest.mark.parametrize("row", [make(1), make(2), make(3), make(4), make(5), make(6), make(7), make(8)])
def test_words(row, monkeypatch):
    monkeypatch.setattr(module, "LIMIT", 2)
    with pytest.raises(ValueError, match="too large"):
        check(row)
""",
}


@pytest.mark.parametrize("habit", HABITS)
def test_places_of_a_habit_that_is_hard_to_read_do_not_grow_in_number(habit: str) -> None:
    assert len(find_habits()[habit]) <= HABITS[habit], f"see scripts/proof/count_habits.py {habit}"


def test_each_habit_that_is_hard_to_read_is_found(tmp_path: Path) -> None:
    for name, text in BAD.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    counts = {habit: len(places) for habit, places in find_habits(tmp_path).items()}
    assert counts == dict.fromkeys(HABITS, 1) | {"functions_with_pronouns": 3}  # take, f and g of `BAD`


@pytest.mark.parametrize("figure", CEILINGS)
def test_figure_of_the_size_of_the_package_stays_below_its_ceiling(figure: str) -> None:
    assert count_grain()[figure] <= CEILINGS[figure], "see scripts/proof/house_figures.py"


def compare_code(old: Path, new: Path, *more: str) -> subprocess.CompletedProcess[str]:
    script = ROOT / "scripts" / "proof" / "same_code.py"
    return subprocess.run([sys.executable, script, old, new, *more], capture_output=True, text=True)


def write_package(folder: Path, **modules: str) -> Path:
    (folder / "clrecon").mkdir(parents=True)
    for module, text in modules.items():
        (folder / "clrecon" / f"{module}.py").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def old_code(tmp_path: Path) -> Path:
    """Two functions in two modules."""
    f = '"""A."""\ndef f():\n    """Text."""\n    return g()\n'
    return write_package(tmp_path / "old", a=f, b="import os\ndef g():\n    return 1\n")


def test_functions_that_moved_without_their_docstrings_are_the_same_code(old_code: Path, tmp_path: Path) -> None:
    moved = write_package(tmp_path / "new", c="def g():\n    return 1\ndef f():\n    return g()\n")
    assert compare_code(old_code, moved).returncode == 0


@pytest.mark.parametrize(("options", "code"), [([], 1), (["--renamed", "g=one"], 0)], ids=["unknown", "declared"])
def test_renamed_function_is_the_same_code_only_if_its_new_name_is_declared(
    options: list[str], code: int, old_code: Path, tmp_path: Path
) -> None:
    renamed = write_package(tmp_path / "new", c="def one():\n    return 1\ndef f():\n    return one()\n")
    assert compare_code(old_code, renamed, *options).returncode == code


def test_function_that_changed_is_named_with_its_place_in_both_packages(old_code: Path, tmp_path: Path) -> None:
    changed = write_package(tmp_path / "new", c="def g():\n    return 2\ndef f():\n    return g()\n")
    done = compare_code(old_code, changed)
    assert done.returncode == 1
    assert f"only in {old_code}: clrecon/b.py:2" in done.stdout
    assert f"only in {changed}: clrecon/c.py:1" in done.stdout
