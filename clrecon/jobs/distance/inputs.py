"""The two meshes of a job of distances: their files, and whether they can lie in one frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.mesh import Mesh
from clrecon.mesh.reader import read_mesh
from clrecon.system.text import escape_text, format_digits

_OTHER_UNIT = 100.0
"""Ratio of the sizes of two meshes from which on their units are doubted; metres and millimetres differ by 1000."""


def read_side(path: str | Path, space: str | None) -> Mesh:
    """Read a mesh; `space` is the frame of its coordinates if the file does not name one."""
    mesh = read_mesh(path)
    if space is not None and mesh.report["file"]["space_from"] == "assumed":
        return read_mesh(path, space=space)
    return mesh


def describe_mesh(mesh: Mesh, path: str | Path) -> dict[str, Any]:
    """Return the report's entry of a mesh; the name of its file without folders."""
    quality = mesh.quality()
    file = mesh.report["file"]
    closed = quality.closed and quality.oriented
    return {
        "name": escape_text(Path(path).name),
        "kind": file["kind"],
        "space": file["space"],
        "space_from": file["space_from"],
        "vertices": mesh.vertex_count,
        "triangles": mesh.triangle_count,
        "closed": closed,
        "area_mm2": quality.area_mm2,
        "volume_ml": abs(quality.volume_ml) if closed else None,
        "bounds_mm": quality.bounds_mm,
    }


def doubt_frames(meshes: Sequence[Mesh], entries: Sequence[dict[str, Any]]) -> list[str]:
    """Return what speaks against both meshes lying in one frame and unit."""
    doubts = []
    hashes = [_frame_of_reference(mesh) for mesh in meshes]
    a, b = (entry["name"] for entry in entries)
    if None not in hashes and hashes[0] != hashes[1]:
        doubts.append(
            f"{a} and {b} are from different frames of reference ({hashes[0]}, {hashes[1]}, hashes): nothing vouches"
            " that they lie together"
        )
    boxes = [np.array(entry["bounds_mm"]) for entry in entries if entry["bounds_mm"]]
    if len(boxes) < 2:
        return doubts
    sizes = [float(np.linalg.norm(box[1] - box[0])) for box in boxes]
    if min(sizes) > 0.0 and max(sizes) / min(sizes) >= _OTHER_UNIT:
        doubts.append(
            f"{a} is {format_digits(sizes[0], 4)} mm across and {b} {format_digits(sizes[1], 4)} mm: is"
            f" one of them in another unit?"
        )
    gap = float(np.linalg.norm(np.maximum(0.0, np.maximum(boxes[0][0] - boxes[1][1], boxes[1][0] - boxes[0][1]))))
    if gap > 0.0:
        sources = {entry["space_from"] for entry in entries}
        hint = ": is the frame of the file that names none another?" if "assumed" in sources else ""
        doubts.append(f"the boxes round {a} and {b} lie {format_digits(gap, 4)} mm apart{hint}")
    return doubts


def _frame_of_reference(mesh: Mesh) -> str | None:
    lines = mesh.report.get("certificate_lines") or ()
    return next((line.split()[1] for line in lines if line.startswith("frame_of_reference ")), None)
