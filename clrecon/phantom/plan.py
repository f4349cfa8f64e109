"""The plan of the spine phantom: levels, curve, ribs and body outline, in mm about the centre of the volume.

Axes are the patient's: x to the left, y to the posterior, z to the superior.  Sizes are round figures of adult
anatomy (vertebral bodies 28 to 50 mm wide, 16 to 28 mm high, discs 4 to 11 mm), interpolated between levels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Anatomy", "Disc", "Rib", "Vertebra", "plan_anatomy"]

Float64Array = NDArray[np.float64]

LEVELS = tuple([f"T{n}" for n in range(1, 13)] + [f"L{n}" for n in range(1, 6)])
"""Vertebrae from top to bottom."""

_CENTRE_LEVEL = LEVELS.index("T12")
_KEYS = [LEVELS.index(name) for name in ("T1", "T6", "T12", "L1", "L3", "L5")]
_SIZES = {
    "width": (28.0, 29.0, 40.0, 42.0, 46.0, 50.0),
    "depth": (18.0, 25.0, 31.0, 33.0, 35.0, 36.0),
    "height": (16.5, 20.0, 25.0, 27.0, 28.5, 28.0),
    "disc": (4.0, 4.5, 6.5, 8.0, 10.5, 10.0),
    "canal_half_width": (9.0, 8.5, 11.0, 11.5, 12.0, 13.0),
    "canal_half_depth": (7.5, 7.5, 8.0, 8.5, 8.5, 8.5),
    # Lean of the upward axis towards the posterior: thoracic kyphosis, lumbar lordosis.
    "lean_degrees": (-20.0, -4.0, 10.0, 9.0, 1.0, -17.0),
}


@dataclass(frozen=True)
class Vertebra:
    """One level: its frame and its sizes.

    Attributes
    ----------
    name : str
    center : ndarray, shape (3,)
        Middle of the vertebral body, mm.
    axes : ndarray, shape (3, 3)
        Rows are the local left, posterior and superior directions.
    width, depth, height, canal_half_width, canal_half_depth : float
        mm.
    lumbar : float
        0 thoracic shape to 1 lumbar shape of the processes.
    waves : ndarray, shape (n, 5)
        Trabecular texture, see `clrecon.phantom.fields.waves_at`.
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

    Attributes
    ----------
    vertebrae, discs, ribs : lists, top to bottom
    half_width, half_depth : float
        Half axes of the body outline about x = y = 0.
    curve_x, curve_y : ndarray
        Polynomials (highest power first) in z / 100 mm: centre line of the vertebral bodies.
    curve_z : (low, high)
        Range in which the polynomials hold.
    marker : ndarray, shape (3,)
        Centre of the small metal ball on the patient's left.
    marker_radius : float
    absent : list of str
        Parts left out on purpose.
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

    def level_z(self, name: str) -> float:
        """Return z of the centre of a level's vertebral body."""
        return float(next(v.center[2] for v in self.vertebrae if v.name == name))


def _frame(lean: float, roll: float) -> Float64Array:
    """Return the rows local left, posterior and superior after a lean about x and a small roll about y, in radians."""
    superior = np.array((math.sin(roll), math.sin(lean), 0.0))
    superior[2] = math.sqrt(1.0 - superior @ superior)
    left = np.array((1.0, 0.0, 0.0)) - superior[0] * superior
    left /= np.linalg.norm(left)
    return np.array((left, np.cross(superior, left), superior))


def _trabecular_waves(generator: np.random.Generator, steps_mm: Float64Array) -> Float64Array:
    """Plane waves of 2 to 6 mm, mostly across the vertical trabeculae, with unit variance before sampling.

    Each wave is damped as averaging over a voxel would damp it, so that coarse voxels show less texture and no aliases.
    """
    count = 14
    direction = generator.normal(size=(count, 3)) * (1.0, 1.0, 0.5)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    vectors = direction * (2.0 * math.pi / generator.uniform(2.0, 6.0, count))[:, None]
    damping = np.prod(np.sinc(vectors @ steps_mm / (2.0 * math.pi)), axis=1)
    phase = generator.uniform(0.0, 2.0 * math.pi, count)
    return np.column_stack((vectors, phase, math.sqrt(2.0 / count) * damping))


def _plan_rib(vertebra: Vertebra, side: int, half_width: float, half_depth: float) -> Rib:
    """Return the points of a rib from the costovertebral joint round the chest wall, sloping down to the front."""
    number = int(vertebra.name[1:])
    side_name = "left" if side > 0 else "right"
    wall_x, wall_y = half_width - 24.0, half_depth - 21.0
    canal_y = vertebra.depth / 2.0 + vertebra.canal_half_depth
    head = vertebra.to_patient((side * (vertebra.width / 2.0 + 2.0), vertebra.depth * 0.38, vertebra.height * 0.36))
    tubercle = vertebra.to_patient((side * (vertebra.canal_half_width + 23.0), canal_y + 7.0, vertebra.height * 0.30))
    start = math.degrees(math.asin(min(0.85, (abs(tubercle[0]) + 17.0) / wall_x)))
    end = {11: 95.0, 12: 62.0}.get(number, 152.0)
    angles = np.radians(np.linspace(start, max(end, start + 12.0), 26))
    wall = np.stack((side * wall_x * np.sin(angles), wall_y * np.cos(angles), np.zeros_like(angles)), axis=1)
    wall[:, 2] = tubercle[2] - 3.0 - 0.42 * (np.degrees(angles) - start)
    chain = np.vstack((head, tubercle, wall))
    # two passes of corner cutting round the bends at the tubercle and the angle of the rib
    for _ in range(2):
        cut = np.empty((2 * len(chain) - 2, 3))
        cut[0::2] = 0.75 * chain[:-1] + 0.25 * chain[1:]
        cut[1::2] = 0.25 * chain[:-1] + 0.75 * chain[1:]
        chain = np.vstack((chain[:1], cut, chain[-1:]))
    return Rib(f"{side_name} rib {number}", chain[:: 3 if len(chain) > 60 else 2])


def plan_anatomy(field_of_view_mm: tuple[float, float, float], steps_mm: Float64Array, seed: int) -> Anatomy:
    """Lay out the phantom for a field of view.

    Parameters
    ----------
    field_of_view_mm : (width, depth, length)
        Extents of the volume along columns, rows and slices.  The body outline follows width and depth between
        the limits of a slim child and of an adult; bones keep their size.
    steps_mm : ndarray, shape (3, 3)
        Columns are the voxel steps in LPS mm.
    seed : int
        Small changes of position and the phases of the texture.

    Returns
    -------
    Anatomy
    """
    generator = np.random.default_rng((seed, 11))
    half_width = float(np.clip(min(0.45 * field_of_view_mm[0], 0.60 * field_of_view_mm[1]), 118.0, 160.0))
    half_depth = float(0.73 * half_width)
    sizes = {key: np.interp(np.arange(len(LEVELS)), _KEYS, values) for key, values in _SIZES.items()}
    leans = np.radians(sizes["lean_degrees"] + generator.normal(0.0, 0.6, len(LEVELS)))
    rolls = np.radians(generator.normal(0.0, 0.5, len(LEVELS)) + 1.5 * np.sin(np.arange(len(LEVELS)) * 0.7))

    frames = [_frame(lean, roll) for lean, roll in zip(leans, rolls, strict=True)]
    centres = np.zeros((len(LEVELS), 3))
    for n in range(1, len(LEVELS)):
        centres[n] = centres[n - 1] - frames[n - 1][2] * (sizes["height"][n - 1] / 2.0 + sizes["disc"][n - 1] / 2.0)
        centres[n] -= frames[n][2] * (sizes["height"][n] / 2.0 + sizes["disc"][n - 1] / 2.0)
    # tips of the spinous processes stay about 20 mm under the skin of the back
    anchor = np.array((1.7, half_depth - 21.0 - 67.0, -4.0))
    centres += anchor - centres[_CENTRE_LEVEL]

    vertebrae = [
        Vertebra(
            name=name,
            center=centres[n],
            axes=frames[n],
            width=float(sizes["width"][n]),
            depth=float(sizes["depth"][n]),
            height=float(sizes["height"][n]),
            canal_half_width=float(sizes["canal_half_width"][n]),
            canal_half_depth=float(sizes["canal_half_depth"][n]),
            lumbar=float(np.interp(n, (9, 12), (0.0, 1.0))),
            waves=_trabecular_waves(generator, frames[n] @ steps_mm),
        )
        for n, name in enumerate(LEVELS)
    ]
    discs = []
    for upper, lower in zip(vertebrae[:-1], vertebrae[1:], strict=True):
        gap = upper.center - lower.center
        length = float(np.linalg.norm(gap))
        axes = _frame(math.asin(gap[1] / length), math.asin(gap[0] / length))
        half = 0.515 * (upper.width + lower.width) / 2.0, 0.515 * (upper.depth + lower.depth) / 2.0
        discs.append(Disc((upper.center + lower.center) / 2.0, axes, half[0], half[1], length / 2.0))
    # the twelfth rib of the left side is absent: an image mirrored by mistake shows it absent on the right
    ribs = [
        _plan_rib(vertebra, side, half_width, half_depth)
        for vertebra in vertebrae
        for side in (1, -1)
        if vertebra.name[0] == "T" and (vertebra.name, side) != ("T12", 1)
    ]
    z = centres[:, 2] / 100.0
    # On the skin of the left flank, or as far left as a small field of view still shows.
    left = min(half_width + 1.0, 0.42 * field_of_view_mm[0])
    marker_y = 0.0 if left < half_width else half_depth * 0.1
    return Anatomy(
        vertebrae=vertebrae,
        discs=discs,
        ribs=ribs,
        half_width=half_width,
        half_depth=half_depth,
        curve_x=np.polyfit(z, centres[:, 0], 6),
        curve_y=np.polyfit(z, centres[:, 1], 6),
        curve_z=(float(centres[-1, 2]), float(centres[0, 2])),
        marker=np.array((left, marker_y, 0.0)),
        marker_radius=float(max(3.0, 0.9 * np.linalg.norm(steps_mm, axis=0).max())),
        absent=["left rib 12"],
    )
