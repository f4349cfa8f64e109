"""The parts of a planned spine and the outline of its body: levels, and the chain of vertebrae, straight or bent.

Numbers are those of the VerSe data set (Sekuboyina et al., Medical Image Analysis 73, 2021): 1 to 7 are C1 to C7, 8 to
19 are T1 to T12, 20 to 24 are L1 to L5.

Axes are the patient's: x to the left, y to the posterior, z to the superior.  Sizes are round figures of adult
anatomy (bodies of the chest and loin 28 to 50 mm wide and 16 to 28 mm high, discs 4 to 11 mm, interpolated between
levels; the neck is that of a small adult)."""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array

THORACOLUMBAR = tuple([f"T{n}" for n in range(1, 13)] + [f"L{n}" for n in range(1, 6)])
"""Vertebrae of chest and loin from top to bottom: those of a spine phantom without a choice of levels."""

LEVELS = (*(f"C{n}" for n in range(1, 8)), *THORACOLUMBAR)
"""All vertebrae from top to bottom."""

_LONGEST = 200


def level_number(name: str) -> int:
    """Return the number of a level, 1 (C1) to 24 (L5)."""
    return LEVELS.index(name) + 1


def _parse_level(text: str, whole: str) -> int:
    name = text.strip().upper()
    if name not in LEVELS:
        known = text.strip()[:20]
        raise UsageError(f"levels {whole!r}: {known!r} is no level; there are C1 to C7, T1 to T12 and L1 to L5")
    return LEVELS.index(name)


def parse_levels(text: str) -> tuple[str, ...]:
    """Read a choice of levels such as ``"L1-L5"``, ``"C3"`` or ``"C3-C7,T1-T5"``: levels, and ranges from the upper to
    the lower one, in any order; each once, from top to bottom.
    """
    if not isinstance(text, str) or len(text) > _LONGEST or not re.fullmatch(r"[ -~]+", text):
        raise UsageError("levels are a text like C1-L5, L4-L5 or C3-C7,T1-T5")
    chosen: list[int] = []
    for part in text.split(","):
        ends = [_parse_level(end, text) for end in part.split("-")]
        if len(ends) > 2:
            raise UsageError(f"levels {text!r}: {part.strip()!r} is no range; a range has two ends, like C3-C7")
        if ends[0] > ends[-1]:
            turned = f"{LEVELS[ends[-1]]}-{LEVELS[ends[0]]}"
            raise UsageError(f"levels {text!r}: {part.strip()!r} runs upwards; name the upper level first: {turned}")
        chosen += range(ends[0], ends[-1] + 1)
    twice = sorted({LEVELS[n] for n in chosen if chosen.count(n) > 1}, key=LEVELS.index)
    if twice:
        raise UsageError(f"levels {text!r} name {', '.join(twice)} more than once")
    return tuple(LEVELS[n] for n in sorted(chosen))


def format_levels(names: tuple[str, ...]) -> str:
    """Return levels as the shortest text that `parse_levels` reads: ``"C3-T5,L1"``."""
    numbers = [LEVELS.index(name) for name in names]
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ",".join(LEVELS[p[0]] if len(p) == 1 else f"{LEVELS[p[0]]}-{LEVELS[p[-1]]}" for p in parts)


_KEYS = [THORACOLUMBAR.index(name) for name in ("T1", "T6", "T12", "L1", "L3", "L5")]
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
_NECK = {
    # C1 has no body: these are sizes of the space that its ring leaves to the dens and the cord
    "width": (17.0, 17.0, 16.5, 17.0, 17.5, 19.0, 21.5),
    "depth": (14.0, 14.5, 14.5, 14.5, 15.0, 15.5, 16.0),
    "height": (10.0, 16.5, 10.2, 10.0, 10.0, 10.4, 11.8),
    "disc": (4.0, 3.3, 3.3, 3.3, 3.3, 3.5, 3.8),
    "canal_half_width": (14.0, 12.0, 11.5, 11.8, 12.0, 11.8, 11.0),
    "canal_half_depth": (11.0, 8.6, 7.4, 7.2, 7.2, 7.2, 7.2),
    "lean_degrees": (6.0, 5.0, 2.0, -3.0, -8.0, -13.0, -17.0),
}
"""Sizes of C1 to C7; `disc` is the height of the one below."""

_ANCHOR_LEVEL = "T12"


@dataclass(frozen=True)
class SpineChoice:
    """What is chosen of a spine: its levels, from top to bottom, its bend and its facets.

    kyphosis_deg, scoliosis_deg: Angle between the first and the last chosen level that is added to the natural one, in
        the sagittal plane (positive: the back is round) and in the coronal plane (positive: the middle lies to the
        left).
    facet_gap_mm: Distance of neighbouring vertebrae in their facet joints; None: the shapes' own, 2 mm and more.
    centred: True: the levels are put into the middle of the volume; False: T12 is, as without a choice.
    normal: (x, y, z). Normal of the slices.
    length_mm: Length of the volume along `normal`; None: as long as the chosen levels need.
    """

    levels: tuple[str, ...]
    kyphosis_deg: float = 0.0
    scoliosis_deg: float = 0.0
    facet_gap_mm: float | None = None
    centred: bool = True
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    length_mm: float | None = None

    @property
    def is_bent(self) -> bool:
        """True where the spine has another curve than the natural one."""
        return self.kyphosis_deg != 0.0 or self.scoliosis_deg != 0.0


@dataclass(frozen=True)
class Chain:
    """All planned levels: sizes in mm, frames (rows are the local left, posterior and superior directions), the middle
    of each body, (n, 3) mm, and how far the bend has moved it.
    """

    names: tuple[str, ...]
    sizes: dict[str, Float64Array]
    frames: list[Float64Array]
    centres: Float64Array
    moved: Float64Array


def lean_and_roll(lean: float, roll: float) -> Float64Array:
    """Return the rows local left, posterior and superior after a lean about x and a small roll about y, in radians."""
    superior = np.array((math.sin(roll), math.sin(lean), 0.0))
    superior[2] = math.sqrt(1.0 - superior @ superior)
    left = np.array((1.0, 0.0, 0.0)) - superior[0] * superior
    left /= np.linalg.norm(left)
    return np.array((left, np.cross(superior, left), superior))


def _stack(sizes: dict[str, Float64Array], frames: list[Float64Array], anchor: int, spot: Float64Array) -> Float64Array:
    """Return the centres of bodies with their discs between them, that of level `anchor` at `spot`."""
    centres = np.zeros((len(frames), 3))
    for n in range(1, len(frames)):
        centres[n] = centres[n - 1] - frames[n - 1][2] * (sizes["height"][n - 1] / 2.0 + sizes["disc"][n - 1] / 2.0)
        centres[n] -= frames[n][2] * (sizes["height"][n] / 2.0 + sizes["disc"][n - 1] / 2.0)
    centres += spot - centres[anchor]
    return centres


def lay_chain(generator: np.random.Generator, seed: int, half_depth: float, choice: SpineChoice | None) -> Chain:
    """Lay the levels out, T12 a little below the middle of the volume; the generator and the seed bend the curves."""
    count = len(THORACOLUMBAR)
    sizes = {key: np.interp(np.arange(count), _KEYS, values) for key, values in _SIZES.items()}
    leans = np.radians(sizes["lean_degrees"] + generator.normal(0.0, 0.6, count))
    rolls = np.radians(generator.normal(0.0, 0.5, count) + 1.5 * np.sin(np.arange(count) * 0.7))
    names = THORACOLUMBAR
    if choice is not None and choice.levels[0][0] == "C":
        neck = np.random.default_rng((seed, 17))
        names = LEVELS
        more = len(LEVELS) - count
        sizes = {key: np.concatenate((_NECK[key], values)) for key, values in sizes.items()}
        leans = np.concatenate((np.radians(sizes["lean_degrees"][:more] + neck.normal(0.0, 0.6, more)), leans))
        rolls = np.concatenate((np.radians(neck.normal(0.0, 0.5, more)), rolls))
        leans[0], rolls[0] = leans[1], rolls[1]  # the ring lies square to the dens
    anchor = names.index(_ANCHOR_LEVEL)
    centre = np.array((1.7, half_depth - 21.0 - 67.0, -4.0))
    frames = [lean_and_roll(lean, roll) for lean, roll in zip(leans, rolls, strict=True)]
    centres = _stack(sizes, frames, anchor, centre)
    chain = Chain(names, sizes, frames, centres, np.zeros_like(centres))
    if choice is not None and choice.is_bent:
        chain = _bend(chain, anchor, choice)
    return chain


def _bend(chain: Chain, anchor: int, choice: SpineChoice) -> Chain:
    """Turn each level by its share of the angles; no level lies farther back than it did."""
    first, last = (chain.names.index(choice.levels[end]) for end in (0, -1))
    along = np.clip((np.arange(len(chain.names)) - first) / max(1, last - first), 0.0, 1.0) - 0.5
    if first == last:
        along[:] = 0.0
    up = np.array([frame[2] for frame in chain.frames])
    # angles as they are seen on a lateral and an anterior picture, so that they add up
    coronal = np.arctan2(up[:, 0], up[:, 2]) + math.radians(choice.scoliosis_deg) * along
    sagittal = np.arctan2(up[:, 1], up[:, 2]) + math.radians(choice.kyphosis_deg) * along
    up = np.stack((np.tan(coronal), np.tan(sagittal), np.ones_like(along)), axis=1)
    up /= np.linalg.norm(up, axis=1)[:, None]
    frames = [lean_and_roll(math.asin(y), math.asin(x)) for x, y, _ in up]
    centres = _stack(chain.sizes, frames, anchor, chain.centres[anchor])
    away = (centres - chain.centres)[slice(first, last + 1)]
    centres[:, 0] -= (away[:, 0].min() + away[:, 0].max()) / 2.0
    centres[:, 1] -= away[:, 1].max()
    moved = centres - chain.centres
    moved[:, 2] = 0.0
    return dataclasses.replace(chain, frames=frames, centres=centres, moved=moved)


_NECK_HALF_WIDTH, _NECK_HALF_DEPTH = 62.0, 66.0
_NECK_BEHIND_MM = 2.0
"""The middle of the neck lies this far behind the middle of the vertebral bodies."""
_NECK_SHARE = {"C7": 0.45, "C6": 0.85}
"""Share of the neck in the outline at the height of a level: 1 above, 0 below."""


@dataclass(frozen=True)
class Outline:
    """Ellipses that follow each other along z, (n,) mm, ascending.

    Rows, (5, n), are middle x and y, half width and half depth in mm, and the share of the neck, at these heights;
    between them linear, beyond them constant.
    """

    z: Float64Array
    rows: Float64Array

    def at(self, z: NDArray[np.floating]) -> list[NDArray[np.float32]]:
        """Return middle x, middle y, half width, half depth and share of the neck at heights of any shape."""
        return [np.interp(z, self.z, row).astype(np.float32) for row in self.rows]


def plan_outline(chain: Chain, half_width: float, half_depth: float) -> Outline | None:
    """Plan the outline round a chain; None for a straight trunk: an ellipse of these half axes at x = y = 0."""
    with_neck = chain.names[0] == "C1"
    if not with_neck and not chain.moved.any():
        return None
    rows = np.empty((5, len(chain.names)))
    for n, name in enumerate(chain.names):
        share = _NECK_SHARE.get(name, 1.0 if name[0] == "C" else 0.0)
        neck_x, neck_y = chain.centres[n, 0], chain.centres[n, 1] + _NECK_BEHIND_MM
        rows[:, n] = (
            chain.moved[n, 0] + share * (neck_x - chain.moved[n, 0]),
            chain.moved[n, 1] + share * (neck_y - chain.moved[n, 1]),
            half_width + share * (_NECK_HALF_WIDTH - half_width),
            half_depth + share * (_NECK_HALF_DEPTH - half_depth),
            share,
        )
    order = np.argsort(chain.centres[:, 2])
    return Outline(chain.centres[order, 2], rows[:, order])


@dataclass(frozen=True)
class Vertebra:
    """One level, rows of `axes` being the local left, posterior and superior directions, sizes in mm.

    lumbar: 0 thoracic shape to 1 lumbar shape of the processes.
    waves: ndarray, shape (n, 5). Trabecular texture, see `clrecon.proof.phantom.fields.waves_at`.
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
    """All parts of the spine phantom, absent ones left out on purpose, `centres` of bodies shown or not.

    half_width, half_depth: Half axes of the body outline about x = y = 0, unless it is an `outline` of its own.
    curve_x, curve_y, curve_z: Polynomials (highest power first) in z / 100 mm: centre line of the vertebral bodies;
        they hold from the lower to the upper z of the last.
    marker: Centre of the small metal ball on the patient's left.
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
        return float(self.centres[name][2])
