"""The table of a paper: pictures of each method against a slice, by MSE and SSIM, beside pictures of nothing.

Reference: "CPU-GPU Rendering of CT Scan Images for Vertebra Reconstruction from CT Scan Images with a Calibration
Policy", Table 1 and Figures 10 and 11.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.jobs.compare.contours import to_grey
from clrecon.rendering.pictures.likeness import make_control_pictures, measure_pictures

MOST_PIXELS = 512

PAPER = {
    "skimage": {"method": "marching cubes, CPU", "seconds": 300.0},
    "vtk-mc": {"method": "marching cubes, GPU", "seconds": 2.0},
    "cloud": {"method": "affine point cloud", "seconds": 3.0},
    "rays": {"method": "ray casting, GPU", "seconds": 10.0, "later_s": 2.0},
    "rays-cpu": {"method": "ray casting, CPU", "seconds": 300.0},
}
"""What the paper says of its own methods, on its own machine and scan."""

CONTROLS = {
    "black": "all black",
    "white": "all white",
    "noise": "noise",
    "next": "the next slice",
    "shifted": "the slice, moved by 5 pixels",
}


def along_slices(volume: Volume) -> dict[str, Any]:
    """Return camera and size of a picture that looks along the slices, pixel for pixel with the middle one.

    The camera stands before the first slice; what runs along a row is to the right, as in the slice.
    """
    ni, nj, nk = volume.shape_ijk
    di, dj, _ = volume.spacing
    width = min(ni, MOST_PIXELS)
    height = max(7, round(nj * dj / (ni * di) * width))
    middle = volume.ijk_to_lps([[(ni - 1) / 2, (nj - 1) / 2, nk // 2]])[0]
    right, down = volume.affine[:3, 0] / di, volume.affine[:3, 1] / dj
    forward = np.cross(right, down)
    corners = [(i, j, k) for i in (0, ni - 1) for j in (0, nj - 1) for k in (0, nk - 1)]
    away = 1.5 * float(np.linalg.norm(volume.ijk_to_lps(corners) - middle, axis=1).max()) + 10.0
    camera = {
        "position": [float(x) for x in middle - away * forward],
        "focal_point": [float(x) for x in middle],
        "up": [float(x) for x in -down],
        "parallel_scale": 0.5 * nj * dj,
    }
    return {"camera": camera, "size": [width, height]}


def middle_slice(volume: Volume, size: tuple[int, int], offset: int = 0) -> NDArray[np.uint8]:
    """Return the middle slice, or one beside it, as grey values of the size of the pictures."""
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    from PIL import Image

    nk = volume.shape_ijk[2]
    grey = to_grey(volume.voxels[min(nk // 2 + offset, nk - 1)].astype(np.float64))
    return np.asarray(Image.fromarray(grey).resize(size, Image.Resampling.BILINEAR))


def measure_against_slice(
    volume: Volume, pictures: Mapping[str, NDArray[np.uint8]], size: tuple[int, int]
) -> dict[str, Any]:
    """Compare pictures of methods with the middle slice, and pictures that show what that is worth.

    pictures: mapping of str to ndarray, shape (height, width, 3), uint8
    size: (width, height)

    Returns: ``window_hu``, ``slice``; ``methods`` and ``controls``: ``ssim`` and ``mse`` by name.
    """
    wanted = middle_slice(volume, size)
    controls = make_control_pictures(wanted, middle_slice(volume, size, 1))

    def like(picture: NDArray[np.uint8]) -> dict[str, float]:
        grey = np.rint(picture.mean(axis=2)).astype(np.uint8) if picture.ndim == 3 else picture
        found = measure_pictures(grey, wanted, whole=True)
        return {"ssim": found.ssim, "mse": found.mse}

    return {
        "window_hu": [-200.0, 800.0],
        "slice": volume.shape_ijk[2] // 2,
        "methods": {name: like(picture) for name, picture in pictures.items()},
        "controls": {name: like(controls[name]) for name in CONTROLS if name in controls},
    }
