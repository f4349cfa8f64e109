"""The plugin of napari: its manifest, where its layers lie, and its command in a viewer without a screen."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from house import ROOT
from refusals import refused

from clrecon.errors import UsageError
from clrecon.exchange.formats import MESH_INPUTS
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.reading import read_volume
from clrecon.viewer import napari as plugin

MANIFEST = ROOT / "clrecon" / "viewer" / "napari.yaml"
SPHERE = PhantomSettings(
    kind="sphere",
    size=(40, 36),
    slices=24,
    spacing=(1.0, 0.9, 1.4),
    tilt=8.0,
    oblique=(5.0, -4.0, 12.0),
    radius_mm=11.0,
)


@pytest.fixture(scope="module")
def sphere_series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a series of `SPHERE`, which is tilted."""
    folder = tmp_path_factory.mktemp("napari") / "ct"
    write_phantom(folder, SPHERE)
    return folder


def read_manifest() -> Any:
    return pytest.importorskip("npe2").PluginManifest.from_file(MANIFEST)


def test_commands_of_the_manifest_are_functions_of_the_plugin() -> None:
    commands = read_manifest().contributions.commands
    assert commands
    for command in commands:
        module, _, name = command.python_name.partition(":")
        assert callable(getattr(import_module(module), name))


def test_manifest_names_the_files_that_the_reader_takes(tmp_path: Path) -> None:
    [reader] = read_manifest().contributions.readers
    extensions = {pattern.removeprefix("*") for pattern in reader.filename_patterns}

    assert extensions >= set(MESH_INPUTS)
    assert all(plugin.get_reader(f"a{extension}") for extension in extensions)
    assert plugin.get_reader(str(tmp_path))
    assert plugin.get_reader("a.txt") is None
    assert plugin.get_reader(["a.dcm", "b.dcm"]) is None


def test_voxels_of_the_layer_of_a_tilted_scan_lie_where_the_scan_has_them(sphere_series: Path) -> None:
    volume = read_volume(sphere_series)
    reader = plugin.get_reader(str(sphere_series))
    assert reader

    [(voxels, attributes, kind)] = reader(str(sphere_series))

    assert kind == "image"
    assert np.array_equal(voxels, volume.voxels)
    world = attributes["affine"] @ [3, 2, 1, 1]  # k, j, i
    assert world[2::-1] == pytest.approx(volume.ijk_to_lps(np.array([1, 2, 3])), abs=1e-9)
    assert attributes["metadata"]["certificate"]["tilt_deg"] == pytest.approx(SPHERE.tilt)


def test_layer_of_a_mesh_has_its_vertices_with_the_axes_in_reverse(tmp_path: Path) -> None:
    corners = [[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]
    mesh = Mesh(corners, triangles=[[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    mesh.save(tmp_path / "m.ply")
    reader = plugin.get_reader(str(tmp_path / "m.ply"))
    assert reader

    [((vertices, triangles), _, kind)] = reader(str(tmp_path / "m.ply"))

    assert kind == "surface"
    assert np.array_equal(vertices, mesh.vertices[:, ::-1])
    assert np.array_equal(triangles, mesh.triangles)


def test_surface_without_a_selected_scan_is_refused() -> None:
    viewer = SimpleNamespace(layers=SimpleNamespace(selection=[]))
    with refused(UsageError, 0, "select"):  # as many are selected
        plugin.add_surface(viewer)


def test_surface_of_the_selected_scan_lies_on_it_in_napari(
    device: Any, sphere_series: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    components = pytest.importorskip("napari.components")
    layers = pytest.importorskip("napari.layers")
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    viewer = components.ViewerModel()
    [(voxels, attributes, _)] = plugin.get_reader(str(sphere_series))(str(sphere_series))  # type: ignore[misc]
    viewer.add_layer(layers.Image(voxels, **attributes))

    plugin.add_surface(viewer)

    surface = viewer.layers[-1]
    volume: Volume = read_volume(sphere_series)
    places = surface.data[0][:, ::-1]  # x, y, z of napari's z, y, x
    radii = np.linalg.norm(places - volume.ijk_to_lps((np.array(volume.shape_ijk) - 1) / 2), axis=1)
    assert radii == pytest.approx(SPHERE.radius_mm, abs=1.0)  # mm: the centre is off by part of a voxel; measured 0.71
