"""VTK's work on meshes: parts and cuts at planes; arrays in and out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.exchange.raw_content import RawMesh, numbers_of
from clrecon.exchange.vtp import add_arrays, make_polydata

Points = NDArray[np.float64]


def clip_surface(surface: Any, point: Points, normal: Points, capped: bool) -> Any:
    """Return the part of a ``pyvista.PolyData`` on the side of a plane that the normal points to.

    Capped, its cell array ``Labels`` is 1 in the cap and 0 elsewhere, and other cell arrays are lost.
    """
    from vtkmodules.vtkCommonDataModel import vtkPlane, vtkPlaneCollection
    from vtkmodules.vtkFiltersGeneral import vtkClipClosedSurface

    if not capped:
        return surface.clip(normal=normal, origin=point, invert=False)
    planes = vtkPlaneCollection()
    planes.AddItem(vtkPlane(origin=point, normal=normal))
    clipper: Any = vtkClipClosedSurface(clipping_planes=planes, pass_point_data=True)  # that of pyvista loses them
    clipper.SetScalarModeToLabels()
    clipper.SetInputData(surface)
    clipper.Update()
    return clipper.GetOutput()


def cut_surface(surface: Any, point: Points, normal: Points) -> list[Points]:
    """Return the lines in which a plane cuts a ``pyvista.PolyData``, (n, 3), the first point again at a closed end."""
    cut = surface.slice(normal=normal, origin=point)
    next_to: list[list[int]] = [[] for _ in range(cut.n_points)]
    for _, begin, end in cut.lines.reshape(-1, 3).tolist():
        next_to[begin].append(end)
        next_to[end].append(begin)
    lines = []
    for start in sorted(range(cut.n_points), key=lambda row: len(next_to[row]) % 2 == 0):  # open ends first
        line = [start]
        while next_to[line[-1]]:  # VTK's own joining of lines breaks them where it begins
            line.append(next_to[line[-1]].pop())
            next_to[line[-1]].remove(line[-2])
        if len(line) > 1:
            lines.append(np.array(cut.points[line], np.float64))
    return lines


def wrap_polydata(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32],
    normals: NDArray[np.float32] | None,
    values: Mapping[str, NDArray[np.float32]],
    face_values: Mapping[str, NDArray[np.float32]],
    voxel_mm: float | None = None,
) -> Any:
    """``pyvista.PolyData`` in LPS mm that shares the memory of vertices and normals; see `Mesh.to_pyvista`."""
    import pyvista

    polydata = pyvista.wrap(make_polydata(vertices, triangles, normals, values=values))
    add_arrays(polydata.GetCellData(), face_values)
    polydata.field_data["SPACE"] = ["LPS"]
    polydata.field_data["UNIT"] = ["mm"]
    if voxel_mm is not None:
        polydata.field_data["VOXEL_MM"] = [voxel_mm]
    return polydata


def unwrap_polydata(polydata: Any) -> tuple[RawMesh, float | None]:
    """Return what a ``pyvista.PolyData`` holds, and its voxel step; see `Mesh.from_pyvista`."""
    import pyvista

    wrapped = pyvista.wrap(polydata) if hasattr(polydata, "GetPolys") else polydata
    if not isinstance(wrapped, pyvista.PolyData):
        raise UsageError(
            f"a {type(polydata).__name__} is no pyvista.PolyData: of a volume or grid take extract_surface() first"
        )
    if not wrapped.is_all_triangles:
        wrapped = wrapped.triangulate()
    faces = np.asarray(wrapped.faces)
    if not len(faces):
        raise UsageError(f"the PolyData has {wrapped.n_points:,} points and no faces: it is no surface")
    raw = RawMesh(
        "PolyData",
        np.array(wrapped.points),
        faces.reshape(-1, 4)[:, 1:],
        wrapped.point_data["Normals"] if "Normals" in wrapped.point_data else None,
        str(wrapped.field_data["SPACE"][0]) if "SPACE" in wrapped.field_data else None,
        values=numbers_of(wrapped.point_data),
        face_values=numbers_of(wrapped.cell_data),
    )
    return raw, float(wrapped.field_data["VOXEL_MM"][0]) if "VOXEL_MM" in wrapped.field_data else None
