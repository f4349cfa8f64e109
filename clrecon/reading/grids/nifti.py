"""NIfTI-1 and NIfTI-2 to read, by nibabel, NIfTI-1 to write (nifti1.h, nifti2.h); its RAS becomes LPS here."""

from __future__ import annotations

import math
import re
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, lps_affine_from_ras
from clrecon.geometry.images import MM_PER_UNIT, place_in_header
from clrecon.reading.grids.grid_file import (
    VOLUME,
    GridFile,
    VolumeContent,
    VoxelBytes,
    file_beside,
    import_extra,
    open_gzip,
    open_packer,
    read_bytes,
    write_slices,
)
from clrecon.system.light_dataclass import dataclass
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text

LARGEST_HEADER = 2**24
"""Most bytes before the voxels; extensions of label maps have some 10,000."""

_AFFINES_DIFFER_MM = 0.1
"""Distance at a corner from which sform and qform count as different; the quaternions of a qform are only float32."""

_SPACINGS_DIFFER = 0.01
"""Difference, as a share of the longest step, from which spacings count as different: ITK reads pixdim, others the
sform."""

_FIRST = (b"\x5c\x01\0\0", b"\0\0\x01\x5c")
_SECOND = (b"\x1c\x02\0\0", b"\0\0\x02\x1c")
"""First four bytes of NIfTI-1 (`_FIRST`) and NIfTI-2: the size of the header, 348 or 540, in little and big endian."""


@dataclass(frozen=True)
class _Header:
    """The header: nibabel's object, its size, whether the voxels are in another file, and in which."""

    parsed: Any
    size: int
    paired: bool
    offset: int
    extension: bytes


def is_nifti(start: bytes) -> bool:
    """True when the (inflated) first bytes of a file are those of a NIfTI header."""
    return start[:4] in (*_FIRST, *_SECOND)


def open_nifti(path: Path, purpose: str) -> GridFile:
    name = escape_text(path.name)
    with open_regular(path) as file:
        compressed = _is_gzip(file)
        header = _read_header(open_gzip(file) if compressed else file, name, purpose)
    try:
        shape = _shape(header.parsed, name, purpose)
        dtype = _dtype(header.parsed, name, purpose)
        slope, intercept = header.parsed.get_slope_inter()
        with np.errstate(over="ignore", invalid="ignore"):  # forms that are not finite are refused
            affine, warnings = nifti_affine(header.parsed, shape, name)
    except (ValueError, TypeError, KeyError, OverflowError, _header_error()) as error:
        if isinstance(error, UsageError):
            raise
        raise RefusedInputError(f"{name} has a corrupt NIfTI header: {escape_text(str(error))}") from error
    return GridFile(
        name=name,
        purpose=purpose,
        kind="NIfTI-2" if header.size == 540 else "NIfTI-1",
        shape_ijk=shape,
        dtype=dtype,
        affine=affine,
        voxel_bytes=_find_voxels(path, compressed, header),
        slope=1.0 if slope is None else float(slope),
        intercept=0.0 if intercept is None else float(intercept),
        warnings=tuple(warnings),
        extension=header.extension,
    )


def _is_gzip(file: BinaryIO) -> bool:
    start = file.read(2)
    file.seek(0)
    return start == b"\x1f\x8b"


def _header_error() -> type[Exception]:
    """Return the error that nibabel raises about headers; a header is there, and so is nibabel."""
    from nibabel.spatialimages import HeaderDataError

    return cast("type[Exception]", HeaderDataError)


def _read_header(stream: BinaryIO, name: str, purpose: str) -> _Header:
    nibabel = import_extra("nibabel", purpose)
    start = read_bytes(stream, 4, name, "its header")
    kind, size, magic = (nibabel.Nifti2Header, 540, b"2") if start in _SECOND else (nibabel.Nifti1Header, 348, b"1")
    parsed = kind(start + read_bytes(stream, size - 4, name, "its header"), check=False)
    magic_found = parsed["magic"].item()
    paired = magic_found[:3] == b"ni" + magic
    if not paired and magic_found[:3] != b"n+" + magic:
        raise RefusedInputError(
            f"{name} is no NIfTI file (its mark is {escape_text(repr(magic_found))}): Analyze files do not say where"
            " they lie and are not read, convert it to .nii.gz"
        )
    offset = float(parsed["vox_offset"])
    first = 0 if paired else size + 4
    if not (math.isfinite(offset) and first <= offset <= LARGEST_HEADER and offset == int(offset)):
        raise RefusedInputError(f"{name} has a corrupt NIfTI header: its voxels start at byte {offset:g}")
    extension = b"" if paired else read_bytes(stream, int(offset) - size, name, "its header")
    return _Header(parsed, size, paired, int(offset), extension)


def _find_voxels(path: Path, compressed: bool, header: _Header) -> VoxelBytes:
    """Find the voxels: in the file itself, or for a pair in the .img (or .img.gz) of the same name."""
    if header.paired:
        match = re.fullmatch(r"(.*)\.hdr(\.gz)?", path.name, re.IGNORECASE | re.DOTALL)
        if match is None:
            raise RefusedInputError(
                f"{escape_text(path.name)} is the header of a NIfTI pair: its name must end with .hdr, that of the"
                " voxels with .img"
            )
        stem = match[1]
        names = [f"{stem}.img", f"{stem}.img.gz", f"{stem}.IMG"]
        path = file_beside(path, next((other for other in names if path.with_name(other).exists()), names[0]))
        with open_regular(path) as file:
            compressed = _is_gzip(file)
    if compressed:
        return VoxelBytes(path, packing="gzip", skip=header.offset)
    return VoxelBytes(path, offset=header.offset)


def _shape(header: Any, name: str, purpose: str) -> tuple[int, int, int]:
    """Return (ni, nj, nk); further axes of length one are ignored."""
    shape = tuple(int(n) for n in header.get_data_shape())
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3:
        several = f": {math.prod(shape[3:])} of them, split it into one file each" if len(shape) > 3 else ""
        raise RefusedInputError(
            f"{name} has {len(shape)} axes ({' x '.join(map(str, shape))}): a {purpose} has three{several}"
        )
    return shape[0], shape[1], shape[2]


def _dtype(header: Any, name: str, purpose: str) -> np.dtype[Any]:
    dtype = cast("np.dtype[Any]", header.get_data_dtype())
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        shown = "colours" if dtype.names else str(dtype)
        raise RefusedInputError(f"{name} is not a {purpose}: its voxels are {shown}; one real number each is read")
    return dtype


def nifti_affine(header: Any, shape: tuple[int, int, int], name: str) -> tuple[Float64Array, list[str]]:
    """Return the affine of a header in LPS, the sform, else the qform, and warnings if they or pixdim disagree."""
    warnings = []
    sform = header.get_sform(coded=True)[0]
    try:
        qform = _qform(header)
    except (ValueError, _header_error()) as error:
        if sform is None:
            raise
        qform = None
        warnings.append(f"its qform cannot be read ({escape_text(str(error))}): the sform is used")
    chosen = sform if sform is not None else qform
    if chosen is None:
        raise RefusedInputError(
            f"{name} does not say where it lies (sform_code and qform_code are 0): write it with a position"
        )
    unit = MM_PER_UNIT.get(int(header["xyzt_units"]) & 7)
    if unit is None:
        raise RefusedInputError(
            f"{name} has lengths in unknown units (code {int(header['xyzt_units']) & 7}): metres, mm and microns are"
            " read"
        )
    scale = np.diag((unit, unit, unit, 1.0))
    try:
        affine = checked_affine(lps_affine_from_ras(scale @ chosen))
    except UsageError as error:
        raise RefusedInputError(f"{name} cannot be placed: {error}") from error
    sides, stated = np.linalg.norm(chosen[:3, :3], axis=0), np.abs(header["pixdim"][1:4]).astype(np.float64)
    if not np.abs(sides - stated).max() <= _SPACINGS_DIFFER * sides.max():
        shown = [" x ".join(f"{unit * step:.4g}" for step in steps) for steps in (stated, sides)]
        warnings.append(f"pixdim says a spacing of {shown[0]} mm, the affine {shown[1]} mm: the affine is used")
    if sform is not None and qform is not None:
        corners = np.array(list(product(*((0, length) for length in shape[:3]), (1,))))
        apart = unit * np.linalg.norm(corners @ (sform - qform).T, axis=1).max()
        if not apart <= _AFFINES_DIFFER_MM:
            warnings.append(f"sform and qform lie {apart:.3g} mm apart: the sform is used")
    return affine, warnings


def _qform(header: Any) -> Any:
    """Return the qform, None where its code is 0; pixdim[0] = 0 means 1, as the definition of NIfTI says."""
    if header["pixdim"][0] == 0:
        header = header.copy()
        header["pixdim"][0] = 1
    return header.get_qform(coded=True)[0]


_COMMENT_CODE = 6
"""Code of the extension that holds plain text."""


def write_nifti(stream: BinaryIO, content: VolumeContent, *, packed: bool) -> None:
    """Write the file; the certificate is a header extension of plain text."""
    if not packed:
        _write_parts(stream, content)
        return
    with open_packer(stream) as packing:
        _write_parts(packing, content)


def _write_parts(stream: Any, content: VolumeContent) -> None:
    nibabel = import_extra("nibabel", VOLUME)
    dtype = content.voxels.dtype.newbyteorder("<")
    header = nibabel.Nifti1Header(endianness="<")
    header.set_data_dtype(dtype)
    header.set_data_shape(content.voxels.shape[::-1])
    header.set_slope_inter(1.0, 0.0)
    place_in_header(header, content.affine)
    header["descrip"] = b"HU; certificate of clrecon in the header extension"
    text = "\n".join(("clrecon", *content.lines)).encode("ascii")
    header.extensions.append(nibabel.nifti1.Nifti1Extension(_COMMENT_CODE, text))
    header["vox_offset"] = header.single_vox_offset + header.extensions.get_sizeondisk()
    start = BytesIO()  # nibabel asks where it is, and a stream that packs does not know
    header.write_to(start)
    stream.write(start.getvalue())
    write_slices(stream, content)
