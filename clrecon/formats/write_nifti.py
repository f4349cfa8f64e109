"""NIfTI-1 (.nii, .nii.gz), with nibabel's header; the voxels go to the file slice by slice."""

from __future__ import annotations

import gzip
from collections.abc import Iterable
from typing import Any, BinaryIO

import numpy as np

from clrecon.formats.content import PACKING, VolumeContent
from clrecon.formats.extras import import_extra
from clrecon.formats.grid_file import VOLUME
from clrecon.geometry.affine import Float64Array, column_spacing
from clrecon.geometry.frames import lps_affine_from_ras

__all__ = ["place_in_header", "write_nifti"]

MM = 2
SCANNER = 1
"""Codes of NIfTI: lengths in mm, positions as the scanner gave them."""

COMMENT_CODE = 6
"""Code of the extension that holds plain text."""


def place_in_header(header: Any, affine: Float64Array) -> None:
    """Write the place of the voxels into a header of nibabel.

    Parameters
    ----------
    header : nibabel.Nifti1Header
    affine : ndarray, shape (4, 4)
        Index (i, j, k) to LPS mm.
    """
    ras = lps_affine_from_ras(affine)
    header.set_xyzt_units(MM)
    header.set_sform(ras, SCANNER)
    if _is_rigid(ras):
        header.set_qform(ras, SCANNER)  # cannot hold a shear
    else:
        header["pixdim"][1:4] = column_spacing(affine)


def _is_rigid(affine: Float64Array) -> bool:
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    return bool(np.abs(axes.T @ axes - np.eye(3)).max() < 1e-6)


def write_nifti(stream: BinaryIO, content: VolumeContent, *, packed: bool) -> None:
    """Write the file; the certificate is a header extension of plain text.

    Raises
    ------
    UsageError
        nibabel is not installed.
    """
    if not packed:
        _write_parts(stream, content)
        return
    with gzip.GzipFile(filename="", mode="wb", compresslevel=PACKING, fileobj=stream, mtime=0) as packing:
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
    extension = nibabel.nifti1.Nifti1Extension(COMMENT_CODE, text)
    header.extensions.append(extension)
    header["vox_offset"] = header.single_vox_offset + header.extensions.get_sizeondisk()
    header.write_to(stream)
    _write_slices(stream, (np.asarray(layer, dtype) for layer in content.voxels), content)


def _write_slices(stream: Any, layers: Iterable[np.ndarray], content: VolumeContent) -> None:
    count = len(content.voxels)
    for k, layer in enumerate(layers):
        stream.write(layer.tobytes())
        content.progress("write", k + 1, count)
