"""The texts of the project: tests that assert, no machine paths, no unfinished marks, generated files up to date."""

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
    assert len(files) >= 5
    lazy = {path.name: names for path in files if (names := find_tests_without_assertion(path.read_text()))}
    assert lazy == {}


_FROM_TESTS = re.compile(r"(?m)^\s*(?:from|import) (?:tests\b|guards\b|test_\w+)")


def test_helpers_of_tests_are_imported_one_way() -> None:
    folder = ROOT / "tests"
    files = [path for path in project_files(".py") if path.is_relative_to(folder)]
    helpers = [path for path in files if not path.name.startswith(("test_", "conftest"))]
    assert len(helpers) > 10 and {path.parent for path in helpers} == {folder / "support"}
    assert [path.name for path in files if _FROM_TESTS.search(path.read_text(encoding="utf-8"))] == []
    assert _FROM_TESTS.search("import numpy\nfrom tests.support import house\n")
    assert _FROM_TESTS.search("def f():\n    import test_texts\n")


def test_test_files_have_names_of_their_own() -> None:
    names = [path.name for path in project_files(".py") if path.is_relative_to(ROOT / "tests")]
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize(
    "body", ["pass", "assert True", "run()", "with pytest.raises(ValueError):\n        run()", "print(assert_all)"]
)
def test_a_test_without_assertion_is_found(body: str) -> None:
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
def test_a_test_with_assertion_is_accepted(body: str) -> None:
    assert find_tests_without_assertion(f"def test_it():\n    {body}\n") == []


def test_texts_hold_no_machine_paths_and_no_unfinished_marks() -> None:
    files = project_files(*TEXT_SUFFIXES)
    assert len(files) > 40
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
def test_a_forbidden_line_is_found(line: str) -> None:
    assert len(find_forbidden(f"fine\n{line}\n")) == 1


def test_files_are_short() -> None:
    longest = {path.name: len(path.read_text().splitlines()) for path in project_files(".py", ".cl")}
    assert {name: lines for name, lines in longest.items() if lines > 600} == {}


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


def test_functions_are_short() -> None:
    found = {path.name: names for path in project_files(".py") if (names := long_functions(path.read_text()))}
    assert found == {}
    assert long_functions("def f():\n" + "    x = 1\n" * 80) == ["f"]
    assert long_functions("def f():\n" + "    x = 1\n" * 79) == []
    inner = "class C:\n    def f():\n        try:\n            pass\n        except E:\n            def g():\n"
    assert long_functions(inner + "                x = 1\n" * 80) == ["f", "g"]


def test_generated_files_are_up_to_date_and_a_changed_one_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rendered = {name: render() for name, render in derive_mc_tables.HEADERS.items()}
    check = partial(
        derive_mc_tables.main, ["--check"], headers={name: partial(str, text) for name, text in rendered.items()}
    )
    assert (check(), capsys.readouterr().out) == (0, "")
    assert len(rendered) == 2
    for changed in (None, *rendered):
        for name, text in rendered.items():
            (tmp_path / name).write_text(text.replace("0x", "0X", 1) if name == changed else text)
        assert check(folder=tmp_path) == (changed is not None)
        said = capsys.readouterr().out
        assert said.count("is not what the table gives") == (changed is not None) and (changed or "") in said
