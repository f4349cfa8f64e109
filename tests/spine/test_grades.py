"""Grades of given screws in a vertebra of boxes and cylinders: the breach in closed form, and its direction."""

from __future__ import annotations

import numpy as np
import pytest
from box_vertebra import HALF_HU, BoxVertebra, grid_around, turned
from variants import daily

from clrecon.errors import UsageError
from clrecon.spine.frame import VertebraFrame, _basis, _look_through, find_frame
from clrecon.spine.measures import Screw, grade_breach, grade_screw
from clrecon.spine.solid_bone import SolidBone, fill_vertebra

RADIUS = 4.0
VERTEBRA = BoxVertebra(left_radius=RADIUS, right_radius=RADIUS, medial_deg=0.0, rotation=turned(6.0, 4.0, 12.0))
OFFSETS = {"medial": (-1.0, 0.0), "lateral": (1.0, 0.0), "cranial": (0.0, 1.0), "caudal": (0.0, -1.0)}


@pytest.fixture(scope="module")
def placed() -> tuple[SolidBone, VertebraFrame]:
    affine, shape = grid_around(VERTEBRA)
    volume, labels = VERTEBRA.scan(affine, shape)
    bone = fill_vertebra(volume, labels, 3, HALF_HU, "L3")
    return bone, find_frame(bone, "L3")


def put(side: float, outward: float, up: float, diameter: float, front: float = -5.0) -> Screw:
    """A screw along a pedicle's axis, shifted outward and up, from behind the plate to y = `front`."""
    start, _ = VERTEBRA.axis(side)
    x, z = start[0] + side * outward, start[2] + up
    ends = np.array([(x, 48.0, z), (x, front, z)]) @ VERTEBRA.axes + np.array(VERTEBRA.centre)
    return Screw(ends[0], ends[1], diameter)


@pytest.mark.seconds
@pytest.mark.parametrize("side", daily(1, [1.0, -1.0]))
@pytest.mark.parametrize("direction", OFFSETS)
def test_the_breach_is_what_lies_outside(placed: tuple[SolidBone, VertebraFrame], side: float, direction: str) -> None:
    outward, up = OFFSETS[direction]
    for shift, diameter in ((2.5, 6.0), (4.0, 5.0)):
        grade = grade_screw(*placed, put(side, shift * outward, shift * up, diameter), "L3")
        breach = shift + diameter / 2.0 - RADIUS
        assert grade.side == ("left" if side > 0.0 else "right")
        assert grade.direction == direction
        assert grade.breach_mm == pytest.approx(breach, abs=0.25)
        assert grade.grade == grade_breach(breach)
        assert grade.margins_mm[direction] == pytest.approx(-breach, abs=0.25)
        if direction != "lateral":  # the body is 21 mm wide there, and ends too
            assert grade.front_mm == 0.0


def test_a_screw_in_the_middle_has_no_breach(placed: tuple[SolidBone, VertebraFrame]) -> None:
    grade = grade_screw(*placed, put(1.0, 0.0, 0.0, 5.0), "L3")
    assert (grade.grade, grade.breach_mm, grade.direction) == ("A", 0.0, None)
    assert set(grade.breaches_mm.values()) == {0.0}
    assert grade.margins_mm["medial"] == pytest.approx(RADIUS - 2.5, abs=0.2)


def test_a_screw_through_the_canal_is_the_worst(placed: tuple[SolidBone, VertebraFrame]) -> None:
    grade = grade_screw(*placed, put(1.0, -12.0, 0.0, 6.0), "L3")
    assert (grade.grade, grade.direction) == ("E", "medial")
    assert grade.breach_mm > 6.0


def test_a_tip_beyond_the_body_is_told_apart(placed: tuple[SolidBone, VertebraFrame]) -> None:
    grade = grade_screw(*placed, put(-1.0, 0.0, 0.0, 5.0, front=-20.0), "L3")
    assert grade.grade == "A"
    assert grade.front_mm == pytest.approx(5.0, abs=0.3)


@pytest.mark.parametrize(
    ("breach", "grade"),
    [(0.0, "A"), (0.1, "B"), (1.99, "B"), (2.0, "C"), (3.99, "C"), (4.0, "D"), (5.99, "D"), (6.0, "E"), (40.0, "E")],
)
def test_the_grades_end_where_they_should(breach: float, grade: str) -> None:
    assert grade_breach(breach) == grade


def test_screws_that_cannot_be_graded_are_refused(placed: tuple[SolidBone, VertebraFrame]) -> None:
    there = put(1.0, 0.0, 0.0, 5.0)
    with pytest.raises(UsageError, match="screw runs from front to back in L3"):
        grade_screw(*placed, Screw(there.tip, there.entry, 5.0), "L3")
    for up in (-40.0, 40.0):  # the way along the vertebra's height does not matter
        shift = np.array((0.0, 0.0, up))
        with pytest.raises(UsageError, match="screw runs from front to back in L3"):
            grade_screw(*placed, Screw(there.tip + shift, there.entry + shift, 5.0), "L3")
        with pytest.raises(UsageError, match="screw lies"):
            grade_screw(*placed, Screw(there.entry + 5 * shift, there.tip + 5 * shift, 5.0), "L3")
    with pytest.raises(UsageError, match=r"screw lies \d+ mm or more from L3"):
        grade_screw(*placed, Screw(there.entry + 300.0, there.tip + 300.0, 5.0), "L3")
    with pytest.raises(UsageError, match="the tip of screw lies behind the body of L3"):
        grade_screw(*placed, put(1.0, 0.0, 0.0, 5.0, front=30.0), "L3")
    for entry, diameter, said in (
        ((0.0, 0.0, np.nan), 5.0, "needs finite numbers"),
        (there.tip, 5.0, "0 mm long"),
        (there.entry, 0.0, "0 mm thick"),
        (there.entry, 40.0, "40 mm thick"),
    ):
        with pytest.raises(UsageError, match=said):
            Screw(np.array(entry), there.tip, diameter)


def test_a_tube_is_looked_through_along_its_axis() -> None:
    """A wall of 1.5 mm round a hole of 12 mm that leans between the directions that are tried first."""
    basis = _basis(3.3, -11.0)
    around = np.linspace(0.0, 2.0 * np.pi, 110, endpoint=False)
    radius, angle, height = np.meshgrid(np.arange(12.0, 13.6, 0.5), around, np.arange(-20.0, 20.5))
    tube = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1).reshape(-1, 3)
    found, axes, centre = _look_through(tube @ basis)
    assert np.degrees(np.arccos(axes[2] @ basis[2])) < 0.3
    assert found == pytest.approx(11.0, abs=0.5) and np.abs(centre).max() < 0.5
