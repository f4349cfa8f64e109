"""Traits of a vertebra in a made scan along its canal: exact figures."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from clrecon.spine.discs import AHEAD_MM, ASIDE_MM, Bound, Course, Looks
from clrecon.spine.regions import WEIGHTS, Piece, Traits, _walls, beside_share, judge, weigh

PLACES = 60
WHOLE = Piece(Bound(10, 0, 40.0), Bound(50, 0, 20.0), 10, 50, 2.4, 0.775, 0.375, 0.75, 0.0276)
"""Most of its traits lie half way between bad and good."""


def looks_of(depths: dict[int, float] | None = None) -> Looks:
    """A body from 10 to 30 mm before the canal and 15 mm to each side; planes as dark as `depths` says at places."""
    depth = np.full((PLACES, 3), np.nan, np.float32)
    for place, value in (depths or {}).items():
        depth[place, 1] = value
    flat = np.zeros((PLACES, 3), np.float32)
    return Looks(flat, flat, depth, *(np.full(PLACES, mm) for mm in (20.0, 30.0, 15.0)))


def scan_of() -> np.ndarray:
    """Marrow of 70 HU within a wall of 300 HU; the middle of the piece are the places 20 to 39."""
    radius = np.hypot((AHEAD_MM[:, None] - 20.0) / 10.0, ASIDE_MM / 15.0)
    page = np.where(radius < 0.85, 70.0, np.where(radius < 1.15, 300.0, 0.0))
    scan = np.repeat(page[None], PLACES, axis=0).astype(np.float32)
    scan[34:40] = 70.0  # no wall in 6 of 20
    core = slice(15, 26), slice(34, 51)  # within 5 and 8 mm of the middle
    scan[20][core], scan[21][core] = -61.0, -60.0  # 1 of 20 is dark
    tube = slice(0, 4), slice(39, 46)
    for first, last, hu in ((10, 14, 251.0), (14, 17, -151.0), (17, 18, 250.0), (18, 19, -150.0)):
        scan[first:last, tube[0], tube[1]] = hu  # 7 of 40 are filled
    return scan


def judged(
    piece: Piece, gaps: tuple[float, ...] = (), depths: dict[int, float] | None = None, scan: np.ndarray | None = None
) -> Traits:
    nothing = np.zeros((PLACES, 3))
    known = np.zeros(PLACES, bool)
    known[10:35] = known[50:] = True  # 25 of 40
    course = Course(nothing, nothing, nothing, nothing, known, (False, False))
    usual = np.full(PLACES, 100.0)
    usual[50:] = 50.0
    return judge(piece, gaps, scan_of() if scan is None else scan, looks_of(depths), course, usual)


def traits_of(piece: Piece, gaps: tuple[float, ...] = (), depths: dict[int, float] | None = None) -> dict[str, float]:
    return {name: value for name, (value, _) in judged(piece, gaps, depths).items()}


def test_whole_vertebra_has_every_trait_with_its_share() -> None:
    found = traits_of(WHOLE, (10.0, 28.0, 99.0), {20: 36.0})
    assert found == pytest.approx(
        {
            "upper disc": 0.5,  # 40 of 80 HU
            "lower disc": 1 / 3,  # 20 of 60 HU
            "inside": 0.56,  # 36 of 50 HU
            "wall": 2 / 7,  # 0.7 between 0.6 and 0.95
            "marrow": 0.75,  # 70 HU between 40 and 80
            "dark": 0.5,
            "canal": 0.5,
            "line": 9 / 14,
            "height": (1.6 - 40 / 28) / 0.35,
            "volume": 0.5,
            "border": 0.5,
            "arch": 0.5,
            "rim": 0.25,
            "one part": 0.5,
        },
        rel=1e-6,
    )


@pytest.mark.parametrize(
    ("changes", "gaps", "name", "value"),
    [
        ({}, (56.0,), "height", 4 / 7),
        ({}, (40.0, 48.0), "height", 1.0),
        ({"volume_ml": 90.0}, (), "volume", 0.5),
        ({"volume_ml": 0.8, "upper": None}, (), "volume", 0.5),
        ({"volume_ml": 90.0, "lower": None}, (), "volume", 0.5),
        ({"upper": Bound(10, 0, 80.0), "lower": Bound(50, 0, 90.0)}, (), "inside", 1.1),  # 36 of 80 HU
    ],
)
def test_a_changed_vertebra_loses_the_trait_of_the_change(
    changes: dict[str, Any], gaps: tuple[float, ...], name: str, value: float
) -> None:
    found = traits_of(replace(WHOLE, **changes), gaps, {20: 36.0})
    assert found[name] == pytest.approx(min(value, 1.0), rel=1e-6)


def test_each_trait_is_described_with_its_figure() -> None:
    assert [text for _, text in judged(WHOLE, (10.0, 28.0, 99.0), {20: 36.0}).values()] == [
        "the disc at its upper end is 40 HU darker than bone",
        "the disc at its lower end is 20 HU darker than bone",
        "36 HU darker plane within it: there may be another disc",
        "its body has a wall in 70 % of the directions",
        "the middle of its body has 70 HU",
        "5 % of the middle of its body is fat or air",
        "18 % of its canal is filled with bone or air",
        "its canal was seen on 62 % of its height",
        "its height is 40 mm, and 28 mm is usual beside it",
        "its volume is 2.4 ml, not 3 to 80",
        "38 % of it may be a neighbour's: their joints are closed",
        "it has only 0.0 ml of a spinous process",
        "75 % of its voxels lie in its surface: the slices are thick for its size",
        "78 % of it hang together",
    ]


@pytest.mark.parametrize(
    ("wall", "beyond", "share"), [(300.0, 240.0, 1.0), (300.0, 241.0, 0.0), (130.0, 70.0, 1.0), (129.0, 0.0, 0.0)]
)
def test_a_wall_is_dense_and_60_hu_denser_than_what_lies_beyond(wall: float, beyond: float, share: float) -> None:
    """A dark ring within the wall makes none; in front alone are 12 of the 18 directions."""
    looks = replace(looks_of(), front_mm=np.full(PLACES, 40.0), side_mm=np.full(PLACES, 30.0))
    radius = np.hypot((AHEAD_MM[:, None] - 20.0) / 20.0, ASIDE_MM / 30.0)
    page = np.where(radius < 0.95, 0.0, np.where(radius < 1.05, wall, beyond))
    assert _walls(np.repeat(page[None], PLACES, axis=0), looks, WHOLE) == share
    page[:20] = 70.0
    assert _walls(np.repeat(page[None], PLACES, axis=0), looks, WHOLE) == pytest.approx(share * 12 / 18)


def test_part_of_a_vertebra_lacks_disc_height_and_arch() -> None:
    part = traits_of(replace(WHOLE, lower=None), (28.0,))
    assert set(traits_of(WHOLE, (28.0,))) - set(part) == {"lower disc", "height", "arch"}
    assert "height" not in traits_of(WHOLE)


@pytest.mark.parametrize(
    ("end", "depths", "inner"),
    [
        (50, {19: 999.0, 20: 40.0, 39: 30.0, 40: 999.0}, 40.0),  # a quarter of 40 from each end
        (50, {19: 999.0, 20: 30.0, 39: 40.0, 40: 999.0}, 40.0),
        (30, {16: 999.0, 17: 40.0, 22: 30.0, 23: 999.0}, 40.0),  # 7 of 20
        (30, {16: 999.0, 17: 30.0, 22: 40.0, 23: 999.0}, 40.0),
        (30, {16: 999.0, 23: 999.0}, 0.0),
    ],
)
def test_a_further_disc_is_looked_for_well_within(end: int, depths: dict[int, float], inner: float) -> None:
    piece = replace(WHOLE, end=end)
    assert traits_of(piece, depths=depths)["inside"] == pytest.approx(min(1.0, 2.0 * (1.0 - inner / 50.0)), rel=1e-6)


def test_confidence_is_what_the_traits_take_from_the_logarithm() -> None:
    good = {name: (1.0, name) for name in ("arch", "volume", "height", "line")}
    assert weigh(good) == (1.0, [])
    assert weigh({name: (0.0, name) for name in WEIGHTS})[0] == pytest.approx(math.exp(-3.67))
    confidence, doubts = weigh({**good, "arch": (0.0, "no arch"), "line": (0.39, "no line"), "height": (0.65, "low")})
    assert confidence == pytest.approx(math.exp(-0.45 - 0.15 * 0.61 - 0.25 * 0.35)) and confidence < 0.6
    assert doubts == ["no arch", "no line"]  # 0.0915 is more than a fifth of 0.45, 0.0875 is less
    assert weigh({**good, "arch": (0.0, "no arch"), "line": (0.8, "no line")}) == (pytest.approx(math.exp(-0.48)), [])


def test_bone_beside_a_body_is_counted_at_its_places() -> None:
    """Within 4 mm of 7 mm beside the wall of the body above, 6 to 20 mm before the canal, at the places 20 to 39."""
    looks, scan = looks_of(), np.full((PLACES, len(AHEAD_MM), len(ASIDE_MM)), np.nan, np.float32)
    looks.side_mm[:10] = 12.0
    lower = replace(WHOLE, begin=29, end=49)  # the wall 20 mm above: 12 mm; its middle: 34 to 43
    scan[34:44] = 0.0
    for first in (42 + 15, 42 - 23):
        scan[34:44, 6:21, first : first + 9] = 100.0
    assert beside_share(scan, looks, lower, 100.0) == 1.0
    scan[34:44, 6] = 0.0
    assert beside_share(scan, looks, lower, 100.0) == pytest.approx(14 / 15)
    scan[34:44, 6] = scan[34:44, 7]
    assert beside_share(scan, looks, lower, 101.0) == 0.0
    scan[34:36] = np.where(scan[34:36] == 100.0, 99.0, scan[34:36])
    assert beside_share(scan, looks, lower, 100.0) == pytest.approx(0.8)
    assert beside_share(np.full_like(scan, np.nan), looks, lower, 100.0) == 0.0
