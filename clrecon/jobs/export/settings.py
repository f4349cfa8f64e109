"""Settings of the export job, validated on construction."""

from __future__ import annotations

from dataclasses import dataclass

from clrecon.jobs.shared.settings import InputSettings


@dataclass(frozen=True, kw_only=True)
class ExportSettings(InputSettings):
    """Settings of the export job.

    resample: Resample to a regular grid with this step in mm, see `clrecon.geometry.resample.resample_volume`; None:
        voxels stay as they are.
    space: {"lps", "ras"}. Patient frame of the numbers of crop and region.  The frame of the file is that of its
        format.
    **shared: See `clrecon.jobs.shared.settings.InputSettings`.
    """

    resample: float | None = None
    space: str = "lps"

    def __post_init__(self) -> None:
        super().__post_init__()
        from clrecon.geometry.frames import frame_from_lps
        from clrecon.geometry.resample import check_step

        frame_from_lps(self.space)
        if self.resample is not None:
            check_step(self.resample)

    @property
    def needs_device(self) -> bool:
        """True where the region or a step of preprocessing runs on a device."""
        return bool(self.region) or self.preprocess is not None
