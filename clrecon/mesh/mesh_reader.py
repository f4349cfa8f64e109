"""`read_mesh`: a mesh from a file, our own or that of another program."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import RefusedInputError, UsageError
from clrecon.exchange.formats import FORMATS, MESH_INPUTS
from clrecon.exchange.raw_content import RawMesh, frame_of_file, turn_to_lps
from clrecon.geometry import frame_from_lps
from clrecon.mesh.mesh import Mesh
from clrecon.system.arguments import Space, explains_arguments
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.text import escape_text

log = get_logger(__name__)


@explains_arguments
def read_mesh(path: str | os.PathLike[str], *, space: Space | None = None) -> Mesh:
    """Read a mesh from a file.

    Parameters
    ----------
    path : str or path
        By the extension: STL (binary or text; corners that coincide are joined), PLY, OBJ and VTP with triangles in
        mm; 3MF in its own unit, with the transforms and components of its build; GLB, by the matrices of its nodes:
        ours in the patient's frame, those of others from metres with Y up, where (L, P, S) = 1000 (X, -Z, Y) mm and
        corners that coincide are joined.
    space : {"lps", "ras"}, optional
        Patient frame of coordinates that do not name theirs; None: LPS, which the report then calls assumed.

    Returns
    -------
    Mesh
        In LPS mm.  Entries of ``report["file"]``: ``kind``, ``space``, ``space_from`` ("file", "argument" or
        "assumed"), ``unit`` (of the file), ``triangles``, ``parts`` (``name``, ``triangles`` and ``color`` of each
        object, whose triangles follow one another) and ``warnings``.  The name and the colour of a file's only object
        are the mesh's own: ``report["part_name"]``, ``report["color"]``.  Numbers at the vertices and triangles of PLY
        (``scalar_NAME``) and VTP files are ``values[NAME]`` and ``face_values[NAME]``; so are those at the vertices of
        our GLB files, NaN for -1.

    Raises
    ------
    UsageError
        There is no such file, the extension or ``space`` is unknown, or the file names another frame.
    RefusedInputError
        The file cannot be read, is cut or corrupt, or has numbers that a mesh cannot have.
    """
    if space is not None:
        frame_from_lps(space)
    file = Path(path)
    name = escape_text(file.name)
    extension = file.suffix.lower()
    if extension not in MESH_INPUTS:
        raise UsageError(f"{name}: meshes are read from files {', '.join(MESH_INPUTS)}")
    if not os.path.lexists(file):
        raise UsageError(f"there is no mesh {escape_text(str(path), 200)}")
    raw: RawMesh = FORMATS[extension].code.read_mesh(file)
    frame, source = frame_of_file(raw, space, name)
    if raw.vertices.dtype.kind not in "fiu":
        raise RefusedInputError(f"{name} is corrupt: its vertices are no numbers")
    vertices, normals = turn_to_lps(frame, raw.vertices, raw.normals)
    if source == "assumed":
        raw.warnings.append(f"{name} names no patient frame: its coordinates are taken as LPS")
    report = _report_of_file(raw, frame, source)
    try:
        mesh = Mesh(vertices, raw.triangles, normals, report)
    except UsageError as error:
        raise RefusedInputError(f"{name} is corrupt: {error}") from error
    mesh.values, mesh.face_values = dict(raw.values), dict(raw.face_values)
    log.info("%s file read: %d triangles", raw.kind, mesh.triangle_count)
    log_warnings(log, raw.warnings)
    return mesh


def _report_of_file(raw: RawMesh, space: str, source: str) -> dict[str, Any]:
    """Return the report of a mesh: what the file says of it, and where its frame is known from."""
    facts: dict[str, Any] = {
        "kind": raw.kind,
        "space": space,
        "space_from": source,
        "unit": raw.unit,
        "triangles": len(raw.triangles),
        "parts": [
            {"name": escape_text(part.name) or None, "triangles": part.triangles, "color": part.color}
            for part in raw.parts
        ],
        "warnings": raw.warnings,
    }
    report: dict[str, Any] = {"file": facts}
    if len(raw.parts) == 1:
        part_facts = {"part_name": facts["parts"][0]["name"], "color": facts["parts"][0]["color"]}
        report |= {name: value for name, value in part_facts.items() if value is not None}
    if raw.iso_value_hu is not None and np.isfinite(raw.iso_value_hu):
        report["iso_value_hu"] = raw.iso_value_hu
    if raw.certificate:
        report["certificate_lines"] = list(raw.certificate)
    return report
