"""`read_labels`: reads every kind of file with labels."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from math import prod
from pathlib import Path

import numpy as np

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.geometry.grid import Grid
from clrecon.geometry.volume import Volume
from clrecon.labels.label_grids import open_masks, read_grid_labels, read_masks
from clrecon.labels.label_map import LARGEST_NUMBER, LabelMap, check_wanted
from clrecon.labels.segmentation import SEGMENTATION_CLASSES, read_segmentation, tell_pixel_bytes
from clrecon.labels.segments import Wanted
from clrecon.labels.structures import STRUCTURE_SET, read_structures
from clrecon.reading.grids.grid_file import LABEL_MAP, GridFile
from clrecon.reading.grids.reader import name_of_grid, open_grid, tell_kind
from clrecon.reading.urls import refuse_url
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import escape_text

_OTHER_OBJECTS = {
    "1.2.840.10008.5.1.4.1.1.481.2": "an RT dose",
    "1.2.840.10008.5.1.4.1.1.481.5": "an RT plan",
    "1.2.840.10008.5.1.4.1.1.481.1": "an RT image",
    "1.2.840.10008.5.1.4.1.1.66.1": "a spatial registration",
}
"""SOP classes that lie beside a scan and its labels, in words."""

LARGE_BYTES = 2**29
"""Stored bytes that take a second to unpack.  Zeros pack to a thousandth: a file of 33 MB can hold 34 GB."""

_MOST_TIMES = 8
"""Most voxels of a large map for each voxel of its scan: twice as fine along each axis."""


_MASK_NUMBERS = ((1,), (255,))
"""The numbers of a mask of one structure."""

_WARNINGS_SHOWN = 3
"""Warnings that a refusal quotes."""


@explains_arguments
def read_labels(
    path: str | Path,
    label: Sequence[str | int] | str | int | None = None,
    *,
    volume: Grid | None = None,
    follow_links: bool = False,
    progress: Progress | None = None,
) -> LabelMap:
    """Read a label map: NIfTI (.nii, .nii.gz), NRRD and 3D Slicer's .seg.nrrd, MetaImage, DICOM SEG, RTSTRUCT, or a
    folder of masks.

    The kind is told from the content.  MetaImage needs the package SimpleITK.  A folder holds one mask a structure on
    one grid, as TotalSegmentator writes them: labels are numbered from 1 in the alphabetical order of the files and
    named by them, and a voxel of several masks belongs to the first of them (in ``warnings``: how many).  A file with
    one mask (0 and 1, or 0 and 255) that holds no name is named by the file too.

    Parameters
    ----------
    path : path
    label : int, str or sequence of them, optional
        The labels to read, as `LabelMap.find` takes them; the map has no others.  They may overlap other labels, but
        not each other.
    volume : Volume, optional
        The scan of the labels.  An RTSTRUCT needs it: its contours become labels on the slices of the scan.  A map that
        takes long to unpack is refused if it has many times as many voxels.
    follow_links : bool
        In a folder of masks, read those that are links out of it too (git-annex, DataLad); else they are refused.
    progress : callable, optional
        Called as ``progress("read", done, total)``: slices, in DICOM SEG frames.

    Returns
    -------
    LabelMap
        In LPS mm, on the grid of the file.

    Raises
    ------
    UsageError
        The file does not exist, a package is missing, or a wanted segment does not exist.
    RefusedInputError
        The file is not a label map (CT images, probabilities, negative numbers, four axes), is cut off or corrupt, does
        not say where it lies in space, or has segments that overlap.
    """
    wanted = check_wanted(label)
    labels = _read_map(path, Wanted(wanted, others=False), volume, follow_links, progress or ignore_progress)
    return labels if wanted is None else _keep(labels, [labels.find(label) for label in wanted])


def read_all_labels(
    path: str | Path,
    first: Sequence[str | int] | None = None,
    *,
    volume: Grid | None = None,
    follow_links: bool = False,
) -> LabelMap:
    """Read a label map with all labels, which tell a surface where its own ends; `first` get voxels of several."""
    return _read_map(path, Wanted(check_wanted(first)), volume, follow_links, ignore_progress)


def _keep(labels: LabelMap, numbers: Sequence[int]) -> LabelMap:
    if {*labels.numbers, *labels.names} <= set(numbers):
        return labels
    table = np.zeros(LARGEST_NUMBER + 1, labels.voxels.dtype)
    table[list(numbers)] = numbers
    names = {number: labels.name(number) for number in numbers}
    return labels.changed(np.stack([table[plane] for plane in labels.voxels]), names)


def _read_map(
    path: str | Path, wanted: Wanted, volume: Grid | None, follow_links: bool, progress: Progress
) -> LabelMap:
    refuse_url(path, "label map")
    path = Path(path)
    try:
        if not path.exists():
            raise UsageError(f"there is no label map {escape_text(str(path), 200)}")
        if not path.is_file() and not path.is_dir():
            raise RefusedInputError(f"{escape_text(path.name)} is no regular file")
        name, kind = escape_text(path.name), "folder" if path.is_dir() else tell_kind(path)
        if kind is None:
            raise RefusedInputError(
                f"{name} is no label map that can be read: NIfTI, NRRD, MetaImage, DICOM SEG and RTSTRUCT are"
            )
        reader: Callable[..., LabelMap] = partial(_read_grid, kind)
        if kind in ("folder", "DICOM"):
            reader = _read_dicom if kind == "DICOM" else partial(_read_folder, follow_links)
        labels = reader(path, wanted, volume, progress)
    except OSError as error:
        raise RefusedInputError(f"{escape_text(path.name)} cannot be read: {error.strerror or error}") from error
    if not labels.numbers and wanted.labels is not None:
        raise UsageError(f"no voxel of {name} has the label '{escape_text(str(wanted.labels[0]), 60)}'")
    if not labels.numbers:
        why = "".join(f"; {warning}" for warning in labels.warnings[:_WARNINGS_SHOWN])
        raise RefusedInputError(f"{name} is empty: no voxel has a label{why}")
    for label in wanted.labels or ():
        labels.find(label)
    return labels


def _read_dicom(path: Path, wanted: Wanted, volume: Grid | None, progress: Progress) -> LabelMap:
    name, sop_class = escape_text(path.name), _tell_class(path)
    if sop_class in _OTHER_OBJECTS:
        raise RefusedInputError(f"{name} is {_OTHER_OBJECTS[sop_class]}, no label map: give a SEG or an RTSTRUCT")
    if sop_class == STRUCTURE_SET:
        return read_structures(path, volume if isinstance(volume, Volume) else None, wanted, progress)
    return read_segmentation(path, wanted, progress, partial(_check_proportion, name, volume))


def _read_grid(kind: str, path: Path, wanted: Wanted, volume: Grid | None, progress: Progress) -> LabelMap:
    grid = open_grid(path, kind, LABEL_MAP)
    _check_proportion(grid.name, volume, grid.shape_ijk, _stored_bytes(grid))
    return _name_mask(read_grid_labels(grid, wanted, progress), path)


def _read_folder(follow_links: bool, path: Path, wanted: Wanted, volume: Grid | None, progress: Progress) -> LabelMap:
    masks = open_masks(path, follow_links=follow_links)
    for grid in masks.values():
        _check_proportion(grid.name, volume, grid.shape_ijk, _stored_bytes(grid))
    return read_masks(path, masks, wanted, progress)


def _name_mask(labels: LabelMap, path: Path) -> LabelMap:
    """Return the map; a mask of one structure that its file does not name has the name of the file."""
    if labels.numbers not in _MASK_NUMBERS or labels.names != {n: f"label_{n}" for n in labels.numbers}:
        return labels
    names = {labels.numbers[0]: name_of_grid(path)}
    return LabelMap(labels.voxels, labels.affine, names, warnings=labels.warnings)


def is_large_map(path: str | Path, *, most_bytes: int = LARGE_BYTES) -> bool:
    """Tell from its header whether a label map is read after its scan: contours of an RTSTRUCT need its slices, and one
    that takes long to unpack is better held against its grid first."""
    try:
        if Path(path).is_dir():
            return max(map(_stored_bytes, open_masks(Path(path)).values())) > most_bytes
        kind = tell_kind(Path(path))
        if kind == "DICOM" and _tell_class(Path(path)) == STRUCTURE_SET:
            return True
        if kind == "DICOM":
            return tell_pixel_bytes(Path(path)) > most_bytes
        return kind is not None and _stored_bytes(open_grid(Path(path), kind, LABEL_MAP)) > most_bytes
    except (ClreconError, OSError):  # told by `read_labels`
        return False


def is_dicom_map(path: str | Path) -> bool:
    """True for a DICOM file whose meta header says that it holds labels: a segmentation or a structure set."""
    return Path(path).is_file() and _tell_class(Path(path)) in (*SEGMENTATION_CLASSES, STRUCTURE_SET)


def _tell_class(path: Path) -> str:
    """Return the SOP class of a DICOM file as its meta header says it, "" where it does not."""
    from pydicom.filereader import read_file_meta_info

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pydicom's messages quote the file unescaped
            return str(read_file_meta_info(path).get("MediaStorageSOPClassUID", ""))
    except Exception:  # pydicom raises many error types; told by the readers
        return ""


def _stored_bytes(grid: GridFile) -> int:
    return prod(grid.shape_ijk) * grid.layers * grid.dtype.itemsize


def _check_proportion(name: str, volume: Grid | None, shape_ijk: tuple[int, int, int], stored_bytes: int) -> None:
    """Refuse a large map with many times the voxels of its scan, before it is unpacked; without the scan none is."""
    if volume is None:
        return
    times = prod(shape_ijk) / prod(volume.shape_ijk)
    if stored_bytes <= LARGE_BYTES or times <= _MOST_TIMES:
        return
    shapes = [" x ".join(map(str, each)) for each in (shape_ijk, volume.shape_ijk)]
    raise RefusedInputError(
        f"{name} has {shapes[0]} voxels, {times:,.0f} times as many as the scan ({shapes[1]}): it is not unpacked,"
        f" up to {_MOST_TIMES} times are; give labels on the grid of the scan"
    )
