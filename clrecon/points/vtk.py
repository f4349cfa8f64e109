"""A cloud as ``pyvista.PolyData``: arrays in and out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.vtp import make_polydata


def wrap_cloud(
    points: NDArray[np.floating],
    normals: NDArray[np.float32] | None,
    hu: NDArray[np.float32] | None,
    labels: NDArray[np.int32] | None,
) -> Any:
    """``pyvista.PolyData`` in LPS mm that shares the memory of the arrays; see `PointCloud.to_pyvista`."""
    import pyvista

    polydata = pyvista.wrap(make_polydata(points, None, normals, hu, labels))
    polydata.field_data["SPACE"] = ["LPS"]
    polydata.field_data["UNIT"] = ["mm"]
    return polydata
