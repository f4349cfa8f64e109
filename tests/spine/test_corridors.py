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
from clrecon.geometry import Volume
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

L3 = {"number": 3, "level": HALF_HU, "name": "L3"}  # the label that `BoxVertebra.scan` gives
POSES = {
    "turned": (BoxVertebra(rotation=turned(18.0, -12.0, 9.0)), {}),
    "straight": (BoxVertebra(), {}),
    "sheared": (BoxVertebra(), {"shear": 0.3}),
    "mirrored": (BoxVertebra(), {"mirrored": True}),
    "thick slices": (BoxVertebra(left_radius=4.5, right_radius=3.5), {"spacing": (1.0, 1.0, 2.0)}),
}


@pytest.fixture(scope="module", params=daily(1, POSES))
def posed(request: pytest.FixtureRequest) -> Any:
    """A vertebra in one of the poses, what was measured of it, and each side's corridor with its true radius and axis.

    `off_mm` is the tolerance on the radius, twice as large where slices are thick.
    """
    vertebra, options = POSES[request.param]
    affine, shape = grid_around(vertebra, **options)
    measured = measure_corridors(*vertebra.scan(affine, shape), **L3)
    left, right = measured.corridors
    return SimpleNamespace(
        vertebra=vertebra,
        measured=measured,
        off_mm=tolerances.CORRIDOR_RADIUS_MM * (2.0 if request.param == "thick slices" else 1.0),
        sides=[(left, vertebra.left_radius, vertebra.axis(1.0)), (right, vertebra.right_radius, vertebra.axis(-1.0))],
    )


def to_frame_of(vertebra: BoxVertebra, *points: Any) -> np.ndarray:
    """Points in mm along the axes of the vertebra, from its centre."""
    return (np.stack(points) - np.array(vertebra.centre)) @ vertebra.axes.T


@pytest.mark.slow
def test_a_corridor_has_the_radius_of_the_cylinder_of_its_pedicle(posed: Any) -> None:
    for corridor, radius, _ in posed.sides:
        assert corridor.radius == pytest.approx(radius, abs=posed.off_mm)


@pytest.mark.slow
def test_a_corridor_runs_along_the_axis_of_the_cylinder(posed: Any) -> None:
    for corridor, _, (start, direction) in posed.sides:
        back, tip = to_frame_of(posed.vertebra, corridor.back, corridor.tip)
        cosine = (tip - back) @ direction / np.linalg.norm(tip - back)
        beside_axis = (back - start) - ((back - start) @ direction) * direction
        assert np.degrees(np.arccos(min(1.0, cosine))) < tolerances.CORRIDOR_ANGLE_DEG
        assert np.linalg.norm(beside_axis) < tolerances.CORRIDOR_PLACE_MM


@pytest.mark.slow
def test_the_frame_of_a_posed_vertebra_has_its_axes(posed: Any) -> None:
    cosines = (posed.measured.frame.axes * posed.vertebra.axes).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).max() < tolerances.CORRIDOR_FRAME_DEG


@pytest.mark.slow
def test_both_sides_of_a_posed_vertebra_have_a_corridor_without_a_warning(posed: Any) -> None:
    assert posed.measured.warnings == ()
    assert [(side.side, side.refused) for side in posed.measured.corridors] == [("left", None), ("right", None)]


@pytest.mark.slow
def test_a_corridor_runs_from_the_plate_past_the_canal_into_the_body(posed: Any) -> None:
    behind_the_plate = PLATE_Y + PLATE_HALF[1]
    within_the_body = BODY_HALF[1] - BODY_SHARE * (2.0 * BODY_HALF[1])  # from its back wall
    for corridor, _, _ in posed.sides:
        entry, back, tip = to_frame_of(posed.vertebra, corridor.entry, corridor.back, corridor.tip)
        assert entry[1] == pytest.approx(behind_the_plate, abs=tolerances.CORRIDOR_END_MM)
        assert back[1] == pytest.approx(CANAL_Y, abs=tolerances.CORRIDOR_END_MM)
        assert tip[1] == pytest.approx(within_the_body, abs=tolerances.CORRIDOR_END_MM)


@pytest.mark.slow
def test_the_length_of_a_corridor_is_that_from_entry_to_tip(posed: Any) -> None:
    for corridor, _, _ in posed.sides:
        assert corridor.length == pytest.approx(np.linalg.norm(corridor.tip - corridor.entry))


@pytest.mark.slow
def test_the_medial_angle_of_a_corridor_is_that_of_the_cylinder_and_lies_in_its_range(posed: Any) -> None:
    for corridor, _, _ in posed.sides:
        low, high = corridor.medial_range_deg
        assert low <= corridor.medial_deg <= high
        assert corridor.medial_deg == pytest.approx(posed.vertebra.medial_deg, abs=tolerances.CORRIDOR_ANGLE_DEG)


@pytest.mark.slow
def test_the_nearest_wall_of_a_corridor_is_its_radius_away(posed: Any) -> None:
    for corridor, _, _ in posed.sides:
        assert corridor.margins.keys() == {"medial", "lateral", "cranial", "caudal"}
        nearest = min(margin for margin in corridor.margins.values() if margin is not None)
        assert nearest == pytest.approx(corridor.radius, abs=0.02)  # the step of the search for the widest line


@pytest.mark.slow
def test_the_canal_is_as_far_from_a_corridor_as_the_cylinder_is_wide(posed: Any) -> None:
    for corridor, radius, _ in posed.sides:
        assert corridor.canal == pytest.approx(radius, abs=2.0 * posed.off_mm)  # of the radius and of the canal's wall


@pytest.mark.slow
def test_walls_at_the_half_maximum_are_placed_by_hu_without_bias(posed: Any) -> None:
    for corridor, _, _ in posed.sides:
        assert corridor.by_hu_share > 0.95  # measured 1.0 in the turned pose
        assert abs(corridor.bias.median_mm) <= 0.2  # mm: a quarter of the least side of a voxel, 0.8 mm


@pytest.mark.release
def test_medial_angles_in_the_patient_differ_by_the_turn_of_the_vertebra() -> None:
    """Its left points backwards: a line of the left side runs more to the left, and less towards the midline."""
    vertebra = BoxVertebra(rotation=turned(0.0, 0.0, 15.0))
    affine, shape = grid_around(vertebra)
    left, right = measure_corridors(*vertebra.scan(affine, shape), **L3).corridors
    turn_deg = np.degrees(np.arctan2(vertebra.axes[0, 1], vertebra.axes[0, 0]))
    assert left.medial_lps_deg - left.medial_deg == pytest.approx(-turn_deg, abs=tolerances.CORRIDOR_FRAME_DEG)
    assert right.medial_lps_deg - right.medial_deg == pytest.approx(turn_deg, abs=tolerances.CORRIDOR_FRAME_DEG)


@pytest.fixture(scope="module")
def at_a_tenth_of_the_contrast() -> Any:
    """The corridors of pedicles of 4 and 3 mm at 100 of 1000 HU, in voxels of 1 mm.

    Partial volume reaches half a voxel to both sides: a tenth of the contrast lies 0.4 mm outside of the half.
    """
    vertebra = BoxVertebra(left_radius=4.0, right_radius=3.0)
    affine, shape = grid_around(vertebra, spacing=(1.0, 1.0, 1.0))
    return measure_corridors(*vertebra.scan(affine, shape), **{**L3, "level": 100.0}).corridors


@pytest.mark.release
def test_corridors_at_a_lower_level_are_wider_by_the_way_to_it(at_a_tenth_of_the_contrast: Any) -> None:
    for corridor, radius in zip(at_a_tenth_of_the_contrast, (4.0, 3.0), strict=True):
        assert corridor.radius == pytest.approx(radius + 0.4, abs=2.0 * tolerances.CORRIDOR_RADIUS_MM)


@pytest.mark.release
def test_the_bias_of_a_lower_level_is_its_way_from_the_half_maximum(at_a_tenth_of_the_contrast: Any) -> None:
    for corridor in at_a_tenth_of_the_contrast:
        assert corridor.bias.median_mm == pytest.approx(0.4, abs=0.25)  # mm: a quarter of a voxel of 1 mm
        assert corridor.bias.half_hu == pytest.approx(HALF_HU, abs=1.0)


@pytest.mark.seconds
def test_a_pedicle_less_than_two_voxels_wide_has_no_corridor_and_the_wider_one_has() -> None:
    vertebra = BoxVertebra(left_radius=4.5, right_radius=2.0)
    affine, shape = grid_around(vertebra, spacing=(2.5, 2.5, 2.5))
    left, right = measure_corridors(*vertebra.scan(affine, shape), **L3).corridors
    assert left.refused is None
    assert left.radius == pytest.approx(4.5, abs=0.6)  # mm: about a quarter of a voxel of 2.5 mm
    assert right.radius is None
    assert "not resolved" in str(right.refused)


@pytest.fixture(scope="module")
def without_an_arch() -> tuple[Volume, np.ndarray]:
    """A scan and labels of a body without pedicles and plate."""
    vertebra = BoxVertebra(arch=False)
    return vertebra.scan(*grid_around(vertebra))


@pytest.mark.parametrize(
    ("number", "level_hu", "name", "facts"),
    [
        (3, HALF_HU, "liver", ("label", "vertebra")),
        (9, HALF_HU, "L9", ("L9", "scan")),
        (3, 2000.0, "L3", ("L3", 2000, 1000)),
    ],
    ids=["no vertebra by its name", "label not in the scan", "level above all bone"],
)
def test_corridors_of_a_label_that_is_no_vertebra_or_has_no_bone_are_refused(
    without_an_arch: tuple[Volume, np.ndarray], number: int, level_hu: float, name: str, facts: tuple[str | int, ...]
) -> None:
    with refused(RefusedInputError, *facts):
        measure_corridors(*without_an_arch, number=number, level=level_hu, name=name)


def test_corridors_of_a_label_too_small_for_a_vertebra_are_refused(without_an_arch: tuple[Volume, np.ndarray]) -> None:
    volume, labels = without_an_arch
    few = np.zeros_like(labels)
    few[20:30, 40:50, 40:50] = 3
    with refused(RefusedInputError, "volume", "vertebra", "L3"):
        measure_corridors(volume.with_voxels(np.where(few > 0, 900, 0).astype(np.int16)), few, **L3)


@pytest.fixture(scope="module")
def whole_vertebra() -> tuple[Volume, np.ndarray, int, int]:
    """A scan, its labels, and the first and last row of the vertebra, from front to back; its left pedicle has 4 mm."""
    vertebra = BoxVertebra(left_radius=4.0)
    volume, labels = vertebra.scan(*grid_around(vertebra))
    rows = np.argwhere(labels == 3)[:, 1]
    return volume, labels, int(rows.min()), int(rows.max())


@pytest.mark.seconds
def test_a_vertebra_whose_plate_the_scan_cuts_has_its_corridors_and_a_warning(
    whole_vertebra: tuple[Volume, np.ndarray, int, int],
) -> None:
    volume, labels, _, last = whole_vertebra
    through_the_plate = np.s_[:, : last - 3]
    shorter = Volume(volume.voxels[through_the_plate], volume.affine)
    measured = measure_corridors(shorter, labels[through_the_plate], **L3)
    left, _ = measured.corridors
    assert measured.warnings == ("L3 touches the end of the scan with its processes; body and pedicles are whole",)
    assert left.radius == pytest.approx(4.0, abs=tolerances.CORRIDOR_RADIUS_MM)


@pytest.mark.seconds
def test_corridors_of_a_vertebra_whose_body_the_scan_cuts_are_refused(
    whole_vertebra: tuple[Volume, np.ndarray, int, int],
) -> None:
    volume, labels, first, _ = whole_vertebra
    through_the_body = np.s_[:, first + 4 :]
    affine = volume.affine.copy()
    affine[:3, 3] += affine[:3, 1] * (first + 4)
    with refused(RefusedInputError, "L3", "voxels"):
        measure_corridors(Volume(volume.voxels[through_the_body], affine), labels[through_the_body], **L3)


@pytest.mark.seconds
def test_distances_of_segments_from_points_are_the_least_of_many_places_along_them() -> None:
    generator = np.random.default_rng(4)
    points = generator.uniform(-20.0, 20.0, (500, 3))
    starts, ends = generator.uniform(-20.0, 20.0, (2, 40, 3))
    share = np.linspace(0.0, 1.0, 4001)[:, None, None]
    expected = [
        np.linalg.norm(start + share * (end - start) - points, axis=-1).min()
        for start, end in zip(starts, ends, strict=True)
    ]
    np.testing.assert_allclose(segment_distances(starts, ends, points), expected, atol=tolerances.SEGMENT_DISTANCE_MM)


def test_distances_of_segments_from_no_points_are_infinite() -> None:
    starts, ends = np.zeros((2, 3)), np.ones((2, 3))
    assert segment_distances(starts, ends, np.zeros((0, 3))).tolist() == [np.inf, np.inf]


@pytest.mark.parametrize(
    ("point", "from_segment", "from_place"),
    [((13.0, 4.0, 0.0), 5.0, np.hypot(10, 4)), ((4.0, 0.0, 2.0), 2.0, np.hypot(1, 2))],
    ids=["beyond the end", "beside the middle"],
)
def test_distance_of_a_segment_and_of_one_without_length_is_that_of_its_nearest_point(
    point: tuple[float, ...], from_segment: float, from_place: float
) -> None:
    """A segment along x from 0 to 10 mm, and one that begins and ends at x = 3 mm."""
    starts, ends = np.array([[0.0, 0, 0], [3.0, 0, 0]]), np.array([[10.0, 0, 0], [3.0, 0, 0]])
    distances = segment_distances(starts, ends, np.array([point]))
    np.testing.assert_allclose(distances, [from_segment, from_place], atol=tolerances.SEGMENT_DISTANCE_MM)


SPAN = Span(side=1.0, back=20.0, tip=-20.0, pass_y=0.0)  # lines of the left side, from y = 20 to -20 mm


@pytest.fixture
def judge_and_lines() -> tuple[LineJudge, np.ndarray, np.ndarray, np.ndarray]:
    """A judge of lines in random points with a tunnel of 3 mm, 180 lines, their ends, and the points.

    The first 60 lines lie near those that the judge knows, the others farther and farther away.
    """
    generator = np.random.default_rng(5)
    surface = generator.uniform(-25.0, 25.0, (3000, 3))
    surface = surface[np.hypot(surface[:, 0], surface[:, 2]) > 3.0]
    known = np.zeros((3, 4))
    known[:, 0] = (-0.5, 0.0, 0.5)
    judge = LineJudge.beside(known, reach=5.0, depth=lambda points: points[:, 0], surface=surface, span=SPAN)
    lines = np.concatenate([generator.normal(0.0, spread, (60, 4)) for spread in (0.3, 1.0, 8.0)])
    return judge, lines, line_points(lines, SPAN)[:, [0, -1]].transpose(1, 0, 2), surface


def test_the_radius_of_a_line_is_its_distance_from_all_points_of_the_surface(
    judge_and_lines: tuple[LineJudge, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    judge, lines, (starts, ends), surface = judge_and_lines
    expected = segment_distances(starts, ends, surface)
    np.testing.assert_allclose(judge.radius(lines), expected, atol=tolerances.SEGMENT_DISTANCE_MM)


def test_a_judge_keeps_less_than_a_quarter_of_the_surface_which_is_enough_for_lines_near_known_ones(
    judge_and_lines: tuple[LineJudge, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    judge, lines, (starts, ends), surface = judge_and_lines
    too_large_by = segment_distances(starts, ends, judge.walls) - judge.radius(lines)
    assert len(judge.walls) < len(surface) / 4
    assert (np.abs(too_large_by[:60]) < tolerances.SEGMENT_DISTANCE_MM).all()
    assert too_large_by[60:].max() > 0.1, "lines farther away need the whole surface"  # mm; measured 19


def test_of_two_lines_as_far_from_the_surface_the_deeper_scores_higher() -> None:
    """Lines at x = -3 and 3 mm beside a surface of one point; the depth is 10 + x mm."""
    lines = np.array([[-3.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]])
    one_point = np.zeros((1, 3))
    judge = LineJudge.beside(lines, reach=5.0, depth=lambda points: 10.0 + points[:, 0], surface=one_point, span=SPAN)
    np.testing.assert_allclose(judge.radius(lines), [3.0, 3.0], atol=tolerances.SEGMENT_DISTANCE_MM)
    shallow, deep = judge.score(lines)
    assert 3.0 < shallow < deep < 3.5  # the radius counts most


@pytest.mark.parametrize(
    ("radius", "margin", "diameter"), [(3.5, 1.0, 5.0), (3.56, 1.0, 5.1), (0.9, 1.0, 0.0), (3.0, 0.0, 6.0)]
)
def test_the_largest_screw_keeps_the_margin_on_both_sides_in_whole_tenths_of_a_millimetre(
    radius: float, margin: float, diameter: float
) -> None:
    assert screw_diameter(radius, margin) == pytest.approx(diameter)


@pytest.mark.release
def test_corridors_of_a_label_by_name_are_those_of_its_number(
    whole_vertebra: tuple[Volume, np.ndarray, int, int],
) -> None:
    volume, labels, _, _ = whole_vertebra
    by_name = find_corridors(volume, LabelMap(labels, volume.affine, {3: "L3"}), "L3", HALF_HU)
    by_number = measure_corridors(volume, labels, **L3)
    assert by_name.name == "L3"
    assert [side.radius for side in by_name.corridors] == [side.radius for side in by_number.corridors]


def test_corridors_of_a_name_that_the_labels_lack_are_refused(
    whole_vertebra: tuple[Volume, np.ndarray, int, int],
) -> None:
    volume, labels, _, _ = whole_vertebra
    with refused(UsageError, "L4"):
        find_corridors(volume, LabelMap(labels, volume.affine, {3: "L3"}), "L4", HALF_HU)


@pytest.mark.parametrize(
    ("solid_above_mm", "heights_of_wall"),
    [(np.inf, [-30.0, -29.9, 0.0, 29.9, 30.0]), (29.95, [-30.0, -29.9, 0.0, 29.9])],
    ids=["free canal", "bone before the wall above 29.95 mm"],
)
def test_the_canal_wall_ends_three_quarters_of_a_body_from_its_middle_and_where_bone_hides_it(
    solid_above_mm: float, heights_of_wall: list[float]
) -> None:
    """A body 40 mm high, a straight canal along z, and points of the surface 5 mm beside it."""
    heights = np.array((-31.0, -30.0, -29.9, 0.0, 29.9, 30.0, 31.0))
    frame = SimpleNamespace(
        body_height=40.0,
        to_frame=lambda points: points,
        to_lps=lambda points: points,
        canal_at=lambda z: np.stack((np.zeros_like(z), np.zeros_like(z), z), axis=1),
    )
    bone = SimpleNamespace(
        surface=np.stack((np.full(7, 5.0), np.zeros(7), heights), axis=1),
        lattice=SimpleNamespace(step=0.5),
        is_solid=lambda points: points[:, 2] > solid_above_mm,
    )
    assert heights[canal_wall(bone, frame)].tolist() == heights_of_wall


@pytest.mark.parametrize(
    ("left_out", "radius", "in_voxels", "by_hu_share"),
    [(0, 3.0, 6.0 / 1.5, 0.5), (1, 4.0, 8.0 / 0.5, 0.0), (2, 5.0, 10.0 / (0.6 * 1.5), 0.0)],
    ids=["beside the line", "before its start", "beyond its end"],
)
def test_the_nearest_wall_lies_beside_the_line_or_beyond_its_ends(
    left_out: int, radius: float, in_voxels: float, by_hu_share: float
) -> None:
    """A line along x from 0 to 10 mm; points 3 mm beside it, 4 mm before its start, 5 mm beyond its end, far away.

    The nearest is left out first, then the next.  The diameter is said in voxels along the way to the nearest.
    """
    surface = np.array([(5.0, 3.0, 0.0), (-4.0, 0.0, 0.0), (14.0, 3.0, 0.0), (5.0, 0.0, 40.0)])[left_out:]
    by_hu = np.array((True, False, False, True))[left_out:]
    bone, frame = SimpleNamespace(steps=np.diag((0.5, 1.5, 2.0)), by_hu=by_hu), SimpleNamespace(axes=np.eye(3))
    first, last = np.zeros(3), np.array((10.0, 0.0, 0.0))
    diameter_and_share = _walls(bone, frame, surface, first, last, radius)  # type: ignore[arg-type]
    assert diameter_and_share == pytest.approx([in_voxels, by_hu_share])
