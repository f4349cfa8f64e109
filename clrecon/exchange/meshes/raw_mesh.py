"""What a reader found in a file of a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Part:
    """An object of a file: its triangles follow those of the part before it.

    name: Empty where the file gives none.
    color: Red, green and blue, 0 to 1, as on a screen (sRGB).
    """

    name: str
    triangles: int
    color: tuple[float, float, float] | None = None


@dataclass
class RawMesh:
    """A file's triangles, in the file's own frame.

    kind: "STL", "PLY", "OBJ", "GLB", "3MF" or "VTP".
    vertices: ndarray, shape (n, 3), of any real type. mm, placed as the file says; perhaps not finite.
    triangles: ndarray, shape (m, 3), integer. Perhaps of vertices that are not there.
    normals: ndarray, shape (n, 3), float32, or None
    space: Frame that the file names.
    unit: Unit of the lengths in the file.
    parts: Empty where the file has no objects.
    """

    kind: str
    vertices: NDArray[Any]
    triangles: NDArray[Any]
    normals: NDArray[np.float32] | None = None
    space: str | None = None
    iso_value_hu: float | None = None
    certificate: Sequence[str] = ()
    warnings: list[str] = field(default_factory=list)
    unit: str = "mm"
    parts: Sequence[Part] = ()
