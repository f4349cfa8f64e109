"""`BaseMesh`: the arrays of an indexed triangle surface in LPS mm, checked, moved and written."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.exchange.content import Content, checked_columns, facts_for_file
from clrecon.exchange.coordinates import as_stored, rows_of_three
from clrecon.exchange.formats import write_mesh
from clrecon.exchange.raw_content import turn_to_lps
from clrecon.geometry.affine import apply_affine, checked_affine, column_spacing, normal_matrix
from clrecon.mesh.quality import find_pieces
from clrecon.mesh.triangles import vertex_normals
from clrecon.system.arguments import Space, explains_arguments
from clrecon.system.base_classes import Message
from clrecon.system.paths import keep_existing
from clrecon.system.text import escape_text

_MOST_VERTICES = 2**32

Own = TypeVar("Own", bound="BaseMesh")


def _as_indices(values: ArrayLike) -> NDArray[np.uint32]:
    array = rows_of_three(values, "triangles", kinds="iu", words="hold indices of vertices (integers)")
    # Only other types can hold values that uint32 cannot; arrays from a device are uint32 and need no check.
    if array.size and array.dtype != np.uint32:
        low, high = int(array.min()), int(array.max())
        if low < 0 or high >= _MOST_VERTICES:
            raise UsageError(f"triangles hold indices from {low} to {high}: they must fit 32 bits without a sign")
    return np.ascontiguousarray(array, dtype=np.uint32)


class BaseMesh(Message):
    """An indexed triangle surface; `clrecon.mesh.mesh.Mesh` says what its arguments are."""

    def __init__(
        self,
        vertices: ArrayLike,
        triangles: ArrayLike,
        normals: ArrayLike | None = None,
        report: dict[str, Any] | None = None,
        *,
        trusted: bool = False,
    ):
        self._vertices = as_stored(rows_of_three(vertices, "vertices"))
        self._triangles = _as_indices(triangles)
        self._normals = (
            None if normals is None else np.ascontiguousarray(rows_of_three(normals, "normals"), dtype=np.float32)
        )
        if len(self._vertices) > _MOST_VERTICES:
            raise UsageError(f"a mesh has at most {_MOST_VERTICES} vertices, this one has {len(self._vertices)}")
        if self._normals is not None and len(self._normals) != len(self._vertices):
            raise UsageError(f"{len(self._normals)} normals for {len(self._vertices)} vertices: one a vertex is needed")
        self.report: dict[str, Any] = {} if report is None else report
        self.values: dict[str, NDArray[np.floating]] = {}
        """Numbers at the vertices by name, (n,) each, such as ``thickness_mm``, or ``HU`` of `Volume.sample`; written
        to the formats that hold some."""
        self.face_values: dict[str, NDArray[np.floating]] = {}
        """Numbers at the triangles by name, (m,) each; written to PLY and VTP."""
        if not trusted:
            self.check()

    @property
    def vertices(self) -> NDArray[np.floating]:
        """Positions in LPS mm, shape (n, 3), float32; float64 where they lie far from the origin."""
        return self._vertices

    @property
    def triangles(self) -> NDArray[np.uint32]:
        """Indices of vertices, shape (m, 3), counter-clockwise when seen from outside."""
        return self._triangles

    @property
    def normals(self) -> NDArray[np.float32] | None:
        """Outward unit vectors at the vertices, shape (n, 3), or None."""
        return self._normals

    @property
    def vertex_count(self) -> int:
        """Number of vertices, n."""
        return len(self._vertices)

    @property
    def triangle_count(self) -> int:
        """Number of triangles, m."""
        return len(self._triangles)

    @property
    def voxel_mm(self) -> float | None:
        """Shortest voxel step of the scan that the mesh comes from, mm, the measure of bounds; None where unknown."""
        affine = self.report.get("affine_ijk_to_lps_mm")
        return self.report.get("voxel_mm") if affine is None else min(column_spacing(np.asarray(affine)))

    def check(self) -> None:
        """Check every number, as when a mesh is made; this is for arrays that were changed since."""
        if self.triangle_count and int(self._triangles.max()) >= self.vertex_count:
            row = int(np.flatnonzero((self._triangles >= self.vertex_count).any(axis=1))[0])
            raise UsageError(
                f"triangle {row:,} refers to vertex {int(self._triangles[row].max()):,}, the mesh has"
                f" {self.vertex_count:,} vertices, which are numbered from 0"
            )
        for name, values in (("vertex", self._vertices), ("normal", self._normals)):
            if values is not None and not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
                raise UsageError(f"{name} {row:,} is not finite: {values[row].tolist()}")

    def checked_values(self) -> dict[str, NDArray[np.float32]]:
        """Return `values` as float32, refusing those that are no number a vertex, or have a name that no file holds."""
        return checked_columns("values", self.values, "vertex", self.vertex_count)

    def checked_face_values(self) -> dict[str, NDArray[np.float32]]:
        """Return `face_values`, checked as `values`."""
        return checked_columns("face_values", self.face_values, "triangle", self.triangle_count)

    @explains_arguments
    def in_space(self, space: str) -> tuple[NDArray[np.floating], NDArray[np.float32] | None]:
        """Return vertices and normals in another patient frame; the mesh itself is always LPS.

        space: {"lps", "ras"}. RAS negates x and y, which is a half turn: the winding of the triangles stays.

        Returns:
        vertices: ndarray, shape (n, 3), mm, of the type of `vertices`
        """
        return turn_to_lps(space, self._vertices, self._normals)  # a half turn is its own inverse

    def transformed(self: Own, matrix: ArrayLike) -> Own:
        """Return the mesh moved, turned or scaled by an affine; this one stays as it is.

        matrix: array_like, shape (4, 4). LPS mm to LPS mm; the last row is (0, 0, 0, 1).  A mirror is allowed:
            triangles are turned round, so that they stay counter-clockwise when seen from outside.

        Returns: Normals go through the inverse transpose.  The report has ``moved_by``, the matrix from the place where
            the scan put the mesh, and no longer the affine and the certificate of the scan: they say nothing of its new
            place.
        """
        checked = checked_affine(matrix)
        normals = self._normals
        if normals is not None and len(normals):
            directions = normals @ normal_matrix(checked).T
            lengths = np.linalg.norm(directions, axis=1, keepdims=True)
            normals = np.divide(directions, lengths, out=directions, where=lengths > 0)
        mirrored = np.linalg.det(checked[:3, :3]) < 0
        scan = ("affine_ijk_to_lps_mm", "certificate", "certificate_lines")
        report = {name: value for name, value in self.report.items() if name not in scan}
        before = self.report.get("moved_by")
        if self.voxel_mm is not None:
            report["voxel_mm"] = self.voxel_mm * float(np.linalg.svd(checked[:3, :3], compute_uv=False).min())
        report["moved_by"] = (checked if before is None else checked @ np.array(before)).tolist()
        triangles = self._triangles[:, ::-1] if mirrored else self._triangles
        return give_values(self, type(self)(apply_affine(checked, self._vertices), triangles, normals, report))

    def describe(self, space: str, *, keep_ids: bool = False) -> Content:
        """Return the contents of a file of the mesh in `space`; nothing else of `report` is ever written.

        Only with `keep_ids` they have the hash of the frame of reference.
        """
        vertices, normals = self.in_space(space)
        facts = facts_for_file(self.report, space, keep_ids=keep_ids)
        name, color = self.report.get("part_name"), self.report.get("color")
        title = self.report.get("label_name")
        return Content(
            vertices=vertices,
            triangles=self.triangles,
            normals=normals,
            name=None if name is None else str(name),
            title=None if title is None else escape_text(str(title)),
            color=None if color is None else (float(color[0]), float(color[1]), float(color[2])),
            values=self.checked_values(),
            face_values=self.checked_face_values(),
            slices=self.report.get("page_slices"),
            **facts,
        )

    def describe_parts(self, space: str, most: int, *, keep_ids: bool = False) -> Content:
        """Return what `describe` does, with normals, and with up to `most` components and the rest as parts."""
        content = self.describe(space, keep_ids=keep_ids)
        if not self.triangle_count:
            return content
        normals = vertex_normals(content.vertices, self.triangles) if content.normals is None else content.normals
        return replace(content, normals=normals, pieces=find_pieces(self.vertices, self.triangles, most))

    @explains_arguments
    def save(
        self, path: str | os.PathLike[str], space: Space = "lps", *, no_clobber: bool = False, keep_ids: bool = False
    ) -> int:
        """Write the mesh to a file; its extension gives the format.

        STL (binary), PLY (binary), OBJ, GLB, VTP, 3MF, or a page of HTML that shows it (``docs/view.md``).  The file is
        either complete or absent, and an older file of that name is replaced in one step.  It holds no patient data,
        date or path.

        path: ``.stl``, ``.ply``, ``.obj``, ``.glb``, ``.vtp``, ``.3mf`` or ``.html``, upper or lower case.
        space: {"lps", "ras"}. Patient frame of the coordinates; the file names it.  Units are mm; a node matrix in GLB
            maps them to the metres, Y up, of glTF.  STL holds only float32, a page 65,536 steps a side, which it names;
            the other formats keep float64 vertices.
        no_clobber: A file of that name stays and is an `OutputError`.
        keep_ids: The comments hold the hash of the frame of reference, by which files of one scan are told.

        Returns: Size of the file in bytes.
        """
        with keep_existing(keep=no_clobber):
            return write_mesh(self, path, space, keep_ids=keep_ids)


def give_values(mesh: BaseMesh, to: Own, vertices: Any = slice(None), triangles: Any = slice(None)) -> Own:
    """Give a mesh made of some vertices and triangles of another, by index, the numbers at these; return it."""
    to.values = {name: values[vertices] for name, values in mesh.values.items()}
    to.face_values = {name: values[triangles] for name, values in mesh.face_values.items()}
    return to
