"""A docstring of a function names parameters, variables and functions that are there: a new name is carried on."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import chain

from house import ROOT

QUOTED = re.compile(r"(?<!`)`([a-z_][a-z0-9_]*)`(?!`)")
CALLED = re.compile(r"\b(\w+)\(")
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
DEFINITIONS = (*FUNCTIONS, ast.ClassDef)


def names_in(node: ast.AST) -> Iterator[str]:
    """Names that a piece of code uses: of variables, parameters, attributes, keywords, functions, and as texts."""
    for part in ast.walk(node):
        text = getattr(part, "value", None)
        values = [getattr(part, field, None) for field in ("id", "attr", "arg", "name", "asname")]
        yield from (value for value in (*values, text) if isinstance(value, str) and value.isidentifier())


def find_strangers(tree: ast.Module, known: set[str]) -> Iterator[str]:
    """Names in docstrings of functions that neither `known` has nor the function, its class and its module."""
    module = {name for part in tree.body if not isinstance(part, DEFINITIONS) for name in names_in(part)}
    waiting: list[tuple[ast.AST, tuple[ast.AST, ...]]] = [(part, ()) for part in tree.body]
    while waiting:
        node, outer = waiting.pop()
        if isinstance(node, DEFINITIONS):
            outer = (*outer, node)
            quoted = QUOTED.findall(ast.get_docstring(node) or "") if isinstance(node, FUNCTIONS) else []
            strange = [name for name in quoted if name not in known and name not in module]
            used = {name for part in outer for name in names_in(part)} if strange else set()
            yield from (f"{node.name}: {name}" for name in strange if name not in used)
        waiting += [(part, outer) for part in ast.iter_child_nodes(node) if isinstance(part, ast.stmt)]


def definitions_in(tree: ast.Module) -> Iterator[str]:
    """Names of functions and classes, and of what a module sets."""
    for part in ast.walk(tree):
        if isinstance(part, DEFINITIONS):
            yield part.name
    for part in tree.body:
        if isinstance(part, (ast.Assign, ast.AnnAssign)):
            yield from names_in(part)


def test_docstrings_name_what_is_there() -> None:
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted((ROOT / "clrecon").rglob("*.py"))}
    known = {path.stem for path in trees}.union(*map(definitions_in, trees.values()))
    for path in chain((ROOT / "cl").rglob("*.cl"), (ROOT / "cl").rglob("*.h")):
        known.update(CALLED.findall(path.read_text(encoding="utf-8")))
    found = {path.name: list(find_strangers(tree, known)) for path, tree in trees.items()}
    assert {name: strangers for name, strangers in found.items() if strangers} == {}


def test_the_old_name_of_a_parameter_is_found() -> None:
    source = 'def run(item):\n    """Run `item`; `what` names it, `helper` and `KEPT` help."""\n    return item.kept'
    assert list(find_strangers(ast.parse(source), {"helper"})) == ["run: what"]
