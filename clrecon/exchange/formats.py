"""Formats of meshes and clouds, chosen by the extension of a file to write, by the first bytes of a cloud to read.

A writer estimates the size of the file (exactly for STL, PLY and GLB, rather too small for the others), writes to a
binary stream, and reads the file back.  VTP is written by VTK.  The other formats are written here and not by a
library; each module says why: headers, comments and matrices that name frame and unit, a full disk that must be
noticed, time and memory.  The same mesh or cloud gives the same bytes.  No file holds patient data, a date or a path.

Nothing here loads numpy or the module of a format before a file is written or read: help texts name the extensions.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from clrecon.errors import NoSurfaceError, OutputError, RefusedInputError, UsageError
from clrecon.system.files import StagedFile, stage_file
from clrecon.system.light_dataclass import dataclass
from clrecon.system.paths import find_extension, open_regular
from clrecon.system.text import escape_text

if TYPE_CHECKING:
    from clrecon.exchange.content import Assembly, Content, PointContent, Writable
    from clrecon.exchange.raw_content import RawCloud

_FOUR_GIB = 2**32 - 1
NO_LIMIT = 2**62


@dataclass(frozen=True, kw_only=True)
class FileFormat:
    """A format of meshes, of clouds or of both, and the module of this package that writes and reads its files.

    The module, imported when it is needed, has `estimate` (bytes of a file, exact or rather too small), `write`,
    `verify` (reads the file back, and raises `OutputError` unless sizes and counts are those of the contents),
    `read_mesh` and `read_cloud`, and where a mesh can be written `in_pieces`, `write_pieces`.

    most_bytes: Largest file that the format, or common readers of it, can handle.
    triangle_bytes: At least so many bytes of it are those of each triangle.
    """

    module: str
    meshes: bool = False
    clouds: bool = False
    is_read: bool = True
    holds_many: bool = False
    in_pieces: bool = False
    most_bytes: int = NO_LIMIT
    triangle_bytes: int = 0

    @property
    def code(self) -> Any:
        return import_module(f"clrecon.exchange.{self.module}")


# STL: the format could hold more, but many programs keep offsets in 32 bits.  GLB: its length field has 32 bits.
_REGISTRY = {
    ".stl": FileFormat(module="stl", meshes=True, in_pieces=True, most_bytes=_FOUR_GIB, triangle_bytes=50),
    ".ply": FileFormat(module="ply", meshes=True, clouds=True, in_pieces=True),
    ".obj": FileFormat(module="obj", meshes=True, holds_many=True),
    ".glb": FileFormat(module="glb", meshes=True, holds_many=True, most_bytes=_FOUR_GIB, triangle_bytes=12),
    ".vtp": FileFormat(module="vtp", meshes=True, clouds=True, holds_many=True),
    ".3mf": FileFormat(module="threemf", meshes=True, holds_many=True),
    ".html": FileFormat(module="page", meshes=True, holds_many=True, is_read=False),
    ".npz": FileFormat(module="npz", clouds=True),
    ".xyz": FileFormat(module="xyz", clouds=True),
    ".las": FileFormat(module="las", clouds=True),
}
"""The formats by the extensions of their files, in the order in which messages and help name them."""

FORMATS = {extension: own for extension, own in _REGISTRY.items() if own.meshes}
CLOUD_FORMATS = {extension: own for extension, own in _REGISTRY.items() if own.clouds}
IN_PIECES = tuple(extension for extension, own in FORMATS.items() if own.in_pieces)
ASSEMBLIES = tuple(extension for extension, own in FORMATS.items() if own.holds_many)
MESH_INPUTS = tuple(extension for extension, own in FORMATS.items() if own.is_read)
CLOUD_INPUTS = (*CLOUD_FORMATS, ".csv", ".txt", ".asc")


def list_extensions(extensions: Sequence[str]) -> str:
    """Name extensions in a sentence: ``.a, .b or .c``."""
    return f"{', '.join(extensions[:-1])} or {extensions[-1]}"


def stage_content(
    content: PointContent | Assembly,
    path: str | os.PathLike[str],
    chosen: FileFormat,
    counted: str,
    others: str,
    pieces: Iterable[Content] | None = None,
) -> AbstractContextManager[StagedFile]:
    """Write contents under a temporary name (`stage_file`); `counted`, `others` are words in a message of its limit.

    With `pieces` these are written, and `content` has their counts alone.
    """
    code = chosen.code
    expected_bytes = code.estimate(content)
    _check_bytes(expected_bytes, path, chosen, counted, others)
    return stage_file(
        path,
        lambda stream: code.write(stream, content) if pieces is None else code.write_pieces(stream, content, pieces),
        lambda temporary: code.verify(temporary, content),
        expected_bytes=expected_bytes,
    )


def _check_bytes(
    expected_bytes: int, path: str | os.PathLike[str], chosen: FileFormat, counted: str, others: str
) -> None:
    if expected_bytes > chosen.most_bytes:
        kind = os.path.splitext(os.fspath(path))[1][1:].upper()
        raise OutputError(
            f"{counted} make a {kind} file of about {expected_bytes / 2**30:.1f} GiB, at most 4 GiB can be"
            f" read: write {others}"
        )


def check_triangles(count: int, path: str | os.PathLike[str]) -> None:
    """Refuse a mesh that is certainly too large for its format, before it is measured and written."""
    chosen = FORMATS[check_format(path)]
    _check_bytes(count * chosen.triangle_bytes, path, chosen, f"{count} triangles", "PLY or VTP")


MOST_PARTS = 20
"""Most components of a mesh that a page lists one by one; the smaller ones are one part together."""


def check_assembly(path: str | os.PathLike[str]) -> None:
    """Refuse a file whose format holds one object only."""
    extension = check_format(path)
    if extension not in ASSEMBLIES:
        raise UsageError(
            f"{extension} holds one mesh: several with their names in one file are {list_extensions(ASSEMBLIES)}"
        )


def stage_assembly(
    meshes: Sequence[Writable], path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False
) -> AbstractContextManager[StagedFile]:
    """Write several meshes as the objects of one file, as `stage_mesh` does one."""
    from clrecon.exchange.content import Assembly

    check_assembly(path)
    for mesh in meshes:
        mesh.check()
    extension = check_format(path)
    content = Assembly(
        tuple(_describe_content(mesh, extension, space, 1, keep_ids=keep_ids) for mesh in meshes if mesh.triangle_count)
    )
    if not content.parts:
        raise NoSurfaceError("the surfaces are empty: no file is written")
    count = sum(mesh.triangle_count for mesh in meshes)
    return stage_content(content, path, FORMATS[extension], f"{count} triangles", "fewer labels")


def stage_pieces(
    whole: Content, pieces: Iterable[Content], path: str | os.PathLike[str]
) -> AbstractContextManager[StagedFile]:
    """Write a mesh as `stage_mesh` does, a piece at a time, none of which is kept.

    whole: Facts and counts: its arrays have the shapes of all pieces together, and may take no memory.
    pieces: In the order of the file: their triangles refer to vertices of the whole, of their own piece and the next.
    """
    count = len(whole.triangles)
    return stage_content(whole, path, FORMATS[check_format(path)], f"{count} triangles", "PLY", pieces)


def check_in_pieces(path: str | os.PathLike[str]) -> None:
    """Refuse a file whose format needs the whole mesh before its first byte."""
    extension = check_format(path)
    if extension not in IN_PIECES:
        raise UsageError(
            f"{extension} needs the whole mesh in memory: in pieces are written {list_extensions(IN_PIECES)}"
        )


def check_format(path: str | os.PathLike[str]) -> str:
    """Return the extension of a mesh file in lower case, such as ``.stl``."""
    return find_extension(path, FORMATS, "mesh")


def describe_rounding(mesh: Writable, extension: str) -> list[str]:
    """Return the warning for a format that rounds the vertices more than the mesh does; no warning for the others."""
    if extension != ".stl" or mesh.vertices.dtype.name == "float32":
        return []
    from clrecon.geometry.vertices import float32_step

    step = float32_step(float(abs(mesh.vertices).max()))
    return [
        f"STL holds float32: so far from the origin its vertices are rounded to steps of {step:.2g} mm;"
        " PLY, VTP, OBJ, GLB and 3MF keep them"
    ]


def write_mesh(mesh: Writable, path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False) -> int:
    """Write a mesh to a file, as `Mesh.save` does; return its size in bytes."""
    with stage_mesh(mesh, path, space, keep_ids=keep_ids) as staged:
        staged.commit()
    return staged.size


def stage_mesh(
    mesh: Writable, path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False
) -> AbstractContextManager[StagedFile]:
    """Write a mesh under a temporary name, to be committed with other files; see `clrecon.system.files.stage_file`."""
    extension = check_format(path)
    chosen = FORMATS[extension]
    mesh.check()
    content = _describe_content(mesh, extension, space, MOST_PARTS, keep_ids=keep_ids)
    if mesh.triangle_count == 0:
        raise NoSurfaceError(f"the surface is empty: no {extension[1:].upper()} file is written")
    return stage_content(content, path, chosen, f"{mesh.triangle_count} triangles", "PLY or VTP")


def _describe_content(mesh: Writable, extension: str, space: str, parts: int, *, keep_ids: bool) -> Content:
    """Return the contents of a file, with normals and parts where its format shows them."""
    if extension == ".html":
        return mesh.describe_parts(space, parts, keep_ids=keep_ids)
    return mesh.describe(space, keep_ids=keep_ids)


_KEPT = {".xyz": ("hu",), ".npz": ("normals", "hu", "labels", "ijk")}
_KEPT_BY_OTHERS = ("normals", "hu", "labels")


class WritableCloud(Protocol):
    def __len__(self) -> int: ...
    def describe(self, space: str, *, keep_ids: bool = False, with_ijk: bool = True) -> PointContent: ...


def check_cloud_format(path: str | os.PathLike[str]) -> str:
    """Return the extension of a cloud file in lower case, such as ``.ply``."""
    extension = find_extension(path, CLOUD_FORMATS, "cloud")
    if extension == ".las":
        CLOUD_FORMATS[extension].code.import_laspy()
    return extension


def describe_cloud_losses(content: PointContent, extension: str) -> list[str]:
    """Return a line for what the cloud knows of its points and a file with this extension has no place for."""
    names = {"normals": "normals", "hu": "HU", "labels": "labels"}  # voxel indices are for the steps of this program
    lost = [
        word
        for name, word in names.items()
        if getattr(content, name) is not None and name not in _KEPT.get(extension, _KEPT_BY_OTHERS)
    ]
    lost += [name for name in content.values if extension in (".xyz", ".las")]
    if not lost:
        return []
    others = "PLY, VTP and NPZ" if content.values else "PLY, VTP, NPZ and LAS"
    return [f"{extension[1:].upper()} has no place for {' and '.join(lost)}: {others} have"]


def write_cloud(
    cloud: WritableCloud, path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False
) -> int:
    """Write a cloud to a file, as `PointCloud.save` does; return its size in bytes."""
    with stage_cloud(cloud, path, space, keep_ids=keep_ids) as staged:
        staged.commit()
    return staged.size


def stage_cloud(
    cloud: WritableCloud, path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False
) -> AbstractContextManager[StagedFile]:
    """Write a cloud under a temporary name, to be committed with other files; see `clrecon.system.files.stage_file`."""
    extension = check_cloud_format(path)
    has_place = "ijk" in _KEPT.get(extension, _KEPT_BY_OTHERS)
    content = cloud.describe(space, keep_ids=keep_ids, with_ijk=has_place)
    if len(cloud) == 0:
        raise NoSurfaceError(f"the cloud is empty: no {extension[1:].upper()} file is written")
    return stage_content(content, path, CLOUD_FORMATS[extension], f"{len(cloud):,} points", "PLY or VTP")


_START_BYTES = 512


def read_raw_cloud(path: str | os.PathLike[str]) -> RawCloud:
    """Read a cloud file: PLY, VTP, NPZ, LAS, or a table of numbers."""
    file = Path(path)
    name = escape_text(file.name)
    try:
        with open_regular(file) as stream:
            start = stream.read(_START_BYTES)
    except FileNotFoundError as error:
        raise UsageError(f"there is no cloud {escape_text(str(path), 200)}") from error
    except OSError as error:
        raise RefusedInputError(f"{name} cannot be read: {error.strerror or error}") from error
    extension = _tell_cloud(start)
    if extension is None:
        raise RefusedInputError(f"{name} is no cloud that is read: PLY, VTP, NPZ, LAS or a table of numbers (XYZ)")
    cloud: RawCloud = CLOUD_FORMATS[extension].code.read_cloud(file)
    return cloud


def _tell_cloud(start: bytes) -> str | None:
    """Return the extension that the first bytes of a file should have; None where it is no cloud."""
    if start[:3] == b"ply" and start[3:4] in (b"\n", b"\r", b" "):
        return ".ply"
    if start[:4] in (b"PK\3\4", b"PK\5\6"):
        return ".npz"
    if start[:4] == b"LASF":
        return ".las"
    if b"<VTKFile" in start:
        return ".vtp"
    return None if b"\0" in start or not start.strip() else ".xyz"
