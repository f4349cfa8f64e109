"""Mesh files: one module for each format, chosen by the extension of the file.

A writer estimates the size of the file, writes to a binary stream, and reads the file back.  VTP is written by VTK. The
other formats are written here and not by a library; each module says why: headers, comments and matrices that name
frame and unit, a full disk that must be noticed, time and memory.

The same mesh gives the same bytes every time.  No file holds patient data, a date or a path.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from clrecon.errors import NoSurfaceError, OutputError, UsageError
from clrecon.exchange import (
    glb,
    obj,
    ply,
    stl,
    threemf,
    vtp,
)
from clrecon.exchange.content import Content, Writable
from clrecon.geometry.precision import float32_step
from clrecon.system.files import StagedFile, stage_file

__all__ = ["FORMATS", "MeshFormat", "check_format", "describe_rounding", "stage_mesh", "write_mesh"]


@dataclass(frozen=True)
class MeshFormat:
    """A file format of meshes.

    Attributes
    ----------
    estimate : callable
        Estimates the size of the file in bytes; exact for STL, PLY and GLB, rather too small for the others.
    write : callable
        Writes the contents to a stream.
    verify : callable
        Reads the file back and raises `OutputError` unless sizes and counts are those of the contents.
    most_bytes : int
        Largest file that the format, or common readers of it, can handle.
    """

    estimate: Callable[[Content], int]
    write: Callable[[BinaryIO, Content], None]
    verify: Callable[[Path, Content], None]
    most_bytes: int


# STL: the format could hold more, but many programs keep offsets in 32 bits.  GLB: its length field has 32 bits.
_FOUR_GIB = 2**32 - 1
_NO_LIMIT = 2**62

FORMATS = {
    ".stl": MeshFormat(stl.estimate, stl.write, stl.verify, _FOUR_GIB),
    ".ply": MeshFormat(ply.estimate, ply.write, ply.verify, _NO_LIMIT),
    ".obj": MeshFormat(obj.estimate, obj.write, obj.verify, _NO_LIMIT),
    ".glb": MeshFormat(glb.estimate, glb.write, glb.verify, _FOUR_GIB),
    ".vtp": MeshFormat(vtp.estimate, vtp.write, vtp.verify, _NO_LIMIT),
    ".3mf": MeshFormat(threemf.estimate, threemf.write, threemf.verify, _NO_LIMIT),
}


def check_format(path: str | os.PathLike[str]) -> str:
    """Return the extension of a mesh file in lower case, such as ``.stl``.

    Raises
    ------
    UsageError
        The extension is missing, or no writer has it.
    """
    try:
        extension = os.path.splitext(os.fspath(path))[1].lower()
    except TypeError as error:
        raise UsageError(f"a mesh file is named by a string or a path, not {type(path).__name__}") from error
    if extension not in FORMATS:
        found = f"the extension {extension!r}" if extension else "no extension"
        raise UsageError(f"the name of the mesh file has {found}: use one of {', '.join(FORMATS)}")
    return extension


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

    Returns
    -------
    int
        Size of the file in bytes.
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
    content = mesh.describe(space, keep_ids=keep_ids)
    if mesh.triangle_count == 0:
        raise NoSurfaceError(f"the surface is empty: no {extension[1:].upper()} file is written")
    expected_bytes = chosen.estimate(content)
    if expected_bytes > chosen.most_bytes:
        raise OutputError(
            f"{mesh.triangle_count} triangles make a {extension[1:].upper()} file of about "
            f"{expected_bytes / 2**30:.1f} GiB, at most 4 GiB can be read: write PLY or VTP"
        )
    return stage_file(
        path,
        lambda stream: chosen.write(stream, content),
        lambda temporary: chosen.verify(temporary, content),
        expected_bytes=expected_bytes,
    )
