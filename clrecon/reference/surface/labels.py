"""Twin of `clrecon.operators.surface.labels`: which samples are inside of a label, and its surface, in plain numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.labels.growth import Growth
from clrecon.labels.solid import fill_solid, find_boxes
from clrecon.reference.surface.extract import Surface, extract_inside, sample_grid


def own_labels(labels: NDArray[Any], volume: Volume, grow_mm: float | None) -> NDArray[np.uint16]:
    """Grow labels into samples without one.

    labels: ndarray, shape (nk, nj, ni). Labels on the grid of the volume; 0 is no label.
    grow_mm: A sample without a label gets the nearest label within this distance in mm, the lowest of equally near
        ones. None: the nearest, in mm, among its 26 neighbours.

    Returns: ndarray, shape (nk, nj, ni), uint16. A sample that has a label keeps it.
    """
    growth = Growth.of(volume, grow_mm)
    offsets, shells, reach = growth.offsets, growth.shells, growth.reach
    owner = labels.astype(np.uint16)
    none = 65_536
    padded = np.pad(labels.astype(np.int64), [(n, n) for n in reach[::-1]])
    padded[padded == 0] = none
    nk, nj, ni = labels.shape
    for shell in range(shells.max(initial=-1) + 1):
        nearest = np.full(labels.shape, none)
        for di, dj, dk in offsets[shells == shell] + np.array(reach):
            nearest = np.minimum(nearest, padded[dk : dk + nk, dj : dj + nj, di : di + ni])
        grown = (owner == 0) & (nearest < none)
        owner[grown] = nearest[grown]
    return owner


def find_solid(
    volume: Volume,
    labels: NDArray[Any],
    iso_value: float,
    *,
    grow_mm: float | None = None,
    closed: bool = True,
    solid: tuple[int, ...] = (),
) -> NDArray[np.uint16]:
    """Return for each sample the label that it is inside of: its owner where HU reach the iso value, 0 elsewhere."""
    rule = choose_iso_rule(volume, iso_value, closed)
    labels = labels.astype(np.uint16)
    inside = np.where(volume.voxels >= rule.lowest_inside, own_labels(labels, volume, grow_mm), 0).astype(np.uint16)
    for number, box in find_boxes(labels, solid, Growth.of(volume, grow_mm).reach).items():
        fill_solid(inside, labels, number, box, closed)
    return inside


def extract_label(
    volume: Volume, inside: NDArray[np.uint16], number: int, iso_value: float, *, closed: bool = True
) -> Surface:
    """Extract the surface of one label of a small volume.

    Where HU cross the iso level between a sample of the label and one without a label, the vertex lies there, as on the
    surface without labels.  Everywhere else (beside another label, or beside dense samples without a label) it lies
    half way, and its normal follows the label, not HU.

    inside: ndarray, shape (nk, nj, ni), uint16. Result of `find_solid`.
    iso_value: HU.

    Returns: As `clrecon.reference.surface.extract.extract_isosurface`.
    """
    rule = choose_iso_rule(volume, iso_value, closed)
    grown = np.pad(inside, rule.border)
    dense = sample_grid(volume, rule, rule.border) >= rule.lowest_inside
    if rule.closed:
        dense[[0, -1]] = dense[:, [0, -1]] = dense[:, :, [0, -1]] = False
    return extract_inside(
        volume, rule, grown == number, hu_places=(dense & (grown == number)) | ((grown == 0) & ~dense)
    )
