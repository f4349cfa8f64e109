"""Steps of the search for vertebrae and corridors on a few numbers, whose results are known in closed form."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clrecon.spine import corridors, discs, frame, measures, regions, split
from clrecon.spine.discs import Bound, Course, Looks


def straight_course(places: int, reaches: tuple[bool, bool] = (False, False)) -> Course:
    """A canal that runs straight down along z from 0."""
    canal = np.column_stack([np.zeros((places, 2)), -np.arange(float(places))])
    down, ahead, aside = (np.tile(way, (places, 1)) for way in ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)))
    return Course(canal, down, ahead, aside, np.ones(places, bool), reaches)


def plain_looks(depth: np.ndarray) -> Looks:
    mm = np.full(len(depth), 20.0)
    return Looks(depth, depth, depth, mm, mm, mm)


@pytest.mark.parametrize("seeds", [[], [4]])
def test_fewer_than_two_seeds_have_no_disc_between_them(seeds: list[int]) -> None:
    found, usual = discs.discs_between(plain_looks(np.full((9, len(discs.TILTS_DEG)), 50.0)), seeds)
    assert found == [] and usual.tolist() == [0.0] * 9


def test_a_label_without_a_canal_is_looked_through_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[float] = []

    def no_hole(points: np.ndarray, basis: np.ndarray, pixel: float) -> tuple[float, np.ndarray]:
        tried.append(pixel)
        return 0.0, np.zeros(2)

    monkeypatch.setattr(frame, "_hole", no_hole)
    assert frame._look_through(np.zeros((3, 3)))[0] == 0.0
    assert set(tried[:-1]) == {frame.PIXELS_MM[0]} and tried[-1] == frame.PIXELS_MM[1]


def test_bone_beyond_the_discs_is_said_to_lie_above_or_below(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(split, "beside_share", lambda *given: 0.0)
    bounds = [Bound(10, 8, 90.0), Bound(40, 8, 90.0)]
    depth = np.zeros((90, 1))
    found = split._Found(straight_course(90), depth, plain_looks(depth), bounds, np.zeros(90))
    none = np.zeros(4)
    spans, left_out = split._spans(found, np.zeros((2, 2, 2), np.uint8), none, none, none, 1.0, 200.0)
    assert [(number, piece.begin, piece.end) for number, piece in spans] == [(2, 10, 40)]
    assert left_out == [
        "above the first vertebra 10 mm follow without a disc that was found",
        "below the last vertebra 50 mm follow without a disc that was found",
    ]


def test_a_spinous_process_reaches_down_by_80_mm_less_1_6_heights() -> None:
    k, j, i = np.mgrid[:60, :1, :1].astype(float)
    part: Any = SimpleNamespace(
        aside=0.0 * k, ahead=0.0 * k, points=lambda volume, at: np.stack([i[at], j[at], -k[at] - 5.0], axis=-1)
    )
    planes = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -5.0)]), np.tile((0.0, 0.0, -1.0), (2, 1))
    pieces = np.full((60, 1, 1), 2, np.uint8)
    kept = regions._bound(part, pieces, [Bound(0, 8, 90.0), Bound(30, 8, 90.0)], planes, None)  # type: ignore[arg-type]
    assert kept[:, 0, 0].tolist() == [2] * 33 + [0] * 27  # 80 - 1.6 * 30 mm, and the plane itself


def test_the_refinement_begins_with_half_the_steps_of_the_coarse_search() -> None:
    assert corridors.FINE_STEPS[0] == (corridors.COARSE_MM / 2.0, corridors.COARSE_DEG / 2.0)


def test_the_frame_of_a_vertebra_is_a_turn_and_its_canal_leans() -> None:
    turned = np.array([(0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    own = frame.VertebraFrame(np.array((5.0, 6.0, 7.0)), turned, (2.0, 30.0), (0.25, -0.5), 9.0, (-20.0, 20.0), 25.0)
    assert own.to_frame(np.array([(5.0, 7.0, 9.0)])).tolist() == [[1.0, 0.0, 2.0]]
    assert own.to_lps(np.array([(1.0, 0.0, 2.0)])).tolist() == [[5.0, 7.0, 9.0]]
    assert own.canal_at(np.array((0.0, 4.0))).tolist() == [[2.0, 30.0, 0.0], [3.0, 28.0, 4.0]]


def test_a_wall_beyond_the_canals_reach_is_not_its_wall() -> None:
    reach = measures.CANAL_REACH_MM
    free: Any = SimpleNamespace(
        surface=np.array([(reach, 0.0, 0.0), (reach + 0.01, 0.0, 0.0)]),
        lattice=SimpleNamespace(step=0.5),
        is_solid=lambda points: np.zeros(len(points), bool),
    )
    where: Any = SimpleNamespace(
        body_height=40.0,
        to_frame=lambda points: points,
        to_lps=lambda points: points,
        canal_at=lambda z: np.zeros((len(z), 3)),
    )
    assert measures.canal_wall(free, where).tolist() == [True, False]


def test_the_bias_of_a_cylinder_is_that_of_its_ramp() -> None:
    """From 800 HU at 4.5 mm to 0 at 6.5 mm: 200 HU lie half a mm outside of the half maximum, all round the line."""
    first, last = np.array((1.0, 2.0, 3.0)), np.array((9.0, 8.0, 3.0))
    way = (last - first) / 10.0
    seen = []

    def ramp(places: np.ndarray) -> np.ndarray:
        offset = places - first - ((places - first) @ way)[:, None] * way
        return np.clip(400.0 * (6.5 - np.linalg.norm(offset, axis=1)), 0.0, 800.0)

    def is_solid(places: np.ndarray) -> np.ndarray:
        seen.append(places)
        return ramp(places) >= 200.0 - 1e-6

    bone: Any = SimpleNamespace(is_solid=is_solid, sample_hu=ramp, level=200.0 - 1e-6)
    found = measures.measure_bias(bone, SimpleNamespace(to_lps=lambda points: points), first, last)  # type: ignore[arg-type]
    assert found is not None
    assert (found.median_mm, found.low_mm, found.high_mm) == pytest.approx((0.5, 0.5, 0.5), abs=0.11)
    means = seen[0].reshape(measures.STATIONS, measures.RAYS, -1, 3).mean(axis=1)
    stations = first + np.linspace(0.0, 10.0, measures.STATIONS)[:, None] * way
    assert np.abs(means - stations[:, None]).max() < 1e-9
