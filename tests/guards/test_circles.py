"""No file imports itself over others, whether at module level, inside a function or for an annotation."""

from __future__ import annotations

from functools import cache

import pytest
from house import find_circles, imported_files, package_modules


@cache
def package_imports() -> dict[str, set[str]]:
    modules = package_modules()
    return {name: imported_files(path.read_text(encoding="utf-8"), modules) for name, path in modules.items()}


def test_no_file_of_the_package_imports_itself_over_others() -> None:
    assert len(package_imports()) > 300  # of some 430 files: the whole package is looked at
    assert find_circles(package_imports()) == []


def room_imports(imports: dict[str, set[str]], packages: set[str]) -> dict[str, set[str]]:
    """The same between rooms and the rooms in them: ``reading.dicom``, ``reading`` (what lies in no inner room)."""

    def room_of(module: str) -> str:
        return module if module in packages else module.rpartition(".")[0]

    found: dict[str, set[str]] = {room_of(module): set() for module in imports}
    for module, others in imports.items():
        rooms = {room_of(other) for other in others}
        found[room_of(module)] |= {room for room in rooms if room not in (room_of(module), "clrecon")}
    return found


def test_no_folder_of_the_package_imports_itself_over_others() -> None:
    packages = {name for name, path in package_modules().items() if path.name == "__init__.py"}
    rooms = room_imports(package_imports(), packages)
    assert len(rooms) > 30  # of some 55 folders: the whole package is looked at
    assert find_circles(rooms) == []


def test_folders_that_import_each_other_over_different_files_are_found() -> None:
    imports = {"c.a.x.one": {"c.a.y.two"}, "c.a.y.two": set(), "c.a.y.three": {"c.a.x.four"}, "c.a.x.four": set()}
    assert find_circles(imports) == []  # of files
    assert find_circles(room_imports(imports, {"c.a.x", "c.a.y"})) == [["c.a.x", "c.a.y"]]


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
    ids=["chain", "two ways to one file", "pair", "two circles with a common file", "two circles", "itself"],
)
def test_circles_of_imports_are_found(imports: dict[str, list[str]], circles: list[list[str]]) -> None:
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
    ids=["name of a module", "module of a package", "dotted import", "inside a function", "for type checkers"],
)
def test_every_kind_of_import_counts_as_an_import_of_its_file(source: str) -> None:
    assert imported_files(source, {"clrecon.mesh", "clrecon.mesh.mesh"}) == {"clrecon.mesh.mesh"}
