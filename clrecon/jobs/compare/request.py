"""What the process of one method is told, and what it tells: plain values, and arrays in files of a folder."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.rendering.views.camera import Camera

_VOXELS, _PLACE = "voxels.npy", "place.npz"


@dataclass(frozen=True)
class Request:
    """What one process does.

    method: Name in `COMPARED`.
    folder: Has the volume; gets the results.
    device: Index of the OpenCL device.
    repeat: Warm runs.
    timeout: Seconds after which a device that finishes nothing hangs.
    camera: Parameters of the `Camera` of the picture.
    size: [int, int]. Width and height of the picture.
    along: Camera and size of a picture along the slices, for the table of the paper.
    """

    method: str
    folder: str
    iso_value: float
    closed: bool
    device: int
    memory: int | None
    repeat: int
    timeout: float
    camera: dict[str, Any]
    size: tuple[int, int]
    along: dict[str, Any] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the request for JSON."""
        return asdict(self)

    def views(self) -> dict[str, tuple[Camera, tuple[int, int]]]:
        """Return the pictures that are drawn: the name of each, its camera, and its size."""
        views = {"view": (Camera(**self.camera), (self.size[0], self.size[1]))}
        if self.along is not None:
            width, height = self.along["size"]
            views["along"] = Camera(**self.along["camera"]), (width, height)
        return views


def save_volume(folder: Path, volume: Volume) -> None:
    """Write voxels and place of a volume, and nothing of its report."""
    np.save(folder / _VOXELS, volume.voxels, allow_pickle=False)
    place = {"affine": volume.affine}
    if volume.uneven:
        place["positions"] = volume.slice_origins()
    np.savez(folder / _PLACE, **place)  # type: ignore[arg-type]


def load_volume(folder: Path) -> Volume:
    """Read what `save_volume` wrote, into memory."""
    voxels = np.load(folder / _VOXELS, allow_pickle=False)
    with np.load(folder / _PLACE, allow_pickle=False) as place:
        return Volume(voxels, place["affine"], None, place["positions"] if "positions" in place else None)


def save_arrays(folder: Path, name: str, **arrays: NDArray[Any] | None) -> None:
    """Write the arrays of a method; those that are None are left out."""
    for what, array in arrays.items():
        if array is not None:
            np.save(folder / f"{name}-{what}.npy", array, allow_pickle=False)


def load_array(folder: Path, name: str, what: str) -> NDArray[Any] | None:
    """Read one of them; None if it was left out."""
    path = folder / f"{name}-{what}.npy"
    return np.load(path, allow_pickle=False) if path.exists() else None


def save_mesh(folder: Path, name: str, mesh: Mesh) -> None:
    """Write the arrays of a mesh."""
    save_arrays(folder, name, vertices=mesh.vertices, triangles=mesh.triangles, normals=mesh.normals)


def load_mesh(folder: Path, name: str) -> Mesh | None:
    """Read the mesh of a method; None if it made none."""
    vertices, triangles = (load_array(folder, name, what) for what in ("vertices", "triangles"))
    if vertices is None or triangles is None:
        return None
    return Mesh(vertices, triangles, load_array(folder, name, "normals"))
