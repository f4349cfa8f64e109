"""`Mesh`: an indexed triangle surface in LPS mm."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import choose_space, frame_from_lps
from clrecon.mesh.base import BaseMesh
from clrecon.mesh.components import select_components, split_components
from clrecon.mesh.quality import MeshQuality, measure_quality, measure_triangles
from clrecon.system.arguments import explains_arguments
from clrecon.system.packages import ShownAsHtml, import_package, public_function
from clrecon.system.pieces import find_bounds


class Mesh(BaseMesh, ShownAsHtml):
    """An indexed triangle surface in the patient frame LPS, millimetres.

    Parameters
    ----------
    vertices : array_like, shape (n, 3)
        LPS mm; kept as float32, without a copy when they are C-contiguous float32.  Others that reach 4096 mm from
        the origin, where float32 would round them by more than 2e-4 mm, are kept as float64.
    triangles : array_like, shape (m, 3)
        Indices of vertices, from 0, counter-clockwise when seen from outside; kept as uint32.
    normals : array_like, shape (n, 3), optional
        Unit vectors at the vertices that point outward, LPS; kept as float32.
    report : dict, optional
        Facts about the origin of this mesh, without patient data: ``iso_value_hu``, ``affine_ijk_to_lps_mm``,
        ``certificate`` (the report of the volume), device, times.  The first three are written to the formats that have
        a place for them.
    trusted : bool
        True: indices and coordinates come from a computation that makes no wrong ones, and are not looked at.

    Raises
    ------
    UsageError
        A shape or type cannot be used, the number of normals is not that of the vertices, a triangle refers to a vertex
        that does not exist, or a coordinate is not finite.
    """

    @property
    def bounds(self) -> NDArray[np.float64] | None:
        """Lowest and highest corner of the box round the vertices, shape (2, 3), LPS mm; None without vertices."""
        if not self.vertex_count:
            return None
        return np.array(find_bounds(self.vertices), dtype=np.float64)

    @property
    def area(self) -> float:
        """Area in mm2."""
        return measure_triangles(self.vertices, self.triangles)[0]

    @property
    def volume(self) -> float:
        """Enclosed volume in mm3 (1000 mm3 are 1 ml), signed: cavities count negative, as does a mesh inside out.

        It means nothing where the mesh is open: see `quality`.
        """
        return measure_triangles(self.vertices, self.triangles)[1]

    def quality(self) -> MeshQuality:
        """Measure the mesh: closedness, size and faults."""
        return measure_quality(self.vertices, self.triangles)

    def components(self) -> list[Mesh]:
        """Return the parts that share no vertex, each a mesh, the largest area first."""
        return self.split()

    @explains_arguments
    def split(
        self,
        keep_largest: int | None = None,
        min_volume_ml: float | None = None,
        *,
        seeds: Sequence[Sequence[float]] = (),
    ) -> list[Mesh]:
        """Return the parts that share no vertex as meshes, the largest area first, or some of them.

        Parameters
        ----------
        keep_largest : int, optional
            This number of parts, those of largest area.
        min_volume_ml : float, optional
            Parts that enclose at least this volume, regardless of sign: the wall of a cavity is a part of its own.
        seeds : sequence of (x, y, z)
            Parts whose surface lies nearest to one of these points, LPS mm.

        Raises
        ------
        UsageError, NoSurfaceError
            See ``clrecon.mesh.select_components``.
        """
        return split_components(self, keep_largest, min_volume_ml, seeds=seeds)

    @explains_arguments
    def keep_largest(self, count: int = 1) -> Mesh:
        """Return the mesh with its ``count`` parts of largest area alone.

        The walls of cavities are parts of their own, so with one part cavities are filled.

        Raises
        ------
        UsageError
            ``count`` is below 1.
        NoSurfaceError
            The mesh is empty.
        """
        own = copy.copy(self)
        own.report = dict(self.report)
        return select_components(own, count)

    def to_pyvista(self) -> Any:
        """Return the mesh as ``pyvista.PolyData`` in LPS mm, sharing the memory of vertices and normals.

        The normals are the active point normals, named ``Normals``; `values` are point arrays; the field arrays
        ``SPACE`` and ``UNIT`` name frame and unit.

        Raises
        ------
        UsageError
            The mesh fails ``check``: VTK would crash on it.
        """
        from clrecon.mesh.vtk import wrap_polydata

        self.check()
        return wrap_polydata(self._vertices, self._triangles, self._normals, self.checked_values())

    @classmethod
    @explains_arguments
    def from_pyvista(cls, polydata: Any, space: str | None = None) -> Mesh:
        """Make a mesh of a ``pyvista.PolyData``; polygons and strips become triangles.

        Parameters
        ----------
        polydata : pyvista.PolyData or vtkPolyData
            In mm.  Its point normals, if it has any that are named ``Normals``, are taken over, and its point arrays of
            one number each, whose names are letters, digits and _, become `values`.
        space : {"lps", "ras"}, optional
            Patient frame of the points; None: that of the field array ``SPACE``, which `to_pyvista` and 3D Slicer
            write, else LPS.

        Raises
        ------
        UsageError
            It is no PolyData, has no faces, or a number that a mesh cannot have; or ``space`` is not that of the array.
        """
        from clrecon.mesh.vtk import unwrap_polydata

        vertices, triangles, normals, values, named = unwrap_polydata(polydata)
        made = cls._of_others(vertices, triangles, normals, choose_space(space, named, "the PolyData"))
        made.values = values
        return made

    def to_trimesh(self) -> Any:
        """Return the mesh as ``trimesh.Trimesh`` in LPS mm, its ``units`` "mm" and ``metadata["SPACE"]`` "LPS".

        Vertices and triangles keep their order and number (``process=False``).

        Raises
        ------
        UsageError
            trimesh is not installed, or the mesh fails ``check``.
        """
        trimesh = import_package("trimesh", "to_trimesh")
        self.check()
        made = trimesh.Trimesh(
            np.array(self.vertices, dtype=np.float64),
            self.triangles.astype(np.int64),
            vertex_normals=None if self.normals is None else self.normals.astype(np.float64),
            metadata={"SPACE": "LPS", "UNIT": "mm"},
            process=False,
        )
        made.units = "mm"
        return made

    @classmethod
    @explains_arguments
    def from_trimesh(cls, mesh: Any, space: str | None = None) -> Mesh:
        """Make a mesh of a ``trimesh.Trimesh``.

        Parameters
        ----------
        mesh : trimesh.Trimesh
            In mm.  Its normals are not taken over: trimesh makes them of the triangles when they are asked for.
        space : {"lps", "ras"}, optional
            Patient frame of the vertices; None: that of ``metadata["SPACE"]``, which `to_trimesh` sets, else LPS.

        Raises
        ------
        UsageError
            It is no Trimesh, its ``units`` are not mm, or it has a number that a mesh cannot have; or ``space`` is not
            that of the metadata.
        """
        vertices, faces = getattr(mesh, "vertices", None), getattr(mesh, "faces", None)
        if vertices is None or faces is None or hasattr(mesh, "n_points"):
            raise UsageError(
                f"a {type(mesh).__name__} is no trimesh.Trimesh: of a Scene take scene.to_geometry() first"
            )
        units = getattr(mesh, "units", None)
        if units not in (None, "mm", "millimeter", "millimeters"):
            raise UsageError(f"the mesh is in {units}, clrecon's are in mm: call its convert_units('mm') first")
        named = (getattr(mesh, "metadata", None) or {}).get("SPACE")
        return cls._of_others(np.asarray(vertices), np.asarray(faces), None, choose_space(space, named, "the Trimesh"))

    @classmethod
    def _of_others(
        cls, vertices: NDArray[Any], triangles: NDArray[Any], normals: NDArray[Any] | None, space: str
    ) -> Mesh:
        """Make a mesh of arrays in ``space``."""
        if space != "LPS":
            signs = np.diag(frame_from_lps(space))
            vertices = vertices * signs.astype(vertices.dtype)
            normals = None if normals is None else normals * signs.astype(normals.dtype)
        return cls(vertices, triangles, normals)

    def show(self) -> None:
        """Show the mesh in a window of pyvista, until it is closed; see `clrecon.show`.

        Raises
        ------
        UsageError
            The mesh has no triangle, there is no display, or OpenGL does not work on it.
        """
        public_function("show")(self)

    def __repr__(self) -> str:
        normals = "" if self.normals is None else ", with normals"
        return f"Mesh({self.vertex_count} vertices, {self.triangle_count} triangles{normals}, LPS mm)"
