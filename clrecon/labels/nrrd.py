"""NRRD label maps, and 3D Slicer's segmentations (.seg.nrrd) with their names and layers.

pynrrd parses the header; the voxels are read here, slice by slice.  A header that points to data in other files is
refused: such paths could name anything.

Source: the NRRD format definition (teem.sourceforge.net/nrrd/format.html) and 3D Slicer's segmentation file format.
"""

from __future__ import annotations

import gzip
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.text import escape_text
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, compose_affine
from clrecon.labels.extras import import_extra
from clrecon.labels.label_map import LabelMap
from clrecon.labels.overlap import Painter
from clrecon.labels.stream import check_size, empty_labels, iterate_slices, show_name

__all__ = ["is_nrrd", "nrrd_affine", "read_nrrd"]

LARGEST_HEADER = 2**20

LPS_FROM_SPACE = {
    "left-posterior-superior": (1.0, 1.0, 1.0), "lps": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0), "ras": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0), "las": (1.0, -1.0, 1.0),
}  # fmt: skip
"""Signs that take a frame that NRRD knows by name to LPS."""

TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(("longlong", "long long", "signed long long", "int64", "int64_t"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}


@dataclass(frozen=True)
class _Segment:
    """One segment of a .seg.nrrd: the voxels of `layer` that hold `value`."""

    number: int
    name: str
    layer: int
    value: int


def is_nrrd(start: bytes) -> bool:
    """True when the first bytes of a file are the mark of NRRD."""
    return start[:4] == b"NRRD"


def read_nrrd(path: Path, only: tuple[str | int, ...] | None = None) -> LabelMap:
    """Read a label map or a segmentation.

    Parameters
    ----------
    path : Path
    only : tuple of str or int, optional
        The labels that are wanted: others may overlap.

    Raises
    ------
    UsageError
        pynrrd is not installed, or a wanted label is not there.
    RefusedInputError
        The file is cut or corrupt, no label map, not placed, or segments overlap.
    """
    name, file_bytes = show_name(path), path.stat().st_size
    with open(path, "rb") as file:
        start = file.read(LARGEST_HEADER)
        end = re.search(rb"\r?\n\r?\n", start)
        if end is None:
            raise RefusedInputError(
                f"{name} has no voxels: its NRRD header does not end within {LARGEST_HEADER:,} bytes"
            )
        header = _parse(start[: end.start()], name)
        encoding = str(header.get("encoding", "")).lower()
        if encoding not in ("raw", "gzip", "gz"):
            raise RefusedInputError(
                f"{name} is stored as '{escape_text(encoding)}': raw and gzip are read, write it so"
            )
        file.seek(end.end())
        if encoding == "raw":
            return _read_voxels(file, header, name, file_bytes, False, only)
        with gzip.GzipFile(fileobj=file) as inflated:
            return _read_voxels(inflated, header, name, file_bytes, True, only)


def _parse(text: bytes, name: str) -> dict[str, Any]:
    nrrd = import_extra("nrrd")
    lines = [line + "\n" for line in text.decode("utf-8", "replace").splitlines()]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            header = dict(nrrd.read_header([*lines, "\n"]))
    except (nrrd.NRRDError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise RefusedInputError(f"{name} has a corrupt NRRD header: {escape_text(str(error))}") from error
    for field in ("data file", "datafile", "line skip", "lineskip", "byte skip", "byteskip"):
        if header.get(field) not in (None, 0):
            raise RefusedInputError(
                f"{name} says '{field}': NRRD files with header and voxels in one file, without a gap, are read"
            )
    return header


def _read_voxels(
    stream: Any,
    header: dict[str, Any],
    name: str,
    file_bytes: int,
    compressed: bool,
    only: tuple[str | int, ...] | None,
) -> LabelMap:
    sizes = _sizes(header, name)
    dtype = _dtype(header, name)
    layers = sizes[0] if len(sizes) == 4 else 1
    ni, nj, nk = sizes[-3:]
    affine = nrrd_affine(header, name)
    check_size(name, sizes, dtype.itemsize, file_bytes, compressed)
    planes = iterate_slices(stream, nk, layers * ni * nj, dtype, (1.0, 0.0), name)
    segments = _read_segments(header, name)
    if layers == 1:
        voxels = empty_labels(name, (nk, nj, ni))
        for k, plane in enumerate(planes):
            if plane.any():
                voxels[k] = plane.reshape(nj, ni)
        return LabelMap(voxels, affine, {segment.number: segment.name for segment in segments})
    if not segments:
        raise RefusedInputError(f"{name} has {layers} layers and does not say which segments they hold")
    return _merge_layers(planes, (nk, nj, ni, layers), affine, segments, name, only)


def _merge_layers(
    planes: Any,
    shape: tuple[int, int, int, int],
    affine: Float64Array,
    segments: list[_Segment],
    name: str,
    only: tuple[str | int, ...] | None,
) -> LabelMap:
    """One map of segments that are stored in layers; numbers that layers share are given anew."""
    if len({segment.number for segment in segments}) < len(segments):
        segments = [_Segment(n, s.name, s.layer, s.value) for n, s in enumerate(segments, start=1)]
    painter = Painter(name, empty_labels(name, shape[:3]), {s.number: s.name for s in segments}, only)
    in_order = {number: place for place, number in enumerate(painter.order)}
    for k, plane in enumerate(planes):
        stack = plane.reshape(shape[1:])
        for segment in sorted(segments, key=lambda s: in_order[s.number]):
            painter.paint(k, segment.number, stack[..., segment.layer] == segment.value)
    return painter.finish(affine)


def _sizes(header: dict[str, Any], name: str) -> tuple[int, ...]:
    try:
        sizes = tuple(int(n) for n in header["sizes"])
        kinds = [str(kind).lower() for kind in header.get("kinds", ["domain"] * len(sizes))]
    except (KeyError, TypeError, ValueError) as error:
        raise RefusedInputError(f"{name} has a corrupt NRRD header: no sizes") from error
    layered = len(sizes) == 4 and kinds[:1] == ["list"]
    if header.get("dimension") != len(sizes) or not (len(sizes) == 3 or layered):
        raise RefusedInputError(
            f"{name} has {len(sizes)} axes ({' x '.join(map(str, sizes))}): a label map has three, or a list of layers"
            " before them"
        )
    return sizes


def _dtype(header: dict[str, Any], name: str) -> np.dtype[Any]:
    code = TYPES.get(str(header.get("type", "")).lower())
    if code is None:
        raise RefusedInputError(
            f"{name} is not a label map: its voxels are '{escape_text(str(header.get('type')))}',"
            " labels are whole numbers"
        )
    endian = str(header.get("endian", "")).lower()
    if code[1:] != "1" and endian not in ("little", "big"):
        raise RefusedInputError(f"{name} has a corrupt NRRD header: it does not say its endian")
    return np.dtype((">" if endian == "big" else "<") + code)


def nrrd_affine(header: dict[str, Any], name: str) -> Float64Array:
    """The affine of an NRRD header, from the frame that it names to LPS.

    Parameters
    ----------
    header : dict
        As `nrrd.read_header` gives it.
    name : str
        Of the file, for messages.

    Returns
    -------
    ndarray, shape (4, 4), float64
        Index (i, j, k) to LPS mm; of the last three axes where there are four.

    Raises
    ------
    RefusedInputError
        No frame or one without a known direction, no directions or origin, or they are no affine.
    """
    space = str(header.get("space", "")).strip().lower()
    if space not in LPS_FROM_SPACE:
        raise RefusedInputError(
            f"{name} does not say where it lies in the patient (space '{escape_text(space)}'): write it with the space"
            " left-posterior-superior, right-anterior-superior or left-anterior-superior"
        )
    signs = np.array(LPS_FROM_SPACE[space])
    try:
        directions: NDArray[np.float64] = np.asarray(header["space directions"], dtype=np.float64)
        if len(directions) != header["dimension"]:
            raise ValueError(f"{len(directions)} directions for {header['dimension']} axes")
        steps = directions[-3:]
        origin = np.asarray(header["space origin"], dtype=np.float64)
        return checked_affine(compose_affine(steps[0] * signs, steps[1] * signs, steps[2] * signs, origin * signs))
    except (KeyError, IndexError, TypeError, ValueError, UsageError) as error:
        raise RefusedInputError(
            f"{name} cannot be placed: its space directions and space origin are no affine ({escape_text(str(error))})"
        ) from error


def _read_segments(header: dict[str, Any], name: str) -> list[_Segment]:
    """The segments that the header of a .seg.nrrd names, in their order."""
    segments = []
    numbers = sorted({int(m[1]) for field in header if (m := re.fullmatch(r"Segment([0-9]{1,5})_LabelValue", field))})
    for n in numbers:
        try:
            value, layer = int(header[f"Segment{n}_LabelValue"]), int(header.get(f"Segment{n}_Layer", 0))
        except ValueError as error:
            raise RefusedInputError(f"{name} has a corrupt NRRD header: value or layer of segment {n}") from error
        segments.append(_Segment(value, str(header.get(f"Segment{n}_Name", "")), layer, value))
    return segments
