"""Settings that every job shares: which scan, which parts of it become air, and which device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from clrecon.errors import UsageError
from clrecon.reading import Selection

if TYPE_CHECKING:
    from clrecon.geometry.boxes import Box


@dataclass(frozen=True, kw_only=True)
class InputSettings(Selection):
    """Settings of the input: what is read, which parts become air, and the device for the computation.

    series, phase, allow_gaps, force, follow_links, rescale: See `clrecon.reading.Selection`.
    remove_table: First turn everything except the patient's body into air, see `clrecon.anatomy.body.remove_table`.
    allow_bone_loss: Continue even if this removes more than 2 % of the bone, or `preprocess` more than half of what is
        at the level and above.
    field_of_view: float or "auto". First turn everything farther from the centre of the slices (mm) into air; "auto":
        the circle that fits them.
    clip_box: (x0, x1, y0, y1, z0, z1). Crop the scan to a box by whole voxels, see `clrecon.geometry.crop.crop_volume`;
        infinite numbers leave a side open.  mm of the frame `space` where the job has one, else LPS; so are the next
        two.
    between: (z0, z1). Crop it to these heights.
    around: (x, y, z, r). Crop it to a cube around a point; `r` is half of its side.
    region: Rules of the region of interest, outside of which everything becomes air, see
        `clrecon.jobs.shared.region_rules.parse_region_rules`; mm of the frame `space` where the job has one, else LPS.
    preprocess: Steps before the surface, see `clrecon.jobs.shared.preprocess_steps.parse_preprocess`.
    keep_ids: Write the hashes of the UIDs of series and frame of reference into reports and mesh files.
    device: Name or index of an OpenCL device; None leaves the choice to `choose_device`.
    memory: Bytes that may be taken on the device; None is all that it has.  A volume that does not fit is processed in
        slabs.
    """

    remove_table: bool = False
    allow_bone_loss: bool = False
    field_of_view: float | str | None = None
    clip_box: Sequence[float] | None = None
    between: Sequence[float] | None = None
    around: Sequence[float] | None = None
    region: Sequence[str] | None = None
    preprocess: str | Sequence[str] | None = None
    keep_ids: bool = False
    device: str | None = None
    memory: int | None = None

    def __post_init__(self) -> None:
        if self.memory is not None and self.memory < 1:
            raise UsageError(f"the memory that may be taken must be above 0 bytes, not {self.memory}")
        if isinstance(self.field_of_view, str):
            if self.field_of_view != "auto":
                raise UsageError(f"the field of view is a radius in mm or auto, not {self.field_of_view!r}")
        elif self.field_of_view is not None and not (math.isfinite(self.field_of_view) and self.field_of_view > 0.0):
            raise UsageError(f"the radius of the field of view is a length in mm above 0, not {self.field_of_view:g}")
        if self.allow_bone_loss and not (self.remove_table or self.preprocess is not None):
            raise UsageError(
                "a loss of bone is allowed, but nothing takes any: ask for the removal of the table or for"
                " preprocessing too"
            )
        _ = self.crop
        self._check_region()

    def _check_region(self) -> None:
        from clrecon.jobs.shared.region_rules import parse_region_rules

        if self.region:
            parse_region_rules(self.region)
        if self.region_later and not self.region:
            raise UsageError("a step of preprocessing is the region of interest, and there is none: give its rules")

    @property
    def crop(self) -> Box | None:
        """The box that the scan is cropped to; None without a crop."""
        from clrecon.geometry.boxes import crop_box  # loads numpy, which the help does without

        return crop_box(self.clip_box, self.between, self.around)

    @property
    def crop_margin(self) -> int:
        """Voxels that stay beyond the box on each side."""
        return 0

    @property
    def region_later(self) -> bool:
        """True where the region of interest is a step of preprocessing, and does not come before."""
        from clrecon.jobs.shared.preprocess_steps import parse_preprocess

        return self.preprocess is not None and any(step.name == "region" for step in parse_preprocess(self.preprocess))

    @property
    def space_of_points(self) -> str:
        """Patient frame of the region's numbers: that of what is written, LPS where a job has none."""
        return str(getattr(self, "space", "lps"))
