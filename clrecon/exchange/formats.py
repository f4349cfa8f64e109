"""Mesh files: one module for each format, chosen by the extension of the file.

A writer estimates the size of the file (exactly for STL, PLY and GLB, rather too small for the others), writes to a
binary stream, and reads the file back.  VTP is written by VTK.  The other formats are written here and not by a
library; each module says why: headers, comments and matrices that name frame and unit, a full disk that must be
noticed, time and memory.

The same mesh gives the same bytes every time.  No file holds patient data, a date or a path.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import AbstractContextManager

import numpy as np

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange import glb, obj, page, ply, stl, threemf, vtp
from clrecon.exchange.content import Assembly, Content, Writable
from clrecon.exchange.file_format import FOUR_GIB, NO_LIMIT, FileFormat, find_extension, stage_content
from clrecon.geometry.vertices import float32_step
from clrecon.system.files import StagedFile

# STL: the format could hold more, but many programs keep offsets in 32 bits.  GLB: its length field has 32 bits.
FORMATS: dict[str, FileFormat[Content]] = {
    ".stl": FileFormat(stl.estimate, stl.write, stl.verify, FOUR_GIB),
    ".ply": FileFormat(ply.estimate, ply.write, ply.verify, NO_LIMIT),
    ".obj": FileFormat(obj.estimate, obj.write, obj.verify, NO_LIMIT),
    ".glb": FileFormat(glb.estimate, glb.write, glb.verify, FOUR_GIB),
    ".vtp": FileFormat(vtp.estimate, vtp.write, vtp.verify, NO_LIMIT),
    ".3mf": FileFormat(threemf.estimate, threemf.write, threemf.verify, NO_LIMIT),
    ".html": FileFormat(page.estimate, page.write, page.verify, NO_LIMIT),
}


ASSEMBLIES: dict[str, FileFormat[Assembly]] = {
    ".glb": FileFormat(glb.estimate, glb.write, glb.verify, FOUR_GIB),
    ".3mf": FileFormat(threemf.estimate, threemf.write, threemf.verify, NO_LIMIT),
    ".obj": FileFormat(obj.estimate, obj.write, obj.verify, NO_LIMIT),
    ".vtp": FileFormat(vtp.estimate, vtp.write, vtp.verify, NO_LIMIT),
    ".html": FileFormat(page.estimate, page.write, page.verify, NO_LIMIT),
}
"""Formats that hold several named objects in a file."""


MOST_PARTS = 20
"""Most components of a mesh that a page lists one by one; the smaller ones are one part together."""


def check_assembly(path: str | os.PathLike[str]) -> None:
    """Refuse a file whose format holds one object only."""
    extension = check_format(path)
    if extension not in ASSEMBLIES:
        raise UsageError(
            f"{extension} holds one mesh: several with their names in one file are .3mf, .glb, .obj, .vtp or .html"
        )


def stage_assembly(
    meshes: Sequence[Writable], path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False
) -> AbstractContextManager[StagedFile]:
    """Write several meshes as the objects of one file, as `stage_mesh` does one."""
    check_assembly(path)
    for mesh in meshes:
        mesh.check()
    extension = check_format(path)
    content = Assembly(
        tuple(_describe(mesh, extension, space, 1, keep_ids=keep_ids) for mesh in meshes if mesh.triangle_count)
    )
    if not content.parts:
        raise NoSurfaceError("the surfaces are empty: no file is written")
    count = sum(mesh.triangle_count for mesh in meshes)
    return stage_content(content, path, ASSEMBLIES[extension], f"{count} triangles", "fewer labels")


def check_format(path: str | os.PathLike[str]) -> str:
    """Return the extension of a mesh file in lower case, such as ``.stl``."""
    return find_extension(path, FORMATS, "mesh")


def describe_rounding(mesh: Writable, extension: str) -> list[str]:
    """Return the warning for a format that rounds the vertices more than the mesh does; no warning for the others."""
    if extension != ".stl" or mesh.vertices.dtype == np.float32:
        return []
    step = float32_step(float(np.abs(mesh.vertices).max()))
    return [
        f"STL holds float32: so far from the origin its vertices are rounded to steps of {step:.2g} mm;"
        " PLY, VTP, OBJ, GLB and 3MF keep them"
    ]


def write_mesh(mesh: Writable, path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False) -> int:
    """Write a mesh to a file; what `Mesh.save` does.

    Returns: Size of the file in bytes.
    """
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
    content = _describe(mesh, extension, space, MOST_PARTS, keep_ids=keep_ids)
    if mesh.triangle_count == 0:
        raise NoSurfaceError(f"the surface is empty: no {extension[1:].upper()} file is written")
    return stage_content(content, path, chosen, f"{mesh.triangle_count} triangles", "PLY or VTP")


def _describe(mesh: Writable, extension: str, space: str, parts: int, *, keep_ids: bool) -> Content:
    """Return the contents of a file, with normals and parts where its format shows them."""
    if extension == ".html":
        return mesh.describe_parts(space, parts, keep_ids=keep_ids)
    return mesh.describe(space, keep_ids=keep_ids)
