"""Every module imports only what stands left of it, and heavy libraries only where and when they are needed."""

from __future__ import annotations

import pytest
from house import LEFT_OF, find_layer_faults, layer_of, package_modules


def test_every_module_keeps_to_its_layer() -> None:
    modules = package_modules()
    assert len(modules) > 20
    faults = [
        fault
        for name, path in modules.items()
        for fault in find_layer_faults(path.read_text(encoding="utf-8"), name, path.name == "__init__.py")
    ]
    assert faults == []


def test_every_folder_is_a_known_layer() -> None:
    assert {layer_of(name) for name in package_modules()} <= set(LEFT_OF)


def test_no_layer_imports_one_that_imports_it() -> None:
    layers = {name: allowed for name, allowed in LEFT_OF.items() if name != "__init__"}
    loops = [(a, b) for a, allowed in layers.items() for b in allowed if a in layers[b]]
    assert loops == []


@pytest.mark.parametrize(
    ("module", "source", "expected"),
    [
        ("clrecon.geometry.volume", "from clrecon.dicom import read_volume", "may not import clrecon.dicom"),
        ("clrecon.geometry.volume", "def f():\n    import clrecon.opencl.select", "may not import clrecon.opencl"),
        ("clrecon.exchange.stl", "from ..dicom import read_volume", "may not import clrecon.dicom"),
        ("clrecon.phantom.shapes", "from clrecon.mesh import Mesh", "may not import clrecon.mesh"),
        ("clrecon.operators.surface.extract", "from clrecon import reference", "may not import clrecon.reference"),
        ("clrecon.cli.main", "from clrecon.geometry import Volume", "may not import clrecon.geometry"),
        ("clrecon.mesh.quality", "import scipy.spatial", "scipy at module level"),
        ("clrecon.reference.surface.extract", "def f():\n    import pyopencl", "may not import pyopencl"),
        ("clrecon.jobs.mesh.job", "try:\n    import pyvista\nexcept ImportError:\n    pass", "pyvista at module level"),
        ("clrecon.novelty.thing", "", "not in the table"),
        ("clrecon.errors", "import numpy", "numpy at module level"),
    ],
)
def test_a_wrong_import_is_found(module: str, source: str, expected: str) -> None:
    faults = find_layer_faults(source, module)
    assert len(faults) == 1
    assert expected in faults[0]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("clrecon.jobs.selftest", "from clrecon.reference.surface import extract"),
        ("clrecon.mesh.quality", "def f():\n    import scipy.spatial"),
        (
            "clrecon.jobs.mesh.job",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from clrecon.mesh import Mesh",
        ),
        ("clrecon.geometry.volume", "from .affine import apply_affine\nimport numpy.typing"),
    ],
)
def test_a_right_import_is_accepted(module: str, source: str) -> None:
    assert find_layer_faults(source, module) == []
