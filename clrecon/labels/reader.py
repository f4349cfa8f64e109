"""`read_labels`: what kind of file it is, told from its first bytes."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path

from clrecon.dicom.text import escape_text
from clrecon.errors import RefusedInputError, UsageError
from clrecon.labels.label_map import LabelMap
from clrecon.labels.nifti import is_nifti, read_nifti
from clrecon.labels.nrrd import is_nrrd, read_nrrd
from clrecon.labels.overlap import check_wanted
from clrecon.labels.segmentation import is_dicom, read_segmentation
from clrecon.labels.stream import show_name

__all__ = ["read_labels"]


def read_labels(path: str | Path, only: Sequence[str | int] | None = None) -> LabelMap:
    """Read a label map: NIfTI (.nii, .nii.gz), NRRD and 3D Slicer's .seg.nrrd, or DICOM SEG.

    The kind is told from the content.  NIfTI and NRRD need the extra ``clrecon[labels]``.

    Parameters
    ----------
    path : path
    only : sequence of str or int, optional
        The labels that are wanted, as `LabelMap.find` takes them.  It matters for files whose segments overlap:
        those that are wanted may not overlap each other, and take what they share with others.

    Returns
    -------
    LabelMap
        In LPS mm, on the grid of the file.

    Raises
    ------
    UsageError
        There is no such file, a package is missing, or a wanted segment is not there.
    RefusedInputError
        The file is no label map (CT images, probabilities, negative numbers, four axes), cut or corrupt, does not
        say where it lies, or segments overlap.
    """
    wanted = check_wanted(only)
    path = Path(path)
    if path.is_dir():
        raise UsageError(f"{show_name(path)} is a folder: give the file with the labels")
    try:
        if not path.exists():
            raise UsageError(f"there is no label map {escape_text(str(path), 200)}")
        if not path.is_file():
            raise RefusedInputError(f"{show_name(path)} is no regular file")
        with open(path, "rb") as file:
            start = file.read(132)
        start, name = _inflate(start), show_name(path)
        if is_nifti(start):
            labels = read_nifti(path)
        elif is_nrrd(start):
            labels = read_nrrd(path, wanted)
        elif is_dicom(start):
            labels = read_segmentation(path, wanted)
        else:
            raise RefusedInputError(f"{name} is no label map that can be read: NIfTI, NRRD and DICOM SEG are")
    except OSError as error:
        raise RefusedInputError(f"{show_name(path)} cannot be read: {error.strerror or error}") from error
    if not labels.numbers:
        raise RefusedInputError(f"{name} is empty: no voxel has a label")
    for label in wanted or ():
        labels.find(label)
    return labels


def _inflate(start: bytes) -> bytes:
    """The first bytes, inflated where they are gzip."""
    if start[:2] != b"\x1f\x8b":
        return start
    try:
        return zlib.decompressobj(wbits=31).decompress(start, 64)
    except zlib.error:
        return b""
