"""Label maps in grid files: NIfTI with a label table, NRRD with 3D Slicer's segments and layers, MetaImage.

A folder of masks, one file a structure, as TotalSegmentator writes it, is one map with the names of the files.

Source: 3D Slicer's segmentation file format; the label table of Caret and Connectome Workbench.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.labels.label_map import LARGEST_NUMBER, LabelMap, find_number
from clrecon.labels.segments import Painter, Wanted, empty_labels, iterate_labels
from clrecon.reading.grids.grid_file import LABEL_MAP, GridFile
from clrecon.reading.grids.reader import name_of_grid, open_grid, tell_kind
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import count_of, escape_text, join_names

_LABEL = re.compile(
    rb"""<Label\b[^>]{0,500}?\bKey=["']([0-9]{1,9})["'][^>]{0,500}>\s*(?:<!\[CDATA\[(.*?)\]\]>|([^<]*))""", re.DOTALL
)


@dataclass(frozen=True)
class _Segment:
    """One segment of a .seg.nrrd: the voxels of `layer` that hold `value`."""

    number: int
    name: str
    layer: int
    value: int


def read_grid_labels(grid: GridFile, wanted: Wanted, progress: Progress = ignore_progress) -> LabelMap:
    """Read a label map or a segmentation; of segments in layers only those that are not wanted may overlap."""
    segments, remarks = _read_segments(grid)
    ni, nj, nk = grid.shape_ijk
    voxels = empty_labels(grid.name, (nk, nj, ni))
    if grid.layers > 1:
        return _merge_layers(grid, voxels, segments, wanted, remarks, progress)
    for k, plane in enumerate(iterate_labels(grid)):
        if plane.any():
            voxels[k] = plane
        progress("read", k + 1, nk)
    names = {segment.number: segment.name for segment in segments} or _read_names(grid.extension)
    return LabelMap(voxels, grid.affine, names, warnings=[*grid.warnings, *remarks])


def _merge_layers(
    grid: GridFile,
    voxels: NDArray[Any],
    segments: Sequence[_Segment],
    wanted: Wanted,
    remarks: list[str],
    progress: Progress,
) -> LabelMap:
    """Merge segments that are stored in layers into one map; numbers that several layers use are renumbered."""
    if len({segment.number for segment in segments}) < len(segments):
        segments = [_Segment(n, s.name, s.layer, s.value) for n, s in enumerate(segments, start=1)]
    painter = Painter(grid.name, voxels, {s.number: s.name for s in segments}, wanted)
    by_number = {segment.number: segment for segment in segments}
    unnamed = 0
    for k, stack in enumerate(iterate_labels(grid)):
        known = stack == 0
        for segment in segments:
            known[..., segment.layer] |= stack[..., segment.layer] == segment.value
        unnamed += known.size - np.count_nonzero(known)
        for number in painter.order:
            painter.paint(k, number, stack[..., by_number[number].layer] == by_number[number].value)
        progress("read", k + 1, len(voxels))
    if unnamed:
        remarks.append(f"{unnamed:,} voxels hold values that no segment of their layer has (LabelValue): left out")
    return painter.finish(grid.affine, warnings=[*grid.warnings, *remarks])


def _read_segments(grid: GridFile) -> tuple[list[_Segment], list[str]]:
    """Return the segments that the header of a .seg.nrrd names, in their order, and what is to be said about them.

    3D Slicer wrote neither layers nor values before version 4.11: segment n was layer n.
    """
    fields = grid.fields
    numbers = {int(m[1]) for field in fields if (m := re.fullmatch(r"Segment([0-9]{1,5})_(Name|ID|LabelValue)", field))}
    if grid.layers > 1 and not numbers:
        raise RefusedInputError(f"{grid.name} has {grid.layers} layers and does not say which segments they hold")
    names = {n: str(fields.get(f"Segment{n}_Name", "")) for n in sorted(numbers)}
    values = _read_numbers(grid, names, "LabelValue")
    layers = _read_numbers(grid, names, "Layer")
    if names and not values and not layers and list(names) == list(range(grid.layers)):
        warnings = (
            [] if grid.layers == 1 else [f"its {grid.layers} segments name no layer: segment n is taken from layer n"]
        )
        return [_Segment(n + 1, name, n, 1) for n, name in names.items()], warnings
    lost = {"LabelValue": len(names) - len(values), "Layer": len(names) - len(layers)}
    if grid.layers > 1 and any(lost.values()):
        field_name, count = max(lost.items(), key=lambda item: item[1])
        raise RefusedInputError(
            f"{grid.name} has {grid.layers} layers, and {count} of its {len(names)} segments have no {field_name}"
            f" (SegmentN_{field_name}): which voxels are theirs is not known"
        )
    beyond = [layer for layer in layers.values() if not 0 <= layer < grid.layers]
    if beyond:
        raise RefusedInputError(f"{grid.name} has {grid.layers} layers, and a segment is in layer {beyond[0]}")
    remarks = []
    if lost["LabelValue"]:
        remarks.append(f"{lost['LabelValue']} of {len(names)} segments have no LabelValue: their names are not known")
    empty = [n for n, value in values.items() if value == 0]
    if empty:
        remarks.append(f"{len(empty)} of {len(names)} segments have LabelValue 0, which is no label: left out")
    return [_Segment(v, names[n], layers.get(n, 0), v) for n, v in values.items() if v != 0], remarks


def _read_numbers(grid: GridFile, segments: Iterable[int], key: str) -> dict[int, int]:
    try:
        fields = {n: grid.fields.get(f"Segment{n}_{key}") for n in segments}
        return {n: int(value) for n, value in fields.items() if value is not None}
    except ValueError as error:
        raise RefusedInputError(f"{grid.name} has a corrupt NRRD header: {key} of a segment is no number") from error


def _read_names(extension: bytes) -> dict[int, str]:
    """Return the names of a label table of Caret, Connectome Workbench or TotalSegmentator in a NIfTI header."""
    names = {}
    for match in _LABEL.finditer(extension):
        text = (match[2] or match[3] or b"").decode("utf-8", "replace")
        names[int(match[1])] = text if match[2] is not None else html.unescape(text)
    return {number: text for number, text in names.items() if text.strip()}


SAME_GRID_MM = 1e-3
"""Largest distance of a voxel from its position in the first mask; the sform of a NIfTI file is float32."""


_GRID_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd", ".hdr")
"""Ends of the names of links that are not opened, by which they may be masks."""


def _list_files(folder: Path, follow_links: bool) -> Iterator[Path]:
    """List files as scans are looked for: links inside of the folder lead to what is there anyway, others wait."""
    root = folder.resolve()
    paths, lost = [], []
    for path in sorted(folder.iterdir(), key=lambda path: path.name):
        if path.name.startswith("."):
            continue
        if not path.is_symlink():
            yield path
        elif not path.exists():
            lost.append(path)
        elif root not in path.resolve().parents:
            paths.append(path)
    left = [
        (lost, "to a file that is not there", "restore it"),
        (paths, "out of it", f"{name_parameter('follow_links', True)} follows links"),
    ]
    for links, whither, advice in left:
        masks = [escape_text(path.name) for path in links if path.name.lower().endswith(_GRID_SUFFIXES)]
        if masks and not (follow_links and links is paths):
            phrase = "mask of {} is a link" if len(masks) == 1 else "masks of {} are links"
            raise RefusedInputError(
                f"{len(masks)} {phrase.format(escape_text(folder.name))} {whither} ({join_names(masks)}); {advice}"
            )
    yield from paths if follow_links else ()


def open_masks(folder: Path, *, follow_links: bool = False) -> dict[str, GridFile]:
    """Read the headers of a folder's masks, by structure in alphabetical order; hidden and other files are left out."""
    shown = escape_text(folder.name)
    masks: dict[str, GridFile] = {}
    for path in sorted(_list_files(folder, follow_links), key=lambda path: path.name):
        kind = tell_kind(path) if path.is_file() else None
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
    """Read the masks of `open_masks` as one map, the first as 1; a shared voxel is the first's, wanted ones lead."""
    names = dict(enumerate(masks, start=1))
    chosen = set(names) if wanted.labels is None else {find_number(one, names, names) for one in wanted.labels}
    order = [*sorted(chosen), *(sorted(set(names) - chosen) if wanted.others else ())]
    first = masks[names[order[0]]]
    ni, nj, nk = first.shape_ijk
    voxels = empty_labels(escape_text(folder.name), (nk, nj, ni))
    shared, empty = 0, []
    for done, number in enumerate(order, start=1):
        grid = masks[names[number]]
        _check_same(first, grid)
        voxel_count, others = _add(voxels, number, grid)
        shared += others
        empty += [] if voxel_count else [escape_text(names[number])]
        progress("read", done, len(order))
    warnings = [f"{warning} ({grid.name})" for grid in (masks[names[n]] for n in order) for warning in grid.warnings]
    if empty:
        hold = "holds" if len(empty) == 1 else "hold"
        warnings.append(f"{len(empty)} of {count_of(len(order), 'mask')} {hold} no voxel: {join_names(empty)}")
    if shared:
        warnings.append(
            f"the masks overlap in {count_of(shared, 'voxel')}: each belongs to the first of its masks in alphabetical"
            " order, labels that were chosen before others"
        )
    return LabelMap(voxels, first.affine, {number: names[number] for number in sorted(order)}, warnings=warnings)


def _check_same(first: GridFile, second: GridFile) -> None:
    shapes = [" x ".join(map(str, grid.shape_ijk)) for grid in (first, second)]
    end = np.append(np.array(first.shape_ijk) - 1.0, 1.0)
    corners = np.array(list(product(*((0.0, last) for last in end[:3]), (1.0,))))
    off = float(np.linalg.norm(corners @ (second.affine - first.affine).T, axis=1).max())
    if shapes[0] != shapes[1] or off > SAME_GRID_MM:
        raise RefusedInputError(
            f"the masks {first.name} and {second.name} lie on two grids: {shapes[0]} and {shapes[1]} voxels"
            + (f", up to {off:.3g} mm apart" if shapes[0] == shapes[1] else "")
            + "; the masks of one folder belong to one grid"
        )


def _add(voxels: NDArray[Any], number: int, grid: GridFile) -> tuple[int, int]:
    """Write a mask into voxels that are free, and return how many it has, and how many of them were not."""
    value, painted = 0, 0
    shared = 0
    for k, plane in enumerate(iterate_labels(grid)):
        mask = plane != 0
        if not mask.any():
            continue
        values = np.unique(plane[mask])
        value = value or int(values[0])
        if len(values) > 1 or values[0] != value:
            second = next(int(each) for each in values if each != value)
            raise RefusedInputError(
                f"{grid.name} holds several labels, {value} and {second}: a folder of masks has one file a structure;"
                " give a label map as a file"
            )
        occupied = voxels[k] != 0
        painted += np.count_nonzero(mask)
        shared += np.count_nonzero(mask & occupied)
        voxels[k][mask & ~occupied] = number
    return painted, shared
