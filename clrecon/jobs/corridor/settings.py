"""Settings of the corridor job, validated on construction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clrecon.errors import UsageError
from clrecon.geometry import frame_from_lps
from clrecon.reading import Selection
from clrecon.system.arguments import name_parameter

LARGEST_MARGIN_MM = 5.0


@dataclass(frozen=True)
class CorridorFiles:
    """Outputs of the job.

    output: Meshes: the vertebra and a cylinder a side, in files of its name with those of label and side.
    picture: .png, .jpg or .tif; one for each vertebra.
    report: JSON.
    """

    output: str | Path | None = None
    picture: str | Path | None = None
    report: str | Path | None = None


@dataclass(frozen=True, kw_only=True)
class CorridorSettings(Selection):
    """Settings of the corridor job.

    series, phase, allow_gaps, force, follow_links, rescale: See `clrecon.reading.Selection`.
    labels: Label map of the vertebrae.
    only: Labels of the vertebrae that are looked at; at least one.
    iso_value: HU of the bone's surface; None: half way, measured in the scan.
    margin: Distance in mm that a screw of the largest diameter keeps from the surface.
    screws: Given screws, in mm of the frame `space` where they came from a command, else LPS.
    space: {"lps", "ras"}. Patient frame of the points in the report, of given screws, and of the meshes.
    keep_ids: Write the hashes of the UIDs of series and frame of reference into the report.
    device: For the mesh of the vertebra alone.
    memory: Bytes that may be taken on the device.
    """

    labels: str | Path
    only: tuple[str | int, ...]
    iso_value: float | None = None
    margin: float = 1.0
    screws: tuple[Any, ...] = ()
    space: str = "lps"
    keep_ids: bool = False
    device: str | None = None
    memory: int | None = None

    def __post_init__(self) -> None:
        if not self.only:
            raise UsageError(f"name the vertebrae: {name_parameter('only', 'L3')}, once for each")
        if not (math.isfinite(self.margin) and 0.0 <= self.margin <= LARGEST_MARGIN_MM):
            raise UsageError(f"the margin is a length from 0 to {LARGEST_MARGIN_MM:g} mm, not {self.margin:g}")
        if self.iso_value is not None and not math.isfinite(self.iso_value):
            raise UsageError(f"the level is a finite number of HU, not {self.iso_value}")
        frame_from_lps(self.space)
