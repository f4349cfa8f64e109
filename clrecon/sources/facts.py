"""What was seen in the voxels of an input while they were read."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PixelFacts:
    """Figures of the pixels that were read.

    padding_share: Share of the voxels, 0 to 1.
    hu_min, hu_max: Lowest and highest HU of the volume, padding included.
    padding_hu: HU that padding was filled with; None without padding.
    stray: Number of values that lost bits of their own, see `clrecon.dicom.pixels.stray_bits`.
    stray_text: One line about these values; empty if there are none.
    padding_text: One line about padding that no header declares and that was found by its shape, or about declared
        padding that masks tissue; empty if there is none.
    """

    padding_share: float
    hu_min: float
    hu_max: float
    padding_hu: float | None = None
    stray: int = 0
    stray_text: str = ""
    padding_text: str = ""
