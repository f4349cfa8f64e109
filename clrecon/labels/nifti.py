"""NIfTI-1 and NIfTI-2 label maps (.nii, .nii.gz).

nibabel parses the header; the voxels are read here, slice by slice.  NIfTI's frame is RAS mm, and this is where it
ends: `nifti_affine` gives LPS.

Source: the NIfTI-1 and NIfTI-2 definitions (nifti1.h, nifti2.h).
"""

from __future__ import annotations

import gzip
import html
import math
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from clrecon.dicom.text import escape_text
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_affine
from clrecon.geometry.frames import lps_affine_from_ras
from clrecon.labels.extras import import_extra
from clrecon.labels.label_map import LabelMap
from clrecon.labels.stream import check_size, empty_labels, iterate_slices, read_bytes, show_name

__all__ = ["is_nifti", "nifti_affine", "read_nifti"]

LARGEST_HEADER = 2**24
"""Bytes before the voxels; extensions of label maps have some 10,000."""

MM_PER_UNIT = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}
"""Code of the spatial unit: unknown (read as mm, as everybody does), metre, mm, micron."""

AFFINES_DIFFER_MM = 0.1
"""sform and qform that are this far apart at a corner are said to disagree: quaternions are float32."""

_LABEL = re.compile(
    rb'<Label\b[^>]{0,500}?\bKey="([0-9]{1,9})"[^>]{0,500}>\s*(?:<!\[CDATA\[(.*?)\]\]>|([^<]*))', re.DOTALL
)


def is_nifti(start: bytes) -> bool:
    """True when the (inflated) first bytes of a file are those of a NIfTI header."""
    return start[:4] in (b"\x5c\x01\0\0", b"\0\0\x01\x5c", b"\x1c\x02\0\0", b"\0\0\x02\x1c")


def read_nifti(path: Path) -> LabelMap:
    """Read a label map.

    Raises
    ------
    UsageError
        nibabel is not installed.
    RefusedInputError
        The file is cut or corrupt, no label map, not placed, or has more than three axes.
    """
    name, file_bytes = show_name(path), path.stat().st_size
    with open(path, "rb") as file:
        compressed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        if not compressed:
            return _read_stream(file, name, file_bytes, False)
        with gzip.GzipFile(fileobj=file) as inflated:
            return _read_stream(inflated, name, file_bytes, True)  # type: ignore[arg-type]


def _read_stream(stream: BinaryIO, name: str, file_bytes: int, compressed: bool) -> LabelMap:
    header, extension = _read_header(stream, name)
    try:
        shape, dtype, scale = _layout(header, name)
        affine, warnings = nifti_affine(header, shape, name)
    except (ValueError, TypeError, KeyError, OverflowError, header_errors()) as error:
        if isinstance(error, UsageError):
            raise
        raise RefusedInputError(f"{name} has a corrupt NIfTI header: {escape_text(str(error))}") from error
    check_size(name, shape, dtype.itemsize, file_bytes, compressed)
    ni, nj, nk = shape
    voxels = empty_labels(name, (nk, nj, ni))
    for k, labels in enumerate(iterate_slices(stream, nk, ni * nj, dtype, scale, name)):
        if labels.any():
            voxels[k] = labels.reshape(nj, ni)
    return LabelMap(voxels, affine, _read_names(extension), warnings=warnings)


def header_errors() -> type[Exception]:
    """What nibabel raises about headers."""
    nibabel = import_extra("nibabel")
    return nibabel.spatialimages.HeaderDataError  # type: ignore[no-any-return]


def _read_header(stream: BinaryIO, name: str) -> tuple[Any, bytes]:
    """The parsed header and the bytes between it and the voxels."""
    nibabel = import_extra("nibabel")
    start = read_bytes(stream, 4, name, "its header")
    second = start in (b"\x1c\x02\0\0", b"\0\0\x02\x1c")
    kind, size, magic = (nibabel.Nifti2Header, 540, b"n+2") if second else (nibabel.Nifti1Header, 348, b"n+1")
    block = start + read_bytes(stream, size - 4, name, "its header")
    header = kind(block, check=False)
    found = header["magic"].item()
    if not found.startswith(magic):
        raise RefusedInputError(
            f"{name} is no NIfTI file in one piece (its mark is {escape_text(repr(found))}): header and voxels in two"
            " files (.hdr, .img) and Analyze files are not read, convert it to .nii.gz"
        )
    offset = float(header["vox_offset"])
    if not (math.isfinite(offset) and size + 4 <= offset <= LARGEST_HEADER and offset == int(offset)):
        raise RefusedInputError(f"{name} has a corrupt NIfTI header: its voxels start at byte {offset:g}")
    return header, read_bytes(stream, int(offset) - size, name, "its header")


def _layout(header: Any, name: str) -> tuple[tuple[int, int, int], np.dtype[Any], tuple[float, float]]:
    """Shape (ni, nj, nk), stored type, and (slope, intercept)."""
    shape = tuple(int(n) for n in header.get_data_shape())
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3:
        raise RefusedInputError(
            f"{name} has {len(shape)} axes ({' x '.join(map(str, shape))}): a label map has three; split it into one"
            " file a volume"
        )
    dtype = header.get_data_dtype()
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise RefusedInputError(f"{name} is not a label map: its voxels are {dtype}, labels are whole numbers")
    slope, intercept = header.get_slope_inter()
    scale = (1.0 if slope is None else float(slope), 0.0 if intercept is None else float(intercept))
    return (shape[0], shape[1], shape[2]), dtype, scale


def nifti_affine(header: Any, shape: tuple[int, int, int], name: str) -> tuple[Float64Array, list[str]]:
    """The affine of a NIfTI header, from RAS to LPS: the sform, else the qform.

    Parameters
    ----------
    header : nibabel.Nifti1Header or Nifti2Header
    shape : (ni, nj, nk)
    name : str
        Of the file, for messages.

    Returns
    -------
    affine : ndarray, shape (4, 4), float64
        Index (i, j, k) to LPS mm.
    warnings : list of str
        One where sform and qform disagree.

    Raises
    ------
    RefusedInputError
        Neither of both, or it is no affine.
    """
    sform, qform = (_coded(header, which) for which in ("sform", "qform"))
    chosen = sform if sform is not None else qform
    if chosen is None:
        raise RefusedInputError(
            f"{name} does not say where it lies (sform_code and qform_code are 0): write it with a position"
        )
    unit = MM_PER_UNIT.get(int(header["xyzt_units"]) & 7, 1.0)
    scale = np.diag((unit, unit, unit, 1.0))
    try:
        affine = checked_affine(lps_affine_from_ras(scale @ chosen))
    except UsageError as error:
        raise RefusedInputError(f"{name} cannot be placed: {error}") from error
    warnings = []
    if sform is not None and qform is not None:
        corners = np.array([[i, j, k, 1] for i in (0, shape[0]) for j in (0, shape[1]) for k in (0, shape[2])])
        apart = unit * np.linalg.norm(corners @ (sform - qform).T, axis=1).max()
        if not apart <= AFFINES_DIFFER_MM:
            warnings.append(f"sform and qform of the label map lie {apart:.3g} mm apart: the sform is used")
    return affine, warnings


def _coded(header: Any, which: str) -> Any:
    """The sform or qform, None where its code is 0."""
    return getattr(header, f"get_{which}")(coded=True)[0]


def _read_names(extension: bytes) -> dict[int, str]:
    """Names in a label table as Caret, Connectome Workbench and TotalSegmentator write it into the header."""
    names = {}
    for match in _LABEL.finditer(extension):
        text = (match[2] or match[3] or b"").decode("utf-8", "replace")
        names[int(match[1])] = text if match[2] is not None else html.unescape(text)
    return {number: text for number, text in names.items() if text.strip()}
