"""Odd bodies for tests: small phantoms on tables, each made once a process, with the voxels of their bone."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.phantom import KINDS, MATERIALS, PhantomSettings, label_materials, make_phantom

COARSE = 2.8
"""Steps of a small phantom in those of its kind: 2.5 to 5 mm."""
FINER = dict.fromkeys(("bones", "limb", "skull", "skull-prone"), 2.3)
"""The same of those whose rims in the table, or whose table, are as thin as a coarse voxel, and of what lies beside."""

BODIES: dict[str, dict[str, Any]] = {
    "skull": {"kind": "skull", "table": "headrest"},
    "skull-prone": {"kind": "skull", "table": "flat", "prone": True},
    "head": {"kind": "head", "table": "headrest"},
    "bones": {"kind": "bones", "table": "flat"},
    "limb": {"kind": "limb", "table": "curved"},
    "pair": {"kind": "pair", "table": "flat"},
    "pelvis": {"kind": "pelvis", "table": "flat", "table_gap_mm": 6.0},
    "contrast": {"kind": "contrast", "table": "curved", "prone": True},
    "water": {"kind": "water", "table": "flat"},
    "empty": {"kind": "empty", "table": "flat"},
}
"""Settings of each body; those without a gap touch the table."""


@dataclass(frozen=True)
class OddBody:
    """A phantom with its truth.

    Attributes
    ----------
    settings : PhantomSettings
    volume : Volume
    labels : ndarray, shape (nk, nj, ni), uint8
        Place in `MATERIALS`.
    """

    settings: PhantomSettings
    volume: Volume
    labels: NDArray[np.uint8]

    def of(self, *materials: str) -> NDArray[np.bool_]:
        """Voxels of these materials."""
        return np.isin(self.labels, [MATERIALS.index(name) for name in materials])

    @property
    def dense(self) -> NDArray[np.bool_]:
        """Voxels above 300 HU that are of no table: bone, metal, contrast medium and their blurred edge."""
        return np.asarray((self.volume.voxels > 300) & ~self.of("table"))


def settings_of(name: str) -> PhantomSettings:
    """Settings of a small phantom of `BODIES`."""
    given = BODIES[name]
    coarse = FINER.get(name, COARSE)
    dj, di, dk = (coarse * step for step in KINDS[given["kind"]].spacing)
    columns, rows, slices = (round(extent / coarse) for extent in (258, 248, 97))  # in steps of its kind
    return PhantomSettings(size=(columns, rows), slices=slices, spacing=(dj, 1.04 * di, dk), **given)


@functools.cache
def make_odd(name: str) -> OddBody:
    """Make a body of `BODIES`; not to be changed."""
    settings = settings_of(name)
    voxels, affine, _ = make_phantom(settings)
    voxels.flags.writeable = False
    return OddBody(settings, Volume(voxels, affine), label_materials(settings))
