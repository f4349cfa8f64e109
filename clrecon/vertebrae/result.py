"""What the search for vertebrae found: the label map, each vertebra with its confidence, the discs, a middle plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.labels import LabelMap
from clrecon.system.messages import Message
from clrecon.system.records import Record


@dataclass(frozen=True, eq=False)
class Vertebra(Record):
    """One vertebra.

    Attributes
    ----------
    number : int
        Its number in the label map.
    name : str
    confidence : float
        The overlap (Dice) with the true vertebra that is to be expected, see docs/vertebrae.md; below 0.5 it is low.
    is_confident : bool
    doubts : list of str
        What is wrong with one of low confidence.
    whole : bool
        False where the scan cuts it.
    centre_mm : list of float
        Middle of its body, LPS mm.
    height_mm : float
        Distance of the planes above and below it, middle of disc to middle of disc.
    volume_ml : float
    """

    number: int
    name: str
    confidence: float
    is_confident: bool
    doubts: list[str]
    whole: bool
    centre_mm: list[float]
    height_mm: float
    volume_ml: float


@dataclass(frozen=True)
class MiddlePlane(Message):
    """The scan along the spine, straightened: what a picture of the result shows.

    A row is 1 mm along the canal, from the head downwards.

    Attributes
    ----------
    sagittal, coronal : ndarray, shape (n, columns), float32
        HU, columns 1 mm apart; NaN outside of the scan.  Sagittal: the front is on the left.  Coronal: through the
        bodies, the patient's right is on the left.
    sagittal_labels, coronal_labels : ndarray, shape (n, columns), int32
        Numbers of the vertebrae there, those of low confidence included.
    canal_column, middle_column : int
        Column of the canal in the sagittal picture, and of the canal in the coronal one.
    lines : list of ((row, column), (row, column))
        Planes between vertebrae in the sagittal picture, from the front wall of the body to the back wall.
    rows : list of float
        Row of the middle of each vertebra.
    """

    sagittal: NDArray[np.float32]
    coronal: NDArray[np.float32]
    sagittal_labels: NDArray[np.int32]
    coronal_labels: NDArray[np.int32]
    canal_column: int
    middle_column: int
    lines: list[tuple[tuple[float, float], tuple[float, float]]]
    rows: list[float]


@dataclass(frozen=True)
class VertebraSplit(Message):
    """The result of `clrecon.split_vertebrae`.

    Attributes
    ----------
    labels : LabelMap
        On the grid of the scan.  Those of low confidence are in it only where they are to be kept.
    vertebrae : list of Vertebra
        All that were found, from the head downwards.
    discs_mm : ndarray, shape (m, 3), float64
        Middles of the discs, LPS mm, from the head downwards.
    disc_normals : ndarray, shape (m, 3), float64
        Unit vectors square to the discs, downwards.
    level_hu : float
        Bone of the map is what is this dense, or enclosed by it.
    left_out : list of str
        What else was seen along the spine and is no vertebra of the map, such as the sacrum.
    plane : MiddlePlane
    """

    labels: LabelMap
    vertebrae: list[Vertebra]
    discs_mm: NDArray[np.float64]
    disc_normals: NDArray[np.float64]
    level_hu: float
    left_out: list[str]
    plane: MiddlePlane

    @property
    def low_confidence(self) -> list[Vertebra]:
        """The vertebrae of low confidence."""
        return [one for one in self.vertebrae if not one.is_confident]
