"""The files of the project: tests that assert, no machine paths, no unfinished marks, generated files up to date."""

from __future__ import annotations

import ast
import re
from functools import partial
from pathlib import Path

import derive_mc_tables
import pytest
from house import ROOT, project_files, statements_of

TEXT_SUFFIXES = (".py", ".cl", ".h", ".md", ".cfg", ".toml", ".cff", ".yaml", "run")
FORBIDDEN = {
    "a path of one machine": re.compile(r"(?<![\w.])/(?:home|root|Users|wor" + r"k|tmp/\w+)/"),
    "a mark of an unfinished merge": re.compile(r"^(?:<{7}|>{7})(?: |$)"),
    "an unfinished mark": re.compile(r"\b(?:TO" + r"DO|FIX" + r"ME|XX" + r"X|HA" + r"CK)\b"),
}


def find_forbidden(text: str) -> list[str]:
    return [
        f"{number}: {what}"
        for number, line in enumerate(text.splitlines(), start=1)
        for what, pattern in FORBIDDEN.items()
        if pattern.search(line)
    ]


def _asserts_value(node: ast.AST) -> bool:
    """An assert of something that can be false, a numpy or own assertion, or an expected error."""
    if isinstance(node, ast.Assert):
        return not isinstance(node.test, ast.Constant)
    if isinstance(node, ast.Call):
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        expects_error = name == "refused" or (
            name == "raises" and any(keyword.arg == "match" for keyword in node.keywords)
        )
        return name.startswith(("assert_", "check_")) or expects_error
    return False


def find_tests_without_assertion(source: str) -> list[str]:
    return [
        node.name
        for node in statements_of(source)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and node.name.startswith("test_")
        and not any(_asserts_value(child) for child in ast.walk(node))
    ]


def test_every_test_asserts_a_value() -> None:
    files = [path for path in project_files(".py") if path.name.startswith("test_") and "tests" in path.parts]
    assert len(files) > 300  # of some 490: tests are looked for where they lie
    lazy = {path.name: names for path in files if (names := find_tests_without_assertion(path.read_text()))}
    assert lazy == {}


_FROM_TESTS = re.compile(r"(?m)^\s*(?:from|import) (?:tests\b|guards\b|test_\w+)")


FILES_OF_TESTS = [path for path in project_files(".py") if path.is_relative_to(ROOT / "tests")]


def test_helpers_of_tests_are_in_the_folder_support() -> None:
    helpers = [path for path in FILES_OF_TESTS if not path.name.startswith(("test_", "conftest"))]
    assert {path.parent for path in helpers} == {ROOT / "tests" / "support"}


def test_no_file_of_tests_imports_another_one_by_its_folder_or_a_test() -> None:
    assert [path.name for path in FILES_OF_TESTS if _FROM_TESTS.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(
    "source", ["import numpy\nfrom tests.support import house\n", "def f():\n    import test_texts\n"]
)
def test_import_of_a_folder_of_tests_or_of_a_test_is_found(source: str) -> None:
    assert _FROM_TESTS.search(source) is not None


def test_no_two_files_of_tests_have_the_same_name() -> None:
    names = [path.name for path in FILES_OF_TESTS]
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize(
    "body", ["pass", "assert True", "run()", "with pytest.raises(ValueError):\n        run()", "print(assert_all)"]
)
def test_test_that_asserts_no_value_is_found(body: str) -> None:
    assert find_tests_without_assertion(f"def test_it():\n    {body}\n") == ["test_it"]


@pytest.mark.parametrize(
    "body",
    [
        "assert run() == 3",
        "np.testing.assert_allclose(a, b)",
        "with pytest.raises(ValueError, match='no'):\n        run()",
        "with refused(ValueError, 3):\n        run()",
    ],
)
def test_test_that_asserts_a_value_or_expects_a_message_is_accepted(body: str) -> None:
    assert find_tests_without_assertion(f"def test_it():\n    {body}\n") == []


def test_no_file_has_a_path_of_one_machine_or_an_unfinished_mark() -> None:
    files = project_files(*TEXT_SUFFIXES)
    assert len(files) > 600  # of more than 1000: texts are looked for where they lie
    faults = [f"{path.name}:{fault}" for path in files for fault in find_forbidden(path.read_text(encoding="utf-8"))]
    assert faults == []


@pytest.mark.parametrize(
    "line",
    [
        "x = 1  # TO" + "DO later",
        "open('/wor" + "k/main/a')",
        "see /ho" + "me/ann/x",
        "<" * 7 + " HEAD",
        ">" * 7 + " a1b2",
    ],
)
def test_line_with_a_path_of_one_machine_or_an_unfinished_mark_is_found(line: str) -> None:
    [fault] = find_forbidden(f"fine\n{line}\n")
    assert fault.startswith("2: ")


def test_no_file_of_python_or_kernels_has_more_than_600_lines() -> None:
    counts = {path: len(path.read_text().splitlines()) for path in project_files(".py", ".cl")}
    assert len(counts) > 600  # files, of some 1160: the whole project is looked at
    assert {path.name: lines for path, lines in counts.items() if lines > 600} == {}


_FUNCTION = re.compile(r"^( *)(?:async )?def ", re.MULTILINE)


def long_functions(source: str, limit: int = 80) -> list[str]:
    """Functions of more than `limit` lines, the docstring among them."""
    starts = [(source.count("\n", 0, found.start()), len(found[1])) for found in _FUNCTION.finditer(source)]
    ends = [
        next((line for line, further in starts[place + 1 :] if further <= indent), source.count("\n") + 1)
        for place, (_, indent) in enumerate(starts)
    ]  # where the next function begins that is not of this one
    if all(end - start < limit for (start, _), end in zip(starts, ends, strict=True)):
        return []  # which spares most files the parser
    return [
        node.name
        for node in statements_of(source)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and (node.end_lineno or node.lineno) - node.lineno >= limit
    ]


def test_no_function_has_more_than_80_lines() -> None:
    assert {path.name: names for path in project_files(".py") if (names := long_functions(path.read_text()))} == {}


@pytest.mark.parametrize(
    ("source", "functions"),
    [
        pytest.param("def f():\n" + "    x = 1\n" * 79, [], id="80 lines"),
        pytest.param("def f():\n" + "    x = 1\n" * 80, ["f"], id="81 lines"),
        pytest.param(
            "class C:\n    def f():\n        try:\n            pass\n        except E:\n            def g():\n"
            + "                x = 1\n" * 80,
            ["f", "g"],
            id="function in a method",
        ),
    ],
)
def test_function_of_more_than_80_lines_is_found(source: str, functions: list[str]) -> None:
    assert long_functions(source) == functions


@pytest.fixture(scope="module")
def rendered_tables() -> dict[str, str]:
    """Headers with the tables of marching cubes, as the script derives them now: it takes a second."""
    return {name: render() for name, render in derive_mc_tables.HEADERS.items()}


def check_tables(rendered: dict[str, str], **folder: Path) -> int:
    return derive_mc_tables.main(
        ["--check"], headers={name: partial(str, text) for name, text in rendered.items()}, **folder
    )


def test_generated_tables_of_marching_cubes_are_those_that_the_script_derives(rendered_tables: dict[str, str]) -> None:
    assert check_tables(rendered_tables) == 0


@pytest.mark.parametrize("changed", derive_mc_tables.HEADERS)
def test_generated_table_that_was_changed_is_found_by_its_name(
    changed: str, rendered_tables: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, text in rendered_tables.items():
        (tmp_path / name).write_text(text.replace("0x", "0X", 1) if name == changed else text)
    assert check_tables(rendered_tables, folder=tmp_path) == 1
    [line] = capsys.readouterr().out.splitlines()
    assert changed in line
    assert "is not what the table gives" in line
