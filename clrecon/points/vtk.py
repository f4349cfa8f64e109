"""A cloud as ``pyvista.PolyData``: arrays in and out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
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


def unwrap_cloud(polydata: Any) -> tuple[dict[str, NDArray[Any] | None], str | None]:
    """Arrays of a ``pyvista.PolyData`` by their names in a cloud, and the frame that it names."""
    import pyvista

    found = pyvista.wrap(polydata) if hasattr(polydata, "GetPolys") else polydata
    if not isinstance(found, pyvista.PolyData):
        raise UsageError(f"a {type(polydata).__name__} is no pyvista.PolyData")
    arrays: dict[str, NDArray[Any] | None] = {"points": np.array(found.points)}
    for name, theirs in {"normals": "Normals", "hu": "HU", "labels": "label"}.items():
        arrays[name] = np.array(found.point_data[theirs]) if theirs in found.point_data else None
    named = found.field_data["SPACE"][0] if "SPACE" in found.field_data else None
    return arrays, None if named is None else str(named)
