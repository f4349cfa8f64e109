"""LAS 1.4, the format of surveyors, by laspy, which is the extra ``las`` of this program.

Coordinates are whole numbers of 1e-4 mm from an offset near the cloud; HU, label and normals are extra dimensions.
Frame, unit, iso value and certificate stand in a record of the user ``clrecon``.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from clrecon.errors import OutputError, RefusedInputError, UsageError
from clrecon.exchange.content import PointContent, check_same, refuse_file
from clrecon.exchange.raw_content import RawCloud, read_remarks, say_cut
from clrecon.system.packages import install_command
from clrecon.system.text import escape_text

_SCALE_MM = 1e-4
"""Step of the coordinates: they are rounded by 5e-5 mm at most."""
_USER = "clrecon"
_HEAD_BYTES = 375
_POINT_BYTES = 30
_DATE = slice(90, 94)
"""Bytes of the day and year of creation; laspy writes those of today."""
_MOST_STEPS = 2**31 - 1
_LONGEST_RECORD = 65535


def import_laspy() -> Any:
    try:
        import laspy
    except ImportError as error:
        raise UsageError(
            f"LAS files need the package laspy: {install_command('laspy')}; PLY, VTP, NPZ and XYZ need none"
        ) from error
    return laspy


def _extra(content: PointContent) -> dict[str, tuple[str, Any]]:
    columns: dict[str, tuple[str, Any]] = {}
    if content.hu is not None:
        columns["HU"] = ("float32", content.hu)
    if content.labels is not None:
        columns["label"] = ("int32", content.labels)
    if content.normals is not None:
        columns |= {name: ("float32", content.normals[:, axis]) for axis, name in enumerate(("nx", "ny", "nz"))}
    return columns


def estimate(content: PointContent) -> int:
    """Return the size of the file in bytes, without its variable records."""
    return _HEAD_BYTES + (_POINT_BYTES + 4 * len(_extra(content))) * len(content.vertices)


def write(stream: BinaryIO, content: PointContent) -> None:
    """Write the points; the file has no date and no name of a computer."""
    laspy = import_laspy()
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.generating_software, header.system_identifier = "clrecon", ""
    low, high = (end.astype(np.float64) for end in (content.vertices.min(axis=0), content.vertices.max(axis=0)))
    if (high - low).max() / _SCALE_MM / 2 > _MOST_STEPS:
        raise OutputError(
            f"the cloud is {(high - low).max():.6g} mm long, LAS in steps of {_SCALE_MM:g} mm holds"
            f" {2 * _MOST_STEPS * _SCALE_MM:.6g} mm: write PLY or VTP"
        )
    header.scales, header.offsets = np.full(3, _SCALE_MM), np.rint((low + high) / 2)
    extra = _extra(content)
    header.add_extra_dims([laspy.ExtraBytesParams(name, type=form) for name, (form, _) in extra.items()])
    text = "\n".join(content.remarks).encode("ascii")[:_LONGEST_RECORD]
    header.vlrs.append(laspy.VLR(_USER, 1, "frame, unit and certificate", text))
    las = laspy.LasData(header)
    las.x, las.y, las.z = content.vertices.astype(np.float64).T
    for name, (_, values) in extra.items():
        las[name] = values
    memory = io.BytesIO()  # laspy goes back to the head at the end
    las.write(memory)
    memory.getbuffer()[_DATE] = bytes(4)
    stream.write(memory.getbuffer())


def verify(path: Path, content: PointContent) -> None:
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    length = _POINT_BYTES + 4 * len(_extra(content))
    if len(head) < _HEAD_BYTES or head[:4] != b"LASF":
        raise refuse_file("in the header", repr(head[:4]), "LASF")
    start, stored, count = _sizes(head)
    check_same("bytes a point and points", (stored, count), (length, len(content.vertices)))
    check_same("bytes", path.stat().st_size, start + length * count)


def _sizes(head: bytes) -> tuple[int, int, int]:
    """Return the offset of the points, the bytes of a point, and their number (LAS 1.4, table 3)."""
    (start,) = struct.unpack_from("<I", head, 96)
    length, count = struct.unpack_from("<HI", head, 105)
    if head[25] >= 4:
        (count,) = struct.unpack_from("<Q", head, 247)
    return start, length, count


def _check_records(data: bytes, start: int) -> None:
    """Refuse numbers of variable records that have no room: laspy would count through them all."""
    (count,) = struct.unpack_from("<I", data, 100)
    after, extended = struct.unpack_from("<QI", data, 235) if data[25] >= 4 else (0, 0)
    if count * 54 > start or extended * 60 > max(len(data) - after, 0):
        raise ValueError(f"{count:,} and {extended:,} variable records have no room in it")


def read_cloud(path: Path) -> RawCloud:
    """Read the points of a file without compression, with its extra dimensions."""
    name = escape_text(path.name)
    laspy = import_laspy()
    try:
        with path.open("rb") as stream:
            data = stream.read()
        if len(data) < 227 or (data[25] >= 4 and len(data) < _HEAD_BYTES):
            raise RefusedInputError(f"{name} is cut: it has {len(data)} bytes, its head alone has more")
        start, length, count = _sizes(data)
        if data[104] & 0xC0:
            raise RefusedInputError(f"{name} is compressed (LAZ): unpack it, for example with laszip")
        if length < 20 or start + length * count > len(data):
            raise RefusedInputError(
                f"{name} is cut or corrupt: {count:,} points of {length} bytes cannot come from {len(data):,} bytes"
            )
        _check_records(data, start)
        las = laspy.read(io.BytesIO(data))
        with np.errstate(all="ignore"):  # harmed scales
            points = np.stack([np.asarray(las.x), np.asarray(las.y), np.asarray(las.z)], axis=1)
        columns = {
            own: np.asarray(las[own]) for own in map(str, las.point_format.extra_dimension_names) if las[own].ndim == 1
        }
        texts = [
            line
            for record in las.vlrs
            if record.user_id == _USER
            for line in bytes(record.record_data).decode("ascii", "replace").splitlines()
        ]
    except RefusedInputError:
        raise
    except Exception as error:  # laspy raises whatever numpy and struct raise on a harmed file
        raise say_cut(name, error) from error
    return RawCloud("LAS", points, columns, **read_remarks(texts))
