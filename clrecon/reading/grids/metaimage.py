"""MetaImage: .mha, and .mhd with the voxels in one file beside it.

SimpleITK, the reference reader of this format, interprets the header, but only after every important field was checked
here; and it never reads the voxels.  The reasons were seen with SimpleITK 2.5.  A header with NDims = 100000 ends the
process (a write beyond an array).  A header without a position is placed at the origin.  A field with too few numbers
swallows the next one: a spacing of 2 mm was then read as 1 mm.  Damaged compressed voxels come back as numbers, with
only a line on standard error.  It also writes: the certificate as fields of its own, the voxels not packed.

Its frame is LPS mm.  AnatomicalOrientation only informs people; the affine comes from TransformMatrix, Offset and
ElementSpacing.

Source: the MetaIO documentation (itk.org/Wiki/MetaIO/Documentation) and ITK's MetaImageIO.
"""

from __future__ import annotations

import math
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from clrecon.errors import OutputError, RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_affine
from clrecon.geometry.images import make_sitk
from clrecon.reading.grids.grid_file import VOLUME, GridFile, VolumeContent, VoxelBytes, file_beside, import_extra
from clrecon.system.foreign_words import hush
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text

LARGEST_HEADER = 2**20
_LONGEST_KEY, LONGEST_VALUE = 100, 4000
"""Longest accepted key and value in bytes; MetaIO has 255 bytes for keys and 32 KiB for values."""

MM_PER_UNIT = {"": 1.0, "?": 1.0, "mm": 1.0, "cm": 10.0, "um": 0.001}
"""Millimetres of each value of DistanceUnits: missing or unknown (read as mm, as other programs do), mm, cm, micron."""

_SAME_FIELD = {
    "Offset": ("Offset", "Position", "Origin"),
    "TransformMatrix": ("TransformMatrix", "Rotation", "Orientation"),
    "ByteOrderMSB": ("BinaryDataByteOrderMSB", "ElementByteOrderMSB"),
}
"""Different names of the same field."""

PLAIN = {
    "HeaderSize": 0.0,
    "ElementNumberOfChannels": 1.0,
    "ElementToIntensityFunctionSlope": 1.0,
    "ElementToIntensityFunctionOffset": 0.0,
}
"""Fields that must have this value."""

UNUSED_NUMBERS = {"CenterOfRotation": 0, "ElementSize": 0, "Color": 4, "CompressedDataSize": 1}
"""Fields of numbers that are not used, and how many they have, 0 for one an axis.  MetaIO takes what is missing from
the lines that follow: those are then not read, or complained of on standard error."""

_ELEMENT_TYPES = (
    *(f"MET_{sign}{size}" for sign in ("", "U") for size in ("CHAR", "SHORT", "INT", "LONG", "LONG_LONG")),
    "MET_FLOAT", "MET_DOUBLE",
)  # fmt: skip

_START = re.compile(rb"\s*(ObjectType|NDims)[ \t]*=")


def is_metaimage(start: bytes) -> bool:
    """True when the first bytes of a file are the first field of a MetaImage header."""
    return _START.match(start) is not None


def open_metaimage(path: Path, purpose: str) -> GridFile:
    name = escape_text(path.name)
    fields, end = _read_fields(path, name)
    header = _Header(fields, name, purpose)
    header.check()
    packing = "zlib" if header.flag("CompressedData", False) else "raw"
    if fields["ElementDataFile"].upper() == "LOCAL":
        voxel_bytes = VoxelBytes(path, end, packing)
    else:
        voxel_bytes = VoxelBytes(header.data_file(path), 0, packing)
    shape, dtype, affine = _ask_library(path, header)
    return GridFile(
        name=name,
        purpose=purpose,
        kind="MetaImage",
        shape_ijk=shape,
        dtype=dtype.newbyteorder(">" if header.flag("ByteOrderMSB", False) else "<"),
        affine=affine,
        voxel_bytes=voxel_bytes,
        warnings=tuple(header.warnings),
    )


def _read_fields(path: Path, name: str) -> tuple[dict[str, str], int]:
    """Read the fields up to ElementDataFile, which is the last, and the offset of the byte after it."""
    with open_regular(path) as file:
        start = file.read(LARGEST_HEADER)
    fields: dict[str, str] = {}
    seen = {""}
    position = 0
    while "ElementDataFile" not in fields:
        line, newline, _ = start[position : position + _LONGEST_KEY + LONGEST_VALUE].partition(b"\n")
        key, mark, value = (part.strip() for part in line.decode("latin-1").partition("="))
        position += len(line) + len(newline)
        if not line and not newline or (key and not mark) or len(key) > _LONGEST_KEY or len(value) > LONGEST_VALUE:
            raise RefusedInputError(
                f"{name} has a corrupt MetaImage header: no line 'ElementDataFile = ...' ends it, it stops at"
                f" '{escape_text(key)}'"
            )
        if key and key.casefold() in seen:
            raise RefusedInputError(f"{name} has a corrupt MetaImage header: it says {escape_text(key)} twice")
        seen.add(key.casefold())
        if key:
            fields[key] = value
    return fields, position


class _Header:
    """The fields of a header, checked before any library sees them."""

    def __init__(self, fields: dict[str, str], name: str, purpose: str):
        self.fields, self.name = fields, name
        self.purpose = purpose
        self.warnings: list[str] = []

    def check(self) -> None:
        """Refuse a header unless it describes one grid of real numbers with a position."""
        self._check_kind()
        axes = self.numbers("NDims", 1)[0]
        if axes not in (3, 4):
            raise self.wrong("NDims", f"a {self.purpose} has three axes")
        sizes = self.numbers("DimSize", int(axes))
        if min(sizes) < 1 or max(sizes) > 2**31 or any(n != int(n) for n in sizes):
            raise self.wrong("DimSize", "whole numbers from 1")
        if axes == 4 and sizes[3] != 1:
            shown = " x ".join(f"{n:g}" for n in sizes)
            raise RefusedInputError(
                f"{self.name} has 4 axes ({shown}): a {self.purpose} has three: {sizes[3]:g} of them,"
                " split it into one file each"
            )
        if min(self.numbers("ElementSpacing", int(axes))) <= 0:
            raise self.wrong("ElementSpacing", "steps above 0 mm; directions belong into TransformMatrix")
        self.numbers("TransformMatrix", int(axes * axes))
        self.numbers("Offset", int(axes))
        for key, count in UNUSED_NUMBERS.items():
            if key in self.fields:
                self.numbers(key, count or int(axes))

    def _check_kind(self) -> None:
        if self.text("ObjectType", "Image").lower() != "image":
            raise self.wrong("ObjectType", "Image")
        if self.text("ElementType").upper() not in _ELEMENT_TYPES:
            raise self.wrong("ElementType", f"a {self.purpose} has one real number a voxel")
        if not self.flag("BinaryData", True):
            raise self.wrong("BinaryData", "True: voxels written as text are not read")
        for key, only in PLAIN.items():
            if key in self.fields and self.numbers(key, 1) != [only]:
                raise self.wrong(key, f"{only:g}")
        if self.text("DistanceUnits", "") not in MM_PER_UNIT:
            raise self.wrong("DistanceUnits", "mm, cm or um")
        self.flag("CompressedData", False)
        if self._name_of("ByteOrderMSB") is None and self.text("ElementType").upper() not in ("MET_CHAR", "MET_UCHAR"):
            self.warnings.append("the byte order is not said (BinaryDataByteOrderMSB): little endian is taken")

    def wrong(self, key: str, expected: str) -> RefusedInputError:
        used = self._name_of(key)
        if used is None:
            return RefusedInputError(f"{self.name} is no usable MetaImage: {key} is missing, expected {expected}")
        shown = escape_text(self.fields[used])
        return RefusedInputError(f"{self.name} is no usable MetaImage: {used} is '{shown}', expected {expected}")

    def _name_of(self, key: str) -> str | None:
        used = [other for other in _SAME_FIELD.get(key, (key,)) if other in self.fields]
        if len(used) > 1:
            raise RefusedInputError(f"{self.name} has a corrupt MetaImage header: it says {used[0]} and {used[1]}")
        return used[0] if used else None

    def text(self, key: str, default: str | None = None) -> str:
        used = self._name_of(key)
        if used is None and default is None:
            raise self.wrong(key, "a value")
        return str(default) if used is None else self.fields[used]

    def numbers(self, key: str, count: int) -> list[float]:
        """Return exactly `count` finite numbers."""
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        if self._name_of(key) is None:
            raise self.wrong(key, expected + (": it does not say where it lies" * (count > 1 and key != "DimSize")))
        parts = self.text(key).split()
        if len(parts) != count or not all(re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", p) for p in parts):
            raise self.wrong(key, expected)
        numbers = [float(part) for part in parts]
        if not all(map(math.isfinite, numbers)):
            raise self.wrong(key, expected)
        return numbers

    def flag(self, key: str, default: bool) -> bool:
        value = self.text(key, str(default)).lower()
        if value not in ("true", "t", "1", "false", "f", "0"):
            raise self.wrong(key, "True or False")
        return value in ("true", "t", "1")

    def data_file(self, path: Path) -> Path:
        named = self.fields["ElementDataFile"]
        if not named or named.upper().split()[0] == "LIST" or "%" in named:
            raise self.wrong("ElementDataFile", "LOCAL or one file, not several")
        return file_beside(path, named)


def _ask_library(path: Path, header: _Header) -> tuple[tuple[int, int, int], np.dtype[Any], Float64Array]:
    """Return shape (ni, nj, nk), type and affine, as SimpleITK understands the header."""
    sitk = import_extra("SimpleITK", header.purpose)
    reader = sitk.ImageFileReader()
    reader.SetImageIO("MetaImageIO")  # SimpleITK may use its MetaImage reader only.
    reader.SetFileName(str(path))
    try:
        with hush():
            reader.ReadImageInformation()
    except RuntimeError as error:
        raise RefusedInputError(f"{header.name} is no usable MetaImage: SimpleITK cannot read its header") from error
    kind = reader.GetPixelIDValue()
    dtype = next((np.dtype(code) for name, code in _PIXELS.items() if getattr(sitk, name) == kind), None)
    size, axes = tuple(int(n) for n in reader.GetSize()), reader.GetDimension()
    directions = np.array(reader.GetDirection()).reshape(axes, axes)
    placed = (reader.GetSpacing(), reader.GetOrigin(), directions.T.ravel())
    stated = (header.numbers("ElementSpacing", axes), header.numbers("Offset", axes))
    same = all(map(np.allclose, placed, (*stated, header.numbers("TransformMatrix", axes * axes))))
    same = same and list(size) == header.numbers("DimSize", axes)
    if dtype is None or not same or reader.GetNumberOfComponents() != 1:
        raise RefusedInputError(f"{header.name} has a corrupt MetaImage header: it can be read in two ways")
    affine = np.eye(4)
    affine[:3, :3] = directions[:3, :3] * np.array(reader.GetSpacing()[:3])
    affine[:3, 3] = reader.GetOrigin()[:3]
    affine[:3] *= MM_PER_UNIT[header.text("DistanceUnits", "")]
    try:
        if np.any(directions[:3, 3:]):
            raise UsageError("the fourth axis leads through space")
        return (size[0], size[1], size[2]), dtype, checked_affine(affine)
    except UsageError as error:
        raise RefusedInputError(f"{header.name} cannot be placed: {error}") from error


_PIXELS = {
    "sitkInt8": "i1", "sitkUInt8": "u1", "sitkInt16": "i2", "sitkUInt16": "u2", "sitkInt32": "i4", "sitkUInt32": "u4",
    "sitkInt64": "i8", "sitkUInt64": "u8", "sitkFloat32": "f4", "sitkFloat64": "f8",
}  # fmt: skip
"""Names of voxel types in SimpleITK."""


_NAME = "volume.mha"


def write_metaimage(stream: BinaryIO, content: VolumeContent) -> None:
    """Write the file.  SimpleITK writes to a name alone: a temporary file, whose bytes go to the stream."""
    sitk = import_extra("SimpleITK", VOLUME)
    content.progress("write", 0, 0)
    image = make_sitk(content.voxels, content.affine)
    for n, line in enumerate(("HU", *content.lines)):
        image.SetMetaData(f"clrecon_{n:02}", line)
    with tempfile.TemporaryDirectory(prefix="clrecon-") as folder:
        path = Path(folder, _NAME)
        try:
            with hush():
                sitk.WriteImage(image, str(path), useCompression=False, imageIO="MetaImageIO")
        except RuntimeError as error:
            raise OutputError(f"SimpleITK cannot write a temporary file of {content.voxels.nbytes} bytes") from error
        if path.stat().st_size < content.voxels.nbytes:
            raise OutputError("SimpleITK could not write the whole volume: is the disk of temporary files full?")
        with path.open("rb") as written:
            shutil.copyfileobj(written, stream, 2**20)
