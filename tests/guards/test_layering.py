"""Every module imports only what stands left of it, and heavy libraries only where and when they are needed."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from house import LEFT_OF, PACKAGE, ROOT, find_layer_faults, layer_of, package_modules, read_imports


def test_every_module_keeps_to_its_layer() -> None:
    modules = package_modules()
    assert len(modules) > 300  # measured 432: they are looked at
    faults = [
        fault
        for name, path in modules.items()
        for fault in find_layer_faults(path.read_text(encoding="utf-8"), name, path.name == "__init__.py")
    ]
    assert faults == []


def test_every_import_that_the_table_of_layers_allows_occurs() -> None:
    used: dict[str, set[str]] = {layer: set() for layer in LEFT_OF}
    for name, path in package_modules().items():
        source = path.read_text(encoding="utf-8")
        imported = {
            layer_of(other)
            for other, _, _ in read_imports(source, name, path.name == "__init__.py")
            if other.split(".")[0] == "clrecon"
        }
        used[layer_of(name)] |= imported - {layer_of(name)}
    assert {layer: set(allowed) for layer, allowed in LEFT_OF.items()} == used


def test_every_folder_of_the_package_is_in_the_table_of_layers() -> None:
    assert {layer_of(name) for name in package_modules()} <= set(LEFT_OF)


def test_no_two_layers_may_import_each_other() -> None:
    layers = {name: allowed for name, allowed in LEFT_OF.items() if name != "__init__"}
    pairs = [(first, second) for first, allowed in layers.items() for second in allowed if first in layers[second]]
    assert pairs == []


@pytest.mark.parametrize(
    ("module", "source", "expected"),
    [
        (
            "clrecon.geometry.volume",
            "from clrecon.reading.dicom import read_volume",
            "may not import clrecon.reading.dicom",
        ),
        ("clrecon.geometry.volume", "def f():\n    import clrecon.opencl.select", "may not import clrecon.opencl"),
        ("clrecon.exchange.stl", "from ..reading.dicom import read_volume", "may not import clrecon.reading.dicom"),
        ("clrecon.mesh.mesh", "from clrecon.proof.phantom import MATERIALS", "may not import clrecon.proof"),
        ("clrecon.operators.surface.extract", "from clrecon import proof", "may not import clrecon.proof"),
        ("clrecon.cli.main", "from clrecon.geometry import Volume", "may not import clrecon.geometry"),
        ("clrecon.mesh.quality", "import scipy.spatial", "scipy at module level"),
        ("clrecon.proof.surface.extract", "def f():\n    import pyopencl", "may not import pyopencl"),
        ("clrecon.jobs.mesh.job", "try:\n    import pyvista\nexcept ImportError:\n    pass", "pyvista at module level"),
        ("clrecon.novelty.thing", "", "not in the table"),
        ("clrecon.errors", "import numpy", "numpy at module level"),
    ],
)
def test_import_against_the_table_of_layers_or_of_a_heavy_package_is_found(
    module: str, source: str, expected: str
) -> None:
    [fault] = find_layer_faults(source, module)
    assert expected in fault


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("clrecon.proof.surface.surface_checks", "from clrecon.operators.surface import extract"),
        ("clrecon.mesh.quality", "def f():\n    import scipy.spatial"),
        (
            "clrecon.jobs.mesh.job",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from clrecon.mesh import Mesh",
        ),
        ("clrecon.geometry.volume", "from .affine import apply_affine\nimport numpy.typing"),
    ],
)
def test_import_within_the_table_of_layers_is_no_fault(module: str, source: str) -> None:
    assert find_layer_faults(source, module) == []


CALLS_PUBLIC = {
    "clrecon/geometry/volume.py": {"write_volume", "show"},
    "clrecon/labels/label_map.py": {"Mask", "resample_labels"},
    "clrecon/mesh/mesh.py": {"show"},
    "clrecon/operators/masks/mask.py": {"extract_label_masks"},
    "clrecon/system/packages.py": {"to_html"},
}
"""Methods that are public functions further right, called by their public names and not imported."""


def public_calls(source: str) -> set[str]:
    """Names that a source asks `clrecon.system.packages` for; "?" for one that is not written out."""
    if "public_function" not in source:
        return set()
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    asked = [call.args[0] for call in calls if isinstance(call.func, ast.Name) and call.func.id == "public_function"]
    return {str(name.value) if isinstance(name, ast.Constant) else "?" for name in asked}


def test_only_listed_modules_call_public_functions_of_layers_further_right() -> None:
    files = package_modules().values()
    found = {path.relative_to(ROOT).as_posix(): public_calls(path.read_text(encoding="utf-8")) for path in files}
    assert {name: calls for name, calls in found.items() if calls} == CALLS_PUBLIC


def test_call_of_a_public_function_is_found_by_its_name_or_as_unknown() -> None:
    assert public_calls("public_function('a')(public_function(b))") == {"a", "?"}


VTK_ELSEWHERE = {
    "clrecon/exchange/vtp.py",  # VTK's own format, written by VTK
    "clrecon/proof/bench.py",  # VTK as the peer that is timed
    "clrecon/proof/compare/makers.py",  # the same, as peers that are compared
}


def imports_vtk(source: str, module: str = "clrecon.room.module", is_package: bool = False) -> bool:
    return any(
        name.split(".")[0] in ("pyvista", "vtk", "vtkmodules")
        for name, _, _ in read_imports(source, module, is_package)
    )


def test_vtk_is_imported_by_files_named_vtk_the_viewer_and_listed_files_alone() -> None:
    importing = {
        path.relative_to(ROOT).as_posix()
        for name, path in package_modules().items()
        if imports_vtk(path.read_text(encoding="utf-8"), name, path.name == "__init__.py")
    }
    others = {name for name in importing if not name.endswith("/vtk.py") and not name.startswith("clrecon/viewer/")}
    assert others == VTK_ELSEWHERE


@pytest.mark.parametrize(
    ("source", "is_found"),
    [
        ("def f():\n    from vtkmodules.vtkCommonCore import vtkPoints", True),
        ("from clrecon.exchange.vtp import make_polydata", False),
    ],
)
def test_import_of_vtk_inside_a_function_is_found(source: str, is_found: bool) -> None:
    assert imports_vtk(source) == is_found


def reference_implementations() -> list[Path]:
    """Files of slow, plain twins of operators, without the checks that compare both."""
    rooms = {path.parent.name for path in (PACKAGE / "operators").glob("*/__init__.py")}
    files = [path for room in sorted({*rooms, "volumes"}) for path in (PACKAGE / "proof" / room).glob("*.py")]
    return [path for path in files if "_check" not in path.name]


@pytest.mark.parametrize("path", reference_implementations(), ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_reference_implementation_imports_nothing_of_the_operators_that_it_checks(path: Path) -> None:
    imports = read_imports(path.read_text(encoding="utf-8"), path.stem)
    layers = {layer_of(name) for name, *_ in imports if "clrecon" in name}
    assert layers <= {"errors", "geometry", "labels", "rendering", "proof"}
