"""A docstring of a function names parameters, variables and functions that are there: a new name is carried on."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import chain
from typing import Any

from house import ROOT

import clrecon

QUOTED = re.compile(r"(?<!`)`([a-z_][a-z0-9_]*)`(?!`)")
CALLED = re.compile(r"\b(\w+)\(")
LINKED = re.compile(r"(?<!`)`([A-Za-z_][\w.]*)(?:\(\))?`(?!`)")
HANGING = re.compile(r"^\w[\w, ]*\w: .*\n {4}", re.MULTILINE)
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


def test_names_in_docstrings_of_functions_exist() -> None:
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted((ROOT / "clrecon").rglob("*.py"))}
    known = {path.stem for path in trees}.union(*map(definitions_in, trees.values()))
    for path in chain((ROOT / "cl").rglob("*.cl"), (ROOT / "cl").rglob("*.h")):
        known.update(CALLED.findall(path.read_text(encoding="utf-8")))
    found = {path.name: list(find_strangers(tree, known)) for path, tree in trees.items()}
    assert {name: strangers for name, strangers in found.items() if strangers} == {}


def test_name_in_a_docstring_that_the_code_no_longer_has_is_found() -> None:
    source = 'def run(item):\n    """Run `item`; `what` names it, `helper` and `KEPT` help."""\n    return item.kept'
    assert list(find_strangers(ast.parse(source), {"helper"})) == ["run: what"]


def find_unlinked(docstring: str, owner: type | None) -> list[str]:
    """Names in single backticks that are no link of the Guide: neither public nor methods of the class itself."""
    methods = (Callable, property, classmethod, staticmethod, cached_property)

    def is_method(name: str) -> bool:
        return isinstance(inspect.getattr_static(owner, name, None), methods)

    def is_public(name: str) -> bool:
        value: Any = clrecon
        for part in name.removeprefix("clrecon.").split("."):
            value = getattr(value, part, None)
        return value is not None

    return [name for name in LINKED.findall(docstring) if not is_method(name) and not is_public(name)]


def public_docstrings() -> Iterator[tuple[str, str, type | None]]:
    """Names, docstrings and classes of what the Guide describes: public functions, classes and their methods."""
    for name in dir(clrecon):
        public = getattr(clrecon, name)
        if name.startswith("_") or not callable(public):
            continue
        owner = public if inspect.isclass(public) else None
        yield name, inspect.getdoc(public) or "", owner
        for method in vars(owner) if owner else ():
            if not method.startswith("_"):
                yield f"{name}.{method}", inspect.getdoc(getattr(owner, method)) or "", owner


def test_names_in_docstrings_of_public_names_can_be_linked_by_the_guide() -> None:
    unlinked = {name: find_unlinked(text, owner) for name, text, owner in public_docstrings()}
    assert len(unlinked) > 200  # measured 373: they are looked at
    assert {name: names for name, names in unlinked.items() if names} == {}


def test_no_docstring_of_a_public_name_has_a_hanging_paragraph() -> None:
    docstrings = [(name, text) for name, text, _ in public_docstrings()]
    assert len(docstrings) > 200  # measured 373: they are looked at
    assert [name for name, text in docstrings if HANGING.search(text)] == []


def test_name_in_a_docstring_that_the_guide_cannot_link_is_found() -> None:
    text = "As `Mesh.save`, `save` and `gone`: see ``vertices``."
    assert find_unlinked(text, clrecon.Mesh) == ["gone"]


def test_hanging_paragraph_of_a_docstring_is_found() -> None:
    assert HANGING.search("A box.\n\nlow, high: Corners\n    in mm.") is not None
