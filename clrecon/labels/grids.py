"""Label maps from grid files: NIfTI with a label table, NRRD with 3D Slicer's segments and layers, MetaImage.

Source: 3D Slicer's segmentation file format; the label table of Caret and Connectome Workbench.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.formats.grid_file import GridFile
from clrecon.labels.label_map import LabelMap
from clrecon.labels.overlap import Painter, Wanted
from clrecon.labels.stream import empty_labels, iterate_labels
from clrecon.system.progress import Progress, ignore_progress

__all__ = ["read_grid_labels"]

_LABEL = re.compile(
    rb'<Label\b[^>]{0,500}?\bKey="([0-9]{1,9})"[^>]{0,500}>\s*(?:<!\[CDATA\[(.*?)\]\]>|([^<]*))', re.DOTALL
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

    Parameters
    ----------
    grid : GridFile
    wanted : Wanted
        Of segments in layers only the others may overlap.
    progress : callable
        Called as ``progress("read", slices done, all slices)``.

    Raises
    ------
    UsageError
        A wanted label does not exist.
    RefusedInputError
        The file is cut off or corrupt, is not a label map, or has segments that overlap.
    """
    segments = _read_segments(grid.fields, grid.name)
    if grid.layers > 1 and not segments:
        raise RefusedInputError(f"{grid.name} has {grid.layers} layers and does not say which segments they hold")
    ni, nj, nk = grid.shape_ijk
    voxels = empty_labels(grid.name, (nk, nj, ni))
    if grid.layers > 1:
        return _merge_layers(grid, voxels, segments, wanted, progress)
    for k, plane in enumerate(iterate_labels(grid)):
        if plane.any():
            voxels[k] = plane
        progress("read", k + 1, nk)
    names = {segment.number: segment.name for segment in segments} or _read_names(grid.extension)
    return LabelMap(voxels, grid.affine, names, warnings=grid.warnings)


def _merge_layers(
    grid: GridFile,
    voxels: NDArray[Any],
    segments: Iterable[_Segment],
    wanted: Wanted,
    progress: Progress,
) -> LabelMap:
    """Merge segments that are stored in layers into one map; numbers that several layers use are renumbered."""
    segments = list(segments)
    if len({segment.number for segment in segments}) < len(segments):
        segments = [_Segment(n, s.name, s.layer, s.value) for n, s in enumerate(segments, start=1)]
    painter = Painter(grid.name, voxels, {s.number: s.name for s in segments}, wanted)
    by_number = {segment.number: segment for segment in segments}
    for k, stack in enumerate(iterate_labels(grid)):
        for number in painter.order:
            painter.paint(k, number, stack[..., by_number[number].layer] == by_number[number].value)
        progress("read", k + 1, len(voxels))
    return painter.finish(grid.affine, warnings=grid.warnings)


def _read_segments(fields: Mapping[str, Any], name: str) -> list[_Segment]:
    """Return the segments that the header of a .seg.nrrd names, in their order."""
    segments = []
    numbers = sorted({int(m[1]) for field in fields if (m := re.fullmatch(r"Segment([0-9]{1,5})_LabelValue", field))})
    for n in numbers:
        try:
            value, layer = int(fields[f"Segment{n}_LabelValue"]), int(fields.get(f"Segment{n}_Layer", 0))
        except ValueError as error:
            raise RefusedInputError(f"{name} has a corrupt NRRD header: value or layer of segment {n}") from error
        segments.append(_Segment(value, str(fields.get(f"Segment{n}_Name", "")), layer, value))
    return segments


def _read_names(extension: bytes) -> dict[int, str]:
    """Return the names of a label table as Caret, Connectome Workbench and TotalSegmentator write it into a NIfTI
    header.
    """
    names = {}
    for match in _LABEL.finditer(extension):
        text = (match[2] or match[3] or b"").decode("utf-8", "replace")
        names[int(match[1])] = text if match[2] is not None else html.unescape(text)
    return {number: text for number, text in names.items() if text.strip()}
