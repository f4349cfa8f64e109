"""Label maps from grid files: NIfTI with a label table, NRRD with 3D Slicer's segments and layers, MetaImage.

Source: 3D Slicer's segmentation file format; the label table of Caret and Connectome Workbench.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.labels.label_map import LabelMap
from clrecon.labels.overlap import Painter, Wanted
from clrecon.labels.stream import empty_labels, iterate_labels
from clrecon.reading.grids.grid_file import GridFile
from clrecon.system.progress import Progress, ignore_progress

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
    """Read a label map or a segmentation.

    wanted: Of segments in layers only the others may overlap.
    progress: Called as ``progress("read", slices done, all slices)``.
    """
    segments, said = _read_segments(grid)
    ni, nj, nk = grid.shape_ijk
    voxels = empty_labels(grid.name, (nk, nj, ni))
    if grid.layers > 1:
        return _merge_layers(grid, voxels, segments, wanted, said, progress)
    for k, plane in enumerate(iterate_labels(grid)):
        if plane.any():
            voxels[k] = plane
        progress("read", k + 1, nk)
    names = {segment.number: segment.name for segment in segments} or _read_names(grid.extension)
    return LabelMap(voxels, grid.affine, names, warnings=[*grid.warnings, *said])


def _merge_layers(
    grid: GridFile,
    voxels: NDArray[Any],
    segments: Sequence[_Segment],
    wanted: Wanted,
    said: list[str],
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
        said.append(f"{unnamed:,} voxels hold values that no segment of their layer has (LabelValue): left out")
    return painter.finish(grid.affine, warnings=[*grid.warnings, *said])


def _read_segments(grid: GridFile) -> tuple[list[_Segment], list[str]]:
    """Return the segments that the header of a .seg.nrrd names, in their order, and what is to be said about them.

    3D Slicer wrote neither layers nor values before version 4.11: segment n was layer n.
    """
    fields = grid.fields
    found = {int(m[1]) for field in fields if (m := re.fullmatch(r"Segment([0-9]{1,5})_(Name|ID|LabelValue)", field))}
    if grid.layers > 1 and not found:
        raise RefusedInputError(f"{grid.name} has {grid.layers} layers and does not say which segments they hold")
    names = {n: str(fields.get(f"Segment{n}_Name", "")) for n in sorted(found)}
    values = _read_numbers(grid, names, "LabelValue")
    layers = _read_numbers(grid, names, "Layer")
    if names and not values and not layers and list(names) == list(range(grid.layers)):
        told = (
            [] if grid.layers == 1 else [f"its {grid.layers} segments name no layer: segment n is taken from layer n"]
        )
        return [_Segment(n + 1, name, n, 1) for n, name in names.items()], told
    lost = {"LabelValue": len(names) - len(values), "Layer": len(names) - len(layers)}
    if grid.layers > 1 and any(lost.values()):
        what, count = max(lost.items(), key=lambda item: item[1])
        raise RefusedInputError(
            f"{grid.name} has {grid.layers} layers, and {count} of its {len(names)} segments have no {what}"
            f" (SegmentN_{what}): which voxels are theirs is not known"
        )
    beyond = [layer for layer in layers.values() if not 0 <= layer < grid.layers]
    if beyond:
        raise RefusedInputError(f"{grid.name} has {grid.layers} layers, and a segment is in layer {beyond[0]}")
    said = []
    if lost["LabelValue"]:
        said.append(f"{lost['LabelValue']} of {len(names)} segments have no LabelValue: their names are not known")
    empty = [n for n, value in values.items() if value == 0]
    if empty:
        said.append(f"{len(empty)} of {len(names)} segments have LabelValue 0, which is no label: left out")
    segments = [_Segment(v, names[n], layers.get(n, 0), v) for n, v in values.items() if v != 0]
    return segments, said


def _read_numbers(grid: GridFile, segments: Iterable[int], key: str) -> dict[int, int]:
    try:
        fields = {n: grid.fields.get(f"Segment{n}_{key}") for n in segments}
        return {n: int(value) for n, value in fields.items() if value is not None}
    except ValueError as error:
        raise RefusedInputError(f"{grid.name} has a corrupt NRRD header: {key} of a segment is no number") from error


def _read_names(extension: bytes) -> dict[int, str]:
    """Return the names of a label table as Caret, Connectome Workbench and TotalSegmentator write it into a NIfTI
    header.
    """
    names = {}
    for match in _LABEL.finditer(extension):
        text = (match[2] or match[3] or b"").decode("utf-8", "replace")
        names[int(match[1])] = text if match[2] is not None else html.unescape(text)
    return {number: text for number, text in names.items() if text.strip()}
