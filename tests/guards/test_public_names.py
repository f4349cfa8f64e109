"""The public names stand in one list, and what all of them have in common has one form."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import pytest
from house import PACKAGE

import clrecon

STUB = (PACKAGE / "__init__.pyi").read_text(encoding="utf-8")
KEYWORDS = ("device", "memory", "progress")
"""What a call is computed with, not what it computes: never by position."""

TAKE_PROGRESS = {
    "write_volume",
    "Mask.from_band", "SurfaceExtractor.extract_vertices", "extract_points",
    "SurfaceExtractor.extract", "VolumeRenderer.render", "choose_iso_value", "cluster_points", "collapse_quadric",
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


def test_the_stub_says_each_name_once_and_says_them_all() -> None:
    imported = re.findall(r"^from ([\w.]+) import (\w+) as (\w+)$", STUB, re.MULTILINE)
    assigned = re.findall(r"^(\w+) = \w+$", STUB, re.MULTILINE)
    names = [*(name for _, _, name in imported), *assigned, "__version__"]
    assert sorted(names) == sorted(clrecon.__all__)
    assert len(set(names)) == len(names) > 40
    for module, there, name in imported:
        assert there == name and getattr(clrecon, name) is getattr(import_module(module), name)


def test_name_that_is_not_public_is_not_there() -> None:
    for name in ("choose_device", "list_devices", "import_module_", "rendr", "_nothing"):
        with pytest.raises(AttributeError, match=name):
            getattr(clrecon, name)
    assert {name for name in dir(clrecon) if not name.startswith("__")} == set(clrecon.__all__) - {"__version__"}
    assert len(clrecon.__all__) <= 110


def test_star_import_takes_the_public_names() -> None:
    space: dict[str, Any] = {}
    exec("from clrecon import *", space)
    assert set(clrecon.__all__) <= set(space)


def test_device_memory_and_progress_are_given_by_name() -> None:
    found = dict(public_callables())
    assert len(found) > 60
    assert {name: own for name, function in found.items() if (own := by_position(function))} == {}


def test_a_device_by_position_is_found() -> None:
    def takes(volume: int, device: int, *, memory: int) -> None: ...

    assert by_position(takes) == ["device"]


def test_functions_that_take_long_tell_their_progress() -> None:
    take = {name for name, function in public_callables() if "progress" in inspect.signature(function).parameters}
    assert take == TAKE_PROGRESS
