"""Corridors of a vertebra of boxes and cylinders: radius, angles and distances in closed form, in any grid and pose."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tolerances
from box_vertebra import BODY_HALF, CANAL_Y, HALF_HU, PLATE_HALF, PLATE_Y, BoxVertebra, grid_around, turned
from refusals import refused
from variants import daily

from clrecon.errors import RefusedInputError, UsageError
from clrecon.labels import LabelMap
from clrecon.spine.corridors import (
    BODY_SHARE,
    LineJudge,
    Span,
    _walls,
    find_corridors,
    line_points,
    measure_corridors,
    screw_diameter,
    segment_distances,
)
from clrecon.spine.measures import canal_wall

pytestmark = pytest.mark.untraced

POSES = {
    "turned": (BoxVertebra(rotation=turned(18.0, -12.0, 9.0)), {}),
    "straight": (BoxVertebra(), {}),
    "sheared": (BoxVertebra(), {"shear": 0.3}),
    "mirrored": (BoxVertebra(), {"mirrored": True}),
    "thick slices": (BoxVertebra(left_radius=4.5, right_radius=3.5), {"spacing": (1.0, 1.0, 2.0)}),
}


@pytest.fixture(scope="module", params=daily(1, POSES))
def posed(request: pytest.FixtureRequest) -> Any:
    """A vertebra in one of the poses, its frame and corridors, each beside its radius and axis in the truth."""
    vertebra, options = POSES[request.param]
    affine, shape = grid_around(vertebra, **options)
    corridors = measure_corridors(*vertebra.scan(affine, shape), 3, HALF_HU, "L3")
    left, right = corridors.corridors
    return SimpleNamespace(
        vertebra=vertebra,
        found=corridors,
        off_mm=tolerances.CORRIDOR_RADIUS_MM * (2.0 if request.param == "thick slices" else 1.0),
        sides=[(left, vertebra.left_radius, vertebra.axis(1.0)), (right, vertebra.right_radius, vertebra.axis(-1.0))],
    )


def in_vertebra(vertebra: BoxVertebra, *points: Any) -> np.ndarray:
    """Points in mm along the axes of the vertebra, from its centre."""
    return (np.stack(points) - np.array(vertebra.centre)) @ vertebra.axes.T


@pytest.mark.slow
def test_the_cylinder_is_the_corridor(posed: Any) -> None:
    for corridor, radius, (start, direction) in posed.sides:
        assert corridor.radius == pytest.approx(radius, abs=posed.off_mm)
        back, tip = in_vertebra(posed.vertebra, corridor.back, corridor.tip)
        cosine = (tip - back) @ direction / np.linalg.norm(tip - back)
        assert np.degrees(np.arccos(min(1.0, cosine))) < tolerances.CORRIDOR_ANGLE_DEG
        off = back - start
        assert np.linalg.norm(off - (off @ direction) * direction) < 0.5  # mm beside the axis of the cylinder


@pytest.mark.slow
def test_the_frame_of_a_posed_vertebra_follows_its_axes(posed: Any) -> None:
    cosines = (posed.found.frame.axes * posed.vertebra.axes).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max() < tolerances.CORRIDOR_FRAME_DEG


@pytest.mark.slow
def test_both_sides_of_a_posed_vertebra_have_a_corridor(posed: Any) -> None:
    assert posed.found.warnings == ()
    assert [(side.side, side.refused) for side in posed.found.corridors] == [("left", None), ("right", None)]


@pytest.mark.slow
def test_a_corridor_runs_from_the_plate_past_the_canal_into_the_body(posed: Any) -> None:
    for corridor, _, _ in posed.sides:
        entry, back, tip = in_vertebra(posed.vertebra, corridor.entry, corridor.back, corridor.tip)
        assert entry[1] == pytest.approx(PLATE_Y + PLATE_HALF[1], abs=1.0)
        assert back[1] == pytest.approx(CANAL_Y, abs=1.0)
        assert tip[1] == pytest.approx(BODY_HALF[1] - 2.0 * BODY_SHARE * BODY_HALF[1], abs=1.0)
        assert corridor.length == pytest.approx(np.linalg.norm(corridor.tip - corridor.entry), abs=1e-6)


@pytest.mark.slow
def test_the_medial_angle_of_a_corridor_is_that_of_the_cylinder(posed: Any) -> None:
    for corridor, _, _ in posed.sides:
        assert abs(corridor.medial_deg - posed.vertebra.medial_deg) < tolerances.CORRIDOR_ANGLE_DEG
        low, high = corridor.medial_range_deg
        assert low <= corridor.medial_deg <= high


@pytest.mark.slow
def test_a_corridor_keeps_its_radius_to_the_nearest_wall_and_the_canal(posed: Any) -> None:
    for corridor, radius, _ in posed.sides:
        assert corridor.margins.keys() == {"medial", "lateral", "cranial", "caudal"}
        nearest = min(margin for margin in corridor.margins.values() if margin is not None)
        assert nearest == pytest.approx(corridor.radius, abs=0.02)
        assert corridor.canal == pytest.approx(radius, abs=2.0 * posed.off_mm)


@pytest.mark.slow
def test_walls_of_a_corridor_are_placed_by_hu_without_bias(posed: Any) -> None:
    for corridor, _, _ in posed.sides:
        assert abs(corridor.bias.median_mm) <= 0.2
        assert corridor.by_hu_share > 0.95


@pytest.mark.release
def test_angles_of_the_patient_follow_the_pose() -> None:
    vertebra = BoxVertebra(rotation=turned(0.0, 0.0, 15.0))
    affine, shape = grid_around(vertebra)
    found = measure_corridors(*vertebra.scan(affine, shape), 3, HALF_HU, "L3")
    left, right = found.corridors
    # its left points backwards: a line of the left side runs more to the left, and less towards the midline
    turn = np.degrees(np.arctan2(vertebra.axes[0, 1], vertebra.axes[0, 0]))
    assert left.medial_lps_deg - left.medial_deg == pytest.approx(-turn, abs=2.0)
    assert right.medial_lps_deg - right.medial_deg == pytest.approx(turn, abs=2.0)


@pytest.mark.release
def test_a_level_farther_out_is_told() -> None:
    """Partial volume reaches half a voxel to both sides: a tenth of the contrast lies 0.4 voxel outside of the half."""
    vertebra = BoxVertebra()
    affine, shape = grid_around(vertebra, spacing=(1.0, 1.0, 1.0))
    found = measure_corridors(*vertebra.scan(affine, shape), 3, 100.0, "L3")
    for corridor, radius in zip(found.corridors, (4.0, 3.0), strict=True):
        assert corridor.radius == pytest.approx(radius + 0.4, abs=2.0 * tolerances.CORRIDOR_RADIUS_MM)
        assert corridor.bias.median_mm == pytest.approx(0.4, abs=0.25)
        assert corridor.bias.half_hu == pytest.approx(HALF_HU, abs=30.0)


@pytest.mark.seconds
def test_a_pedicle_below_two_voxels_is_refused() -> None:
    vertebra = BoxVertebra(left_radius=4.5, right_radius=2.0)
    affine, shape = grid_around(vertebra, spacing=(2.5, 2.5, 2.5))
    left, right = measure_corridors(*vertebra.scan(affine, shape), 3, HALF_HU, "L3").corridors
    assert left.refused is None and left.radius == pytest.approx(4.5, abs=0.6)
    assert right.radius is None and right.refused is not None
    assert "not resolved" in right.refused


def test_what_is_no_vertebra_is_refused() -> None:
    vertebra = BoxVertebra(arch=False)
    affine, shape = grid_around(vertebra)
    volume, labels = vertebra.scan(affine, shape)
    with refused(RefusedInputError, "label", "vertebra"):
        measure_corridors(volume, labels, 3, HALF_HU, "liver")
    with refused(RefusedInputError, "L9", "scan"):
        measure_corridors(volume, labels, 9, HALF_HU, "L9")
    with refused(RefusedInputError, "L3", 2000, 1000):
        measure_corridors(volume, labels, 3, 2000.0, "L3")
    few = np.zeros_like(labels)
    few[20:30, 40:50, 40:50] = 3
    volume = volume.with_voxels(np.where(few > 0, 900, 0).astype(np.int16))
    with refused(RefusedInputError, "volume", "vertebra", "L3"):
        measure_corridors(volume, few, 3, HALF_HU, "L3")


@pytest.mark.seconds
def test_a_cut_body_is_refused_and_a_cut_process_is_told() -> None:
    vertebra = BoxVertebra()
    affine, (nk, nj, ni) = grid_around(vertebra)
    volume, labels = vertebra.scan(affine, (nk, nj, ni))
    marked = np.argwhere(labels == 3)
    first, last = marked[:, 1].min(), marked[:, 1].max()
    cut = slice(0, last - 3)  # through the plate behind the canal
    shorter = type(volume)(volume.voxels[:, cut], affine)
    found = measure_corridors(shorter, labels[:, cut], 3, HALF_HU, "L3")
    assert found.warnings == ("L3 touches the end of the scan with its processes; body and pedicles are whole",)
    assert found.corridors[0].radius == pytest.approx(4.0, abs=tolerances.CORRIDOR_RADIUS_MM)
    front = affine.copy()
    front[:3, 3] += affine[:3, 1] * (first + 4)
    shorter = type(volume)(volume.voxels[:, first + 4 :], front)
    with refused(RefusedInputError, "L3", "voxels"):
        measure_corridors(shorter, labels[:, first + 4 :], 3, HALF_HU, "L3")


@pytest.mark.seconds
def test_distances_of_segments_are_those_of_their_nearest_points() -> None:
    generator = np.random.default_rng(4)
    points = generator.uniform(-20.0, 20.0, (500, 3))
    first, last = generator.uniform(-20.0, 20.0, (2, 40, 3))
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    expected = [
        np.sqrt(((a + share[:, None] * (b - a) - points) ** 2).sum(axis=-1).min())
        for a, b in zip(first, last, strict=True)
    ]
    np.testing.assert_allclose(segment_distances(first, last, points), expected, atol=tolerances.SEGMENT_DISTANCE_MM)
    assert np.isinf(segment_distances(first, last, np.zeros((0, 3)))).all()
    # beyond the ends, beside the middle, and a segment without length
    ends = (
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]),
        np.array([[10.0, 0, 0], [10.0, 0, 0], [3.0, 0, 0]]),
    )
    for point, wanted in (
        ((13.0, 4.0, 0.0), (5.0, 5.0, np.hypot(10, 4))),
        ((4.0, 0.0, 2.0), (2.0, 2.0, np.hypot(1, 2))),
    ):
        np.testing.assert_allclose(segment_distances(*ends, np.array([point])), wanted, atol=1e-5)


def test_the_radius_of_a_line_is_its_distance_from_all_points_of_the_surface() -> None:
    generator = np.random.default_rng(5)
    surface = generator.uniform(-25.0, 25.0, (3000, 3))
    surface = surface[np.hypot(surface[:, 0], surface[:, 2]) > 3.0]
    span = Span(1.0, 20.0, -20.0, 0.0)
    known = np.zeros((3, 4))
    known[:, 0] = (-0.5, 0.0, 0.5)
    judge = LineJudge.beside(known, 5.0, lambda points: points[:, 0], surface, span)
    lines = np.concatenate([generator.normal(0.0, spread, (60, 4)) for spread in (0.3, 1.0, 8.0)])
    ends = line_points(lines, span)[:, [0, -1]].transpose(1, 0, 2)
    radii = judge.radius(lines)
    np.testing.assert_allclose(radii, segment_distances(*ends, surface), atol=1e-3)
    beside = segment_distances(*ends, judge.walls)
    assert len(judge.walls) < len(surface) / 4
    assert (beside - radii > 0.1).any() and (np.abs(beside - radii)[:60] < 1e-3).all()


def test_of_two_lines_as_far_from_the_surface_the_deeper_scores_higher() -> None:
    span = Span(1.0, 20.0, -20.0, 0.0)
    lines = np.array([[-3.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]])
    surface = np.array([[0.0, 0.0, 0.0]])
    judge = LineJudge.beside(lines, 5.0, lambda points: 10.0 + points[:, 0], surface, span)
    np.testing.assert_allclose(judge.radius(lines), 3.0, atol=1e-3)
    shallow, deep = judge.score(lines)
    assert 3.0 < shallow < deep < 3.5


@pytest.mark.parametrize(
    ("radius", "margin", "diameter"), [(3.5, 1.0, 5.0), (3.56, 1.0, 5.1), (0.9, 1.0, 0.0), (3.0, 0.0, 6.0)]
)
def test_the_largest_screw_keeps_the_margin(radius: float, margin: float, diameter: float) -> None:
    assert screw_diameter(radius, margin) == pytest.approx(diameter)


@pytest.mark.release
def test_corridors_of_a_label_by_name_are_the_same() -> None:
    vertebra = BoxVertebra()
    volume, labels = vertebra.scan(*grid_around(vertebra))
    found = find_corridors(volume, LabelMap(labels, volume.affine, {3: "L3"}), "L3", HALF_HU)
    wanted = measure_corridors(volume, labels, 3, HALF_HU, "L3")
    assert [each.radius for each in found.corridors] == [each.radius for each in wanted.corridors]
    assert found.name == "L3"
    with refused(UsageError, "L4"):
        find_corridors(volume, LabelMap(labels, volume.affine, {3: "L3"}), "L4", HALF_HU)


def test_the_canal_wall_ends_three_quarters_of_a_body_from_its_middle() -> None:
    heights = np.array((-31.0, -30.0, -29.9, 0.0, 29.9, 30.0, 31.0))
    wall = np.stack((np.full(7, 5.0), np.zeros(7), heights), axis=1)
    frame = SimpleNamespace(
        body_height=40.0,
        to_frame=lambda points: points,
        to_lps=lambda points: points,
        canal_at=lambda z: np.stack((np.zeros_like(z), np.zeros_like(z), z), axis=1),
    )
    bone = SimpleNamespace(
        surface=wall, lattice=SimpleNamespace(step=0.5), is_solid=lambda points: np.zeros(len(points), bool)
    )
    assert heights[canal_wall(bone, frame)].tolist() == [-30.0, -29.9, 0.0, 29.9, 30.0]
    bone.is_solid = lambda points: points[:, 2] > 29.95  # what stands before the wall hides it
    assert heights[canal_wall(bone, frame)].tolist() == [-30.0, -29.9, 0.0, 29.9]


def test_the_nearest_wall_lies_beside_the_line_or_beyond_its_ends() -> None:
    surface = np.array([(5.0, 3.0, 0.0), (-4.0, 0.0, 0.0), (14.0, 3.0, 0.0), (5.0, 0.0, 40.0)])
    by_hu, steps, frame = (
        np.array((True, False, False, True)),
        np.diag((0.5, 1.5, 2.0)),
        SimpleNamespace(axes=np.eye(3)),
    )

    def walls(begin: int, radius: float) -> tuple[float, float, float]:
        bone = SimpleNamespace(steps=steps, by_hu=by_hu[begin:])
        return _walls(bone, frame, surface[begin:], np.zeros(3), np.array((10.0, 0.0, 0.0)), radius)

    assert walls(0, 3.0) == pytest.approx((3.0, 6.0 / 1.5, 0.5))
    assert walls(1, 4.0) == pytest.approx((4.0, 8.0 / 0.5, 0.0))
    assert walls(2, 5.0)[0] == pytest.approx(5.0)
