#!/usr/bin/env python3
"""Habits that make the code and its tests hard to read, counted over a checkout.

    python scripts/proof/count_habits.py [--root CHECKOUT] [HABIT ...]

prints the count of each habit, and with names of habits the places of those.  The guard in tests/guards/test_grain.py
holds the counts against ceilings that only fall.
"""

from __future__ import annotations

import argparse
import ast
import gc
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

PRONOUNS = frozenset("found made own each one other what said told at where place way held taken kept".split())
"""Names of variables that say how a value came about, not what it is; a comprehension may use them."""

VERBS = frozenset(
    "ask blend check choose collect compare count cut describe draw estimate extract fill find finish fit grow join "
    "judge look make mark measure name note number numbers of open parse place prepare read say show split spread "
    "start take tell verify warn work write".split()
)
"""Names of functions that leave open what is read, made or checked; a method does it to its object."""

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]+")
PUBLIC_CONSTANTS = re.compile(r"^([A-Z][A-Z0-9_]+(?:, [A-Z][A-Z0-9_]+)*)(?:: [^=\n]+)? = ", re.MULTILINE)
KERNEL = re.compile(r"^__kernel\b.*?^\}", re.DOTALL | re.MULTILINE)
BRANCH = re.compile(r"^[ \t]*#[ \t]*(?:if|ifdef|ifndef|elif|else)\b", re.MULTILINE)
WORDING = re.compile(r"\bmatch=|\bcapsys\b|\bin str\(|str\(\w+\.value\)")
LONG_TABLE = 8
MANY_PARAMETERS = 8
SHORT_BODY = 30
"""Bodies of fewer letters may be equal: they are a call of something else."""

HABITS = (
    "functions_with_pronouns",
    "functions_without_object",
    "assignments_of_three",
    "nested_conditionals",
    "comprehensions_of_two_loops",
    "positional_flags",
    "functions_of_many_parameters",
    "equal_functions",
    "constants_of_one_file",
    "kernels_with_branches",
    "tests_of_wording",
    "tables_without_ids",
    "patches_of_private_names",
)

Places = dict[str, list[str]]


def _read_texts(root: Path, folder: str, pattern: str) -> dict[str, str]:
    paths = [path for path in sorted((root / folder).rglob(pattern)) if "__pycache__" not in path.parts]
    return {path.relative_to(root).as_posix(): path.read_text(encoding="utf-8") for path in paths}


def _own_names(function: ast.AST) -> set[str]:
    """Names that a function gives to its parameters and variables, without those of comprehensions and of functions
    inside of it."""
    names: set[str] = set()
    nodes = list(ast.iter_child_nodes(function))
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        if not isinstance(node, (*FUNCTIONS, *COMPREHENSIONS, ast.Lambda)):
            nodes.extend(ast.iter_child_nodes(node))
    return names


def _habits_of_function(function: ast.FunctionDef | ast.AsyncFunctionDef, is_method: bool) -> Iterator[str]:
    arguments = function.args
    if _own_names(function) & PRONOUNS:
        yield "functions_with_pronouns"
    if not is_method and function.name.strip("_") in VERBS:
        yield "functions_without_object"
    if len(arguments.posonlyargs + arguments.args + arguments.kwonlyargs) >= MANY_PARAMETERS:
        yield "functions_of_many_parameters"
    for default in arguments.defaults:
        if isinstance(default, ast.Constant) and isinstance(default.value, bool):
            yield "positional_flags"


def _habits_of_expression(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Assign):
        if isinstance(node.value, ast.Tuple) and isinstance(node.targets[0], ast.Tuple) and len(node.value.elts) > 2:
            yield "assignments_of_three"
    elif isinstance(node, ast.IfExp):
        if isinstance(node.body, ast.IfExp) or isinstance(node.orelse, ast.IfExp):
            yield "nested_conditionals"
    elif isinstance(node, COMPREHENSIONS) and len(node.generators) > 1:
        yield "comprehensions_of_two_loops"


def _body_text(function: ast.FunctionDef | ast.AsyncFunctionDef, lines: list[str]) -> str:
    """What a function does with its parameters, whatever their names are."""
    body = function.body[ast.get_docstring(function, clean=False) is not None :]
    if not body:
        return ""
    text = "\n".join(line.strip() for line in lines[body[0].lineno - 1 : body[-1].end_lineno])
    for number, argument in enumerate((*function.args.args, *function.args.kwonlyargs)):
        text = re.sub(rf"(?<![\w.]){argument.arg}\b", f"parameter_{number}", text)
    return text


def _count_package(texts: dict[str, str], places: Places) -> None:
    equal: dict[str, set[str]] = defaultdict(set)
    for file, text in texts.items():
        lines, nodes = text.splitlines(), list(ast.walk(ast.parse(text)))
        methods = {id(part) for node in nodes if isinstance(node, ast.ClassDef) for part in node.body}
        for node in nodes:
            habits = _habits_of_expression(node)
            if isinstance(node, FUNCTIONS):
                habits = _habits_of_function(node, id(node) in methods)
                equal[_body_text(node, lines)].add(file)
            for habit in habits:
                places[habit].append(f"{file}:{getattr(node, 'lineno', 0)} {getattr(node, 'name', '')}".rstrip())
    for body, files in equal.items():
        if len(files) > 1 and len(body) > SHORT_BODY:
            places["equal_functions"].append(f"{', '.join(sorted(files))}: {body}")


def _count_constants(package: dict[str, str], places: Places, others: dict[str, str]) -> None:
    """Note the constants without an underscore that no other file, kernel or document names."""
    words = {file: set(re.findall(r"\b[A-Z][A-Z0-9_]+\b", text)) for file, text in (package | others).items()}
    users = Counter(word for names in words.values() for word in names)
    for file, text in package.items():
        names = ", ".join(PUBLIC_CONSTANTS.findall(text)).split(", ")
        places["constants_of_one_file"] += [f"{file}: {name}" for name in names if users[name] == 1]


def _count_kernels(sources: dict[str, str], places: Places) -> None:
    for file, text in sources.items():
        for kernel in KERNEL.findall(text):
            if len(BRANCH.findall(kernel)) > 1:
                places["kernels_with_branches"].append(f"{file}: {kernel.splitlines()[0]}")


def _patches_private(node: ast.AST) -> bool:
    """Whether a call of `setattr` sets a private name or a constant of a module."""
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr"):
        return False
    name = next((each.value for each in node.args[:2][::-1] if isinstance(each, ast.Constant)), None)
    last = name.rpartition(".")[2] if isinstance(name, str) else ""
    return last.startswith("_") or CONSTANT.fullmatch(last) is not None


def _is_table_without_ids(node: ast.AST) -> bool:
    """Whether rows are calls alone: tests/conftest.py names constants, containers and functions, not objects."""
    if not (isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "parametrize" and len(node.args) > 1):
        return False
    rows = getattr(node.args[1], "elts", [])
    named = any(keyword.arg == "ids" for keyword in node.keywords)
    named_rows = [row for row in rows if any(keyword.arg == "id" for keyword in getattr(row, "keywords", []))]
    return (
        len(rows) >= LONG_TABLE
        and not named
        and any(
            all(isinstance(value, ast.Call) for value in getattr(row, "elts", [row]))
            for row in rows
            if row not in named_rows
        )
    )


def _count_tests(texts: dict[str, str], places: Places) -> None:
    for file, text in texts.items():
        lines = text.splitlines()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, FUNCTIONS) and node.name.startswith("test"):
                if WORDING.search("\n".join(lines[node.lineno - 1 : node.end_lineno])):
                    places["tests_of_wording"].append(f"{file}:{node.lineno} {node.name}")
            elif _patches_private(node):
                places["patches_of_private_names"].append(f"{file}:{getattr(node, 'lineno', 0)}")
            elif _is_table_without_ids(node):
                places["tables_without_ids"].append(f"{file}:{getattr(node, 'lineno', 0)}")


@cache
def find_habits(root: Path = ROOT) -> Places:
    """Return the places of each habit by its name."""
    places: Places = {habit: [] for habit in HABITS}
    gc.disable()  # a search among the nodes of all trees takes longer than to parse them
    package, tests = (_read_texts(root, folder, "*.py") for folder in ("clrecon", "tests"))
    _count_package(package, places)
    kernels = _read_texts(root, "cl", "*.*")
    documents = _read_texts(root, "docs", "*.md")
    _count_constants(package, places, tests | kernels | documents | _read_texts(root, "scripts", "*.py"))
    _count_kernels(kernels, places)
    _count_tests(tests, places)
    gc.enable()
    return places


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("habits", nargs="*", default=[], metavar="HABIT", help=", ".join(HABITS))
    parser.add_argument("--root", type=Path, default=ROOT, metavar="CHECKOUT")
    options = parser.parse_args()
    if unknown := set(options.habits) - set(HABITS):
        parser.error(f"no habit of the list: {', '.join(sorted(unknown))}")
    places = find_habits(options.root)
    for habit in HABITS:
        print(f"{habit:32} {len(places[habit]):>6,}")
    for habit in options.habits:
        print("", habit, *places[habit], sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
