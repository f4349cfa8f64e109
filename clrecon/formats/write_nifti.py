"""NIfTI-1 (.nii, .nii.gz), with nibabel's header; the voxels go to the file slice by slice."""

from __future__ import annotations

import gzip
from collections.abc import Iterable
from typing import Any, BinaryIO

import numpy as np

from clrecon.formats.content import PACKING, VolumeContent
from clrecon.formats.extras import import_extra
from clrecon.formats.grid_file import VOLUME
from clrecon.geometry.nifti import place_in_header

COMMENT_CODE = 6
"""Code of the extension that holds plain text."""


def write_nifti(stream: BinaryIO, content: VolumeContent, *, packed: bool) -> None:
    """Write the file; the certificate is a header extension of plain text."""
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
