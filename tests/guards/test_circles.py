"""No file imports itself round a corner, whether at module level, inside a function or for an annotation."""

from __future__ import annotations

import pytest
from house import find_circles, imported_files, package_modules

CIRCLES_ALLOWED = 1
"""Groups of files that still import each other; the number goes down only."""


def package_imports() -> dict[str, set[str]]:
    modules = package_modules()
    return {name: imported_files(path.read_text(encoding="utf-8"), modules) for name, path in modules.items()}


def test_files_import_each_other_in_one_direction() -> None:
    circles = find_circles(package_imports())
    assert len(circles) <= CIRCLES_ALLOWED, circles


@pytest.mark.parametrize(
    ("imports", "circles"),
    [
        ({"a": ["b"], "b": ["c"], "c": []}, []),
        ({"a": ["b", "c"], "b": ["d"], "c": ["d"], "d": []}, []),
        ({"a": ["b"], "b": ["a"]}, [["a", "b"]]),
        ({"a": ["b"], "b": ["c"], "c": ["d", "a"], "d": ["c"], "e": ["a"]}, [["a", "b", "c", "d"]]),
        ({"a": ["b"], "b": ["a"], "c": ["d", "a"], "d": ["c"]}, [["a", "b"], ["c", "d"]]),
        ({"a": ["a"]}, [["a"]]),
    ],
)
def test_circles_are_found(imports: dict[str, list[str]], circles: list[list[str]]) -> None:
    assert find_circles(imports) == circles


@pytest.mark.parametrize(
    "source",
    [
        "from clrecon.mesh.mesh import Mesh",
        "from clrecon.mesh import mesh",
        "import clrecon.mesh.mesh",
        "def f():\n    from clrecon.mesh.mesh import Mesh",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from clrecon.mesh.mesh import Mesh",
    ],
)
def test_every_kind_of_import_counts(source: str) -> None:
    assert imported_files(source, {"clrecon.mesh", "clrecon.mesh.mesh"}) == {"clrecon.mesh.mesh"}
