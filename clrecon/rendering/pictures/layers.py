"""Merging of a picture and a scene from the same camera, pixel by pixel, without PyVista or a screen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.rendering.pictures.picture import Rendering


def merge_layers(rendering: Rendering, colors: NDArray[np.uint8], depth: NDArray[np.floating]) -> Rendering:
    """Merge a picture and a scene from the same camera: the nearer one covers the farther one.

    Each pixel of the picture is one layer at its expected depth.  A mesh within translucent tissue is therefore drawn
    wholly before or wholly behind the tissue.

    rendering: The picture, with a transparent background.
    colors: ndarray, shape (h, w, 4), uint8. The scene: red, green, blue and opacity, not premultiplied; row 0 is the
        top.
    depth: ndarray, shape (h, w), floating. Depths of the scene in mm, as in `Rendering.depth`; NaN where the scene is
        empty.

    Returns: The merged picture.  Both of its depths include the scene; `values` is None.
    """
    width, height = rendering.size
    if colors.shape != (height, width, 4) or depth.shape != (height, width):
        raise UsageError(
            f"the picture has {width} x {height} pixels, the scene {colors.shape} colours and {depth.shape} depths"
        )
    nothing = np.isnan(rendering.expected_depth)
    if (rendering.image[nothing, 3] == 255).any():  # little opacity without a depth: not yet a background
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
    """Blend one picture over another, both not premultiplied; also return their weights (2, h, w), 0 to 1."""
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
    """Mean of two depths, weighted with the share of each layer; infinite where both layers are empty."""
    ways = np.stack([front, back])
    weighted = (shares * np.where(np.isinf(ways), 0.0, ways)).sum(axis=0)
    return np.where(np.isinf(front), np.inf, weighted / np.maximum(shares.sum(axis=0), 1e-9))


def _finite(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.where(np.isinf(depth), np.nan, depth).astype(np.float32)
