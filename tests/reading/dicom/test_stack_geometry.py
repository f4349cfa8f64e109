"""Voxel positions in mm against the truth, and every fault of the geometry."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, set_raw, set_values, write_series
from lost_slices import MISSING
from refusals import assert_one_line, refused
from tolerances import AFFINE_MM, ROUNDED_AFFINE_MM

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
    assert volume.voxels.dtype == np.int16
    assert np.linalg.det(volume.affine[:3, :3]) > 0
    assert volume.spacing[:2] == pytest.approx((0.5, 0.7))


@pytest.mark.parametrize("tilt", [1.0, 2.5, 12.0, -20.0])
def test_gantry_tilt_is_reported(tmp_path, tilt):
    write_series(tmp_path, Plan(tilt_deg=tilt))
    report = read_volume(tmp_path).report
    assert report["tilt_deg"] == pytest.approx(-tilt, abs=1e-6)  # a plan leans back
    assert f"gantry tilt {-tilt:+.2f} degrees" in report["warnings"][0]
    assert report["gap_mm"]["max"] == pytest.approx(1.25)
    assert report["spacing_mm"][2] == pytest.approx(1.25 / np.cos(np.radians(tilt)))


def test_rounded_positions_pass_without_a_word(tmp_path):
    plan = Plan(shape=(40, 3, 4), gap=0.625, decimals=2)
    write_series(tmp_path, plan)
    volume = read_volume(tmp_path)
    assert np.abs(volume.ijk_to_lps(corners(plan)) - plan.truth(corners(plan))).max() < ROUNDED_AFFINE_MM
    assert volume.report["warnings"] == []
    assert volume.report["uneven"] is False
    assert 0.002 < volume.report["grid_residual_max_mm"] <= 0.01


def test_small_jitter_of_the_directions_is_averaged(tmp_path):
    def jitter(ds, k):
        angle = np.radians(0.001) * (-1) ** k
        ds.ImageOrientationPatient = [np.cos(angle).round(12), np.sin(angle).round(12), 0, 0, 1, 0]

    write_series(tmp_path, Plan(shape=(8, 3, 4)), jitter)
    affine = read_volume(tmp_path).affine
    assert affine[1, 0] == pytest.approx(0.0, abs=0.5e-5)
    assert affine[:3, 0] @ affine[:3, 1] == pytest.approx(0.0, abs=1e-9)


def test_skewed_directions_are_made_orthonormal_with_a_warning(tmp_path):
    change = set_values(ImageOrientationPatient=[1, 0.0005, 0, 0, 1, 0])
    write_series(tmp_path, change=change)
    volume = read_volume(tmp_path)
    assert volume.affine[:3, 0] @ volume.affine[:3, 1] == pytest.approx(0.0, abs=1e-12)
    assert volume.affine[1, 0] / 0.5 == pytest.approx(0.00025, abs=1e-8)
    assert "0.0005: made orthonormal" in volume.report["warnings"][0]


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (Plan(leave_out=(2,)), MISSING),
        (Plan(shape=(12, 3, 3), leave_out=(3, 4)), "2 slices missing between -397.50 and -393.75 mm (gap 3.750 mm"),
        (Plan(shape=(12, 3, 3), leave_out=(3, 8)), "; 1 slice missing between -391.25 and -388.75 mm"),
        (Plan(shape=(1, 4, 4)), "a single slice cannot make a surface"),
    ],
    ids=["hole", "hole of two", "two holes", "single"],
)
def test_stacks_that_are_no_grid_are_refused_by_name(tmp_path, plan, words):
    write_series(tmp_path, plan)
    with pytest.raises(RefusedInputError) as caught:
        read_volume(tmp_path)
    assert_one_line(caught.value)
    entry = list_series(tmp_path).series[0]
    assert entry.affine_ijk_to_lps_mm is None
    assert words in entry.problems[0]


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        (set_values(2, FrameOfReferenceUID="1.2.3.4"), ("FrameOfReferenceUID", "slice002.dcm")),
        (set_values(2, PixelSpacing=[0.7, 0.51]), ("PixelSpacing", "0.7\\0.51", "slice002.dcm")),
        (
            set_values(2, ImageOrientationPatient=[1, 0.001, 0, -0.001, 1, 0]),
            ("ImageOrientationPatient", "slice002.dcm"),
        ),
        (set_values(2, ImageOrientationPatient=[1, 0.002, 0, 0, 1, 0]), ("ImageOrientationPatient", "slice002.dcm")),
        (set_values(2, ImageOrientationPatient=[0, 0, 0, 0, 0, 0]), (-398.75, -396.25, "missing")),
    ],
    ids=["frame of reference", "spacing", "spread", "skew", "zeros"],
)
def test_mixed_values_are_refused(tmp_path, change, facts):
    """A slice whose orientation is zeros is parted from the stack, which then has a hole."""
    write_series(tmp_path, change=change)
    with refused(RefusedInputError, *facts):
        read_volume(tmp_path)


def test_rows_and_columns_that_differ_are_refused(tmp_path):
    plan = write_series(tmp_path)
    ds = make_dataset(Plan(shape=(7, 4, 6)), 3)
    save_dataset(ds, tmp_path / plan.name(3))
    with refused(RefusedInputError, "Columns", "Rows", 6, 4):
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
def test_bad_values_name_file_and_tag(tmp_path, keyword, text, words):
    write_series(tmp_path, Plan(shape=(4, 3, 3)), set_raw(keyword, text, only=1))
    with refused(RefusedInputError, "slice001.dcm", keyword, text or "missing"):
        read_volume(tmp_path)
    assert any(words in problem for problem in list_series(tmp_path).series[0].problems)


@pytest.mark.parametrize("stated", [-5.0, 1.3])
def test_stated_spacing_is_ignored_with_a_warning(tmp_path, stated):
    plan = write_series(tmp_path, change=set_values(SpacingBetweenSlices=stated, SliceThickness=-7))
    volume = read_volume(tmp_path)
    assert volume.spacing[2] == pytest.approx(plan.gap)
    assert volume.report["warnings"] == [
        f"SpacingBetweenSlices says {stated:g} mm, the positions say 1.25 mm: the positions are used"
    ]


def test_a_wrong_thickness_is_only_a_warning(tmp_path):
    write_series(tmp_path, change=set_raw("SliceThickness", "thick"))
    report = read_volume(tmp_path).report
    assert report["slice_thickness_mm"] is None
    assert "SliceThickness (0018,0050) is no finite number" in report["warnings"][0]
