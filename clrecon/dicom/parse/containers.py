"""File types other than DICOM, told from their first bytes, so that a message can say what to do."""

from __future__ import annotations

from collections.abc import Iterable

# First bytes of each type, the longest and surest first.
_STARTS = (
    (b"PK\x03\x04", "zip archive"),
    (b"PK\x05\x06", "zip archive"),
    (b"\x1f\x8b", "gzip file"),
    (b"BZh", "bzip2 file"),
    (b"\xfd7zXZ\0", "xz file"),
    (b"\x28\xb5\x2f\xfd", "zstd file"),
    (b"7z\xbc\xaf\x27\x1c", "7z archive"),
    (b"Rar!\x1a\x07", "rar archive"),
    (b"\x89PNG\r\n\x1a\n", "PNG image"),
    (b"\xff\xd8\xff", "JPEG image"),
    (b"\0\0\0\x0cjP  ", "JPEG 2000 image"),
    (b"\xff\x4f\xff\x51", "JPEG 2000 image"),
    (b"II*\0", "TIFF image"),
    (b"MM\0*", "TIFF image"),
    (b"%PDF-", "PDF document"),
    (b"NRRD0", "NRRD volume"),
    (b"ObjectType = Image", "MetaImage volume"),
    (b"\x5c\x01\0\0", "NIfTI volume"),
    (b"\0\0\x01\x5c", "NIfTI volume"),
    (b"\x1c\x02\0\0n+2", "NIfTI volume"),
    (b"glTF", "GLB mesh"),
    (b"ply\n", "PLY mesh or cloud"),
    (b"ply\r", "PLY mesh or cloud"),
    (b'<?xml version="1.0"?>\n<VTKFile', "VTK file"),
    (b"<VTKFile", "VTK file"),
    (b"\x93NUMPY", "NumPy array"),
    (b"\x7fELF", "program"),
    (b"MZ", "program"),
)
_THREEMF_ENTRIES = (b"3D/3dmodel.model", b"[Content_Types].xml")
"""Names of the first entry of a zip archive that is a 3MF file."""
_TAR_MARK = slice(257, 262), b"ustar"

_PACKED = frozenset(
    ("zip archive", "gzip file", "bzip2 file", "xz file", "zstd file", "7z archive", "rar archive", "tar archive")
)
_GRIDS = frozenset(("NRRD volume", "MetaImage volume", "NIfTI volume"))


def describe_container(start: bytes) -> str:
    """Name the type of a file by its first bytes (262 bytes suffice for all); empty if they are unknown."""
    if start.startswith(b"PK\x03\x04") and start[30:].startswith(_THREEMF_ENTRIES):
        return "3MF mesh"
    for mark, kind in _STARTS:
        if start.startswith(mark):
            return kind
    where, mark = _TAR_MARK
    return "tar archive" if start[where] == mark else ""


def is_text(start: bytes) -> bool:
    """True where the first bytes of a file are printable ASCII, or a mark of the order of bytes and such."""
    start = start.removeprefix(b"\xef\xbb\xbf")
    return bool(start) and all(32 <= byte < 127 or byte in b"\t\r\n" for byte in start)


def advise_on(kinds: Iterable[str]) -> str:
    """Return advice about files of these types; empty if there is none."""
    kinds = set(kinds)
    packed, grids = sorted(_PACKED & kinds), sorted(_GRIDS & kinds)
    advice = [f"unpack each {' and '.join(packed)} and name the folder"] if packed else []
    if grids or "gzip file" in kinds:
        what = " or ".join(grids) or "NIfTI volume (.nii.gz)"
        advice.append(f"a {what} is read when the file itself is named")
    if any("mesh" in kind for kind in kinds):
        advice.append("a mesh is shown with clrecon render and measured with clrecon distance")
    if "NumPy array" in kinds:
        advice.append("a NumPy array says no place in space: from Python make a volume of it, Volume(array, affine)")
    return "; ".join(advice)
