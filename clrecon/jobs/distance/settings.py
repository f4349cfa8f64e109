"""Settings of the job of distances, validated on construction."""

from __future__ import annotations

import math
from dataclasses import dataclass

from clrecon.errors import UsageError
from clrecon.geometry import frame_from_lps
from clrecon.mesh.compare.distances import SAMPLES
from clrecon.rendering.views.directions import find_view

MOST_SAMPLES = 10_000_000


@dataclass(frozen=True, kw_only=True)
class DistanceSettings:
    """Settings of the job.

    mesh_space: {"lps", "ras"}. Patient frame of files that do not name theirs; None: LPS, with a warning.
    samples: Points on each surface.
    range_mm: Distance at which the colours end; None: chosen from the distances.
    view: View of the picture, see `clrecon.Camera.fit`.
    space: {"lps", "ras"}. Patient frame of the coloured mesh.
    device: Name or index of an OpenCL device, for the picture.
    memory: Most bytes on the device.
    """

    mesh_space: str | None = None
    samples: int = SAMPLES
    range_mm: float | None = None
    view: str = "anterior"
    space: str = "lps"
    device: str | None = None
    memory: int | None = None

    def __post_init__(self) -> None:
        frame_from_lps(self.space)
        if self.mesh_space is not None:
            frame_from_lps(self.mesh_space)
        if not 1 <= self.samples <= MOST_SAMPLES:
            raise UsageError(f"distances need 1 to {MOST_SAMPLES:,} samples on each mesh, not {self.samples:,}")
        if self.range_mm is not None and not (math.isfinite(self.range_mm) and self.range_mm > 0.0):
            raise UsageError(f"the colours span a number of mm above 0, not {self.range_mm:g}")
        find_view(self.view)
