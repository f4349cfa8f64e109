"""Pictures of a comparison: what each method made from one camera, and how it differs from the reference."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import ClreconError
from clrecon.geometry import Volume
from clrecon.operators.rays.mesh_pictures import box_around
from clrecon.rendering.pictures.likeness import measure_pictures
from clrecon.rendering.views.camera import Camera

VIEW = "anterior"
SIZE = (480, 480)
QUALITY = 80
"""Of WebP; PNG beside the page is exact."""

Image = NDArray[np.uint8]


def choose_camera(volume: Volume, box: NDArray[np.float64]) -> dict[str, Any]:
    """Return the parameters of the camera that looks at what is inside.

    box: ndarray, shape (2, 3). Lowest and highest index (i, j, k), see `clrecon.jobs.compare.contours.find_planes`.
    """
    low, high = box
    ends = np.stack([low - 1.0, high + 1.0])
    places = volume.ijk_to_lps([[ends[bit >> axis & 1, axis] for axis in range(3)] for bit in range(8)])
    camera = Camera.fit(box_around([places]), VIEW, size=SIZE)
    return {
        "position": list(camera.position),
        "focal_point": list(camera.focal_point),
        "up": list(camera.up),
        "parallel_scale": camera.parallel_scale,
    }


def compare_pictures(pictures: Mapping[str, Image], reference: str) -> dict[str, dict[str, float]]:
    """Return ``mse`` and ``ssim`` of each picture to that of the reference; without one, nothing."""
    if reference not in pictures:
        return {}
    found = {}
    for name, picture in pictures.items():
        try:
            like = measure_pictures(picture, pictures[reference])
        except ClreconError:  # nothing is drawn in either
            continue
        found[name] = {"mse": like.mse, "ssim": like.ssim}
    return found


def difference_of(picture: Image, reference: Image) -> Image:
    """Return where two pictures differ, shape (h, w): black where they do not, white from a quarter of the range on."""
    apart = np.abs(picture.astype(np.int16) - reference).max(axis=2)
    return np.asarray(np.minimum(4 * apart, 255), dtype=np.uint8)


def save_png(image: Any, path: Path) -> None:
    """Write a picture, an array or Pillow's, as PNG."""
    _as_pillow(image).save(path, "PNG", optimize=True)


def embed(image: Any) -> str:
    """Return a picture as the address of a WebP inside the page."""
    stream = io.BytesIO()
    _as_pillow(image).save(stream, "WEBP", quality=QUALITY, method=4)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _as_pillow(image: Any) -> Any:
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    from PIL import Image as Pillow

    return Pillow.fromarray(image) if isinstance(image, np.ndarray) else image
