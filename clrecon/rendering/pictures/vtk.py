"""Pictures as PyVista data sets in LPS mm: points, right from every side, or a plane with the picture on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.rendering.pictures.annotations import PictureData
from clrecon.rendering.views.camera import Camera

_FORMS = ("points", "plane")


def rendering_to_pyvista(
    rendering: PictureData, form: str = "points", *, expected: bool = False, distance: float | None = None
) -> Any:
    """See `Rendering.to_pyvista`."""
    camera = rendering.camera
    if camera is None:
        raise UsageError("this picture is no projection (its camera is None): it has no place in a scene")
    if form not in _FORMS:
        raise UsageError(f"a picture goes into a scene as {' or '.join(_FORMS)}, not as {form!r}")
    if form == "points":
        if distance is not None:
            raise UsageError("the points of a picture lie where its rays hit: a distance is for form='plane'")
        dataset = _make_points(rendering, camera, rendering.expected_depth if expected else rendering.depth)
    else:
        dataset = _make_plane(rendering, camera, camera.distance if distance is None else distance)
    for name, text in {"SPACE": "LPS", "UNIT": "mm"}.items():
        dataset.field_data[name] = [text]
    return dataset


def _make_points(rendering: PictureData, camera: Camera, depth: NDArray[np.float32]) -> Any:
    import pyvista

    hit = np.isfinite(depth)
    if not hit.any():
        raise UsageError("this picture hits nothing: it has no points")
    origins, directions = camera.rays(rendering.size)
    cloud = pyvista.PolyData(origins[hit] + depth[hit, None].astype(np.float64) * directions[hit])
    cloud.point_data["depth"] = depth[hit]
    if rendering.values is not None:
        cloud.point_data["HU"] = rendering.values[hit]
    cloud.point_data["RGBA"] = rendering.image[hit]
    return cloud


def _make_plane(rendering: PictureData, camera: Camera, distance: float) -> Any:
    import pyvista

    if not 0.0 < distance < np.inf:
        raise UsageError(
            f"the plane of a picture lies before its camera, at a distance above 0 mm, not at {distance!r}"
        )
    width, height = rendering.size
    right, up, forward = camera.basis()
    pixel = 2.0 * camera.half_height() * (1.0 if camera.is_parallel else distance) / height
    corner = np.array(camera.position) + distance * forward + 0.5 * pixel * (height * up - width * right)
    plane = pyvista.ImageData(dimensions=(width + 1, height + 1, 1), spacing=(pixel, pixel, 1.0), origin=tuple(corner))
    plane.SetDirectionMatrix(*np.column_stack([right, -up, forward]).ravel())
    if rendering.values is not None:
        plane.cell_data["HU"] = np.ascontiguousarray(rendering.values).reshape(-1)
    plane.cell_data["RGBA"] = np.ascontiguousarray(rendering.image).reshape(-1, 4)
    return plane
