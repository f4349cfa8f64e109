"""All kinds of work on a volume on a device, with all arrays of their results."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import clrecon
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.mesh import Mesh
from clrecon.rendering import Rendering

SIZE = (24, 20)


def centre_line(volume: Volume) -> Any:
    """Six points down the middle of a volume, LPS mm."""
    ni, nj, nk = volume.shape_ijk
    return volume.ijk_to_lps([(ni / 2, nj / 2, k) for k in np.linspace(1, nk - 2, 6)])


def label_boxes(volume: Volume, *boxes: tuple[slice, ...]) -> LabelMap:
    """Labels 1, 2 ... in boxes of voxels [k, j, i], on the grid of the volume."""
    numbers = np.zeros(volume.voxels.shape, np.uint8)
    for number, box in enumerate(boxes, start=1):
        numbers[box] = number
    return LabelMap(numbers, volume.affine)


def values(picture: Rendering) -> list[Any]:
    """The arrays of a picture."""
    return [picture.image, picture.depth] + ([] if picture.values is None else [picture.values])


def mesh_arrays(*meshes: Mesh) -> list[Any]:
    """The arrays of meshes."""
    return [array for mesh in meshes for array in (mesh.vertices, mesh.triangles, mesh.normals)]


WORK: dict[str, Callable] = {
    "surface": lambda v, _: mesh_arrays(clrecon.extract_isosurface(v, 100)),
    "trilinear": lambda v, _: mesh_arrays(clrecon.extract_isosurface(v, 100, topology="trilinear")),
    "range": lambda v, _: mesh_arrays(clrecon.extract_isosurface(v, (50, 200))),
    "labels": lambda v, labels: mesh_arrays(*clrecon.extract_labels(v, labels, 100).values()),
    "dvr": lambda v, _: values(clrecon.render(v, preset="muscle", size=SIZE)),
    "dvr labels": lambda v, labels: values(clrecon.render(v, preset="muscle", labels=labels, size=SIZE)),
    "mip": lambda v, _: values(clrecon.render(v, "mip", size=SIZE)),
    "drr": lambda v, _: values(clrecon.render(v, "drr", size=SIZE)),
    "ray surface": lambda v, labels: values(clrecon.render(v, "surface", iso_value=100, labels=labels, size=SIZE)),
    "slices": lambda v, _: values(clrecon.render(v, "slices", size=SIZE, view=(20, 30))),
    "slice": lambda v, _: values(clrecon.cut_slice(v, "coronal", SIZE)),
    "thick slice": lambda v, _: values(clrecon.cut_slice(v, (20, 30), SIZE, thickness=4.0, combine="max")),
    "cpr": lambda v, _: values(clrecon.reformat_curve(v, centre_line(v.volume), size=SIZE)),
}
