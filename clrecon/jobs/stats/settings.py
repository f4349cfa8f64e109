"""Settings of the job of statistics, validated on construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from clrecon.labels.statistics import PERCENTILES, check_percentiles
from clrecon.reading import Selection


@dataclass(frozen=True, kw_only=True)
class StatsSettings(Selection):
    """Settings of the job.

    series, phase, allow_gaps, force, follow_links, rescale: See `clrecon.reading.Selection`.
    labels: Label map: NIfTI, NRRD, MetaImage, DICOM SEG or RTSTRUCT.
    only: Labels that are measured; none: all.
    percentiles: From 0 to 100.
    keep_ids: Write the hashes of the UIDs of series and frame of reference into the report.
    """

    labels: str | Path
    only: Sequence[str | int] = ()
    percentiles: Sequence[float] = PERCENTILES
    keep_ids: bool = False

    def __post_init__(self) -> None:
        check_percentiles(self.percentiles)
