"""cl/ mirrors clrecon/operators/: the kernels of cl/ROOM/ are launched by the modules of operators/ROOM/."""

from __future__ import annotations

import re
from pathlib import Path

from house import PACKAGE, ROOT

from clrecon.opencl import kernel_files
from clrecon.opencl.quirks import first_header
from clrecon.opencl.sources import EXACT_HEADER

KERNELS = ROOT / "cl"
OPERATORS = PACKAGE / "operators"

FIRST_HEADERS = {EXACT_HEADER, first_header("Portable Computing Language", (3, 0))}
"""Headers that the host puts before every kernel file, always or for some drivers, which no file includes."""

_INCLUDE = re.compile(r'(?m)^\s*#\s*include\s+"([^"]+)"')

WITHOUT_KERNELS = {"vertebrae"}
"""Rooms that call operators of other rooms alone."""


def find_unused_kernels(kernels: list[str], operators: dict[str, str]) -> list[str]:
    """Kernel files that no operator of the same room names; `operators` has the source of each by its path."""
    return [
        name
        for name in kernels
        if not any(f'"{name}"' in text for path, text in operators.items() if Path(path).parent == Path(name).parent)
    ]


def find_folders_of_headers(root: Path) -> dict[str, set[str]]:
    """For each header the folders whose kernel files need it, over other headers too."""
    themes: dict[str, set[str]] = {}

    def follow(name: str, theme: str, seen: set[str]) -> None:
        for header in _INCLUDE.findall((root / name).read_text(encoding="utf-8")):
            if header not in seen:
                seen.add(header)
                themes.setdefault(header, set()).add(theme)
                follow(header, theme, seen)

    for path in root.rglob("*.cl"):
        follow(path.relative_to(root).as_posix(), path.parent.name, set())
    return themes


def find_misplaced(themes: dict[str, set[str]]) -> dict[str, set[str]]:
    """Headers of one folder that lie elsewhere, and shared ones that are not in include/."""
    return {
        header: folders
        for header, folders in themes.items()
        if header.split("/")[0] != (next(iter(folders)) if len(folders) == 1 else "include")
    }


def test_folders_of_kernels_are_those_of_the_operators() -> None:
    folders = {path.name for path in KERNELS.iterdir() if path.is_dir() and any(path.iterdir())}
    rooms = {path.name for path in OPERATORS.iterdir() if (path / "__init__.py").is_file()}
    assert folders - {"include", "__pycache__"} == rooms - WITHOUT_KERNELS
    assert rooms >= WITHOUT_KERNELS


def test_every_kernel_file_is_loaded_by_an_operator_of_the_same_folder() -> None:
    operators = {path.relative_to(OPERATORS).as_posix(): path.read_text("utf-8") for path in OPERATORS.rglob("*.py")}
    assert len(kernel_files()) > 30  # of some 50: they are looked for where they lie
    assert find_unused_kernels(kernel_files(), operators) == []


def test_kernel_file_that_only_operators_of_another_folder_load_is_found() -> None:
    operators = {"rays/pictures.py": 'load("rays/composite.cl")', "masks/mask.py": 'load("rays/cast.cl")'}
    assert find_unused_kernels(["rays/cast.cl", "rays/composite.cl"], operators) == ["rays/cast.cl"]


def test_every_header_is_included_by_a_kernel_or_put_before_all_by_the_host() -> None:
    included = find_folders_of_headers(KERNELS).keys()
    assert included | FIRST_HEADERS == {path.relative_to(KERNELS).as_posix() for path in KERNELS.rglob("*.h")}
    assert included & FIRST_HEADERS == set()


def test_every_header_is_in_the_folder_of_its_kernels_and_shared_ones_in_include() -> None:
    assert find_misplaced(find_folders_of_headers(KERNELS)) == {}


def test_header_of_one_folder_in_include_and_shared_header_of_a_folder_are_found(tmp_path: Path) -> None:
    for name, text in (
        ("rays/a.cl", '#include "rays/near.h"\n#include "include/lone.h"\n'),
        ("surface/b.cl", '#include "rays/near.h"\n'),
        ("rays/near.h", '#include "include/far.h"\n'),
        ("include/lone.h", ""),
        ("include/far.h", ""),
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    misplaced = find_misplaced(find_folders_of_headers(tmp_path))
    assert misplaced == {"rays/near.h": {"rays", "surface"}, "include/lone.h": {"rays"}}
