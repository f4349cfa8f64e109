"""Arrays to ``vtkPolyData``: VTK's layout of points and triangles is handled here alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["make_polydata"]


def make_polydata(
    vertices: NDArray[np.floating], triangles: NDArray[np.uint32], normals: NDArray[np.float32] | None
) -> Any:
    """Build a ``vtkPolyData`` that shares the memory of the arrays.

    VTK counts in signed integers: indices are seen as int32 without a copy below 2**31 vertices and are copied to
    int64 above.

    Parameters
    ----------
    vertices : ndarray, shape (n, 3), float32 or float64, C-contiguous
    normals : ndarray, shape (n, 3), float32, C-contiguous
    triangles : ndarray, shape (m, 3), uint32, C-contiguous, every index below n
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    points = vtkPoints()
    points.SetData(numpy_to_vtk(vertices))
    small = max(len(vertices), 3 * len(triangles) + 1) < 2**31
    indices = triangles.view(np.int32) if small else triangles.astype(np.int64)
    offsets = np.arange(0, indices.size + 1, 3, dtype=indices.dtype)
    cells = vtkCellArray()
    cells.SetData(numpy_to_vtk(offsets), numpy_to_vtk(indices.reshape(-1)))
    polydata = vtkPolyData()
    polydata.SetPoints(points)
    polydata.SetPolys(cells)
    if normals is not None:
        array = numpy_to_vtk(normals)
        array.SetName("Normals")
        polydata.GetPointData().SetNormals(array)
    return polydata
