"""CT volumes in every format that is read, written by nibabel, pynrrd and zarr, and MetaImage by hand."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from label_files import OBLIQUE, write_nifti, write_nrrd

ROTATED = OBLIQUE.copy()
ROTATED[:3, :3] = np.linalg.qr(OBLIQUE[:3, :3])[0] @ np.diag((0.7, 0.5, 2.5))
"""ijk to LPS mm: unequal steps at right angles, oblique."""

LEFT_HANDED = OBLIQUE @ np.diag((1.0, -1.0, 1.0, 1.0))

META_TYPES = {"i1": "CHAR", "u1": "UCHAR", "i2": "SHORT", "u2": "USHORT", "i4": "INT", "u4": "UINT",
              "i8": "LONG_LONG", "u8": "ULONG_LONG", "f4": "FLOAT", "f8": "DOUBLE"}  # fmt: skip


def make_ct(shape: Sequence[int] = (4, 6, 7), *, seed: int = 0, low: int = -1024, high: int = 3000) -> np.ndarray:
    """voxels[k, j, i], int16 HU."""
    return np.random.default_rng(seed).integers(low, high, shape).astype(np.int16)


def metaimage_fields(voxels: np.ndarray, affine: np.ndarray = OBLIQUE, **fields: str | None) -> dict[str, str]:
    """The header of voxels[k, j, i] with an LPS affine; a field that is None is left out."""

    def row(values: np.ndarray) -> str:
        return " ".join(repr(float(value)) for value in values)

    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    header: dict[str, str | None] = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": str(voxels.dtype.str[0] == ">"),
        "CompressedData": "False",
        "TransformMatrix": row((affine[:3, :3] / spacing).T.ravel()),
        "Offset": row(affine[:3, 3]),
        "CenterOfRotation": "0 0 0",
        "AnatomicalOrientation": "RAI",
        "ElementSpacing": row(spacing),
        "DimSize": " ".join(map(str, voxels.shape[::-1])),
        "ElementType": f"MET_{META_TYPES[voxels.dtype.str[1:]]}",
        "ElementDataFile": "LOCAL",
        **fields,
    }
    last = "ElementDataFile"
    order = [*(key for key in header if key != last), last]
    return {key: value for key in order if (value := header[key]) is not None}


def write_metaimage(
    path: Path, voxels: np.ndarray, affine: np.ndarray = OBLIQUE, *, packed: bool = False, **fields: str | None
) -> Path:
    """Write a MetaImage; voxels go into a file beside it where its name ends with .mhd."""
    data = np.ascontiguousarray(voxels).tobytes()
    data = zlib.compress(data) if packed else data
    beside = path.with_suffix(".zraw" if packed else ".raw") if path.suffix == ".mhd" else None
    own = {"CompressedData": str(packed), "ElementDataFile": beside.name if beside else "LOCAL"}
    if packed:
        own["CompressedDataSize"] = str(len(data))
    header = metaimage_fields(voxels, affine, **{**own, **fields})
    text = "".join(f"{key} = {value}\n" for key, value in header.items()).encode("latin-1")
    path.write_bytes(text if beside else text + data)
    if beside:
        beside.write_bytes(data)
    return path


WRITERS: dict[str, Callable[..., Path]] = {
    "a.nii": write_nifti,
    "a.nii.gz": write_nifti,
    "two.nii": lambda *args: write_nifti(*args, kind="Nifti2Image"),
    "a.hdr": lambda *args: write_nifti(*args, kind="Nifti1Pair"),
    "raw.nrrd": lambda *args: write_nrrd(*args, encoding="raw"),
    "gzip.nrrd": lambda *args: write_nrrd(*args, encoding="gzip", space="right-anterior-superior"),
    "raw.nhdr": lambda *args: write_nrrd(*args, encoding="raw"),
    "gzip.nhdr": lambda *args: write_nrrd(*args, encoding="gzip", space="left-anterior-superior"),
    "a.mha": write_metaimage,
    "packed.mha": lambda *args: write_metaimage(*args, packed=True),
    "a.mhd": write_metaimage,
    "packed.mhd": lambda *args: write_metaimage(*args, packed=True),
}
"""A name of each kind of file to the function that writes it: ``write(path, voxels, affine)``."""


PATIENT = {"x": "right-to-left", "y": "anterior-to-posterior", "z": "inferior-to-superior"}
"""Orientation (RFC-4 of OME-Zarr) of axes in LPS."""


def make_axes(names: str = "zyx", *, unit: str | None = "millimeter", orientation: bool = True) -> list[dict[str, Any]]:
    """The axes of OME-Zarr metadata, one letter each; x, y and z are of space."""
    axes = []
    for name in names:
        axis: dict[str, Any] = {"name": name, "type": {"t": "time", "c": "channel"}.get(name, "space")}
        if name in PATIENT and unit is not None:
            axis["unit"] = unit
        if name in PATIENT and orientation:
            axis["orientation"] = {"type": "anatomical", "value": PATIENT[name]}
        axes.append(axis)
    return axes


def write_ome_zarr(
    path: Path,
    voxels: np.ndarray,
    *,
    axes: list[dict[str, Any]] | None = None,
    place: Sequence[dict[str, Any]] = ({"type": "scale", "scale": [2.5, 0.75, 0.5]},),
    version: int = 3,
    **storage: Any,
) -> Path:
    """Write an array as OME-Zarr 0.5, or 0.4 for Zarr 2; `place` are its coordinate transformations."""
    import zarr

    image = {"axes": axes or make_axes(), "datasets": [{"path": "0", "coordinateTransformations": list(place)}]}
    old, new = {"multiscales": [{**image, "version": "0.4"}]}, {"ome": {"version": "0.5", "multiscales": [image]}}
    group = zarr.create_group(str(path), zarr_format=version, attributes=old if version == 2 else new)
    chunks = tuple(min(4, count) for count in voxels.shape)
    own: Any = {"shape": voxels.shape, "dtype": voxels.dtype, "chunks": chunks} | storage
    group.create_array("0", **own)[...] = voxels
    return path
