#!/usr/bin/env python3
"""Whether two checkouts of clrecon hold the same statements, wherever they stand: the guard of moves and merges.

    python scripts/proof/same_code.py OLD NEW [--renamed OLD_NAME=NEW_NAME ...]

Functions, classes and all other statements at the top of the modules of clrecon/ are compared as syntax trees, without
docstrings, imports and ``__all__``.  Names of modules do not count; other names that a move has changed are given with
--renamed.  The exit status is 0 if both hold the same statements, 1 with a line for each that only one of them has.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path


class _Bare(ast.NodeTransformer):
    """A tree without docstrings and imports, with the names of the new checkout."""

    def __init__(self, renamed: Mapping[str, str]):
        self._renamed = renamed

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        body = getattr(node, "body", None)
        if isinstance(body, list):
            kept = [line for line in body if not _is_text(line) and not isinstance(line, ast.Import | ast.ImportFrom)]
            node.body = kept or [ast.Pass()]  # type: ignore[attr-defined]
        for field in ("id", "name", "attr", "arg"):
            if isinstance(name := getattr(node, field, None), str):
                setattr(node, field, self._renamed.get(name, name))
        return node


def _is_text(line: ast.stmt) -> bool:
    return isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)


def _names_all(line: ast.stmt) -> bool:
    return isinstance(line, ast.Assign) and any(isinstance(to, ast.Name) and to.id == "__all__" for to in line.targets)


def find_statements(checkout: Path, renamed: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield each statement at the top of a module as a text to compare, and where it stands."""
    for path in sorted((checkout / "clrecon").rglob("*.py")):
        for line in ast.parse(path.read_text(encoding="utf-8")).body:
            if _is_text(line) or _names_all(line) or isinstance(line, ast.Import | ast.ImportFrom):
                continue
            yield ast.dump(_Bare(renamed).visit(line)), f"{path.relative_to(checkout)}:{line.lineno}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--renamed", nargs="*", default=[], metavar="OLD_NAME=NEW_NAME")
    options = parser.parse_args()
    renamed = dict(pair.split("=", 1) for pair in options.renamed)
    sides = []
    for checkout in (options.old, options.new):
        found = list(find_statements(checkout, renamed))
        if not found:
            parser.error(f"{checkout} holds no modules of clrecon")
        sides.append((Counter(text for text, _ in found), dict(found)))
    (old, old_places), (new, new_places) = sides
    for text in old - new:
        print(f"only in {options.old}: {old_places[text]}")
    for text in new - old:
        print(f"only in {options.new}: {new_places[text]}")
    print(
        f"{old.total()} and {new.total()} statements, {(old - new).total()} and {(new - old).total()} on one side only"
    )
    return 0 if old.keys() == new.keys() else 1


if __name__ == "__main__":
    sys.exit(main())
