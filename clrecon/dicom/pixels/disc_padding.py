"""Padding that no header declares: one value everywhere outside of a round field of view.

Many cone-beam scanners write 0 there, which on their scale may be the value of tissue.  Nothing that was measured has
one value without noise everywhere outside of a circle, and nowhere inside along it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.pixels.padding import AIR_RANGE_HU, PaddingMasks, pack_mask

SMALLEST = 32
SAMPLED_SLICES = 16
ROUND = 0.03
"""Largest difference of the four radii along the middle row and column, as a share of the radius."""
OUTSIDE, RIM = 1.03, (0.9, 0.97)
"""Where all voxels have the value, and where hardly any has it, in radii."""
LEAST_PART, LEAST_OUTSIDE, MOST_IN_RIM, FEWEST_VALUES = 0.05, 0.999, 0.05, 16
"""Least share of a slice that lies outside, least share of it that has the value, largest share of the rim that has it,
and fewest values there.
"""


def fill_disc_padding(voxels: NDArray[Any]) -> tuple[float, int, float] | None:
    """Fill the outside of a round field of view of one value above air, as declared padding is filled.

    voxels: ndarray, shape (nk, nj, ni). Changed in place.

    Returns: (float, int, float) or None. The value, the number of its voxels outside, and what they were filled with;
        None where there is no such disc.
    """
    nk, nj, ni = voxels.shape
    value = voxels[0, 0, 0]
    if min(nj, ni) < SMALLEST or value <= AIR_RANGE_HU[1]:
        return None
    distance = _measure_disc(voxels[nk // 2] != value)
    if distance is None or not all(
        _is_disc(picture, value, distance) for picture in voxels[:: -(-nk // SAMPLED_SLICES)]
    ):
        return None
    masks = PaddingMasks(voxels)
    for k, picture in enumerate(voxels):
        masks.add(k, pack_mask((picture == value) & (distance >= RIM[1])))
    count, filled = masks.count, masks.fill()
    return float(value), count, float(value if filled is None else filled)


def _measure_disc(measured: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Return the distance of each pixel from the centre of a disc, in radii; None where no disc has these ends along
    the middle row and column, or leaves next to nothing outside.
    """
    nj, ni = measured.shape
    row, column = np.flatnonzero(measured[nj // 2]), np.flatnonzero(measured[:, ni // 2])
    if not len(row) or not len(column):
        return None
    radii = ((column[-1] - column[0] + 1) / 2.0, (row[-1] - row[0] + 1) / 2.0)
    j, i = np.ogrid[:nj, :ni]
    distance = np.hypot(j - (column[0] + column[-1]) / 2.0, i - (row[0] + row[-1]) / 2.0) / min(radii)
    is_round = abs(radii[0] - radii[1]) <= ROUND * min(radii)
    return distance if is_round and np.mean(distance > OUTSIDE) >= LEAST_PART else None


def _is_disc(picture: NDArray[Any], value: Any, distance: NDArray[np.float64]) -> bool:
    """True where a slice has the value everywhere outside, and other ones of many kinds within."""
    within = picture[(distance > RIM[0]) & (distance < RIM[1])]
    return bool(
        np.mean(picture[distance > OUTSIDE] == value) >= LEAST_OUTSIDE
        and np.mean(within == value) <= MOST_IN_RIM
        and len(np.unique(within)) >= FEWEST_VALUES
    )
