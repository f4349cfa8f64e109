"""The confidence of a vertebra: its discs, its walls, its marrow, its height beside its neighbours, its volume.

Each trait is a number from 0 to 1.  The confidence is the overlap (Dice) with the true vertebra that is to be expected:
the exponential of minus the sum of what each trait lacks of 1, times its weight.  Figures are of adults.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.vertebrae.course import AHEAD_MM, ASIDE_MM, Course, Field
from clrecon.vertebrae.discs import BODY_BACK_MM, Bound, Looks

CONFIDENT = 0.6
"""Least confidence of a vertebra that is written without being asked for."""
WEIGHTS = {
    "rim": 0.34, "upper disc": 0.09, "lower disc": 0.09, "inside": 0.3, "wall": 0.3, "height": 0.25, "border": 0.1,
    "arch": 0.45, "canal": 0.3, "marrow": 0.3, "dark": 0.3, "volume": 0.4, "one part": 0.3, "line": 0.15,
}  # fmt: skip
"""What a trait of 0 takes from the logarithm of the confidence.  Those of rim, discs and border are least squares over
88 vertebrae of phantoms; phantoms hardly show the others: these take more than least squares gave."""
LEAST_DEPTH_HU = 30.0
"""Least depth of any disc: noise and partial volume make shallower ones."""
MARROW_HU = 60.0
"""Least HU of the middle of a body; muscle and a disc beside a thin one have less."""
VOLUME_ML = (3.0, 80.0)
"""Least and largest volume of a vertebra; C3 of a small adult has 4 ml."""
ARCH_SHARE = (0.003, 0.02)
"""Share of a vertebra that lies behind its canal in the middle: too little, and enough for a spinous process."""
WALL_DIRECTIONS = np.radians(np.arange(-130.0, 131.0, 15.0))
"""Directions from the middle of a body in which its wall is looked for, 0 is to the front; the pedicles are behind."""


@dataclass(frozen=True)
class Piece:
    """The bone between two planes.

    upper, lower: None where the scan ends first.
    begin, end: Places along the canal.
    largest_share: Share of its voxels in its largest connected part.
    doubtful_share: Share of its voxels that two ways of dividing the bone give to different vertebrae.
    rim_share: Share of its voxels in its surface.
    arch_ml: Volume of its spinous process.
    """

    upper: Bound | None
    lower: Bound | None
    begin: int
    end: int
    volume_ml: float
    largest_share: float
    doubtful_share: float
    rim_share: float
    arch_ml: float

    @property
    def whole(self) -> bool:
        """True where both planes are there."""
        return self.upper is not None and self.lower is not None


Traits = dict[str, tuple[float, str]]
"""Each trait from 0 to 1, and what is wrong where it is too low."""


def weigh(traits: Traits) -> tuple[float, list[str]]:
    """Return the confidence, and what is wrong where it is too low: the traits that make it so, the worst first."""
    costs = {name: WEIGHTS[name] * (1.0 - value) for name, (value, _) in traits.items()}
    confidence = math.exp(-sum(costs.values()))
    if confidence >= CONFIDENT:
        return confidence, []
    worst = sorted(costs, key=lambda name: -costs[name])
    return confidence, [traits[name][1] for name in worst if costs[name] >= 0.2 * costs[worst[0]]]


def _ramp(value: float, nothing: float, all_of_it: float) -> float:
    return float(np.clip((value - nothing) / (all_of_it - nothing), 0.0, 1.0))


def judge(
    piece: Piece, gaps: Sequence[float], scan: Field, looks: Looks, course: Course, usual: NDArray[np.float64]
) -> Traits:
    """Judge a piece.

    gaps: Heights of the whole pieces beside it, up to two above and two below, mm.
    scan: See `clrecon.vertebrae.course.sample_course`.
    usual: ndarray, shape (n,). Depth of a usual disc at each place, HU.
    """
    height = piece.end - piece.begin
    traits: Traits = {}
    for name, bound in (("upper", piece.upper), ("lower", piece.lower)):
        if bound is not None:
            depth = _ramp(bound.depth_hu, 0.0, max(0.8 * float(usual[bound.at]), 2.0 * LEAST_DEPTH_HU))
            traits[f"{name} disc"] = depth, f"the disc at its {name} end is {bound.depth_hu:.0f} HU darker than bone"
    inner = _further_disc(looks, piece)
    known = [bound.depth_hu for bound in (piece.upper, piece.lower) if bound is not None]
    share = inner / max(min(known), 0.5 * float(usual[piece.begin : piece.end].max(initial=1.0)), 1.0)
    traits["inside"] = _ramp(share, 1.0, 0.5), f"{inner:.0f} HU darker plane within it: there may be another disc"
    wall = _walls(scan, looks, piece)
    traits["wall"] = _ramp(wall, 0.6, 0.95), f"its body has a wall in {100 * wall:.0f} % of the directions"
    marrow, dark = _marrow(scan, looks, piece)
    traits["marrow"] = _ramp(marrow, MARROW_HU - 20.0, MARROW_HU + 20.0), f"the middle of its body has {marrow:.0f} HU"
    traits["dark"] = _ramp(dark, 0.1, 0.0), f"{100 * dark:.0f} % of the middle of its body is fat or air"
    canal = _canal(scan, piece)
    traits["canal"] = _ramp(canal, 0.35, 0.0), f"{100 * canal:.0f} % of its canal is filled with bone or air"
    seen = float(course.known[piece.begin : piece.end].mean())
    traits["line"] = _ramp(seen, 0.4, 0.75), f"its canal was seen on {100 * seen:.0f} % of its height"
    if piece.whole and gaps:
        usual_mm = float(np.median(gaps))
        ratio = max(height / usual_mm, usual_mm / height)
        said = f"its height is {height} mm, and {usual_mm:.0f} mm is usual beside it"
        traits["height"] = _ramp(ratio, 1.6, 1.25), said
    low, high = VOLUME_ML if piece.whole else (1.0, VOLUME_ML[1])
    fits = min(_ramp(piece.volume_ml, 0.6 * low, low), _ramp(piece.volume_ml, 1.25 * high, high))
    traits["volume"] = fits, f"its volume is {piece.volume_ml:.3g} ml, not {low:g} to {high:g}"
    torn = piece.doubtful_share
    traits["border"] = _ramp(torn, 0.6, 0.15), f"{100 * torn:.0f} % of it may be a neighbour's: their joints are closed"
    if piece.whole:
        arch = piece.arch_ml
        share = arch / max(piece.volume_ml, 1e-6)
        traits["arch"] = _ramp(share, *ARCH_SHARE), f"it has only {arch:.1f} ml of a spinous process"
    rim = piece.rim_share
    traits["rim"] = 1.0 - rim, f"{100 * rim:.0f} % of its voxels lie in its surface: the slices are thick for its size"
    traits["one part"] = _ramp(piece.largest_share, 0.6, 0.95), f"{100 * piece.largest_share:.0f} % of it hang together"
    return traits


def _further_disc(looks: Looks, piece: Piece) -> float:
    """Return the depth of the best plane well within a piece, HU."""
    margin = max(7, (piece.end - piece.begin) // 4)
    part = looks.depth[piece.begin + margin : piece.end - margin]
    known = part[np.isfinite(part)]
    return float(known.max()) if known.size else 0.0


def _middle_rows(piece: Piece) -> slice:
    margin = (piece.end - piece.begin) // 4
    first = min(piece.begin + margin, piece.end - 1)
    return slice(first, max(piece.end - margin, first + 1))


def _walls(scan: Field, looks: Looks, piece: Piece) -> float:
    """Return the share of directions in which cortex brighter than the marrow stands round the middle of the body."""
    rows = range(*_middle_rows(piece).indices(len(scan)))
    found = []
    for n in rows:
        middle, deep = looks.middle_mm[n], looks.front_mm[n] - looks.middle_mm[n]
        reach = np.arange(0.6, 1.5, 0.1)[:, None]
        ahead = middle + reach * deep * np.cos(WALL_DIRECTIONS)
        aside = reach * looks.side_mm[n] * np.sin(WALL_DIRECTIONS)
        j = np.clip(np.rint(ahead - AHEAD_MM[0]).astype(int), 0, len(AHEAD_MM) - 1)
        i = np.clip(np.rint(aside - ASIDE_MM[0]).astype(int), 0, len(ASIDE_MM) - 1)
        found.append(np.nan_to_num(scan[n, j, i], nan=-1000.0))
    rings = np.stack(found)
    highest, outside = rings.max(axis=1), rings[:, -3:].min(axis=1)
    # a wall: as dense as bone, and softer beyond it
    return float(((highest >= 130.0) & (outside <= highest - 60.0)).mean())


def _marrow(scan: Field, looks: Looks, piece: Piece) -> tuple[float, float]:
    """Return the median HU of the middle of the body, and the share of its voxels that are fat or air."""
    rows = _middle_rows(piece)
    middle = float(np.median(looks.middle_mm[rows]))
    ahead = np.abs(AHEAD_MM - middle) <= 5.0
    core = scan[rows][:, ahead][:, :, np.abs(ASIDE_MM) <= 8.0]
    known = core[np.isfinite(core)]
    return (float(np.median(known)), float((known < -60.0).mean())) if known.size else (-1000.0, 1.0)


def _canal(scan: Field, piece: Piece) -> float:
    """Return the share of the middle of the canal that is bone or air."""
    tube = scan[piece.begin : piece.end, :4][:, :, np.abs(ASIDE_MM) <= 3.0]
    known = tube[np.isfinite(tube)]
    return float(((known > 250.0) | (known < -150.0)).mean()) if known.size else 1.0


def beside_share(scan: Field, looks: Looks, piece: Piece, level: float) -> float:
    """Return the share of bone right beside a body: muscle stands there, but at the sacrum its wings."""
    rows = range(*_middle_rows(piece).indices(len(scan)))
    side = looks.side_mm[max(piece.begin - 20, 0)]  # of the body above: the wings have no side wall
    found = []
    for n in rows:
        ahead = (AHEAD_MM >= BODY_BACK_MM - 4.0) & (AHEAD_MM <= BODY_BACK_MM + 10.0)
        aside = np.abs(np.abs(ASIDE_MM) - side - 7.0) <= 4.0
        found.append(scan[n][ahead][:, aside])
    known = np.concatenate([part.ravel() for part in found])
    known = known[np.isfinite(known)]
    return float((known >= level).mean()) if known.size else 0.0
