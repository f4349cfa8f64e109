"""Frames of a SEG as data sets made by hand: which stack they form, and at which figures they form none."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from pydicom import Dataset
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.labels.segmentation import MOST_SLICES, place_frames

SQUARE = (1, 0, 0, 0, 1, 0)


def group_with(sequence, **values):
    """A functional group: a sequence of this name whose one item has these elements."""
    inner, outer = Dataset(), Dataset()
    for keyword, value in values.items():
        setattr(inner, keyword, value if isinstance(value, str | float) else list(value))
    setattr(outer, sequence, [inner])
    return outer


def groups_of_all_frames(directions=SQUARE, spacing=(0.75, 0.5), **measures):
    """The shared functional groups: orientation, PixelSpacing in mm, further elements of PixelMeasuresSequence."""
    groups = group_with("PlaneOrientationSequence", ImageOrientationPatient=directions)
    groups.PixelMeasuresSequence = group_with("P", PixelSpacing=spacing, **measures).P
    return groups


def groups_of_frames_at(*positions):
    """Frames at heights, or at positions (x, y, z)."""
    places = [(0.0, 0.0, place) if isinstance(place, float) else place for place in positions]
    return [group_with("PlanePositionSequence", ImagePositionPatient=place) for place in places]


def heights(stack):
    return [float(stack.affine[2, 3] + place * stack.affine[2, 2]) for place in stack.places]


@pytest.mark.parametrize(
    ("positions", "stated", "places", "slices", "step"),
    [
        pytest.param((7.0,), None, [0], 1, 1.0, id="one frame without a step: 1 mm"),
        pytest.param((7.0,), 3.0, [0], 1, 3.0, id="one frame, its header says 3 mm"),
        pytest.param((7.0,), 0.001, [0], 1, 1.0, id="one frame, a step of 1 micrometre is not believed"),
        pytest.param((7.0, 7.0), 3.0, [0, 0], 1, 3.0, id="two frames at one place"),
        pytest.param((7.0, 9.0, 8.0), None, [0, 2, 1], 3, 1.0, id="frames out of order"),
        pytest.param((7.0, 7.0, 9.0), None, [0, 0, 1], 2, 2.0, id="two of three at one place"),
        pytest.param((0.0, 5.0, 10.0), 2.5, [0, 2, 4], 5, 2.5, id="every second slice"),
        pytest.param((0.0, 5.0, 10.0), 2.4755, [0, 2, 4], 5, 2.5, id="two steps are 0.049 mm off: rounded"),
        pytest.param((0.0, 5.0, 10.0), 2.4745, [0, 1, 2], 3, 5.0, id="two steps are 0.051 mm off: not believed"),
        pytest.param((0.0, 5.0, 10.0), 5000.0, [0, 1, 2], 3, 5.0, id="a step beyond the frames"),
        pytest.param((0.0, 5.0, 10.0), 0.0, [0, 1, 2], 3, 5.0, id="a step of zero"),
        pytest.param((0.0, 0.04), 2.5, [0, 1], 2, 0.04, id="frames closer than the step"),
        pytest.param((10.0, 0.0, 7.5), None, [4, 0, 3], 5, 2.5, id="the smallest distance is the step"),
    ],
)
def test_frames_lie_at_whole_steps_of_their_stack(positions, stated, places, slices, step):
    measures = {} if stated is None else {"SpacingBetweenSlices": stated}
    stack = place_frames(groups_of_all_frames(**measures), groups_of_frames_at(*positions), "a.dcm")
    assert (stack.places, stack.slices) == (places, slices)
    assert np.allclose(np.diag(stack.affine), (0.5, 0.75, step, 1.0), rtol=tolerances.LABEL_FLOAT64)
    assert heights(stack) == pytest.approx(positions, rel=tolerances.LABEL_FLOAT64)


def test_step_of_a_sheared_stack_goes_from_the_first_frame_to_the_next():
    frames = groups_of_frames_at((0.0, 1.0, 2.0), (0.5, 1.25, 4.0), (1.5, 1.75, 8.0))
    stack = place_frames(groups_of_all_frames(), frames, "a.dcm")
    assert stack.places == [0, 1, 3]  # the third lies two steps beyond the second
    step, first = stack.affine[:3, 2], stack.affine[:3, 3]
    assert np.allclose(step, (0.5, 0.25, 2.0))
    assert np.allclose(first, (0.0, 1.0, 2.0))


def test_pixel_spacing_of_the_first_frame_goes_before_that_of_all_frames():
    frames = groups_of_frames_at(0.0, 2.0)
    frames[0].PixelMeasuresSequence = group_with("P", PixelSpacing=(0.75, 0.50005)).P
    stack = place_frames(groups_of_all_frames(spacing=(0.75, 0.5)), frames, "a.dcm")
    assert stack.affine[0, 0] == 0.50005


def test_step_stated_by_a_later_frame_does_not_count():
    frames = groups_of_frames_at(0.0, 5.0)
    frames[1].PixelMeasuresSequence = group_with("P", PixelSpacing=(0.75, 0.5), SpacingBetweenSlices=2.5).P
    assert place_frames(groups_of_all_frames(), frames, "a.dcm").slices == 2  # of 5 mm; with steps of 2.5 mm three


def test_frames_without_an_orientation_are_refused_by_its_name():
    with refused(ValueError, "PlaneOrientationSequence"):
        place_frames(None, groups_of_frames_at(0.0, 2.0), "a.dcm")


def frames_in_the_middle_one_off(off_mm):
    """Three frames; a line fitted to points of which the middle one lies 3/2 aside passes it at a distance of 1."""
    return groups_of_frames_at((0.0, 0.0, 0.0), (1.5 * off_mm, 0.0, 2.0), (0.0, 0.0, 4.0))


def test_frame_within_a_twentieth_of_a_mm_of_the_line_is_placed():
    assert place_frames(groups_of_all_frames(), frames_in_the_middle_one_off(off_mm=0.0499), "a.dcm").slices == 3


def test_frame_further_than_a_twentieth_of_a_mm_off_the_line_is_refused():
    with refused(RefusedInputError, "a.dcm", 2.0, 0.05):  # the step, and how far the frame is off
        place_frames(groups_of_all_frames(), frames_in_the_middle_one_off(off_mm=0.0501), "a.dcm")


def test_frames_micrometres_apart_and_uneven_are_refused():
    """The line through all positions begins a step above the lowest frame: that frame would lie below slice 0."""
    frames = groups_of_frames_at(0.005, 0.015, 0.019, 0.019, 0.025, 0.043)
    with refused(RefusedInputError, "a.dcm", "evenly"):
        place_frames(groups_of_all_frames(), frames, "a.dcm")


LONGEST_MM = 0.5 * MOST_SLICES
"""Height of the last slice of the longest stack, in steps of 0.5 mm; the first lies at 0."""


def test_stack_of_the_most_steps_is_placed():
    frames = groups_of_frames_at(0.0, 0.5, LONGEST_MM)
    assert place_frames(groups_of_all_frames(), frames, "a.dcm").slices == 1 + MOST_SLICES


def test_stack_of_a_step_more_is_refused():
    frames = groups_of_frames_at(0.0, 0.5, LONGEST_MM + 0.5)
    with refused(RefusedInputError, "a.dcm", 0.5, LONGEST_MM + 0.5):  # the step and the length, mm
        place_frames(groups_of_all_frames(), frames, "a.dcm")


def frames_of_which_the_second_has(element, values):
    sequences = {"ImageOrientationPatient": "PlaneOrientationSequence", "PixelSpacing": "PixelMeasuresSequence"}
    frames = groups_of_frames_at(0.0, 2.0)
    setattr(frames[1], sequences[element], group_with("P", **{element: values}).P)
    return frames


@pytest.mark.parametrize(
    ("element", "values"),
    [("ImageOrientationPatient", (1, 0, 0, 0, 1, 0.0002)), ("PixelSpacing", (0.75, 0.5002))],
    ids=["direction", "spacing"],
)
def test_frames_that_differ_by_more_than_a_ten_thousandth_are_refused(element, values):
    with refused(RefusedInputError, "direction", "pixel", "a.dcm"):
        place_frames(groups_of_all_frames(), frames_of_which_the_second_has(element, values), "a.dcm")


@pytest.mark.parametrize(
    ("element", "values"),
    [("ImageOrientationPatient", (1, 0, 0, 0, 1, 0.00005)), ("PixelSpacing", (0.75, 0.50005))],
    ids=["direction", "spacing"],
)
def test_frames_that_differ_by_less_than_a_ten_thousandth_form_a_stack(element, values):
    frames = frames_of_which_the_second_has(element, values)
    assert place_frames(groups_of_all_frames(), frames, "a.dcm").slices == 2


DIRECTIONS = {
    "rows too long": (1.002, 0, 0, 0, 1, 0),
    "columns too short": (1, 0, 0, 0, 0.998, 0),
    "of length 1, not at a right angle": (1, 0, 0, 0.08, 0.996795, 0),
    "both too short": (0.999, 0, 0, 0, 0.9985, 0),
}
"""Row and column directions beside (1, 0, 0) and (0, 1, 0): a length, or that of the normal, is off 1 by 0.002 to
0.0032, where 0.001 is allowed."""


@pytest.mark.parametrize("directions", DIRECTIONS.values(), ids=DIRECTIONS)
def test_directions_off_length_one_or_a_right_angle_are_refused(directions):
    with refused(RefusedInputError, "direction", "a.dcm"):
        place_frames(groups_of_all_frames(directions), groups_of_frames_at(0.0, 2.0), "a.dcm")


@pytest.mark.parametrize("directions", DIRECTIONS.values(), ids=DIRECTIONS)
def test_directions_less_than_a_third_as_far_off_are_accepted(directions):
    nearly_square = np.array(SQUARE) + 0.3 * (np.array(directions) - SQUARE)
    assert place_frames(groups_of_all_frames(nearly_square), groups_of_frames_at(0.0, 2.0), "a.dcm").slices == 2


@pytest.mark.parametrize("spacing", [(0.0, 0.5), (0.5, -0.5)], ids=["zero", "negative"])
def test_pixel_spacing_of_zero_or_less_is_refused(spacing):
    with refused(RefusedInputError, "direction", "a.dcm"):
        place_frames(groups_of_all_frames(spacing=spacing), groups_of_frames_at(0.0, 2.0), "a.dcm")


@pytest.mark.parametrize(
    ("values", "words"),
    [((0.0, 0.0), r"3 numbers are needed, there are \[0.0, 0.0\]"), ((0.0, np.nan, 0.0), "0.0, nan, 0.0")],
    ids=["two numbers", "NaN"],
)
def test_position_that_is_not_three_finite_numbers_is_refused(values, words):
    class Position:
        ImagePositionPatient = values

    frames = [*groups_of_frames_at(0.0), {"PlanePositionSequence": [Position]}]
    with pytest.raises(ValueError, match=words):
        place_frames(groups_of_all_frames(), frames, "a.dcm")


EVERY_2_5_MM, TWICE_AT_7_MM = (0.0, 2.5, 5.0), (7.0, 7.0)
"""Heights of frames, mm."""


@pytest.mark.parametrize(
    ("positions", "measures", "step"),
    [
        pytest.param(EVERY_2_5_MM, {"SliceThickness": 1.25, "SpacingBetweenSlices": 2.5}, 2.5, id="both, step 2.5"),
        pytest.param(EVERY_2_5_MM, {"SliceThickness": 2.5, "SpacingBetweenSlices": 1.25}, 1.25, id="both, step 1.25"),
        pytest.param(EVERY_2_5_MM, {"SliceThickness": 2.48}, 2.5, id="thickness, rounded"),
        pytest.param(EVERY_2_5_MM, {"SliceThickness": 5.0}, 2.5, id="thickness of slices that overlap"),
        pytest.param(TWICE_AT_7_MM, {"SliceThickness": 1.25}, 1.25, id="thickness of one slice"),
    ],
)
def test_step_that_the_header_bears_out_has_no_warning(positions, measures, step):
    stack = place_frames(groups_of_all_frames(**measures), groups_of_frames_at(*positions), "a.dcm")
    assert stack.affine[2, 2] == pytest.approx(step, rel=tolerances.LABEL_FLOAT64)
    assert list(stack.warnings) == []


@pytest.mark.parametrize(
    ("positions", "measures", "step", "words"),
    [
        pytest.param(
            EVERY_2_5_MM,
            {"SliceThickness": 1.25},
            1.25,
            "2.5 mm apart, its header says 1.25 mm (SliceThickness, and",
            id="half the distance is the thickness",
        ),
        pytest.param(
            EVERY_2_5_MM,
            {"SliceThickness": 2.0},
            2.5,
            "says 2 mm (SliceThickness, and there is no SpacingBetweenSli",
            id="thickness that no whole number of steps reaches",
        ),
        pytest.param(
            EVERY_2_5_MM,
            {"SpacingBetweenSlices": 2.0},
            2.5,
            "says 2 mm (SpacingBetweenSlices): the step is 2.5 mm",
            id="step that no frame lies at",
        ),
        pytest.param(
            EVERY_2_5_MM,
            {},
            2.5,
            "says neither SpacingBetweenSlices nor SliceThickness: the smallest distance of two",
            id="neither",
        ),
        pytest.param(
            TWICE_AT_7_MM,
            {},
            1.0,
            "one slice says neither SpacingBetweenSlices nor SliceThickness: a thickness of 1 mm",
            id="neither, one slice",
        ),
    ],
)
def test_step_that_the_header_leaves_in_doubt_is_warned_of(positions, measures, step, words):
    stack = place_frames(groups_of_all_frames(**measures), groups_of_frames_at(*positions), "a.dcm")
    assert stack.affine[2, 2] == pytest.approx(step, rel=tolerances.LABEL_FLOAT64)
    (warning,) = stack.warnings
    assert words in warning
