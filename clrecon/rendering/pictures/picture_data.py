"""`PictureData`: the plain values of a picture, which `Rendering` writes, annotates and puts into scenes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.rendering.views.camera import Camera
from clrecon.system.base_classes import Message


@dataclass
class PictureData(Message):
    """Pixels, depths and camera of a picture; see `clrecon.rendering.Rendering` for each attribute."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    expected_depth: NDArray[np.float32]
    camera: Camera | None
    values: NDArray[np.float32] | None = None
    mode: str = "dvr"
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.image.shape[1], self.image.shape[0]

    @property
    def pixel_mm(self) -> float | None:
        """Side of a pixel in mm; None if it varies within the picture (perspective)."""
        if self.camera is not None:
            return self.camera.pixel_mm(self.size) if self.camera.is_parallel else None
        told = self.report.get("pixel_mm")
        return None if told is None else float(told)

    @property
    def is_opaque(self) -> bool:
        """True if no pixel is transparent, not even partly."""
        return bool((self.image[..., 3] == 255).all())
