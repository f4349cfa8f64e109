"""Steps of the search for vertebrae and corridors on a few numbers, whose results are known in closed form."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clrecon.spine import corridors, discs, frame, measures, regions, split
from clrecon.spine.discs import Bound, Course, Looks


def straight_course(places: int, reaches: tuple[bool, bool] = (False, False)) -> Course:
    """A canal that runs straight down along z from 0; places are 1 mm apart."""
    canal = np.column_stack([np.zeros((places, 2)), -np.arange(float(places))])
    down, ahead, aside = (np.tile(axis, (places, 1)) for axis in ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)))
    return Course(canal, down, ahead, aside, np.ones(places, bool), reaches)


def looks_of_depth(depth: np.ndarray) -> Looks:
    """What planes look like that are darker by `depth` (places, tilts) HU, in bodies of 20 mm."""
    mm = np.full(len(depth), 20.0)
    return Looks(depth, depth, depth, mm, mm, mm)


@pytest.mark.parametrize("seeds", [[], [4]], ids=["none", "one"])
def test_fewer_than_two_seeds_have_no_disc_between_them(seeds: list[int]) -> None:
    bounds, usual = discs.discs_between(looks_of_depth(np.full((9, len(discs.TILTS_DEG)), 50.0)), seeds)
    assert bounds == []
    assert usual.tolist() == [0.0] * 9


def test_a_label_without_a_canal_is_looked_through_in_fine_pixels_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """All directions are tried in coarse pixels, and only the best of them in fine ones."""
    pixels: list[float] = []

    def find_no_hole(points: np.ndarray, basis: np.ndarray, pixel: float) -> tuple[float, np.ndarray]:
        pixels.append(pixel)
        return 0.0, np.zeros(2)

    monkeypatch.setattr(frame, "_hole", find_no_hole)
    hole_mm, _, _ = frame._look_through(np.zeros((3, 3)))
    coarse, fine = frame.PIXELS_MM[:2]
    assert hole_mm == 0.0
    assert pixels == [coarse] * (len(pixels) - 1) + [fine]


@pytest.fixture
def spans_and_left_out(monkeypatch: pytest.MonkeyPatch) -> tuple[list[Any], list[str]]:
    """Of 90 mm of a canal with discs after 10 and 40 mm: numbers with pieces, and what was left out."""
    monkeypatch.setattr(split, "beside_share", lambda *given: 0.0)
    depth, bounds = np.zeros((90, 1)), [Bound(at=place, tilt=8, depth_hu=90.0) for place in (10, 40)]
    looked = split._Found(straight_course(90), depth, looks_of_depth(depth), bounds, np.zeros(90))
    measures = dict.fromkeys(("volume_ml", "doubtful_share", "rim_share", "arch_ml"), np.zeros(4))
    return split._spans(looked, np.zeros((2, 2, 2), np.uint8), measures, level=200.0)


def test_a_vertebra_reaches_from_one_disc_to_the_next(spans_and_left_out: tuple[list[Any], list[str]]) -> None:
    spans, _ = spans_and_left_out
    assert [(number, piece.begin, piece.end) for number, piece in spans] == [(2, 10, 40)]


def test_bone_above_the_first_and_below_the_last_disc_is_left_out_with_its_height(
    spans_and_left_out: tuple[list[Any], list[str]],
) -> None:
    _, left_out = spans_and_left_out
    assert left_out == [
        "above the first vertebra 10 mm follow without a disc that was found",
        "below the last vertebra 50 mm follow without a disc that was found",
    ]


def test_a_spinous_process_reaches_below_its_vertebra_by_80_mm_less_1_6_of_its_height() -> None:
    """A column of 60 voxels, 1 mm apart, that begins 5 mm below the upper disc, at the lower one."""
    k, j, i = np.mgrid[:60, :1, :1].astype(float)
    part: Any = SimpleNamespace(
        aside=0.0 * k, ahead=0.0 * k, points=lambda volume, at: np.stack([i[at], j[at], -k[at] - 5.0], axis=-1)
    )
    planes = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, -5.0)]), np.tile((0.0, 0.0, -1.0), (2, 1))
    bounds_30_mm_apart = [Bound(at=place, tilt=8, depth_hu=90.0) for place in (0, 30)]
    pieces = np.full((60, 1, 1), 2, np.uint8)
    kept = regions._bound(part, pieces, bounds_30_mm_apart, planes, None)  # type: ignore[arg-type]
    below = round(80 - 1.6 * 30)
    assert kept[:, 0, 0].tolist() == [2] * (below + 1) + [0] * (59 - below)  # 1: in the plane itself


def test_the_refinement_begins_with_half_the_steps_of_the_coarse_search() -> None:
    assert corridors.FINE_STEPS[0] == (corridors.COARSE_MM / 2.0, corridors.COARSE_DEG / 2.0)


@pytest.fixture
def turned_frame() -> frame.VertebraFrame:
    """About (5, 6, 7), its x along y and its y along -x; the canal at (2, 30) leans by 0.25 and -0.5 mm a mm of z."""
    axes = np.array([(0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    return frame.VertebraFrame(
        origin=np.array((5.0, 6.0, 7.0)), axes=axes, canal=(2.0, 30.0), canal_lean=(0.25, -0.5), canal_radius=9.0,
        body_y=(-20.0, 20.0), body_height=25.0,
    )  # fmt: skip


def test_points_are_turned_and_shifted_into_the_frame_of_a_vertebra_and_back(turned_frame: frame.VertebraFrame) -> None:
    in_lps, in_frame = np.array([(5.0, 7.0, 9.0)]), np.array([(1.0, 0.0, 2.0)])
    assert turned_frame.to_frame(in_lps).tolist() == in_frame.tolist()
    assert turned_frame.to_lps(in_frame).tolist() == in_lps.tolist()


def test_the_canal_of_a_frame_leans_with_the_height(turned_frame: frame.VertebraFrame) -> None:
    at_the_origin, four_mm_above = turned_frame.canal_at(np.array((0.0, 4.0))).tolist()
    assert at_the_origin == [2.0, 30.0, 0.0]
    assert four_mm_above == [2.0 + 4 * 0.25, 30.0 - 4 * 0.5, 4.0]


def test_a_wall_beyond_the_reach_of_the_canal_is_not_its_wall() -> None:
    """Two points of the surface beside a straight canal along z, nothing solid between."""
    reach = measures.CANAL_REACH_MM
    bone: Any = SimpleNamespace(
        surface=np.array([(reach, 0.0, 0.0), (reach + 0.01, 0.0, 0.0)]),
        lattice=SimpleNamespace(step=0.5),
        is_solid=lambda points: np.zeros(len(points), bool),
    )
    straight: Any = SimpleNamespace(
        body_height=40.0,
        to_frame=lambda points: points,
        to_lps=lambda points: points,
        canal_at=lambda z: np.zeros((len(z), 3)),
    )
    assert measures.canal_wall(bone, straight).tolist() == [True, False]


START, END = np.array((1.0, 2.0, 3.0)), np.array((9.0, 8.0, 3.0))
ALONG = (END - START) / 10.0
"""The direction of a line of 10 mm."""


def ramp_around_the_line(points: np.ndarray) -> np.ndarray:
    """800 HU up to 4.5 mm from the line, 0 from 6.5 mm on, evenly between: half of it lies at 5.5, 200 HU at 6 mm."""
    offsets = points - START - ((points - START) @ ALONG)[:, None] * ALONG
    return np.clip(400.0 * (6.5 - np.linalg.norm(offsets, axis=1)), 0.0, 800.0)


@pytest.fixture
def ramp_bone() -> Any:
    """Bone at 200 HU around the line, which keeps the points that it was asked for."""
    asked_for: list[np.ndarray] = []
    level = 200.0 - 1e-6

    def is_solid(points: np.ndarray) -> np.ndarray:
        asked_for.append(points)
        return ramp_around_the_line(points) >= level

    return SimpleNamespace(is_solid=is_solid, sample_hu=ramp_around_the_line, level=level, asked_for=asked_for)


def measure_ramp_bias(bone: Any) -> Any:
    """The bias along the line from `START` to `END`, in a frame that is that of LPS."""
    return measures.measure_bias(bone, SimpleNamespace(to_lps=lambda points: points), START, END)  # type: ignore[arg-type]


def test_the_bias_of_a_ramp_is_the_way_from_its_half_maximum_to_the_level(ramp_bone: Any) -> None:
    bias = measure_ramp_bias(ramp_bone)
    way_mm = 6.0 - 5.5  # from 400 HU, half of the ramp, to 200 HU, the level
    assert (bias.median_mm, bias.low_mm, bias.high_mm) == pytest.approx([way_mm] * 3, abs=0.11)  # steps of 0.1 mm


def test_the_bias_is_measured_along_rays_all_round_evenly_spaced_stations_of_the_line(ramp_bone: Any) -> None:
    measure_ramp_bias(ramp_bone)
    points_on_rays, *_ = ramp_bone.asked_for
    points_on_rays = points_on_rays.reshape(measures.STATIONS, measures.RAYS, -1, 3)
    stations = START + np.linspace(0.0, 10.0, measures.STATIONS)[:, None] * ALONG
    middles = points_on_rays.mean(axis=1)  # of all rays, at each of their steps
    np.testing.assert_allclose(middles, np.broadcast_to(stations[:, None], middles.shape), atol=1e-9)


def test_watershed_of_a_landscape_without_ties_is_that_of_scikit_image() -> None:
    watershed = pytest.importorskip("skimage.segmentation").watershed
    random = np.random.default_rng(4)
    landscape = random.permutation(11 * 12 * 13).reshape(11, 12, 13)
    mask = random.random(landscape.shape) < 0.8
    markers = np.where(random.random(landscape.shape) < 0.01, random.integers(1, 4, landscape.shape), 0) * mask

    assert np.array_equal(regions.flood(landscape, 1.0, markers, mask), watershed(landscape, markers, mask=mask))


def test_groups_of_one_kind_are_numbered_apart_where_only_corners_or_other_kinds_join_them() -> None:
    kinds = np.array([[[2, 2, 5, 0], [0, 0, 5, 2]], [[5, 0, 5, 0], [0, 0, 0, 2]]])
    assert regions.number_groups(kinds).tolist() == [1, 1, 2, 2, 3, 4, 2, 3]  # of the kinds above 0, in their order
