"""A picture among meshes: what PyVista can show of it in LPS mm, and what of it is before and behind a scene.

Two forms of a picture go into a scene: its points, each where the ray of its pixel first hits something, which stay
right from every side, and a plane with the picture on it.  A picture and a scene that were seen by the same camera are
put together pixel by pixel by `merge_layers`, which needs neither PyVista nor a screen.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.camera import Camera
from clrecon.rendering.picture import Rendering

__all__ = ["FORMS", "merge_layers", "rendering_to_pyvista"]

FORMS = ("points", "plane")


def rendering_to_pyvista(
    rendering: Rendering, form: str = "points", *, expected: bool = False, distance: float | None = None
) -> Any:
    """See `Rendering.to_pyvista`."""
    camera = rendering.camera
    if camera is None:
        raise UsageError("this picture is no projection (its camera is None): it has no place in a scene")
    if form not in FORMS:
        raise UsageError(f"a picture goes into a scene as {' or '.join(FORMS)}, not as {form!r}")
    if form == "points":
        if distance is not None:
            raise UsageError("the points of a picture lie where its rays hit: a distance is for form='plane'")
        made = _make_points(rendering, camera, rendering.expected_depth if expected else rendering.depth)
    else:
        made = _make_plane(rendering, camera, camera.distance if distance is None else distance)
    for name, text in {"SPACE": "LPS", "UNIT": "mm"}.items():
        made.field_data[name] = [text]
    return made


def _make_points(rendering: Rendering, camera: Camera, depth: NDArray[np.float32]) -> Any:
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


def _make_plane(rendering: Rendering, camera: Camera, distance: float) -> Any:
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


def merge_layers(rendering: Rendering, colors: NDArray[np.uint8], depth: NDArray[np.floating]) -> Rendering:
    """Put a picture and a scene that one camera has seen together: what is nearer covers what is further away.

    Each pixel of the picture counts as one layer at its expected depth: a mesh within translucent tissue lies before
    or behind all of it.

    Parameters
    ----------
    rendering : Rendering
        With a transparent background.
    colors : ndarray, shape (h, w, 4), uint8
        The scene: red, green, blue and opacity, not premultiplied; row 0 is the top.
    depth : ndarray, shape (h, w), floating
        Of the scene, in mm as in `Rendering.depth`; NaN where nothing is.

    Returns
    -------
    Rendering
        Both depths are those of picture and scene together; `values` is None.

    Raises
    ------
    UsageError
        Other sizes, or a picture whose background is a colour.
    """
    width, height = rendering.size
    if colors.shape != (height, width, 4) or depth.shape != (height, width):
        raise UsageError(
            f"the picture has {width} x {height} pixels, the scene {colors.shape} colours and {depth.shape} depths"
        )
    nothing = np.isnan(rendering.expected_depth)
    if (rendering.image[nothing, 3] == 255).any():  # a trace of opacity without a depth is no background
        raise UsageError("this picture has a coloured background, which hides the scene: use background='transparent'")
    of_picture = np.where(nothing, np.inf, rendering.expected_depth)
    of_scene = np.where(colors[..., 3] > 0, np.nan_to_num(depth, nan=np.inf), np.inf)
    scene_first = of_scene < of_picture
    image, shares = _blend(
        np.where(scene_first[..., None], colors, rendering.image),
        np.where(scene_first[..., None], rendering.image, colors),
    )
    front, back = np.minimum(of_scene, of_picture), np.maximum(of_scene, of_picture)
    return replace(
        rendering,
        image=image,
        depth=_finite(np.fmin(rendering.depth, of_scene)),
        expected_depth=_finite(_mean_way(shares, front, back)),
        values=None,
        report={**rendering.report, "merged_with_scene": True},
    )


def _blend(front: NDArray[np.uint8], back: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """One picture over another, both with straight opacity, and what each adds (2, h, w), 0 to 1."""
    opacity = front[..., 3] / 255.0
    shares = np.stack([opacity, (1.0 - opacity) * back[..., 3] / 255.0])
    sums = shares[0, ..., None] * front[..., :3] + shares[1, ..., None] * back[..., :3]
    total = shares.sum(axis=0)
    image = np.empty_like(front)
    image[..., :3] = np.rint(sums / np.maximum(total, 1e-9)[..., None])
    image[..., 3] = np.rint(255.0 * total)
    return image, shares


def _mean_way(
    shares: NDArray[np.float64], front: NDArray[np.floating], back: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Mean of two depths, weighted with what each layer adds; infinite where neither is there."""
    ways = np.stack([front, back])
    weighted = (shares * np.where(np.isinf(ways), 0.0, ways)).sum(axis=0)
    return np.where(np.isinf(front), np.inf, weighted / np.maximum(shares.sum(axis=0), 1e-9))


def _finite(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.where(np.isinf(depth), np.nan, depth).astype(np.float32)
