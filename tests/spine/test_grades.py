"""Grades of given screws in a vertebra of boxes and cylinders: the breach in closed form, and its direction."""

from __future__ import annotations

import numpy as np
import pytest
from box_vertebra import BODY_HALF, HALF_HU, BoxVertebra, grid_around, turned
from refusals import refused
from variants import daily

from clrecon.errors import UsageError
from clrecon.spine.frame import VertebraFrame, _basis, _look_through, find_frame
from clrecon.spine.measures import Screw, ScrewGrade, grade_breach, grade_screw
from clrecon.spine.solid_bone import SolidBone, fill_vertebra

RADIUS = 4.0
VERTEBRA = BoxVertebra(left_radius=RADIUS, right_radius=RADIUS, medial_deg=0.0, rotation=turned(6.0, 4.0, 12.0))
OFFSETS = {"medial": (-1.0, 0.0), "lateral": (1.0, 0.0), "cranial": (0.0, 1.0), "caudal": (0.0, -1.0)}


@pytest.fixture(scope="module")
def bone_and_frame() -> tuple[SolidBone, VertebraFrame]:
    """The solid bone of `VERTEBRA`, and the frame that is found in it."""
    affine, shape = grid_around(VERTEBRA)
    volume, labels = VERTEBRA.scan(affine, shape)
    bone = fill_vertebra(volume, labels, number=3, level=HALF_HU, subject="L3")
    return bone, find_frame(bone, "L3")


def place_screw(side: float, outward: float, up: float, diameter: float, front: float = -5.0) -> Screw:
    """A screw along a pedicle's axis, shifted outward and up, from behind the plate to y = `front`; lengths in mm."""
    start, _ = VERTEBRA.axis(side)
    x, z = start[0] + side * outward, start[2] + up
    entry, tip = np.array([(x, 48.0, z), (x, front, z)]) @ VERTEBRA.axes + np.array(VERTEBRA.centre)
    return Screw(entry=entry, tip=tip, diameter=diameter)


BREACH_MM = 0.25
"""Tolerance: the lattice of the solid bone has steps of half a millimetre; measured 0.16."""


@pytest.fixture(params=[(2.5, 6.0), (4.0, 5.0)], ids=["1.5 mm", "2.5 mm"])
def breaching(
    request: pytest.FixtureRequest, bone_and_frame: tuple[SolidBone, VertebraFrame], side: float, direction: str
) -> tuple[ScrewGrade, float]:
    """The grade of a screw shifted towards a direction, and by how much of it leaves the pedicle of 4 mm, in mm."""
    shift, diameter = request.param
    outward, up = OFFSETS[direction]
    grade = grade_screw(*bone_and_frame, place_screw(side, shift * outward, shift * up, diameter), "L3")
    return grade, shift + diameter / 2.0 - RADIUS


on_each_side = pytest.mark.parametrize("side", daily(1, [1.0, -1.0]))


@pytest.mark.seconds
@on_each_side
@pytest.mark.parametrize("direction", OFFSETS)
def test_the_breach_of_a_screw_is_what_lies_outside_of_the_pedicle(
    breaching: tuple[ScrewGrade, float], direction: str
) -> None:
    grade, breach_mm = breaching
    assert grade.direction == direction
    assert grade.breach_mm == pytest.approx(breach_mm, abs=BREACH_MM)
    assert grade.margins_mm[direction] == pytest.approx(-breach_mm, abs=BREACH_MM)
    assert grade.grade == grade_breach(breach_mm)


@pytest.mark.seconds
@on_each_side
@pytest.mark.parametrize("direction", ["medial"])
def test_a_screw_has_the_side_of_its_pedicle(breaching: tuple[ScrewGrade, float], side: float) -> None:
    grade, _ = breaching
    assert grade.side == ("left" if side > 0.0 else "right")


@pytest.mark.seconds
@on_each_side
@pytest.mark.parametrize("direction", ["medial", "cranial", "caudal"])
def test_a_screw_whose_tip_lies_in_the_body_does_not_stand_out_in_front(breaching: tuple[ScrewGrade, float]) -> None:
    grade, _ = breaching
    assert grade.front_mm == 0.0


def test_a_screw_in_the_middle_of_a_pedicle_has_grade_a_without_a_breach(
    bone_and_frame: tuple[SolidBone, VertebraFrame],
) -> None:
    grade = grade_screw(*bone_and_frame, place_screw(side=1.0, outward=0.0, up=0.0, diameter=5.0), "L3")
    assert (grade.grade, grade.breach_mm, grade.direction) == ("A", 0.0, None)
    assert set(grade.breaches_mm.values()) == {0.0}
    assert grade.margins_mm["medial"] == pytest.approx(RADIUS - 5.0 / 2, abs=BREACH_MM)


def test_a_screw_through_the_canal_has_grade_e(bone_and_frame: tuple[SolidBone, VertebraFrame]) -> None:
    grade = grade_screw(*bone_and_frame, place_screw(side=1.0, outward=-12.0, up=0.0, diameter=6.0), "L3")
    assert (grade.grade, grade.direction) == ("E", "medial")
    assert grade.breach_mm > 6.0  # from here on a breach has grade E


def test_a_tip_beyond_the_front_of_the_body_is_measured_and_changes_no_grade(
    bone_and_frame: tuple[SolidBone, VertebraFrame],
) -> None:
    """The body ends at y = -15 mm."""
    grade = grade_screw(*bone_and_frame, place_screw(side=-1.0, outward=0.0, up=0.0, diameter=5.0, front=-20.0), "L3")
    assert grade.grade == "A"
    assert grade.front_mm == pytest.approx(20.0 - BODY_HALF[1], abs=BREACH_MM)


@pytest.mark.parametrize(
    ("breach", "grade"),
    [(0.0, "A"), (0.1, "B"), (1.99, "B"), (2.0, "C"), (3.99, "C"), (4.0, "D"), (5.99, "D"), (6.0, "E"), (40.0, "E")],
)
def test_grades_change_at_0_2_4_and_6_mm_of_breach(breach: float, grade: str) -> None:
    assert grade_breach(breach) == grade


SCREW = place_screw(side=1.0, outward=0.0, up=0.0, diameter=5.0)


@pytest.mark.parametrize("up_mm", [0.0, -40.0, 40.0], ids=["in the pedicle", "below", "above"])
def test_a_screw_that_runs_from_front_to_back_is_refused_at_any_height(
    bone_and_frame: tuple[SolidBone, VertebraFrame], up_mm: float
) -> None:
    shift = np.array((0.0, 0.0, up_mm))
    with refused(UsageError, "screw", "front", "back", "L3"):
        grade_screw(*bone_and_frame, Screw(entry=SCREW.tip + shift, tip=SCREW.entry + shift, diameter=5.0), "L3")


@pytest.mark.parametrize("shift", [(0, 0, -200.0), (0, 0, 200.0), (300.0, 300.0, 300.0)], ids=["below", "above", "far"])
def test_a_screw_beside_the_vertebra_is_refused(
    bone_and_frame: tuple[SolidBone, VertebraFrame], shift: tuple[float, ...]
) -> None:
    with refused(UsageError, "screw", "mm", "from", "L3"):
        grade_screw(*bone_and_frame, Screw(entry=SCREW.entry + shift, tip=SCREW.tip + shift, diameter=5.0), "L3")


def test_a_screw_whose_tip_lies_behind_the_body_is_refused(bone_and_frame: tuple[SolidBone, VertebraFrame]) -> None:
    behind_the_body = BODY_HALF[1] + 15.0
    with refused(UsageError, "tip", "behind", "body", "L3"):
        grade_screw(
            *bone_and_frame, place_screw(side=1.0, outward=0.0, up=0.0, diameter=5.0, front=behind_the_body), "L3"
        )


@pytest.mark.parametrize(
    ("entry", "diameter", "words"),
    [
        ((0.0, 0.0, np.nan), 5.0, "needs finite numbers"),
        (SCREW.tip, 5.0, "0 mm long"),
        (SCREW.entry, 0.0, "0 mm thick"),
        (SCREW.entry, 15.1, "15.1 mm thick"),  # up to 15 mm
    ],
    ids=["entry of NaN", "no length", "no thickness", "too thick"],
)
def test_a_screw_without_length_or_of_an_impossible_thickness_is_refused(
    entry: np.ndarray, diameter: float, words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        Screw(entry=np.array(entry), tip=SCREW.tip, diameter=diameter)


def test_the_axis_and_hole_of_a_tube_are_found_between_the_directions_that_are_tried_first() -> None:
    """A wall of 1.5 mm around a hole of 12 mm radius that leans by 3.3 and -11 degrees; pixels are 1 mm."""
    basis = _basis(3.3, -11.0)
    around = np.linspace(0.0, 2.0 * np.pi, 110, endpoint=False)
    radius, angle, height = np.meshgrid(np.arange(12.0, 13.6, 0.5), around, np.arange(-20.0, 20.5))
    tube = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1).reshape(-1, 3)

    hole_mm, axes, centre = _look_through(tube @ basis)

    off_deg = np.degrees(np.arccos(axes[2] @ basis[2]))
    assert off_deg < 0.2  # measured 0.09
    assert hole_mm == pytest.approx(12.0 - 1.0, abs=0.5)  # the wall fills the pixels at its rim, to half a pixel
    assert np.abs(centre).max() < 0.1  # mm; measured 0.03
