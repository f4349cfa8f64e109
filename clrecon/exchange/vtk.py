"""Arrays to ``vtkPolyData``: VTK's layout of points, triangles and point arrays is handled here alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def make_polydata(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32] | None,
    normals: NDArray[np.float32] | None,
    hu: NDArray[np.float32] | None = None,
    labels: NDArray[np.int32] | None = None,
) -> Any:
    """Build a ``vtkPolyData`` that shares the memory of the arrays.

    VTK counts in signed integers: indices are seen as int32 without a copy below 2**31 vertices and are copied to
    int64 above.

    vertices: ndarray, shape (n, 3), float32 or float64, C-contiguous
    triangles: ndarray, shape (m, 3), uint32, C-contiguous, every index below n, or None. None: a cloud, each point a
        cell of its own, without which nothing of it is drawn.
    normals: ndarray, shape (n, 3), float32, C-contiguous, or None. They become the active normals, named ``Normals``.
    hu, labels: ndarray, shape (n,), float32 and int32. The point arrays ``HU``, which becomes the active scalars, and
        ``label``.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    corners = 1 if triangles is None else 3
    count = len(vertices) if triangles is None else len(triangles)
    small = max(len(vertices), corners * count + 1) < 2**31
    if triangles is None:
        indices: NDArray[Any] = np.arange(count, dtype=np.int32 if small else np.int64)
    else:
        indices = triangles.view(np.int32) if small else triangles.astype(np.int64)
    offsets = np.arange(0, indices.size + 1, corners, dtype=indices.dtype)
    cells = vtkCellArray()
    cells.SetData(numpy_to_vtk(offsets), numpy_to_vtk(indices.reshape(-1)))
    points = vtkPoints()
    points.SetData(numpy_to_vtk(vertices))
    polydata = vtkPolyData()
    polydata.SetPoints(points)
    if triangles is None:
        polydata.SetVerts(cells)
    else:
        polydata.SetPolys(cells)
    data = polydata.GetPointData()
    for name, values, put in (
        ("Normals", normals, data.SetNormals),
        ("HU", hu, data.SetScalars),
        ("label", labels, data.AddArray),
    ):
        if values is not None:
            array = numpy_to_vtk(values)
            array.SetName(name)
            put(array)
    return polydata
