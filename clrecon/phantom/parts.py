"""The parts of a planned spine, in mm about the centre of the volume.

Axes are the patient's: x to the left, y to the posterior, z to the superior.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clrecon.phantom.outline import Outline

Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class Vertebra:
    """One level: its frame and its sizes.

    center: ndarray, shape (3,). Middle of the vertebral body, mm.
    axes: ndarray, shape (3, 3). Rows are the local left, posterior and superior directions.
    width, depth, height, canal_half_width, canal_half_depth: mm.
    lumbar: 0 thoracic shape to 1 lumbar shape of the processes.
    waves: ndarray, shape (n, 5). Trabecular texture, see `clrecon.phantom.fields.waves_at`.
    room: mm by which upper and lower articular processes lie farther apart than in a spine without a choice of levels,
        in which neighbours nearly touch.
    facets: ndarray, shape (m, 4). Balls (x, y, z, radius; local mm) that widen the upper articular processes.
    """

    name: str
    center: Float64Array
    axes: Float64Array
    width: float
    depth: float
    height: float
    canal_half_width: float
    canal_half_depth: float
    lumbar: float
    waves: Float64Array
    room: float = 0.0
    facets: Float64Array = field(default_factory=lambda: np.zeros((0, 4)))

    @property
    def is_cervical(self) -> bool:
        """True for C1 to C7."""
        return self.name[0] == "C"

    def to_patient(self, local: tuple[float, float, float]) -> Float64Array:
        """Map a local point to mm of the plan."""
        return self.center + np.array(local) @ self.axes


@dataclass(frozen=True)
class Disc:
    """Disc between two bodies: an elliptic cylinder from the centre of one to the centre of the other."""

    center: Float64Array
    axes: Float64Array
    half_width: float
    half_depth: float
    half_length: float


@dataclass(frozen=True)
class Rib:
    """A rib as a chain of points, shape (n, 3), from its head at the spine to its end."""

    name: str
    points: Float64Array


@dataclass(frozen=True)
class Anatomy:
    """All parts of the spine phantom.

    half_width, half_depth: Half axes of the body outline about x = y = 0.
    curve_x, curve_y: Polynomials (highest power first) in z / 100 mm: centre line of the vertebral bodies.
    curve_z: (low, high). Range in which the polynomials hold.
    marker: ndarray, shape (3,). Centre of the small metal ball on the patient's left.
    absent: Parts left out on purpose.
    centres: Middle of the body of every planned level, shown or not.
    outline: Where the body's outline is not that of a straight trunk.
    """

    vertebrae: list[Vertebra]
    discs: list[Disc]
    ribs: list[Rib]
    half_width: float
    half_depth: float
    curve_x: Float64Array
    curve_y: Float64Array
    curve_z: tuple[float, float]
    marker: Float64Array
    marker_radius: float
    absent: list[str]
    centres: dict[str, Float64Array]
    outline: Outline | None = None

    def level_z(self, name: str) -> float:
        """Return z of the centre of a level's vertebral body."""
        return float(self.centres[name][2])
