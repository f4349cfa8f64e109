"""A folder of masks, one file a structure, as TotalSegmentator writes it: one map with the names of the files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.labels.label_map import LARGEST_NUMBER, LabelMap
from clrecon.labels.names import find_number
from clrecon.labels.overlap import Wanted
from clrecon.labels.stream import empty_labels, iterate_labels
from clrecon.reading.grids.grid_file import LABEL_MAP, GridFile
from clrecon.reading.grids.reader import name_of_grid, open_grid, tell_kind
from clrecon.system.progress import Progress
from clrecon.system.text import count_of, escape_text

SAME_GRID_MM = 1e-3
"""Largest distance of a voxel from its place in the first mask; a sform is float32."""


def open_masks(folder: Path) -> dict[str, GridFile]:
    """Read the headers of the masks of a folder, by the names of their structures in alphabetical order.

    Hidden files, folders and files of other kinds are left out.
    """
    shown = escape_text(folder.name)
    masks: dict[str, GridFile] = {}
    for path in sorted(folder.iterdir(), key=lambda path: path.name):
        kind = tell_kind(path) if path.is_file() and not path.name.startswith(".") else None
        if kind == "DICOM":
            raise RefusedInputError(
                f"{shown} is a folder with DICOM files: of a DICOM SEG or RTSTRUCT give the file, of masks a folder"
                " with one NIfTI, NRRD or MetaImage file a structure"
            )
        if kind is None:
            continue
        name = name_of_grid(path)
        if name in masks:
            raise RefusedInputError(
                f"{shown} has two masks of one name: {masks[name].name} and {escape_text(path.name)}"
            )
        masks[name] = open_grid(path, kind, LABEL_MAP)
    if not masks:
        raise RefusedInputError(
            f"{shown} is a folder without masks: one NIfTI, NRRD or MetaImage file a structure is read; or give the"
            " file with the labels"
        )
    if len(masks) > LARGEST_NUMBER:
        raise RefusedInputError(f"{shown} has {len(masks):,} masks: up to {LARGEST_NUMBER:,} are read")
    return masks


def read_masks(folder: Path, masks: dict[str, GridFile], wanted: Wanted, progress: Progress) -> LabelMap:
    """Read the masks of a folder as one map; the first has number 1.

    A voxel of several masks belongs to the first of them in alphabetical order, wanted ones before others.

    masks: As `open_masks` returns them.
    progress: Called as ``progress("read", masks done, all masks)``.
    """
    names = dict(enumerate(masks, start=1))
    chosen = set(names) if wanted.labels is None else {find_number(one, names, names) for one in wanted.labels}
    order = [*sorted(chosen), *(sorted(set(names) - chosen) if wanted.others else ())]
    first = masks[names[order[0]]]
    ni, nj, nk = first.shape_ijk
    voxels = empty_labels(escape_text(folder.name), (nk, nj, ni))
    shared = 0
    for done, number in enumerate(order, start=1):
        grid = masks[names[number]]
        _check_same(first, grid)
        shared += _add(voxels, number, grid)
        progress("read", done, len(order))
    warnings = [f"{warning} ({grid.name})" for grid in (masks[names[n]] for n in order) for warning in grid.warnings]
    if shared:
        warnings.append(
            f"the masks overlap in {count_of(shared, 'voxel')}: each belongs to the first of its masks in alphabetical"
            " order, labels that were chosen before others"
        )
    return LabelMap(voxels, first.affine, {number: names[number] for number in sorted(order)}, warnings=warnings)


def _check_same(first: GridFile, other: GridFile) -> None:
    shapes = [" x ".join(map(str, grid.shape_ijk)) for grid in (first, other)]
    end = np.append(np.array(first.shape_ijk) - 1.0, 1.0)
    corners = np.array([[i, j, k, 1.0] for i in (0.0, end[0]) for j in (0.0, end[1]) for k in (0.0, end[2])])
    off = float(np.linalg.norm(corners @ (other.affine - first.affine).T, axis=1).max())
    if shapes[0] != shapes[1] or off > SAME_GRID_MM:
        raise RefusedInputError(
            f"the masks {first.name} and {other.name} lie on two grids: {shapes[0]} and {shapes[1]} voxels"
            + (f", up to {off:.3g} mm apart" if shapes[0] == shapes[1] else "")
            + "; the masks of one folder belong to one grid"
        )


def _add(voxels: NDArray[Any], number: int, grid: GridFile) -> int:
    """Write a mask into voxels that are free, and return how many of its voxels were not."""
    value, shared = 0, 0
    for k, plane in enumerate(iterate_labels(grid)):
        mask = plane != 0
        if not mask.any():
            continue
        found = np.unique(plane[mask])
        value = value or int(found[0])
        if len(found) > 1 or found[0] != value:
            other = next(int(each) for each in found if each != value)
            raise RefusedInputError(
                f"{grid.name} holds several labels, {value} and {other}: a folder of masks has one file a structure;"
                " give a label map as a file"
            )
        taken = voxels[k] != 0
        shared += np.count_nonzero(mask & taken)
        voxels[k][mask & ~taken] = number
    return shared
