"""Voxel positions in mm against the truth, and every fault of the geometry."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, set_raw, set_values, write_series
from lost_slices import MISSING
from refusals import assert_one_line, refused
from tolerances import AFFINE_MM, DIRECTION, JITTER_DIRECTION, RIGHT_ANGLE, ROUNDED_AFFINE_MM, TILT_DEG

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume

PLANS = {
    "straight": Plan(),
    "oblique": Plan(angles=(20, -35, 50)),
    "sagittal": Plan(angles=(0, 90, 90)),
    "feet first": Plan(angles=(0, 180, 0)),
    "prone": Plan(angles=(0, 0, 180)),
    "tilt 1": Plan(tilt_deg=1),
    "tilt 2.5": Plan(tilt_deg=2.5),
    "tilt 12": Plan(tilt_deg=12),
    "tilt -20, oblique": Plan(tilt_deg=-20, angles=(5, 7, -11)),
    "shuffled names": Plan(name=lambda k: f"deep/er/{(k * 5) % 7}x"),
    "reversed": Plan(name=lambda k: f"{90 - k}"),
    "far away": Plan(origin=(1e5, -1e5, 9.9e4), decimals=6),
    "two slices": Plan(shape=(2, 3, 4)),
}


def corners(plan: Plan) -> np.ndarray:
    nk, nj, ni = plan.shape
    return np.array([(i, j, k) for i in (0, ni - 1) for j in (0, nj - 1) for k in (0, nk // 2, nk - 1)])


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_voxels_lie_where_they_were_written(tmp_path, plan):
    write_series(tmp_path, plan)
    volume = read_volume(tmp_path)
    points = corners(plan)
    assert np.abs(volume.ijk_to_lps(points) - plan.truth(points)).max() < AFFINE_MM
    assert np.array_equal(volume.voxels, plan.hu())


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_volume_is_right_handed_with_the_pixel_spacing_of_its_slices(tmp_path, plan):
    write_series(tmp_path, plan)
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.int16
    assert np.linalg.det(volume.affine[:3, :3]) > 0  # below it: a mirrored, left-handed one
    assert volume.spacing[:2] == pytest.approx(plan.pixel_spacing[::-1])  # di, dj


@pytest.mark.parametrize("tilt", [1.0, 2.5, 12.0, -20.0])
def test_gantry_tilt_is_in_the_report_and_warned_of(tmp_path, tilt):
    write_series(tmp_path, Plan(tilt_deg=tilt))
    report = read_volume(tmp_path).report
    assert report["tilt_deg"] == pytest.approx(-tilt, abs=TILT_DEG)  # a plan leans back
    assert f"gantry tilt {-tilt:+.2f} degrees" in report["warnings"][0]


@pytest.mark.parametrize("tilt", [1.0, 2.5, 12.0, -20.0])
def test_gap_of_tilted_slices_is_along_their_normal_and_spacing_along_the_table(tmp_path, tilt):
    write_series(tmp_path, Plan(tilt_deg=tilt, gap=1.25))
    report = read_volume(tmp_path).report
    assert report["gap_mm"]["max"] == pytest.approx(1.25)
    assert report["spacing_mm"][2] == pytest.approx(1.25 / np.cos(np.radians(tilt)))


def test_positions_rounded_to_a_hundredth_of_a_mm_are_even_without_a_warning(tmp_path):
    plan = Plan(shape=(40, 3, 4), gap=0.625, decimals=2)
    write_series(tmp_path, plan)
    volume = read_volume(tmp_path)
    assert np.abs(volume.ijk_to_lps(corners(plan)) - plan.truth(corners(plan))).max() < ROUNDED_AFFINE_MM
    assert volume.report["warnings"] == []
    assert volume.report["uneven"] is False
    assert 0 < volume.report["grid_residual_max_mm"] <= 0.01  # the rounding; measured 0.005, half of it


def test_directions_that_jitter_by_a_thousandth_of_a_degree_are_averaged(tmp_path):
    def jitter(ds, k):
        angle = np.radians(0.001) * (-1) ** k
        ds.ImageOrientationPatient = [np.cos(angle).round(12), np.sin(angle).round(12), 0, 0, 1, 0]

    write_series(tmp_path, Plan(shape=(8, 3, 4)), jitter)
    row, column = read_volume(tmp_path).affine[:3, :2].T
    assert row[1] == pytest.approx(0.0, abs=JITTER_DIRECTION)
    assert row @ column == pytest.approx(0.0, abs=RIGHT_ANGLE)


def test_skewed_directions_are_made_orthonormal_with_a_warning(tmp_path):
    change = set_values(ImageOrientationPatient=[1, 0.0005, 0, 0, 1, 0])
    write_series(tmp_path, change=change)
    volume = read_volume(tmp_path)
    row, column = volume.affine[:3, :2].T
    assert row @ column == pytest.approx(0.0, abs=RIGHT_ANGLE)
    assert row[1] / np.linalg.norm(row) == pytest.approx(
        0.0005 / 2, abs=DIRECTION
    )  # half the error to either direction
    assert "0.0005: made orthonormal" in volume.report["warnings"][0]


# Slice k of a plan lies at -400 + 1.25 k mm.
STACKS_WITH_HOLES = pytest.mark.parametrize(
    ("plan", "words"),
    [
        (Plan(leave_out=(2,)), MISSING),
        (Plan(shape=(12, 3, 3), leave_out=(3, 4)), "2 slices missing between -397.50 and -393.75 mm (gap 3.750 mm"),
        (Plan(shape=(12, 3, 3), leave_out=(3, 8)), "; 1 slice missing between -391.25 and -388.75 mm"),
        (Plan(shape=(1, 4, 4)), "a single slice cannot make a volume"),
    ],
    ids=["hole", "hole of two", "two holes", "single"],
)


@STACKS_WITH_HOLES
def test_stack_with_holes_or_of_one_slice_is_refused_in_one_line(tmp_path, plan, words):
    write_series(tmp_path, plan)
    with pytest.raises(RefusedInputError) as refusal:
        read_volume(tmp_path)
    assert_one_line(refusal.value)
    assert words in str(refusal.value)


@STACKS_WITH_HOLES
def test_stack_with_holes_or_of_one_slice_is_listed_without_an_affine_and_with_its_problem(tmp_path, plan, words):
    write_series(tmp_path, plan)
    series = list_series(tmp_path).series[0]
    assert series.affine_ijk_to_lps_mm is None
    assert words in series.problems[0]


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (set_values(only=2, FrameOfReferenceUID="1.2.3.4"), ("FrameOfReferenceUID", "slice002.dcm")),
        (set_values(only=2, PixelSpacing=[0.7, 0.51]), ("PixelSpacing", "0.7\\0.51", "slice002.dcm")),
        (
            set_values(only=2, ImageOrientationPatient=[1, 0.001, 0, -0.001, 1, 0]),
            ("ImageOrientationPatient", "slice002.dcm"),
        ),
        (
            set_values(only=2, ImageOrientationPatient=[1, 0.002, 0, 0, 1, 0]),
            ("ImageOrientationPatient", "slice002.dcm"),
        ),
        (set_values(only=2, ImageOrientationPatient=[0, 0, 0, 0, 0, 0]), (-398.75, -396.25, "missing")),
    ],
    ids=["frame of reference", "spacing", "spread", "skew", "zeros"],
)
def test_slice_with_another_frame_spacing_or_orientation_is_refused(tmp_path, change, facts):
    """A slice whose orientation is zeros is parted from the stack, which then has a hole."""
    write_series(tmp_path, change=change)
    with refused(RefusedInputError, *facts):
        read_volume(tmp_path)


def test_slice_with_another_number_of_rows_is_refused(tmp_path):
    plan = write_series(tmp_path)
    columns, rows = 6, 4  # the others have 5 rows
    ds = make_dataset(Plan(shape=(7, rows, columns)), 3)
    save_dataset(ds, tmp_path / plan.name(3))
    with refused(RefusedInputError, "Columns", "Rows", columns, rows):
        read_volume(tmp_path)


BAD_VALUES = [
    ("PixelSpacing", "0\\0", "PixelSpacing (0028,0030) is '0\\0'"),
    ("PixelSpacing", "-0.7\\0.5", "PixelSpacing (0028,0030) is '-0.7\\0.5'"),
    ("PixelSpacing", "700\\500", "PixelSpacing (0028,0030) is '700\\500'"),
    ("PixelSpacing", "0,7\\0,5", "PixelSpacing (0028,0030) is '0,7\\0,5', expected 2 finite numbers"),
    ("PixelSpacing", "nan\\0.5", "PixelSpacing (0028,0030) is 'nan\\0.5'"),
    ("PixelSpacing", "0.5", "PixelSpacing (0028,0030) is '0.5'"),
    ("PixelSpacing", "", "PixelSpacing (0028,0030) is missing or empty"),
    ("ImagePositionPatient", "1\\2", "ImagePositionPatient (0020,0032) is '1\\2'"),
    ("ImagePositionPatient", "1\\2\\NaN", "ImagePositionPatient (0020,0032) is '1\\2\\NaN'"),
    ("ImagePositionPatient", "1\\2\\3e9", "ImagePositionPatient (0020,0032) is '1\\2\\3e9', expected within 1e+06 mm"),
    ("ImagePositionPatient", "", "ImagePositionPatient (0020,0032) is missing or empty"),
    ("ImageOrientationPatient", "1\\0\\0\\0\\inf\\0", "ImageOrientationPatient (0020,0037) is"),
    ("ImageOrientationPatient", "1\\0\\0", "ImageOrientationPatient (0020,0037) is '1\\0\\0'"),
    ("RescaleSlope", "0", "RescaleSlope (0028,1053) is '0', expected a finite number other than 0"),
    ("RescaleSlope", "abc", "RescaleSlope (0028,1053) is 'abc'"),
    ("RescaleSlope", "1,5", "RescaleSlope (0028,1053) is '1,5'"),
    ("RescaleSlope", "1e400", "RescaleSlope (0028,1053) is '1e400'"),
    ("RescaleSlope", "inf", "RescaleSlope (0028,1053) is 'inf'"),
    ("RescaleIntercept", "nan", "RescaleIntercept (0028,1052) is 'nan'"),
]


@pytest.mark.parametrize("keyword, text, words", BAD_VALUES, ids=[f"{k}={t}" for k, t, _ in BAD_VALUES])
def test_unsound_geometry_or_rescale_is_refused_by_file_and_element(tmp_path, keyword, text, words):
    write_series(tmp_path, Plan(shape=(4, 3, 3)), set_raw(keyword, text, only=1))
    with refused(RefusedInputError, "slice001.dcm", keyword, text or "missing"):
        read_volume(tmp_path)
    assert any(words in problem for problem in list_series(tmp_path).series[0].problems)


@pytest.mark.parametrize("stated", [-5.0, 1.3])
def test_spacing_between_slices_that_the_positions_contradict_is_not_used_and_warned_of(tmp_path, stated):
    plan = write_series(tmp_path, change=set_values(SpacingBetweenSlices=stated, SliceThickness=-7))
    volume = read_volume(tmp_path)
    assert volume.spacing[2] == pytest.approx(plan.gap)
    assert volume.report["warnings"] == [
        f"SpacingBetweenSlices says {stated:g} mm, the positions say 1.25 mm: the positions are used"
    ]


def test_thickness_that_is_no_number_is_not_used_and_warned_of(tmp_path):
    write_series(tmp_path, change=set_raw("SliceThickness", "thick"))
    report = read_volume(tmp_path).report
    assert report["slice_thickness_mm"] is None
    assert "SliceThickness (0018,0050) is no finite number" in report["warnings"][0]
