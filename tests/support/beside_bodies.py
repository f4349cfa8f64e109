"""Two legs on a table, and equipment beside them that is as hard as bone: rails, bars, clips, paddles."""

from __future__ import annotations

import numpy as np

from clrecon.geometry import Volume

SHAPE = (64, 110, 170)
AFFINE = np.array([[2.5, 0, 0, -211.25], [0, 2.5, 0, -136.25], [0, 0, 4.0, -126.0], [0, 0, 0, 1.0]])
Z, Y, X = np.meshgrid(*(AFFINE[2 - n, 3] + AFFINE[2 - n, 2 - n] * np.arange(SHAPE[n]) for n in range(3)), indexing="ij")
"""LPS mm of the voxels."""
RAIL_HU, METAL_HU, PLASTIC_HU = 1329.0, 3071.0, 100.0


def make_legs() -> tuple[np.ndarray, np.ndarray]:
    """HU of two legs, each with a hollow bone, on a table with foam, and the mask of the bones."""
    hu, bone = np.full(SHAPE, -1000.0), np.zeros(SHAPE, bool)
    for side in (-75.0, 75.0):
        hu[np.hypot(X - side, Y) < 58 - 0.06 * Z] = 50
        way = np.hypot(X - side * (1 + 0.0004 * Z), Y - 2)
        hu[way < 14], hu[way < 8] = 1300, -20
        bone |= (way < 14) & (way >= 8)
    top = ((abs(Y - 85) < 2.6) | (abs(Y - 110) < 2.6)) & (abs(X) < 190)
    hu[top & (hu < -500)] = 250
    hu[(abs(Y - 97.5) < 10) & (abs(X) < 188)] = -950
    return hu, bone


def box(centre: tuple[float, float, float], half: tuple[float, float, float], *, slant: float = 0.0) -> np.ndarray:
    """Mask of a box, mm; its middle moves by `slant` along x for each mm along z."""
    x, y, z = centre
    return (abs(X - x - slant * (Z - z)) < half[0]) & (abs(Y - y) < half[1]) & (abs(Z - z) < half[2])


def as_scan(hu: np.ndarray) -> Volume:
    """The HU with noise of 10 HU, as a scan."""
    noise = np.random.default_rng(1).normal(0, 10, SHAPE)
    return Volume(np.rint(hu + noise).astype(np.int16), AFFINE)
