"""OME-Zarr (ngff.openmicroscopy.org) by the package zarr: the full level of the first image of a folder.

Metadata name the axes, their unit, scale and translation, but no patient unless axes have an orientation (RFC-4).
zarr takes a missing file of chunks for the fill value, and of several chunks also an empty one: both are looked for.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, compose_affine
from clrecon.reading.grids.grid_file import GridFile, import_extra
from clrecon.reading.grids.nrrd import MM_PER_UNIT
from clrecon.system.light_dataclass import dataclass
from clrecon.system.memory import iterate_layers
from clrecon.system.text import escape_text

_METADATA = ("zarr.json", ".zarray", ".zattrs")
"""Files of an array that are no chunks."""

_LARGEST_CHUNK_BYTES = 2**30
"""Most bytes of a chunk, which is unpacked as a whole."""

_MM_PER_UNIT = {**MM_PER_UNIT, "nanometer": 1e-6, "angstrom": 1e-7}

_PLAIN = ("x", "y", "z")

_ORIENTATIONS = {
    "right-to-left": (0, 1.0), "left-to-right": (0, -1.0),
    "anterior-to-posterior": (1, 1.0), "posterior-to-anterior": (1, -1.0),
    "inferior-to-superior": (2, 1.0), "superior-to-inferior": (2, -1.0),
}  # fmt: skip
"""Axis of LPS and sign of each orientation of a patient."""

_UNPLACED = "the file does not say how its axes lie in the patient: x, y and z are taken for left, back and head (LPS)"


def open_zarr(path: Path, purpose: str) -> GridFile:
    name = escape_text(path.name)
    zarr = import_extra("zarr", purpose)
    stored = _list_files(path, name)
    with _telling(name, "its metadata"):
        group = zarr.open(str(path), mode="r")
        attributes = group.attrs.asdict()
        images = attributes.get("ome", attributes).get("multiscales", ())
    if not images:
        raise RefusedInputError(
            f"{name} is Zarr without the metadata of an OME-Zarr image (multiscales), which say how far apart voxels"
            " are: name the folder of an image in it, or read its array in Python (docs/formats.md)"
        )
    with _telling(name, "its metadata (multiscales)"):
        level = images[0]["datasets"][0]
        array = group[level["path"]]
        axes = _read_axes(images[0], array, name)
        steps = [*level.get("coordinateTransformations", ()), *images[0].get("coordinateTransformations", ())]
        affine, is_placed = _read_affine(axes, steps, name)
        folder = path / level["path"]
        files = [size for file, size in stored.items() if folder in file.parents and file.name not in _METADATA]
        missing = _count_missing(array, files, name)
    warnings = [
        *([] if is_placed else [_UNPLACED]),
        *([f"the file has {len(images)} images: the first is read"] if len(images) > 1 else []),
        *([f"missing files: {missing:,}; {array.fill_value} stands for their voxels"] if missing else []),
    ]
    nk, nj, ni = (array.shape[axis] for axis in _list_spatial(axes))
    return GridFile(
        name=name,
        purpose=purpose,
        kind="OME-Zarr",
        shape_ijk=(ni, nj, nk),
        dtype=array.dtype,
        affine=affine,
        voxel_bytes=ZarrChunks(path, array, tuple(_list_spatial(axes)), sum(files)),
        warnings=tuple(warnings),
    )


@dataclass(frozen=True, eq=False)
class ZarrChunks:
    """The chunks of an array, which has one entry on all axes but three, `spatial`."""

    path: Path
    array: Any
    spatial: tuple[int, ...]
    file_bytes: int
    compressed: bool = True

    def iterate_slices(self, grid: GridFile) -> Iterator[NDArray[Any]]:
        selection = [slice(None) if axis in self.spatial else 0 for axis in range(self.array.ndim)]
        for first, end in iterate_layers(self.array, self.spatial[0]):
            selection[self.spatial[0]] = slice(first, end)
            with _telling(grid.name, f"{grid.place(first)}, or one up to {end}"):
                layer = self.array[tuple(selection)]
            yield from layer


@contextmanager
def _telling(name: str, section: str) -> Iterator[None]:
    """Turn errors of zarr and its codecs, which are of many kinds, into one of ours."""
    try:
        yield
    except ClreconError:
        raise
    except Exception as error:
        fault = "needs more memory" if isinstance(error, MemoryError) else "is corrupt, or nothing that zarr reads,"
        reason = escape_text(f"{type(error).__name__}: {error}", 160)
        advice = "" if isinstance(error, MemoryError) else ": get it again if it was cut"
        raise RefusedInputError(f"{name} {fault} in {section} ({reason}){advice}") from error


def _list_files(folder: Path, name: str) -> dict[Path, int]:
    """Return the files of a store with their bytes; refuse a link, which leads elsewhere, and a FIFO, which waits."""
    files: dict[Path, int] = {}
    waiting = [folder]
    while waiting:
        with os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(Path(entry.path))
                elif entry.is_file(follow_symlinks=False):
                    files[Path(entry.path)] = entry.stat(follow_symlinks=False).st_size
                else:
                    raise RefusedInputError(f"{name} holds a link or a device: only its own regular files are read")
    return files


def _read_axes(image: Mapping[str, Any], array: Any, name: str) -> list[Mapping[str, Any]]:
    """Return the axes of an array of one volume."""
    if "axes" not in image:
        raise RefusedInputError(f"{name} names no axes: OME-Zarr is read from its version 0.4 on")
    named = [axis if isinstance(axis, dict) else {"name": axis} for axis in image["axes"]]
    axes: list[Mapping[str, Any]] = [
        {"type": "space" if str(axis["name"]).lower() in _PLAIN else None, **axis} for axis in named
    ]
    if len(axes) != array.ndim:
        raise RefusedInputError(f"{name} is corrupt: it names {len(axes)} axes of {array.ndim}")
    spatial = _list_spatial(axes)
    if len(spatial) != 3:
        raise RefusedInputError(f"{name} has {len(spatial)} axes of space: a volume has three")
    for number, axis in enumerate(axes):
        if number not in spatial and array.shape[number] != 1:
            raise RefusedInputError(
                f"{name} has {array.shape[number]} volumes along its axis {escape_text(str(axis['name']), 20)}:"
                " write one file for each"
            )
    if array.dtype.kind not in "iuf":
        raise RefusedInputError(f"{name} has voxels of type {array.dtype}: one real number each is read")
    if prod(array.chunks) * array.dtype.itemsize > _LARGEST_CHUNK_BYTES:
        raise RefusedInputError(
            f"{name} has chunks of {' x '.join(map(str, array.chunks))} numbers of {array.dtype.itemsize} bytes: at"
            f" most {_LARGEST_CHUNK_BYTES:,} bytes are read"
        )
    return axes


def _list_spatial(axes: Sequence[Mapping[str, Any]]) -> list[int]:
    return [number for number, axis in enumerate(axes) if axis.get("type") == "space"]


def _read_affine(
    axes: Sequence[Mapping[str, Any]], transformations: Sequence[Mapping[str, Any]], name: str
) -> tuple[Float64Array, bool]:
    """Return the affine to LPS mm of the axes of space, the last of which is i, and whether they lie in a patient."""
    scale, offset = np.ones(len(axes)), np.zeros(len(axes))
    kinds = [step["type"] for step in transformations]
    for kind, step in zip(kinds, transformations, strict=True):
        if kind not in ("scale", "translation", "identity"):
            raise RefusedInputError(
                f"{name} is placed by '{escape_text(str(kind), 20)}': scale and translation are read"
            )
        numbers = np.asarray(step.get(kind, np.zeros(len(axes))), np.float64)
        if numbers.shape != scale.shape:
            raise RefusedInputError(f"{name} is corrupt: its {kind} has {numbers.size} numbers for {len(axes)} axes")
        if kind == "scale":
            scale, offset = scale * numbers, offset * numbers
        else:
            offset = offset + numbers
    if "scale" not in kinds:
        raise RefusedInputError(f"{name} does not say how far apart its voxels are: it has no scale")
    spatial = _list_spatial(axes)
    values = [str((axes[axis].get("orientation") or {}).get("value")) for axis in spatial]
    is_placed = all(value in _ORIENTATIONS for value in values)
    directions = np.zeros((3, 3))
    for column, axis in enumerate(spatial):
        word = str(axes[axis]["name"]).lower()
        if not is_placed and word not in _PLAIN:
            raise RefusedInputError(f"{name} has an axis {escape_text(word, 20)}: axes of space are x, y and z")
        row, sign = _ORIENTATIONS[values[column]] if is_placed else (_PLAIN.index(word), 1.0)
        directions[row, column] = sign * _read_unit(axes[axis], name)
    if np.linalg.matrix_rank(directions) < 3:
        raise RefusedInputError(f"{name} is corrupt: two of its axes have the same direction")
    k_step, j_step, i_step = (directions * scale[spatial]).T
    try:
        return checked_affine(compose_affine(i_step, j_step, k_step, directions @ offset[spatial])), is_placed
    except UsageError as error:
        raise RefusedInputError(f"{name} cannot be placed: {error}") from error


def _read_unit(axis: Mapping[str, Any], name: str) -> float:
    """Return the millimetres of a unit."""
    unit = axis.get("unit")
    if unit is None:
        word = escape_text(str(axis["name"]), 20)
        raise RefusedInputError(f'{name} says no unit of its axis {word}: add "unit": "millimeter" to its metadata')
    if str(unit).lower() not in _MM_PER_UNIT:
        raise RefusedInputError(f"{name} has lengths in an unknown unit, {escape_text(str(unit), 20)}")
    return _MM_PER_UNIT[str(unit).lower()]


def _count_missing(array: Any, sizes: Sequence[int], name: str) -> int:
    """Count the files of chunks, or shards of chunks, that are not there."""
    if 0 in sizes:
        raise RefusedInputError(f"{name} is cut: {sizes.count(0)} of its files are empty")
    blocks = getattr(array, "shards", None) or array.chunks
    expected = prod(-(-count // length) for count, length in zip(array.shape, blocks, strict=True))
    return max(0, expected - len(sizes))
