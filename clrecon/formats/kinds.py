"""The kind of a file, found from its first bytes; its name is not trusted."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

from clrecon.formats.grid_file import GridFile, Purpose
from clrecon.formats.metaimage import is_metaimage, open_metaimage
from clrecon.formats.nifti import is_nifti, open_nifti
from clrecon.formats.nrrd import is_nrrd, open_nrrd
from clrecon.system.paths import open_regular

_START_BYTES = 512


def tell_kind(path: Path) -> str | None:
    """Return the kind of a file: "DICOM", "NIfTI", "NRRD", "MetaImage", or None."""
    with open_regular(path) as file:
        start = file.read(_START_BYTES)
    if start[128:132] == b"DICM":  # the 128 bytes before it may look like any format
        return "DICOM"
    if is_nifti(_inflate(start)):
        return "NIfTI"
    if is_nrrd(start):
        return "NRRD"
    return "MetaImage" if is_metaimage(start) else None


def _inflate(start: bytes) -> bytes:
    """Return the first bytes, inflated if they are gzip."""
    if start[:2] != b"\x1f\x8b":
        return start
    try:
        return zlib.decompressobj(wbits=31).decompress(start, 64)
    except zlib.error:
        return b""


def name_of_grid(path: Path) -> str:
    """Return the name of a grid file without its file extension, with which structures are named."""
    return re.sub(r"(\.seg)?\.(nii|hdr|nrrd|nhdr|mha|mhd)(\.gz)?$", "", path.name, flags=re.IGNORECASE) or path.name


def open_grid(path: Path, kind: str, purpose: Purpose) -> GridFile:
    """Read the header of a file of one of the `kind` "NIfTI", "NRRD" and "MetaImage"."""
    opener = {"NIfTI": open_nifti, "NRRD": open_nrrd, "MetaImage": open_metaimage}[kind]
    return opener(path, purpose)
