"""Settings of the job that looks into vertebrae, validated on construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from clrecon.errors import UsageError
from clrecon.jobs.inside.pictures import DEFAULT_VIEW
from clrecon.reading import Selection
from clrecon.system.arguments import name_parameter


@dataclass(frozen=True, kw_only=True)
class InsideSettings(Selection):
    """Settings of the job.

    series, phase, allow_gaps, force, follow_links, rescale: See `clrecon.reading.Selection`.
    labels: Label map: NIfTI, NRRD, MetaImage, DICOM SEG or RTSTRUCT.
    only: The vertebrae, by numbers or names of their labels.
    iso_value: HU of the solid bone; None: the labels' own voxels.
    dense: (low, high). Band of dense bone, HU; None leaves an end open.  Default:
        `clrecon.operators.vertebrae.inside.DENSE_HU`.
    close_mm: Radius that closes the solid bone.  Default: `clrecon.operators.vertebrae.solid.CLOSE_MM`.
    grow_mm: Distance of growth with an iso value, see `clrecon.extract_labels`.
    space: {"lps", "ras"}. Patient frame of the meshes.
    view: View of the pictures, see `clrecon.Camera.fit`.
    keep_ids: Write the hashes of the UIDs of series and frame of reference into the report and the mesh files.
    device: Name or index of an OpenCL device.
    memory: Most bytes on the device.
    """

    labels: str | Path
    only: Sequence[str | int]
    iso_value: float | None = None
    dense: Sequence[float | None] | None = None
    close_mm: float | None = None
    grow_mm: float | None = None
    space: str = "lps"
    view: str = DEFAULT_VIEW
    keep_ids: bool = False
    device: str | None = None
    memory: int | None = None

    def __post_init__(self) -> None:
        from clrecon.geometry import frame_from_lps

        frame_from_lps(self.space)
        if not self.only:
            raise UsageError(f"choose the vertebrae by their labels: {name_parameter('only', 'L3')}")
        if self.memory is not None and self.memory < 1:
            raise UsageError(f"the memory that may be taken must be above 0 bytes, not {self.memory}")
        if self.grow_mm is not None and self.iso_value is None:
            raise UsageError(
                f"the labels' own voxels do not grow: leave {name_parameter('grow_mm')} out, or give an iso value"
                f" ({name_parameter('iso_value', 'N')})"
            )
