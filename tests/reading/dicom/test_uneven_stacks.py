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
    assert np.abs(volume.lps_to_ijk(truth) - ijk).max() <= 10 * tolerances.AFFINE_MM


@pytest.mark.parametrize(
    ("offsets", "words"),
    [
        ({k: 1.25 * (k - 6) for k in range(7, 20)}, "gaps 1.250 to 2.500 mm (usual 2.500 mm)"),
        ({9: 0.15}, "gaps 1.100 to 1.400 mm (usual 1.250 mm), up to 0.1"),
        ({k: 0.19 * (k - 10) for k in range(11, 20)}, "gaps 1.250 to 1.440 mm"),
        ({k: 1.25 * (k - 6) - 0.8 * (k >= 12) for k in range(7, 20)}, "gaps 1.250 to 2.500 mm"),
    ],
    ids=["feed changes", "one off", "drift", "feed changes and one off"],
)
@pytest.mark.parametrize("tilt", [0.0, -20.0])
def test_uneven_slices_lie_at_their_own_positions(tmp_path, offsets, words, tilt):
    plan = write_series(tmp_path, Plan(shape=(20, 3, 4), offsets=offsets, tilt_deg=tilt, angles=OBLIQUE))
    volume = read_volume(tmp_path)
    assert volume.uneven
    assert_in_place(volume, plan)
    assert np.array_equal(volume.voxels, plan.hu())
    told = [text for text in volume.report["warnings"] if "unevenly spaced" in text]
    assert len(told) == 1 and words in told[0] and "placed at its own position" in told[0] and ".dcm" not in told[0]
    assert volume.report["uneven"] is True
    assert abs(volume.report["tilt_deg"]) == pytest.approx(abs(tilt), abs=1e-6)
    entry = list_series(tmp_path).series[0]
    assert entry.problems == [] and entry.uneven is True and told[0] in entry.warnings


def test_slices_that_jump_sideways_are_placed_too(tmp_path):
    def sideways(ds, k):
        if k >= 4:
            ds.ImagePositionPatient = [
                float(v) + (3.0 if axis == 0 else 0.0) for axis, v in enumerate(ds.ImagePositionPatient)
            ]

    plan = write_series(tmp_path, Plan(), sideways)
    volume = read_volume(tmp_path)
    assert volume.uneven
    told = [text for text in volume.report["warnings"] if "sideways" in text]
    assert len(told) == 1 and "up to 1.286 mm" in told[0]
    assert not any("tilt" in text for text in volume.report["warnings"])
    for k in range(7):
        assert volume.ijk_to_lps([(0, 0, k)])[0] == pytest.approx(plan.position(k) + (3.0 * (k >= 4), 0, 0))


@pytest.mark.parametrize(
    ("plan", "missing"),
    [
        (Plan(leave_out=(2,)), 1),
        (Plan(shape=(12, 3, 3), leave_out=(3, 4), angles=OBLIQUE), 2),
        (Plan(shape=(12, 3, 3), leave_out=(3, 8), tilt_deg=12.0), 2),
    ],
    ids=["hole", "hole of two", "two holes"],
)
def test_missing_slices_are_read_only_when_that_is_allowed(tmp_path, plan, missing):
    write_series(tmp_path, plan)
    with refused(RefusedInputError, "allow_gaps=True"):
        read_volume(tmp_path)
    volume = read_volume(tmp_path, allow_gaps=True)
    assert_in_place(volume, plan)
    told = [text for text in volume.report["warnings"] if "missing between" in text]
    assert len(told) == 1 and ".dcm" not in told[0] and "surfaces bridge the gap" in told[0]
    assert volume.report["slices_missing"] == missing


def test_the_refusal_names_the_neighbours(tmp_path):
    write_series(tmp_path, Plan(leave_out=(2,)))
    with refused(RefusedInputError, "slice001.dcm", "slice003.dcm"):
        read_volume(tmp_path)


def test_gaps_that_are_allowed_and_not_there_change_nothing(tmp_path):
    write_series(tmp_path, Plan())
    volume = read_volume(tmp_path, allow_gaps=True)
    assert not volume.uneven and volume.report["warnings"] == [] and volume.report["slices_missing"] == 0


def test_noise_within_the_tolerance_stays_one_affine(tmp_path):
    rng = np.random.default_rng(4)
    offsets = dict(enumerate(rng.uniform(-0.008, 0.008, 40).tolist()))
    plan = write_series(tmp_path, Plan(shape=(40, 3, 3), offsets=offsets))
    volume = read_volume(tmp_path)
    assert not volume.uneven and volume.report["warnings"] == []
    assert 0.001 < volume.report["grid_residual_rms_mm"] < volume.report["grid_residual_max_mm"] < 0.0125
    even = Plan(shape=plan.shape)
    fitted = volume.ijk_to_lps([(0, 0, k) for k in range(40)])
    # The fit is nearer to the places that were meant than the stored positions are.
    assert np.abs(fitted - [even.position(k) for k in range(40)]).max() < 0.5 * max(map(abs, offsets.values()))


@pytest.mark.parametrize(
    ("plan", "missing"),
    daily_rows(
        3,
        [
            (Plan(shape=(13, 3, 3), leave_out=(2, 5, 8, 11)), 4),
            (Plan(shape=(4, 3, 3), leave_out=(2,)), 1),
            (Plan(shape=(40, 3, 3), offsets={k: 1.25 * (k - 10) for k in range(11, 40)}, leave_out=(5,)), 1),
            (Plan(shape=(40, 3, 3), offsets={k: 1.25 * (k - 10) for k in range(11, 40)}, leave_out=(1,)), 1),
            (Plan(shape=(40, 3, 3), offsets={k: 1.25 * (k - 10) for k in range(11, 40)}, leave_out=(4, 6)), 2),
            (Plan(shape=(40, 3, 3), offsets={k: 3.75 * (k - 30) for k in range(31, 40)}, leave_out=(35,)), 1),
        ],
    ),
    ids=["as many holes as gaps", "three slices", "fine part", "first gap", "two in a row", "coarse part"],
)
def test_holes_are_measured_by_the_gaps_beside_them(tmp_path, plan, missing):
    write_series(tmp_path, plan)
    with refused(RefusedInputError, "slice", "missing", 1):
        read_volume(tmp_path)
    volume = read_volume(tmp_path, allow_gaps=True)
    assert_in_place(volume, plan)
    assert volume.report["slices_missing"] == missing
