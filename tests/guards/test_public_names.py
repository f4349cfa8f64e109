"""The public names stand in one list, and what all of them have in common has one form."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import pytest
from house import PACKAGE
from refusals import refused

import clrecon

STUB = (PACKAGE / "__init__.pyi").read_text(encoding="utf-8")
KEYWORDS = ("device", "memory", "progress")
"""What a call is computed with, not what it computes: never by position."""

TAKE_PROGRESS = {
    "write_volume",
    "Mask.from_band", "SurfaceExtractor.extract_vertices", "extract_points",
    "SurfaceExtractor.extract", "SurfaceExtractor.save",
    "VolumeRenderer.render", "choose_iso_value", "cluster_points", "collapse_quadric",
    "compare_meshes", "extract_by_method",
    "cut_slice", "decimate_mesh", "denoise_points", "estimate_normals", "extract_isosurface", "extract_isosurfaces",
    "extract_label_masks", "extract_labels", "fill_enclosed", "filter_bilateral", "filter_volume",
    "fit_cortex",
    "find_cut_cells", "find_ghost_slices", "find_mesh_cells", "find_neighbours", "find_spine_line",
    "list_series", "mask_field_of_view", "measure_cells", "measure_distance", "measure_labels", "measure_slices",
    "measure_truth", "measure_vertex_distances",
    "split_vertebrae", "read_labels", "read_volume", "reconstruct_surface", "reformat_curve",
    "remove_outliers", "remove_sparse_cells", "remove_table", "render", "resample_labels", "smooth_mesh", "thin_points",
    "DeviceVolume.resample", "DeviceVolume.save", "Volume.resample", "Volume.save",
    "write_animation",
}  # fmt: skip
"""What can take longer than a second."""


def public_callables() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Public functions, classes and their methods."""
    for name in clrecon.__all__:
        public = getattr(clrecon, name)
        if isinstance(public, type) and not issubclass(public, Exception):
            yield name, public
            methods = inspect.getmembers(public, lambda own: inspect.isfunction(own) or inspect.ismethod(own))
            yield from ((f"{name}.{own}", method) for own, method in methods if not own.startswith("_"))
        elif inspect.isfunction(public):
            yield name, public


def by_position(function: Callable[..., Any]) -> list[str]:
    """Parameters of `KEYWORDS` that a function takes by position, but for a method that passes one of them on."""
    parameters = inspect.signature(function).parameters.values()
    return [own.name for own in parameters if own.name in KEYWORDS and own.kind is not own.KEYWORD_ONLY]


IMPORTED = re.findall(r"^from ([\w.]+) import (\w+) as (\w+)$", STUB, re.MULTILINE)
"""Module, name there, and public name."""


def test_stub_declares_each_public_name_once() -> None:
    assigned = re.findall(r"^(\w+) = \w+$", STUB, re.MULTILINE)
    names = [*(name for _, _, name in IMPORTED), *assigned, "__version__"]
    assert sorted(names) == sorted(set(clrecon.__all__))


@pytest.mark.parametrize(("module", "name_there", "name"), IMPORTED, ids=lambda value: value)
def test_public_name_is_the_object_that_the_stub_imports(module: str, name_there: str, name: str) -> None:
    assert name_there == name
    assert getattr(clrecon, name) is getattr(import_module(module), name)


@pytest.mark.parametrize("name", ["choose_device", "list_devices", "import_module_", "rendr", "_nothing"])
def test_name_that_is_not_public_is_no_attribute_of_clrecon(name: str) -> None:
    with refused(AttributeError, name):
        getattr(clrecon, name)


def test_dir_of_clrecon_has_the_public_names_alone() -> None:
    assert {name for name in dir(clrecon) if not name.startswith("__")} == set(clrecon.__all__) - {"__version__"}


def test_clrecon_has_at_most_110_public_names() -> None:
    assert len(clrecon.__all__) <= 110  # as many as there are: a new name takes the place of another


def test_star_import_takes_the_public_names() -> None:
    namespace: dict[str, Any] = {}
    exec("from clrecon import *", namespace)
    assert set(clrecon.__all__) <= set(namespace)


def test_no_public_function_takes_device_memory_or_progress_by_position() -> None:
    functions = dict(public_callables())
    assert len(functions) > 200  # with methods; measured 305, and of none nothing would be looked at
    assert {name: found for name, function in functions.items() if (found := by_position(function))} == {}


def test_parameter_device_that_is_taken_by_position_is_found() -> None:
    def extract(volume: int, device: int, *, memory: int) -> None: ...

    assert by_position(extract) == ["device"]


def test_public_functions_that_report_progress_are_those_listed_as_taking_long() -> None:
    reporting = {name for name, function in public_callables() if "progress" in inspect.signature(function).parameters}
    assert reporting == TAKE_PROGRESS
