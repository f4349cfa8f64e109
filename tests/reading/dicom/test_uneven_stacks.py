"""Slices that lie on no even line: placed one by one with a warning; missing ones refused unless allowed."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from dicom_series import Plan, write_series
from refusals import refused
from variants import daily_rows

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume

OBLIQUE = (20.0, -15.0, 30.0)


def assert_in_place(volume, plan: Plan) -> None:
    """Every corner of every slice lies where it was written, and comes back."""
    n, rows, columns = plan.shape
    written = [k for k in range(n) if k not in plan.leave_out]
    corners = [(i, j) for i in (0, columns - 1) for j in (0, rows - 1)]
    ijk = np.array([(i, j, k) for k in range(len(written)) for i, j in corners])
    truth = plan.truth(np.array([(i, j, k) for k in written for i, j in corners]))
    assert np.abs(volume.ijk_to_lps(ijk) - truth).max() <= tolerances.AFFINE_MM
    assert np.abs(volume.lps_to_ijk(truth) - ijk).max() <= tolerances.INVERSE_AFFINE_VOXEL


def warnings_with(report, words):
    return [warning for warning in report["warnings"] if words in warning]


# Offsets in mm from even steps of 1.25 mm, which a plan has by default.
UNEVEN = pytest.mark.parametrize(
    ("offsets", "words"),
    [
        ({k: 1.25 * (k - 6) for k in range(7, 20)}, "gaps 1.250 to 2.500 mm (usual 2.500 mm)"),
        ({9: 0.15}, "gaps 1.100 to 1.400 mm (usual 1.250 mm), up to 0.1"),
        ({k: 0.19 * (k - 10) for k in range(11, 20)}, "gaps 1.250 to 1.440 mm"),
        ({k: 1.25 * (k - 6) - 0.8 * (k >= 12) for k in range(7, 20)}, "gaps 1.250 to 2.500 mm"),
    ],
    ids=["feed changes", "one off", "drift", "feed changes and one off"],
)
TILTED = pytest.mark.parametrize("tilt", [0.0, -20.0], ids=["straight", "tilted"])


@UNEVEN
@TILTED
def test_uneven_slices_lie_at_their_own_positions(tmp_path, offsets, words, tilt):
    plan = write_series(tmp_path, Plan(shape=(20, 3, 4), offsets=offsets, tilt_deg=tilt, angles=OBLIQUE))
    volume = read_volume(tmp_path)
    assert volume.uneven
    assert_in_place(volume, plan)
    assert np.array_equal(volume.voxels, plan.hu())


@UNEVEN
@TILTED
def test_uneven_slices_are_warned_of_with_their_gaps_and_without_names_of_files(tmp_path, offsets, words, tilt):
    write_series(tmp_path, Plan(shape=(20, 3, 4), offsets=offsets, tilt_deg=tilt, angles=OBLIQUE))
    (warning,) = warnings_with(read_volume(tmp_path).report, "unevenly spaced")
    assert words in warning
    assert "placed at its own position" in warning
    assert ".dcm" not in warning


@UNEVEN
@TILTED
def test_tilt_of_uneven_slices_is_in_the_report(tmp_path, offsets, words, tilt):
    write_series(tmp_path, Plan(shape=(20, 3, 4), offsets=offsets, tilt_deg=tilt, angles=OBLIQUE))
    report = read_volume(tmp_path).report
    assert report["uneven"] is True
    assert abs(report["tilt_deg"]) == pytest.approx(abs(tilt), abs=tolerances.TILT_DEG)


@UNEVEN
def test_uneven_series_is_listed_without_a_problem_and_with_the_warning(tmp_path, offsets, words):
    write_series(tmp_path, Plan(shape=(20, 3, 4), offsets=offsets, angles=OBLIQUE))
    series = list_series(tmp_path).series[0]
    assert series.problems == []
    assert series.uneven is True
    assert any(words in warning for warning in series.warnings)


SIDEWAYS_MM = 3.0
FIRST_SIDEWAYS = 4


@pytest.fixture
def jump_sideways(tmp_path):
    """The plan of 7 slices, of which those from the fifth on were written 3 mm to the left, and their folder."""

    def change(ds, k):
        if k >= FIRST_SIDEWAYS:
            x, y, z = map(float, ds.ImagePositionPatient)
            ds.ImagePositionPatient = [x + SIDEWAYS_MM, y, z]

    return write_series(tmp_path, Plan(), change), tmp_path


def test_slices_that_jump_sideways_lie_at_their_own_positions(jump_sideways):
    plan, folder = jump_sideways
    volume = read_volume(folder)
    assert volume.uneven
    for k in range(7):
        sideways_mm = SIDEWAYS_MM if k >= FIRST_SIDEWAYS else 0.0
        assert volume.ijk_to_lps([(0, 0, k)])[0] == pytest.approx(plan.position(k) + (sideways_mm, 0.0, 0.0))


def test_slices_that_jump_sideways_are_warned_of_and_not_taken_for_a_tilt(jump_sideways):
    plan, folder = jump_sideways
    report = read_volume(folder).report
    (warning,) = warnings_with(report, "sideways")
    k = np.arange(plan.shape[0])
    sideways_mm = np.where(k >= FIRST_SIDEWAYS, SIDEWAYS_MM, 0.0)
    straight_mm = np.polyval(np.polyfit(k, sideways_mm, 1), k)  # the line through all seven
    assert f"up to {np.abs(sideways_mm - straight_mm).max():.3f} mm" in warning
    assert not warnings_with(report, "tilt")


HOLES = pytest.mark.parametrize(
    ("plan", "missing"),
    [
        (Plan(leave_out=(2,)), 1),
        (Plan(shape=(12, 3, 3), leave_out=(3, 4), angles=OBLIQUE), 2),
        (Plan(shape=(12, 3, 3), leave_out=(3, 8), tilt_deg=12.0), 2),
    ],
    ids=["hole", "hole of two", "two holes"],
)


@HOLES
def test_series_with_missing_slices_is_refused_with_the_parameter_that_allows_them(tmp_path, plan, missing):
    write_series(tmp_path, plan)
    with refused(RefusedInputError, "allow_gaps=True"):
        read_volume(tmp_path)


@HOLES
def test_series_with_allowed_gaps_is_read_in_place_with_one_warning(tmp_path, plan, missing):
    write_series(tmp_path, plan)
    volume = read_volume(tmp_path, allow_gaps=True)
    assert_in_place(volume, plan)
    assert volume.report["slices_missing"] == missing
    (warning,) = warnings_with(volume.report, "missing between")
    assert "surfaces bridge the gap" in warning
    assert ".dcm" not in warning


def test_refusal_of_a_missing_slice_names_the_files_on_either_side(tmp_path):
    write_series(tmp_path, Plan(leave_out=(2,)))
    with refused(RefusedInputError, "slice001.dcm", "slice003.dcm"):
        read_volume(tmp_path)


def test_whole_series_read_with_gaps_allowed_is_even_without_a_warning(tmp_path):
    write_series(tmp_path, Plan())
    volume = read_volume(tmp_path, allow_gaps=True)
    assert not volume.uneven
    assert volume.report["slices_missing"] == 0
    assert volume.report["warnings"] == []


@pytest.fixture
def noisy_positions(tmp_path):
    """The volume of 40 slices whose positions are off by up to 0.008 mm, and the offsets."""
    offsets = dict(enumerate(np.random.default_rng(4).uniform(-0.008, 0.008, 40).tolist()))
    write_series(tmp_path, Plan(shape=(40, 3, 3), offsets=offsets))
    return read_volume(tmp_path), offsets


def test_noise_of_positions_within_the_tolerance_is_even_without_a_warning(noisy_positions):
    volume, _ = noisy_positions
    assert not volume.uneven
    assert volume.report["warnings"] == []
    tolerance_mm = Plan().gap / 100
    assert 0 < volume.report["grid_residual_rms_mm"] < volume.report["grid_residual_max_mm"] < tolerance_mm


def test_fitted_places_are_nearer_to_the_even_ones_than_noisy_positions_are(noisy_positions):
    volume, offsets = noisy_positions
    even = Plan(shape=(40, 3, 3))
    fitted = volume.ijk_to_lps([(0, 0, k) for k in range(40)])
    off_even = np.abs(fitted - [even.position(k) for k in range(40)])
    assert off_even.max() < 0.5 * max(map(abs, offsets.values()))  # a fit averages: measured 0.0024 of 0.0077 mm


FINE_THEN_COARSE = {k: 1.25 * (k - 10) for k in range(11, 40)}
"""Offsets of slices 1.25 mm apart up to the eleventh, then 2.5 mm."""
HOLES_AMONG_OTHER_GAPS = pytest.mark.parametrize(
    ("plan", "missing"),
    daily_rows(
        3,
        [
            pytest.param(Plan(shape=(13, 3, 3), leave_out=(2, 5, 8, 11)), 4, id="as many holes as gaps"),
            pytest.param(Plan(shape=(4, 3, 3), leave_out=(2,)), 1, id="three slices"),
            pytest.param(Plan(shape=(40, 3, 3), offsets=FINE_THEN_COARSE, leave_out=(5,)), 1, id="fine part"),
            pytest.param(Plan(shape=(40, 3, 3), offsets=FINE_THEN_COARSE, leave_out=(1,)), 1, id="first gap"),
            pytest.param(Plan(shape=(40, 3, 3), offsets=FINE_THEN_COARSE, leave_out=(4, 6)), 2, id="two in a row"),
            pytest.param(
                Plan(shape=(40, 3, 3), offsets={k: 3.75 * (k - 30) for k in range(31, 40)}, leave_out=(35,)),
                1,
                id="coarse part",
            ),
        ],
    ),
)


@HOLES_AMONG_OTHER_GAPS
def test_hole_that_is_as_wide_as_gaps_elsewhere_is_refused_as_a_missing_slice(tmp_path, plan, missing):
    write_series(tmp_path, plan)
    with refused(RefusedInputError, "slice", "missing", 1):  # in each hole one
        read_volume(tmp_path)


@HOLES_AMONG_OTHER_GAPS
def test_slices_missing_in_holes_are_counted_by_the_gaps_beside_them(tmp_path, plan, missing):
    write_series(tmp_path, plan)
    volume = read_volume(tmp_path, allow_gaps=True)
    assert_in_place(volume, plan)
    assert volume.report["slices_missing"] == missing
