"""What a reader found in a file of a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Part", "RawMesh"]


@dataclass(frozen=True)
class Part:
    """An object of a file: its triangles follow those of the part before it.

    Attributes
    ----------
    name : str
        Empty where the file gives none.
    triangles : int
    color : (float, float, float) or None
        Red, green and blue, 0 to 1, as on a screen (sRGB).
    """

    name: str
    triangles: int
    color: tuple[float, float, float] | None = None


@dataclass
class RawMesh:
    """A file's triangles, in the file's own frame.

    Attributes
    ----------
    kind : str
        "STL", "PLY", "OBJ", "GLB", "3MF" or "VTP".
    vertices : ndarray, shape (n, 3), of any real type
        mm, placed as the file says; perhaps not finite.
    triangles : ndarray, shape (m, 3), integer
        Perhaps of vertices that are not there.
    normals : ndarray, shape (n, 3), float32, or None
    space : str or None
        Frame that the file names.
    iso_value_hu : float or None
    certificate : sequence of str
    warnings : list of str
    unit : str
        Unit of the lengths in the file.
    parts : sequence of Part
        Empty where the file has no objects.
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
