"""`VolumeContent`: what a volume file holds, in plain values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array
from clrecon.system.progress import Progress

PACKING = 1
"""Level of gzip, as nibabel has it.  Level 6 takes four times as long for a tenth of the bytes."""


@dataclass(frozen=True, eq=False)
class VolumeContent:
    """What a volume file holds.

    voxels: ndarray, shape (nk, nj, ni). int16, int32 or float32.
    affine: ndarray, shape (4, 4), float64. Index (i, j, k) to LPS mm.
    lines: The certificate, plain ASCII, one fact a line: name, blank, value.
    progress: ``progress("write", done, total)``.
    """

    voxels: NDArray[Any]
    affine: Float64Array
    lines: tuple[str, ...]
    progress: Progress
