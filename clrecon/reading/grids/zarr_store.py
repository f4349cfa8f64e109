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
from clrecon.reading.grids.grid_file import VOLUME, GridFile, import_extra
from clrecon.reading.grids.nrrd import MM_PER_UNIT
from clrecon.system.arguments import name_parameter
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


_ORDER = ("t", "c", "z", "y", "x")
"""Axes of an array that does not name its own, the last ones."""


def open_zarr(path: Path, purpose: str, voxel_size: Sequence[float] | None = None) -> GridFile:
    """Open the first image of a folder, or for a `voxel_size` (i, j, k) in mm also an array without metadata."""
    name = escape_text(path.name)
    advice = f": give it in mm with {name_parameter('voxel_size', 'I,J,K')}" if purpose == VOLUME else ""
    zarr = import_extra("zarr", purpose)
    stored = _list_files(path, name)
    with _telling(name, "its metadata"):
        group = zarr.open(str(path), mode="r")
        attributes = group.attrs.asdict()
        images = attributes.get("ome", attributes).get("multiscales", ())
    is_array = hasattr(group, "dtype")
    if not images and not (is_array and voxel_size):
        way_out = advice if is_array else ": name the folder of an image or of an array in it"
        raise RefusedInputError(
            f"{name} is Zarr without the metadata of an OME-Zarr image (multiscales), which say how far apart voxels"
            f" are{way_out}"
        )
    with _telling(name, "its metadata (multiscales)"):
        image: Mapping[str, Any] = images[0] if images else {"axes": _ORDER[-group.ndim :], "datasets": [{"path": ""}]}
        level = image["datasets"][0]
        array = group[level["path"]] if images else group
        axes = _read_axes(image, array, name)
        steps = [*level.get("coordinateTransformations", ()), *image.get("coordinateTransformations", ())]
        affine, is_placed = _read_affine(axes, steps, name, voxel_size, advice)
        folder = path / level["path"]
        files = [size for file, size in stored.items() if folder in file.parents and file.name not in _METADATA]
        missing = _count_missing(array, files, name)
    steps_given = " x ".join(f"{step:g}" for step in voxel_size or ())
    warnings = [
        *([] if is_placed else [_UNPLACED]),
        *([f"the voxels are {steps_given} mm apart, as given: the file does not say"] if voxel_size else []),
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
    axes: Sequence[Mapping[str, Any]],
    transformations: Sequence[Mapping[str, Any]],
    name: str,
    voxel_size: Sequence[float] | None,
    advice: str,
) -> tuple[Float64Array, bool]:
    """Return the affine to LPS mm of the axes of space, the last of which is i, and whether they lie in a patient.

    A voxel size (i, j, k) is for axes without a scale or a unit; without it the `advice` is how to give it.
    """
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
    spatial = _list_spatial(axes)
    units = np.array([_MM_PER_UNIT.get(str(axes[axis].get("unit")).lower(), np.nan) for axis in spatial])
    has_units = "scale" in kinds and not np.isnan(units).any()
    if voxel_size is not None and has_units:
        given = name_parameter("voxel_size")
        raise UsageError(f"{name} says how far apart its voxels are, with a scale and units: leave {given} out")
    if voxel_size is None and not has_units:
        raise RefusedInputError(_explain_units(axes, spatial, kinds, name) + advice)
    mm_per_unit = units if voxel_size is None else np.divide(voxel_size[::-1], np.abs(scale[spatial]))
    values = [str((axes[axis].get("orientation") or {}).get("value")) for axis in spatial]
    is_placed = all(value in _ORIENTATIONS for value in values)
    directions = np.zeros((3, 3))
    for column, axis in enumerate(spatial):
        word = str(axes[axis]["name"]).lower()
        if not is_placed and word not in _PLAIN:
            raise RefusedInputError(f"{name} has an axis {escape_text(word, 20)}: axes of space are x, y and z")
        row, sign = _ORIENTATIONS[values[column]] if is_placed else (_PLAIN.index(word), 1.0)
        directions[row, column] = sign * mm_per_unit[column]
    if np.linalg.matrix_rank(directions) < 3:
        raise RefusedInputError(f"{name} is corrupt: two of its axes have the same direction")
    k_step, j_step, i_step = (directions * scale[spatial]).T
    try:
        return checked_affine(compose_affine(i_step, j_step, k_step, directions @ offset[spatial])), is_placed
    except UsageError as error:
        raise RefusedInputError(f"{name} cannot be placed: {error}") from error


def _explain_units(axes: Sequence[Mapping[str, Any]], spatial: Sequence[int], kinds: Sequence[str], name: str) -> str:
    if "scale" not in kinds:
        return f"{name} does not say how far apart its voxels are, it has no scale"
    axis = next(axes[axis] for axis in spatial if str(axes[axis].get("unit")).lower() not in _MM_PER_UNIT)
    word, unit = (escape_text(str(axis.get(entry)), 20) for entry in ("name", "unit"))
    if axis.get("unit") is None:
        return f'{name} says no unit of its axis {word}, such as "unit": "millimeter" in its metadata'
    return f"{name} has lengths in an unknown unit, {unit}"


def _count_missing(array: Any, sizes: Sequence[int], name: str) -> int:
    """Count the files of chunks, or shards of chunks, that are not there."""
    if 0 in sizes:
        raise RefusedInputError(f"{name} is cut: {sizes.count(0)} of its files are empty")
    blocks = getattr(array, "shards", None) or array.chunks
    expected = prod(-(-count // length) for count, length in zip(array.shape, blocks, strict=True))
    return max(0, expected - len(sizes))
