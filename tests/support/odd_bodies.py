"""Odd bodies for tests: small phantoms on tables with the voxels of their bone, each made once for all processes."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from made_once import make_once
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.labels import read_labels
from clrecon.proof.phantom import KINDS, MATERIALS, PhantomSettings, write_phantom
from clrecon.reading import read_volume

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
"""Settings of each body; those without a gap touch the table.

Contrast medium has up to 461 HU, bone of a trunk or a pelvis up to 841, but for what metal of 3071 HU blurs into.
"""


@dataclass(frozen=True)
class OddBody:
    """A phantom with its truth.

    labels: (nk, nj, ni) uint8, place in `MATERIALS`.
    """

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


def write_odd(folder: Path, name: str) -> Path:
    """The series of a body of `BODIES` in `folder`, which processes share: who asks first makes it."""
    return make_once(folder, name, lambda path: write_phantom(path, settings_of(name)))


@functools.cache
def read_odd(folder: Path, name: str) -> OddBody:
    """A body of `BODIES`; not to be changed."""
    series = write_odd(folder, name)
    volume, labels = read_volume(series), read_labels(series / "materials.nrrd").voxels
    volume.voxels.flags.writeable = False
    return OddBody(Volume(volume.voxels, volume.affine), labels)


class OddBodies:
    """What the fixture `odd` gives: bodies by name, as series and as voxels."""

    def __init__(self, folder: Path):
        self._folder = folder

    def series(self, name: str) -> Path:
        return write_odd(self._folder, name)

    def __getitem__(self, name: str) -> OddBody:
        return read_odd(self._folder, name)
