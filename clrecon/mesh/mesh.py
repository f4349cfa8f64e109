"""`Mesh`: an indexed triangle surface in LPS mm."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.raw_content import RawMesh, join_numbers, numbers_of, turn_to_lps
from clrecon.geometry import Volume
from clrecon.geometry.affine import choose_space
from clrecon.mesh.base import BaseMesh, give_values
from clrecon.mesh.components import select_components, split_components
from clrecon.mesh.connectivity import find_edges
from clrecon.mesh.intersections import find_self_intersections
from clrecon.mesh.quality import MeshQuality, measure_quality, measure_triangles
from clrecon.mesh.triangle_tree import TriangleTree
from clrecon.system.arguments import Space, as_numbers, explains_arguments
from clrecon.system.packages import ShownAsHtml, import_package, public_function
from clrecon.system.pieces import find_bounds, local_origin


def _finite_points(points: ArrayLike, name: str, *, one: bool = False) -> NDArray[np.float64]:
    """Return points (n, 3) or (3,), only the latter where `one` is wanted, as (n, 3)."""
    rows = as_numbers(name, points)
    if rows.shape[-1:] != (3,) or rows.ndim > (1 if one else 2) or not np.isfinite(rows).all():
        raise UsageError(f"{name} must be three finite numbers{'' if one else ' each'}, these have shape {rows.shape}")
    return rows.reshape(-1, 3)


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
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the box round the vertices, shape (2, 3), LPS mm; NaN without vertices."""
        if not self.vertex_count:
            return np.full((2, 3), np.nan)
        return np.array(find_bounds(self.vertices), dtype=np.float64)

    @property
    def area(self) -> float:
        """Area in mm2."""
        return measure_triangles(self.vertices, self.triangles).area_mm2

    @property
    def volume(self) -> float:
        """Enclosed volume in mm3 (1000 mm3 are 1 ml), signed: cavities count negative, as does a mesh inside out.

        It means nothing where the mesh is open: see `quality`.
        """
        return measure_triangles(self.vertices, self.triangles).volume_mm3

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
        seeds: Sequence[Sequence[float]] | Sequence[float] = (),
    ) -> list[Mesh]:
        """Return the parts that share no vertex as meshes, the largest area first, or some of them.

        Parameters
        ----------
        keep_largest : int, optional
            This number of parts, those of largest area.
        min_volume_ml : float, optional
            Parts that enclose at least this volume, regardless of sign: the wall of a cavity is a part of its own.
        seeds : sequence of (x, y, z), or one
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
        whole = copy.copy(self)
        whole.report = dict(self.report)
        return select_components(whole, count)

    def merge(self, *others: Mesh) -> Mesh:
        """Return this mesh and others as one, each as it is: no vertex is joined and nothing is cut.

        What only some have is NaN elsewhere (``values``) or left out (normals, facts of the scan).  Unions of solids
        are those of trimesh: ``clrecon.Mesh.from_trimesh(trimesh.boolean.union([a.to_trimesh(), b.to_trimesh()]))``.
        A `UsageError` where one is no Mesh.
        """
        parts = (self, *others)
        if (wrong := next((each for each in others if not isinstance(each, Mesh)), None)) is not None:
            raise UsageError(f"merge takes meshes, not {type(wrong).__name__}: of a list mesh.merge(*others)")
        starts = np.cumsum([0, *(part.vertex_count for part in parts)])
        triangles = [part.triangles.astype(np.int64) + start for part, start in zip(parts, starts, strict=False)]
        normals = [part.normals for part in parts if part.normals is not None]
        steps = [part.voxel_mm for part in parts if part.voxel_mm is not None]
        facts = {
            name: value for name, value in self.report.items() if all(part.report.get(name) == value for part in parts)
        }
        merged = Mesh(
            np.concatenate([part.vertices for part in parts]),
            np.concatenate(triangles),
            np.concatenate(normals) if len(normals) == len(parts) else None,
            facts | ({"voxel_mm": min(steps)} if steps else {}),
        )
        merged.values = join_numbers([(part.values, part.vertex_count) for part in parts])
        merged.face_values = join_numbers([(part.face_values, part.triangle_count) for part in parts])
        return merged

    @explains_arguments
    def sample(self, volume: Volume, name: str = "HU", order: int = 1, outside: float = float("nan")) -> Mesh:
        """Return the mesh with what `Volume.sample` gives at its vertices in ``values[name]``.

        PLY, VTP and `to_pyvista` keep them; so does GLB as ``_NAME``, with -1 for NaN, which glTF does not know.

        Parameters
        ----------
        volume : Volume or DeviceVolume
        name : str
            Letters, digits and _; numbers of that name are replaced.
        order : {0, 1, 3}
            Nearest voxel, trilinear, cubic spline.
        outside : float
            Value beyond the voxels.
        """
        sampled = give_values(self, copy.copy(self))
        sampled.report = dict(self.report)
        sampled.values[name] = Volume.sample(volume, self.vertices, order=order, outside=outside).astype(np.float32)
        sampled.checked_values()
        return sampled

    @explains_arguments
    def clip(self, point: ArrayLike, normal: ArrayLike, *, capped: bool = True) -> Mesh:
        """Return the part on the side of a plane that its normal points to, cut by VTK: with report and all values.

        Parameters
        ----------
        point, normal : array_like, shape (3,)
            A point of the plane, LPS mm, and a vector of any length but 0.
        capped : bool
            True: the cut is filled, so that a closed mesh stays closed; an open one is refused.  Its ``face_values``
            are NaN.  False: it ends open.

        Raises
        ------
        NoSurfaceError
            Nothing lies on that side.
        """
        from clrecon.mesh.vtk import clip_surface, unwrap_polydata

        surface, on_plane, along, origin = self._cut_by(point, normal)
        if capped and find_edges(self.triangles, self.vertex_count).boundary:
            raise UsageError("the mesh is open, so that its cut cannot be filled: capped=False leaves it open")
        part = clip_surface(surface, on_plane, along, capped)
        if not part.GetNumberOfCells():
            off = float(((on_plane + origin - self.vertices) @ along).min())
            raise NoSurfaceError(f"nothing of the mesh lies on that side of the plane: it ends {abs(off):.4g} mm off")
        raw, _ = unwrap_polydata(part)
        clipped = Mesh(raw.vertices + origin, raw.triangles, report=dict(self.report))
        clipped.values = {name: raw.values[name] for name in self.values}
        if not capped:
            clipped.face_values = {name: raw.face_values[name] for name in self.face_values}
        elif self.face_values:
            middles = raw.vertices[raw.triangles].mean(axis=1, dtype=np.float64)
            _, rows, _ = TriangleTree(self.vertices - origin, self.triangles).nearest(middles)
            cap = raw.face_values["Labels"] > 0
            clipped.face_values = {name: np.where(cap, np.nan, own[rows]) for name, own in self.face_values.items()}
        return clipped

    @explains_arguments
    def section(self, point: ArrayLike, normal: ArrayLike) -> list[NDArray[np.float64]]:
        """Return the outlines in which a plane cuts the mesh, found by VTK; the plane is given as to `clip`.

        Returns
        -------
        list of ndarray, shape (n, 3)
            Polylines in LPS mm, in the order of their points; a closed one ends with its first point.
        """
        from clrecon.mesh.vtk import cut_surface

        surface, on_plane, along, origin = self._cut_by(point, normal)
        return [line + origin for line in cut_surface(surface, on_plane, along)]

    def _cut_by(self, point: ArrayLike, normal: ArrayLike) -> tuple[Any, Any, Any, NDArray[np.float64]]:
        """Return the surface near zero for VTK, a plane there, its normal of length 1, and the place of zero."""
        from clrecon.mesh.vtk import wrap_polydata

        on_plane, along = (
            _finite_points(vector, name, one=True)[0] for vector, name in ((point, "point"), (normal, "normal"))
        )
        if not along.any():
            raise UsageError("the normal of a plane has length 0: it has no side")
        along = along / np.abs(along).max()  # whose square is neither infinite nor 0
        origin = self._origin()
        surface = wrap_polydata(
            self.vertices - origin, self.triangles, None, self.checked_values(), self.checked_face_values()
        )
        return surface, on_plane - origin, along / np.linalg.norm(along), origin

    def _origin(self) -> NDArray[np.float64]:
        if not self.triangle_count:
            raise UsageError("the mesh has no triangle")
        return local_origin(self.vertices)

    @explains_arguments
    def closest_points(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Find the points of the surface that are nearest to points (n, 3) or (3,), LPS mm.

        Returns
        -------
        nearest, distances, triangles : ndarray, shape (n, 3), (n,) and (n,)
            LPS mm; mm without a sign, which `measure_vertex_distances` has; rows of the triangles.
        """
        asked, origin = _finite_points(points, "points"), self._origin()
        nearest, rows, distances = TriangleTree(self.vertices - origin, self.triangles).nearest(asked - origin)
        return nearest + origin, distances, rows

    @explains_arguments
    def ray(self, start: ArrayLike, direction: ArrayLike) -> NDArray[np.float64]:
        """Find where rays first meet the surface, (n, 3), LPS mm; NaN where one meets nothing.

        Parameters
        ----------
        start, direction : array_like, shape (n, 3) or (3,)
            LPS mm, and vectors of any length but 0; one alone is that of all rays.
        """
        starts, ways = _finite_points(start, "start"), _finite_points(direction, "direction")
        if len(ways) not in (1, len(starts)) or not ways.any(axis=1).all():
            raise UsageError(
                f"{len(starts)} starts and {len(ways)} directions: one for each or for all, none of length 0"
            )
        origin = self._origin()
        ways = ways / np.abs(ways).max(axis=1, keepdims=True)
        begin, unit = starts - origin, ways / np.linalg.norm(ways, axis=1, keepdims=True)
        far = np.linalg.norm(begin, axis=1, keepdims=True) + 2.0 * np.abs(self.vertices - origin).max()
        return TriangleTree(self.vertices - origin, self.triangles).first_hits(begin, begin + far * unit) + origin

    def self_intersections(self) -> NDArray[np.int64]:
        """Find the pairs of triangles that cut each other, as rows of ``triangles``, shape (k, 2), exactly."""
        return find_self_intersections(self.vertices, self.triangles)

    def to_pyvista(self) -> Any:
        """Return the mesh as ``pyvista.PolyData`` in LPS mm, sharing the memory of vertices and normals.

        The normals are the active point normals, named ``Normals``; ``values`` are point arrays, ``face_values`` cell
        arrays; the field arrays ``SPACE`` and ``UNIT`` name frame and unit.

        Raises
        ------
        UsageError
            The mesh fails ``check``: VTK would crash on it.
        """
        from clrecon.mesh.vtk import wrap_polydata

        self.check()
        values, face_values = self.checked_values(), self.checked_face_values()
        return wrap_polydata(self._vertices, self._triangles, self._normals, values, face_values, self.voxel_mm)

    @classmethod
    @explains_arguments
    def from_pyvista(cls, polydata: Any, space: Space | None = None) -> Mesh:
        """Make a mesh of a ``pyvista.PolyData``; polygons and strips become triangles.

        Parameters
        ----------
        polydata : pyvista.PolyData or vtkPolyData
            In mm.  Its point normals, if it has any that are named ``Normals``, are taken over; its point and cell
            arrays of one number each, whose names are letters, digits and _, become ``values`` and ``face_values``.
        space : {"lps", "ras"}, optional
            Patient frame of the points; None: that of the field array ``SPACE``, which `to_pyvista` and 3D Slicer
            write, else LPS.

        Raises
        ------
        UsageError
            It is no PolyData, has no faces, or a number that a mesh cannot have; or ``space`` is not that of the array.
        """
        from clrecon.mesh.vtk import unwrap_polydata

        raw, voxel = unwrap_polydata(polydata)
        return cls._of_others(raw, choose_space(space, raw.space, "the PolyData"), voxel)

    def to_trimesh(self) -> Any:
        """Return the mesh as ``trimesh.Trimesh`` in LPS mm, its ``units`` "mm" and ``metadata["SPACE"]`` "LPS".

        Vertices and triangles keep their order and number (``process=False``); ``values`` and ``face_values`` are its
        ``vertex_attributes`` and ``face_attributes``.

        Raises
        ------
        UsageError
            trimesh is not installed, or the mesh fails ``check``.
        """
        trimesh = import_package("trimesh", "to_trimesh")
        self.check()
        converted = trimesh.Trimesh(
            np.array(self.vertices, dtype=np.float64),
            self.triangles.astype(np.int64),
            vertex_normals=None if self.normals is None else self.normals.astype(np.float64),
            metadata={"SPACE": "LPS", "UNIT": "mm", "VOXEL_MM": self.voxel_mm},
            vertex_attributes=self.checked_values(),
            face_attributes=self.checked_face_values(),
            process=False,
        )
        converted.units = "mm"
        return converted

    def to_meshio(self) -> Any:
        """Return the mesh as ``meshio.Mesh`` in LPS mm, for the formats that meshio writes, such as Abaqus and VTU.

        ``normals`` and ``values`` are its ``point_data``, ``face_values`` its ``cell_data``.

        Raises
        ------
        UsageError
            meshio is not installed, or the mesh fails ``check``.
        """
        meshio = import_package("meshio", "to_meshio")
        self.check()
        return meshio.Mesh(
            np.array(self.vertices),
            [("triangle", self.triangles.astype(np.int64))],
            point_data=({} if self.normals is None else {"Normals": self.normals}) | self.checked_values(),
            cell_data={name: [numbers] for name, numbers in self.checked_face_values().items()},
        )

    @classmethod
    @explains_arguments
    def from_trimesh(cls, mesh: Any, space: Space | None = None) -> Mesh:
        """Make a mesh of a ``trimesh.Trimesh``.

        Parameters
        ----------
        mesh : trimesh.Trimesh
            In mm.  Its attributes of one number each become ``values`` and ``face_values``.  Its normals are not taken
            over: trimesh makes them of the triangles when they are asked for.
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
        if units not in (None, "none", "mm", "millimeter", "millimeters"):  # trimesh stores None as a text
            raise UsageError(f"the mesh is in {units}, clrecon's are in mm: call its convert_units('mm') first")
        facts = getattr(mesh, "metadata", None) or {}
        frame = choose_space(space, facts.get("SPACE"), "the Trimesh")
        raw = RawMesh(
            "Trimesh",
            np.asarray(vertices),
            np.asarray(faces),
            values=numbers_of(mesh.vertex_attributes),
            face_values=numbers_of(mesh.face_attributes),
        )
        return cls._of_others(raw, frame, facts.get("VOXEL_MM"))

    @classmethod
    def _of_others(cls, raw: RawMesh, space: str, voxel: Any) -> Mesh:
        """Make a mesh of arrays in ``space``, of a scan whose shortest voxel step is known or None."""
        vertices, normals = turn_to_lps(space, raw.vertices, raw.normals)
        mesh = cls(vertices, raw.triangles, normals, None if voxel is None else {"voxel_mm": float(voxel)})
        mesh.values, mesh.face_values = dict(raw.values), dict(raw.face_values)
        return mesh

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
