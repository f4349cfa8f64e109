"""`Rendering`: a picture with its depths and its camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.camera import Camera

__all__ = ["Rendering"]


@dataclass
class Rendering:
    """A picture of a volume.

    Attributes
    ----------
    image : ndarray, shape (h, w, 4), uint8
        Red, green, blue and opacity, not premultiplied; row 0 is the top.
    depth : ndarray, shape (h, w), float32
        Way along the ray to the first hit in mm, see `Camera.position`; NaN where nothing is hit.
    expected_depth : ndarray, shape (h, w), float32
        Mean way in mm of all that the pixel shows, weighted with what each sample adds to it; NaN where nothing is.
    camera : Camera or None
        None where the picture is no projection (curved reformations).
    values : ndarray, shape (h, w), float32, or None
        HU of each pixel, for modes that show values (mip, minip, mean, slice, cpr); NaN outside of the volume.
    mode : str
    report : dict
        How it was made, free of patient data.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    expected_depth: NDArray[np.float32]
    camera: Camera | None
    values: NDArray[np.float32] | None = None
    mode: str = "dvr"
    report: dict[str, Any] = field(default_factory=dict)
