"""Settings of the vertebrae job, validated on construction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from clrecon.errors import UsageError
from clrecon.reading import Selection


@dataclass(frozen=True, kw_only=True)
class VertebraeSettings(Selection):
    """Settings of the search for vertebrae.

    series, phase, allow_gaps, force, follow_links, rescale: See `clrecon.reading.Selection`.
    level: HU from which on a voxel is bone, see `clrecon.split_vertebrae`.
    seeds: sequence of (x, y, z). Points in LPS mm, one in the body of each vertebra, in place of the search for discs.
    name_at: ((x, y, z), str). A point in LPS mm and the level of the vertebra there.
    first: Level of the uppermost vertebra that is found; not together with `name_at`.
    keep_unsure: Write vertebrae of low confidence too.
    keep_ids: Write the hashes of the UIDs of series and frame of reference into the report.
    """

    level: float | None = None
    seeds: Sequence[Sequence[float]] = ()
    name_at: tuple[Sequence[float], str] | None = None
    first: str | None = None
    keep_unsure: bool = False
    keep_ids: bool = False

    def __post_init__(self) -> None:
        from clrecon.spine.split import check_landmark

        if self.level is not None and not math.isfinite(self.level):
            raise UsageError(f"the level of bone is a number of HU, not {self.level!r}")
        points = [*self.seeds, *([] if self.name_at is None else [self.name_at[0]])]
        for point in points:
            if len(point) != 3 or not all(math.isfinite(value) for value in point):
                raise UsageError(f"a point is three numbers in mm, not {list(point)!r}")
        if len(self.seeds) == 1:
            raise UsageError("one seed is too few: give a point in each vertebra, two at least")
        check_landmark(self.name_at, self.first)
