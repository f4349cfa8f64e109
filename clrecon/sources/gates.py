"""Gates that hold the spacing and the values of every input against what scanners have."""

from __future__ import annotations

from collections.abc import Sequence

from clrecon.sources.facts import PixelFacts
from clrecon.system.records import Gate, none_of

PADDING_SHARE = 0.75
"""Largest share of padding.  A circle in its square leaves 0.21, a 500 mm circle in a field of 800 mm 0.69; above that
a wrong PixelPaddingValue probably masks measured voxels."""
PIXEL_MM = (0.005, 10.0)
"""Range of pixel sizes: from the finest micro-CT in use to attenuation maps of PET and SPECT."""
GAP_MM = (0.005, 50.0)
LOWEST_HU, DENSEST_HU = (-10_000.0, 1000.0), (-900.0, 70_000.0)
"""Ranges of the lowest and the densest voxel.  Undeclared padding goes down to -8192; a cut-out of bone has spongy
parts.  A densest voxel below -900 is air; 16 bits end at 65535."""


def judge_steps(pixels_mm: Sequence[float], gap_mm: float | None) -> Gate:
    """Judge whether pixels and gaps have sizes of real scanners: a mesh a thousand times too large looks like any
    other.
    """
    (low, high), (gap_low, gap_high) = PIXEL_MM, GAP_MM
    odd = [f"pixels of {mm:g} mm" for mm in sorted(set(pixels_mm)) if not low <= mm <= high]
    if gap_mm is not None and not gap_low <= gap_mm <= gap_high:
        odd.append(f"gaps of {gap_mm:g} mm")
    what = f"spacings that no scanner has, outside of {low:g} to {high:g} mm, gaps up to {gap_high:g} mm"
    return none_of("plausible_spacing", len(odd), f"{what} ({', '.join(odd)})" if odd else what)


def list_odd_values(facts: PixelFacts) -> list[str]:
    """Return the lowest and the densest voxel if they lie outside the range of every CT."""
    return [
        f"{name} voxel {value:g} HU, expected {low:g} to {high:g}"
        for name, value, (low, high) in (("lowest", facts.hu_min, LOWEST_HU), ("densest", facts.hu_max, DENSEST_HU))
        if not low <= value <= high
    ]


def judge_figures(odd: Sequence[str]) -> Gate:
    """Judge the gate ``plausible_hu``, given the unusual figures."""
    what = "figures of HU that no CT has"
    return none_of("plausible_hu", len(odd), f"{what} ({'; '.join(odd)})" if odd else what)
