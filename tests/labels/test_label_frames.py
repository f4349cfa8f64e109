"""Frames of a SEG as data sets made by hand: which stack they form, and at which figures they form none."""

from __future__ import annotations

import numpy as np
import pytest
from pydicom import Dataset
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.labels.segmentation import place_frames

SQUARE = (1, 0, 0, 0, 1, 0)


def holder(sequence, **values):
    inner, outer = Dataset(), Dataset()
    for keyword, value in values.items():
        setattr(inner, keyword, value if isinstance(value, str | float) else list(value))
    setattr(outer, sequence, [inner])
    return outer


def shared(directions=SQUARE, spacing=(0.75, 0.5), **measures):
    found = holder("PlaneOrientationSequence", ImageOrientationPatient=directions)
    found.PixelMeasuresSequence = holder("P", PixelSpacing=spacing, **measures).P
    return found


def frames(*positions):
    """Frames at heights, or at positions (x, y, z)."""
    places = [(0.0, 0.0, place) if isinstance(place, float) else place for place in positions]
    return [holder("PlanePositionSequence", ImagePositionPatient=place) for place in places]


def heights(stack):
    return [float(stack.affine[2, 3] + place * stack.affine[2, 2]) for place in stack.places]


@pytest.mark.parametrize(
    ("positions", "stated", "places", "slices", "step"),
    [
        ((7.0,), None, [0], 1, 1.0),
        ((7.0,), 3.0, [0], 1, 3.0),
        ((7.0,), 0.001, [0], 1, 1.0),
        ((7.0, 7.0), 3.0, [0, 0], 1, 3.0),
        ((7.0, 9.0, 8.0), None, [0, 2, 1], 3, 1.0),
        ((7.0, 7.0, 9.0), None, [0, 0, 1], 2, 2.0),
        ((0.0, 5.0, 10.0), 2.5, [0, 2, 4], 5, 2.5),
        ((0.0, 5.0, 10.0), 2.4755, [0, 2, 4], 5, 2.5),  # two steps are 0.049 mm off
        ((0.0, 5.0, 10.0), 2.4745, [0, 1, 2], 3, 5.0),
        ((0.0, 5.0, 10.0), 5000.0, [0, 1, 2], 3, 5.0),
        ((0.0, 5.0, 10.0), 0.0, [0, 1, 2], 3, 5.0),
        ((0.0, 0.04), 2.5, [0, 1], 2, 0.04),
        ((10.0, 0.0, 7.5), None, [4, 0, 3], 5, 2.5),
    ],
)
def test_frames_lie_at_whole_steps(positions, stated, places, slices, step):
    measures = {} if stated is None else {"SpacingBetweenSlices": stated}
    stack = place_frames(shared(**measures), frames(*positions), "a.dcm")
    assert (stack.places, stack.slices) == (places, slices)
    assert np.allclose(np.diag(stack.affine), (0.5, 0.75, step, 1.0), rtol=1e-12)
    assert heights(stack) == pytest.approx(positions, rel=1e-12)


def test_a_sheared_stack_keeps_its_step():
    stack = place_frames(shared(), frames((0.0, 1.0, 2.0), (0.5, 1.25, 4.0), (1.5, 1.75, 8.0)), "a.dcm")
    assert stack.places == [0, 1, 3]
    assert np.allclose(stack.affine[:3, 2:], np.array([[0.5, 0.0], [0.25, 1.0], [2.0, 2.0]]))


def test_a_frame_says_itself_what_all_say():
    own = frames(0.0, 2.0)
    own[0].PixelMeasuresSequence = holder("P", PixelSpacing=(0.75, 0.50005)).P
    assert place_frames(shared(), own, "a.dcm").affine[0, 0] == 0.50005
    own = frames(0.0, 5.0)  # the step that counts is that of the first frame
    own[1].PixelMeasuresSequence = holder("P", PixelSpacing=(0.75, 0.5), SpacingBetweenSlices=2.5).P
    assert place_frames(shared(), own, "a.dcm").slices == 2
    with refused(ValueError, "PlaneOrientationSequence"):
        place_frames(None, own, "a.dcm")


@pytest.mark.parametrize("aside", [0.0749, 0.0751])
def test_a_frame_may_lie_a_twentieth_of_a_mm_off(aside):
    # A line through three points of which the middle one lies 3/2 aside passes it at a distance of 1.
    found = frames((0.0, 0.0, 0.0), (aside, 0.0, 2.0), (0.0, 0.0, 4.0))
    if aside < 0.075:
        assert place_frames(shared(), found, "a.dcm").slices == 3
        return
    with refused(RefusedInputError, "a.dcm", 2.0, 0.05):
        place_frames(shared(), found, "a.dcm")


def test_no_frame_lies_below_the_first_slice():
    """Steps of micrometres: the line through all positions begins a step above the lowest frame."""
    found = frames(0.005, 0.015, 0.019, 0.019, 0.025, 0.043)
    with refused(RefusedInputError, "a.dcm", "evenly"):
        place_frames(shared(), found, "a.dcm")


def test_more_than_a_hundred_thousand_slices_are_too_many():
    assert place_frames(shared(), frames(0.0, 0.5, 50_000.0), "a.dcm").slices == 100_001
    with refused(RefusedInputError, "a.dcm", 0.5, 50000.5):
        place_frames(shared(), frames(0.0, 0.5, 50_000.5), "a.dcm")


@pytest.mark.parametrize(
    ("what", "values"),
    [("PlaneOrientationSequence", (1, 0, 0, 0, 1, 0.0002)), ("PixelMeasuresSequence", (0.75, 0.5002))],
)
def test_frames_of_two_kinds_form_no_stack(what, values):
    found = frames(0.0, 2.0)
    name = "PixelSpacing" if what == "PixelMeasuresSequence" else "ImageOrientationPatient"
    setattr(found[1], what, holder("P", **{name: values}).P)
    with refused(RefusedInputError, "direction", "pixel", "a.dcm"):
        place_frames(shared(), found, "a.dcm")
    nearly = [1, 0, 0, 0, 1, 0.00005] if len(values) == 6 else [0.75, 0.50005]
    setattr(found[1], what, holder("P", **{name: nearly}).P)
    assert place_frames(shared(), found, "a.dcm").slices == 2


@pytest.mark.parametrize(
    "directions",
    [
        (1.002, 0, 0, 0, 1, 0),
        (1, 0, 0, 0, 0.998, 0),
        (1, 0, 0, 0.08, 0.996795, 0),  # both of length 1, but not at a right angle
        (0.999, 0, 0, 0, 0.9985, 0),
    ],
)
def test_directions_have_length_one_and_a_right_angle(directions):
    with refused(RefusedInputError, "direction", "a.dcm"):
        place_frames(shared(directions), frames(0.0, 2.0), "a.dcm")
    nearly = np.array(SQUARE) + 0.3 * (np.array(directions) - SQUARE)
    assert place_frames(shared(nearly), frames(0.0, 2.0), "a.dcm").slices == 2


@pytest.mark.parametrize("spacing", [(0.0, 0.5), (0.5, -0.5)])
def test_spacing_is_above_zero(spacing):
    with refused(RefusedInputError, "direction", "a.dcm"):
        place_frames(shared(spacing=spacing), frames(0.0, 2.0), "a.dcm")


@pytest.mark.parametrize(
    ("values", "words"),
    [((0.0, 0.0), r"3 numbers are needed, there are \[0.0, 0.0\]"), ((0.0, np.nan, 0.0), "0.0, nan, 0.0")],
)
def test_a_position_is_three_finite_numbers(values, words):
    class Place:
        ImagePositionPatient = values

    with pytest.raises(ValueError, match=words):
        place_frames(shared(), [*frames(0.0), {"PlanePositionSequence": [Place]}], "a.dcm")


@pytest.mark.parametrize(
    ("positions", "measures", "step", "words"),
    [
        ((0.0, 2.5, 5.0), {"SliceThickness": 1.25}, 1.25, "2.5 mm apart, its header says 1.25 mm (SliceThickness, and"),
        ((0.0, 2.5, 5.0), {"SliceThickness": 1.25, "SpacingBetweenSlices": 2.5}, 2.5, None),
        ((0.0, 2.5, 5.0), {"SliceThickness": 2.5, "SpacingBetweenSlices": 1.25}, 1.25, None),
        ((0.0, 2.5, 5.0), {"SliceThickness": 2.48}, 2.5, None),
        ((0.0, 2.5, 5.0), {"SliceThickness": 5.0}, 2.5, None),  # slices that overlap
        ((0.0, 2.5, 5.0), {"SliceThickness": 2.0}, 2.5, "says 2 mm (SliceThickness, and there is no SpacingBetweenSli"),
        ((0.0, 2.5, 5.0), {"SpacingBetweenSlices": 2.0}, 2.5, "says 2 mm (SpacingBetweenSlices): the step is 2.5 mm"),
        (
            (0.0, 2.5, 5.0),
            {},
            2.5,
            "says neither SpacingBetweenSlices nor SliceThickness: the smallest distance of two",
        ),
        ((7.0, 7.0), {"SliceThickness": 1.25}, 1.25, None),
        ((7.0, 7.0), {}, 1.0, "one slice says neither SpacingBetweenSlices nor SliceThickness: a thickness of 1 mm"),
    ],
)
def test_the_step_is_bounded_by_the_thickness(positions, measures, step, words):
    stack = place_frames(shared(**measures), frames(*positions), "a.dcm")
    assert stack.affine[2, 2] == pytest.approx(step, rel=1e-12)
    assert [words in warning for warning in stack.warnings] == [True] * (words is not None)
