"""NPZ, numpy's archive, for programs that learn from clouds: `numpy.load` reads it without pickle.

| entry | shape, type |
|---|---|
| ``points`` | (n, 3) float32, or float64 far from the origin; mm in ``space`` |
| ``normals``, ``hu`` | (n, 3) and (n,) float32, where known |
| ``thickness_mm``, ``error_mm`` | (n,) float32, of points on the cortex |
| ``labels``, ``ijk`` | (n,) and (n, 3) int32, where known |
| ``space``, ``unit``, ``inside`` | texts |
| ``iso_value_hu`` | a number |
| ``affine`` | (4, 4) float64, index (i, j, k) of the volume to LPS mm, whatever ``space`` is |
| ``certificate`` | texts, one for each fact |

The entries are stored without compression, which coordinates would not repay.  Own code and not `numpy.savez`, which
would copy each array as a whole.
"""

from __future__ import annotations

import zipfile
import zlib
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.content import PointContent, check_same, refuse_file
from clrecon.exchange.raw_content import RawCloud, columns_of, say_cut
from clrecon.system.text import escape_text

_ENTRY_BYTES = 224
"""Least bytes of an entry beside its numbers: two headers of the ZIP, the header of the array."""
_DEFLATE_RATIO = 1032
"""Highest compression ratio of Deflate (zlib's technical note)."""
_SMALL = 2**20
"""Most bytes of an entry that is not a number for each point."""
_POINTS = ("points", "xyz", "pos", "arr_0")


def _arrays(content: PointContent) -> dict[str, NDArray[Any]]:
    known: dict[str, NDArray[Any] | None] = {
        "points": content.vertices,
        "normals": content.normals,
        "hu": content.hu,
        "labels": content.labels,
        "ijk": content.ijk,
        **content.values,
        "affine": content.affine,
        "iso_value_hu": None if content.iso_value_hu is None else np.array(content.iso_value_hu),
        "inside": None if content.inside is None else np.array(content.inside),
        "certificate": np.array(content.certificate) if content.certificate else None,
        "space": np.array(content.space),
        "unit": np.array("mm"),
    }
    return {name: values for name, values in known.items() if values is not None}


def estimate(content: PointContent) -> int:
    """Return the size of the file in bytes, rather too small."""
    return sum(array.nbytes + _ENTRY_BYTES for array in _arrays(content).values())


def write(stream: BinaryIO, content: PointContent) -> None:
    """Write the entries, dated 1980-01-01, the earliest date of a ZIP, which `ZipFile.open` sets."""
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, values in _arrays(content).items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, values, allow_pickle=False)


def verify(path: Path, content: PointContent) -> None:
    expected = _arrays(content)
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
            arrays = {Path(name).stem: _open_array(archive, name) for name in archive.namelist()}
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, OSError) as error:
        raise refuse_file("in the archive", escape_text(str(error)), "a whole archive") from error
    if broken is not None:
        raise refuse_file("in the archive", escape_text(broken), "whole entries")
    forms = {name: (values.shape, values.dtype) for name, values in expected.items()}
    check_same("in the archive", arrays, forms)


def _open_array(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type of an entry, from its header alone."""
    with archive.open(name) as entry:
        version = np.lib.format.read_magic(entry)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"an array of version {version} of its format")
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(entry)
    return shape, dtype


def read_cloud(path: Path) -> RawCloud:
    """Read points, the entry ``points``, ``xyz``, ``pos`` or ``arr_0``, and the others as this module writes them."""
    name = escape_text(path.name)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            points = next((entry for entry in _POINTS if entry in entries), None)
            if points is None:
                raise RefusedInputError(
                    f"{name} is an archive without points: an entry {', '.join(_POINTS)} of shape (n, 3) is needed"
                )
            arrays = {"points": _read_array(archive, entries[points])}
            known = ("normals", "hu", "labels", "ijk", "space", "affine", "iso_value_hu", "certificate")
            for entry in [*(name for name in known if name in entries), *(n for n in entries if n.endswith("_mm"))]:
                arrays[entry] = _read_array(archive, entries[entry])
    except (
        zipfile.BadZipFile, zlib.error, ValueError, EOFError, OSError, NotImplementedError, RuntimeError, MemoryError,
    ) as error:  # fmt: skip
        raise say_cut(name, error) from error
    return _describe_cloud(name, arrays)


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    shape, dtype = _open_array(archive, info.filename)
    promised = prod(shape) * dtype.itemsize
    if dtype.hasobject or promised > info.file_size or info.file_size > _DEFLATE_RATIO * max(info.compress_size, 1):
        raise ValueError(f"the entry {escape_text(info.filename)} is no array of its size")
    with archive.open(info) as entry:
        return np.asarray(np.lib.format.read_array(entry, allow_pickle=False))


def _describe_cloud(name: str, arrays: dict[str, NDArray[Any]]) -> RawCloud:
    points = arrays["points"]
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise RefusedInputError(f"{name} has points of shape {points.shape} and type {points.dtype}: (n, 3) is needed")
    n = len(points)
    columns: dict[str, NDArray[Any]] = {}
    warnings = []
    for entry, shape, names in (
        ("normals", "(n, 3)", ("nx", "ny", "nz")),
        ("ijk", "(n, 3)", ("i", "j", "k")),
        ("hu", "(n,)", ("hu",)),
        ("labels", "(n,)", ("labels",)),
        *((entry, "(n,)", (entry,)) for entry in arrays if entry.endswith("_mm")),
    ):
        values = arrays.get(entry)
        if values is None:
            continue
        if values.shape == ((n,) if len(names) == 1 else (n, 3)) and values.dtype.kind in "fiu":
            columns |= columns_of(values.reshape(n, len(names)), names)
        else:
            warnings.append(f"{entry} of shape {values.shape} and type {values.dtype} are left out: {shape} is needed")
    space, affine = arrays.get("space"), arrays.get("affine")
    iso_value = arrays.get("iso_value_hu")
    certificate = arrays.get("certificate")
    is_text = certificate is not None and certificate.dtype.kind == "U" and certificate.nbytes <= _SMALL
    return RawCloud(
        "NPZ",
        points,
        columns,
        space=str(space) if space is not None and space.dtype.kind == "U" and space.ndim == 0 else None,
        affine=affine if affine is not None and affine.shape == (4, 4) and affine.dtype.kind in "fiu" else None,
        iso_value_hu=float(iso_value) if iso_value is not None and iso_value.shape == () else None,
        certificate=tuple(certificate.ravel().tolist()) if is_text and certificate is not None else (),
        warnings=warnings,
    )
