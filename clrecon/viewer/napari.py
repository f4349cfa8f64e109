"""The plugin of napari: a reader of scans and meshes, and the bone surface of the selected scan.

`napari.yaml` beside this module lists both.  The world of all layers is (z, y, x) of the patient in LPS mm, so that
volumes and meshes lie in place.  Importing this module imports no napari.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.anatomy.iso_choice import choose_iso_value
from clrecon.errors import UsageError
from clrecon.exchange.formats import MESH_INPUTS
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.images import image_of
from clrecon.mesh import Mesh
from clrecon.mesh.mesh_reader import read_mesh
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.reading import read_volume

if TYPE_CHECKING:
    import napari

LayerData = tuple[Any, dict[str, Any], str]
"""Data, attributes and kind of a layer."""

_SCANS = (".dcm", ".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
_WINDOW_HU = (-450.0, 1050.0)
_BONE_COLOR = "bisque"


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[LayerData]] | None:
    """Return the reader of a folder or file; None where it is of no format of clrecon, or of a stack of files."""
    if not isinstance(path, str | os.PathLike):
        return None
    name = os.fspath(path).lower()
    return read_layers if os.path.isdir(path) or name.endswith((*_SCANS, *MESH_INPUTS)) else None


def read_layers(path: str | Sequence[str]) -> list[LayerData]:
    """Read a scan or a mesh as a layer of its name."""
    assert isinstance(path, str | os.PathLike)
    name = Path(path).name
    if name.lower().endswith(MESH_INPUTS):
        return [surface_layer(read_mesh(path), name)]
    return [volume_layer(read_volume(path), name)]


def volume_layer(volume: Volume, name: str) -> LayerData:
    """Return the image layer of a volume; tilt is kept, uneven slices are resampled."""
    image = image_of(volume, True, "napari", holds_shear=True)
    metadata = {"certificate": volume.report, "resampled": image.resampled}
    attributes = {"name": name, "affine": reverse_axes(image.affine), "contrast_limits": _WINDOW_HU}
    return image.voxels, {**attributes, "colormap": "gray", "metadata": metadata}, "image"


def surface_layer(mesh: Mesh, name: str) -> LayerData:
    """Return the surface layer of a mesh."""
    vertices = np.ascontiguousarray(mesh.vertices[:, ::-1])
    return (vertices, mesh.triangles), {"name": name, "shading": "smooth"}, "surface"


def reverse_axes(affine: Float64Array) -> Float64Array:
    """Return the affine of index (k, j, i) to (z, y, x) for that of (i, j, k) to (x, y, z), and the other way round."""
    order = [2, 1, 0, 3]
    return affine[np.ix_(order, order)]


def add_surface(viewer: napari.viewer.Viewer) -> None:
    """Add the bone surface of the selected image layer, at the level that `clrecon.choose_iso_value` finds."""
    layers = [layer for layer in viewer.layers.selection if getattr(layer.data, "ndim", 0) == 3]
    if len(layers) != 1:
        raise UsageError(f"{len(layers)} image layers of three axes are selected: select the one of the CT")
    [layer] = layers
    volume = Volume(np.asarray(layer.data), reverse_axes(_affine_of(layer)))
    choice = choose_iso_value(volume)
    data, attributes, _ = surface_layer(extract_isosurface(volume, choice.iso_value), f"{layer.name}, bone")
    viewer.add_surface(data, **attributes, colormap=_BONE_COLOR, metadata={"iso_value_hu": choice.iso_value})


def _affine_of(layer: Any) -> Float64Array:
    """Return the affine of index to world of a layer, all its transforms together."""
    affine = np.eye(4)
    affine[:3, 3] = layer.data_to_world((0, 0, 0))
    for axis, step in enumerate(np.eye(3)):
        affine[:3, axis] = layer.data_to_world(step) - affine[:3, 3]
    return affine
