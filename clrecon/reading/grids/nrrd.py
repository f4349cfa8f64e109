"""NRRD (teem.sourceforge.net/nrrd/format.html) by pynrrd: .nrrd, and .nhdr with voxels in a file of its folder."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, compose_affine
from clrecon.reading.grids.grid_file import (
    LABEL_MAP,
    VOLUME,
    GridFile,
    VolumeContent,
    VoxelBytes,
    file_beside,
    import_extra,
    open_packer,
    write_slices,
)
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text

LARGEST_HEADER = 2**20

_LPS_FROM_SPACE = {
    "left-posterior-superior": (1.0, 1.0, 1.0), "lps": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0), "ras": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0), "las": (1.0, -1.0, 1.0),
}  # fmt: skip
"""Signs that turn each named frame of NRRD into LPS."""

MM_PER_UNIT = {
    **dict.fromkeys(("", "mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters"), 10.0),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1000.0),
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "micron", "microns", "micrometer", "micrometers"), 0.001),
}
"""Millimetres of each value of "space units"; mm where it is missing, as other programs read it."""

_DETACHED = re.compile(rb"^data ?file:[ \t]*(.*?)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)
"""The field of a header whose voxels are in another file."""

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


def is_nrrd(start: bytes) -> bool:
    """True when the first bytes of a file are the mark of NRRD."""
    return start[:4] == b"NRRD"


def open_nrrd(path: Path, purpose: str) -> GridFile:
    name = escape_text(path.name)
    with open_regular(path) as file:
        start = file.read(LARGEST_HEADER)
    end = re.search(rb"\r?\n\r?\n", start)
    text = start if end is None else start[: end.start()]
    detached = _DETACHED.search(text)
    if end is None and (detached is None or len(start) == LARGEST_HEADER):
        raise RefusedInputError(f"{name} has no voxels: its NRRD header does not end within {LARGEST_HEADER:,} bytes")
    beside = None if detached is None else _voxel_file(path, detached[1].decode("utf-8", "replace"))
    header = _parse_header(text, name, purpose)
    encoding = str(header.get("encoding", "")).lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise RefusedInputError(f"{name} is stored as '{escape_text(encoding)}': raw and gzip are read, write it so")
    packing = "raw" if encoding == "raw" else "gzip"
    inside = 0 if end is None else end.end()
    layers, shape = _sizes(header, name, purpose)
    dtype = _dtype(header, name, purpose)
    return GridFile(
        name=name,
        purpose=purpose,
        kind="NRRD",
        shape_ijk=shape,
        layers=layers,
        dtype=dtype,
        affine=nrrd_affine(header, name),
        voxel_bytes=VoxelBytes(path, inside, packing) if beside is None else VoxelBytes(beside, 0, packing),
        warnings=_warnings(header),
        fields=header,
    )


def _parse_header(text: bytes, name: str, purpose: str) -> dict[str, Any]:
    nrrd = import_extra("nrrd", purpose)
    lines = [line + "\n" for line in text.decode("utf-8", "replace").splitlines()]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            header = dict(nrrd.read_header([*lines, "\n"]))
    except (nrrd.NRRDError, ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        raise RefusedInputError(f"{name} has a corrupt NRRD header: {escape_text(str(error))}") from error
    for field in ("line skip", "lineskip", "byte skip", "byteskip"):
        if header.get(field) not in (None, 0):
            raise RefusedInputError(f"{name} says '{field}': NRRD files without a gap before their voxels are read")
    return header


def _voxel_file(path: Path, named: str) -> Path:
    """Return the one file beside a detached header that holds the voxels."""
    if not named or named.split()[0].upper() == "LIST" or "%" in named:
        raise RefusedInputError(
            f"{escape_text(path.name)} has its voxels in several files ('data file: {escape_text(named)}'): one is read"
        )
    return file_beside(path, named)


def _warnings(header: dict[str, Any]) -> tuple[str, ...]:
    if any(header.get(field) is not None for field in ("old min", "oldmin", "old max", "oldmax")):
        return ("the header says that the values were quantised (old min, old max): they are taken as they are",)
    return ()


def _sizes(header: dict[str, Any], name: str, purpose: str) -> tuple[int, tuple[int, int, int]]:
    """Return the number of layers, and (ni, nj, nk); a further axis of length one without a direction is ignored."""
    try:
        sizes = tuple(int(n) for n in header["sizes"])
        kinds = [str(kind).lower() for kind in header.get("kinds", ["domain"] * len(sizes))]
    except (KeyError, TypeError, ValueError) as error:
        raise RefusedInputError(f"{name} has a corrupt NRRD header: no sizes") from error
    in_space = _space_axes(header, len(sizes))
    layered = purpose == LABEL_MAP and len(sizes) == 4 and kinds[:1] == ["list"]
    beside = [n for axis, n in enumerate(sizes) if axis not in in_space]
    single = len(in_space) == 3 and all(n == 1 for n in beside)
    if header.get("dimension") != len(sizes) or not (single or layered):
        or_layers = ", or a list of layers before them" if purpose == LABEL_MAP else ""
        several = f"; split it into one file each of the {np.prod(beside)}" if len(in_space) == 3 and beside else ""
        raise RefusedInputError(
            f"{name} has {len(sizes)} axes ({' x '.join(map(str, sizes))}): a {purpose} has three{or_layers}{several}"
        )
    ni, nj, nk = sizes[-3:] if layered else (sizes[axis] for axis in in_space)
    return (sizes[0] if layered else 1), (ni, nj, nk)


def _space_axes(header: dict[str, Any], count: int) -> list[int]:
    """Return the axes that have a direction; all axes where none has one."""
    try:
        directions: NDArray[np.float64] = np.asarray(header["space directions"], dtype=np.float64)
        if directions.ndim != 2 or len(directions) != count:
            return list(range(count))
        return [axis for axis, step in enumerate(directions) if not np.isnan(step).all()]
    except (KeyError, TypeError, ValueError):
        return list(range(count))  # `nrrd_affine` reports the error


def _dtype(header: dict[str, Any], name: str, purpose: str) -> np.dtype[Any]:
    code = TYPES.get(str(header.get("type", "")).lower())
    if code is None:
        raise RefusedInputError(
            f"{name} is not a {purpose}: its voxels are '{escape_text(str(header.get('type')))}'; one real number"
            " each is read"
        )
    endian = str(header.get("endian", "")).lower()
    if code[1:] != "1" and endian not in ("little", "big"):
        raise RefusedInputError(f"{name} has a corrupt NRRD header: it does not say its endian")
    return np.dtype((">" if endian == "big" else "<") + code)


def nrrd_affine(header: dict[str, Any], name: str) -> Float64Array:
    """Return the affine of the three axes with a direction in a header as pynrrd reads it, from its frame to LPS."""
    space = str(header.get("space", "")).strip().lower()
    if space not in _LPS_FROM_SPACE:
        raise RefusedInputError(
            f"{name} does not say where it lies in the patient (space '{escape_text(space)}'): write it with the space"
            " left-posterior-superior, right-anterior-superior or left-anterior-superior"
        )
    signs = np.array(_LPS_FROM_SPACE[space])
    try:
        directions: NDArray[np.float64] = np.asarray(header["space directions"], dtype=np.float64)
        if len(directions) != header["dimension"]:
            raise ValueError(f"{len(directions)} directions for {header['dimension']} axes")
        steps = directions[_space_axes(header, len(directions))]
        if len(steps) != 3:
            raise ValueError(f"{len(steps)} axes with a direction")
        origin = np.asarray(header["space origin"], dtype=np.float64)
        signs = signs * _unit_scale(header, name)
        return checked_affine(compose_affine(steps[0] * signs, steps[1] * signs, steps[2] * signs, origin * signs))
    except (KeyError, IndexError, TypeError, ValueError, UsageError) as error:
        raise RefusedInputError(
            f"{name} cannot be placed: its space directions and space origin are no affine ({escape_text(str(error))})"
        ) from error


def _unit_scale(header: dict[str, Any], name: str) -> NDArray[np.float64]:
    units = header.get("space units") or ["mm"] * 3
    scales = [MM_PER_UNIT.get(str(unit).strip(' "').lower()) for unit in units]
    if len(scales) != 3 or None in scales:
        raise RefusedInputError(
            f"{name} has lengths in unknown units ({escape_text(' '.join(map(str, units)))}): mm, cm, m and um are read"
        )
    return np.array(scales, dtype=np.float64)


def write_nrrd(stream: BinaryIO, content: VolumeContent) -> None:
    """Write the file: the header by pynrrd without its date, which packs slowly, and voxels packed by gzip."""
    nrrd = import_extra("nrrd", VOLUME)
    header = {
        "space": "left-posterior-superior",
        "kinds": ["domain", "domain", "domain"],
        "space directions": content.affine[:3, :3].T,
        "space origin": content.affine[:3, 3],
        "space units": ["mm", "mm", "mm"],
        "endian": "little",
        "encoding": "gzip",
        **{f"clrecon_{n:02}": line for n, line in enumerate(("HU", *content.lines))},
    }
    start = io.BytesIO()
    nrrd.write(start, np.zeros((1, 1, 1), content.voxels.dtype.newbyteorder("<")), header)
    lines = start.getvalue().partition(b"\n\n")[0].split(b"\n")
    sizes = "sizes: {2} {1} {0}".format(*content.voxels.shape).encode()
    fields = [sizes if line.startswith(b"sizes:") else line for line in lines if not line.startswith(b"# on ")]
    stream.write(b"\n".join(fields) + b"\n\n")
    with open_packer(stream) as packing:
        write_slices(packing, content)
