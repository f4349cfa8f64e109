"""The certificate says what is there, in the names of the contract, and each gate fails for its own reason."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import tolerances
from dicom_series import Plan, set_raw, set_values, write_series
from refusals import refused
from report_schemas import find_faults

from clrecon import list_series, read_volume
from clrecon.cli.main import main
from clrecon.geometry import compose_affine
from clrecon.geometry.affine import facts_of_orientation
from clrecon.reading.dicom import reader
from clrecon.reading.dicom.stack.fit import summarise_gaps

IDENTITY = set_values(
    PatientName="SECRET^NAME", PatientID="SECRETID", SeriesDescription="SECRET scan", StudyID="SECRET",
    StudyDate="19010203", InstitutionName="SECRET house", ImageComments="SECRET",
)  # fmt: skip


def read_certificate(folder, **options):
    certificate = list_series(folder, **options).certificate
    assert certificate is not None
    return certificate


def failed_gates(certificate) -> set[str]:
    return {gate["name"] for gate in certificate["gates"] if gate["ok"] is False}


def unmeasured(certificate) -> set[str]:
    return {gate["name"] for gate in certificate["gates"] if gate["ok"] is None}


def test_certificate_of_headers_and_of_a_volume_fit_the_schema(tmp_path):
    write_series(tmp_path)
    assert find_faults(read_certificate(tmp_path), "certificate") == []
    assert find_faults(read_volume(tmp_path).report, "certificate") == []


def test_certificate_of_a_listing_that_reads_pixels_is_the_report_of_the_volume_in_json(tmp_path):
    write_series(tmp_path)
    report = read_volume(tmp_path).report
    assert read_certificate(tmp_path, pixels=True) == report
    assert json.loads(json.dumps(report)) == report


def test_certificate_has_the_gates_of_the_contract(tmp_path):
    write_series(tmp_path)
    contract = (Path(__file__).resolve().parents[3] / "docs" / "contract.md").read_text(encoding="utf-8")
    table = contract.split("The table gives what a series must meet:\n\n| gate | bound |\n|---|---|\n")[1].split(
        "\n\n"
    )[0]
    named = {name for row in table.splitlines() for name in re.findall(r"`(\w+)`", row.split("|")[1])}

    assert {gate["name"] for gate in read_volume(tmp_path).report["gates"]} == named


def test_certificate_of_headers_alone_measures_no_gate_of_pixels_and_reads_none(tmp_path, monkeypatch):
    write_series(tmp_path)

    def refuse(*_):
        raise AssertionError("pixels were read")

    monkeypatch.setattr(reader, "read_voxels", refuse)
    certificate = read_certificate(tmp_path)
    assert (certificate["padding_share"], certificate["hu_range"]) == (None, None)
    assert unmeasured(certificate) == {
        "stated_gap",
        "stated_places",
        "shown_places",
        "padding_share",
        "stored_bits",
        "one_volume",
        "hu_scale",
        "stored_sign",
    }
    with refused(AssertionError, "pixels"):
        read_certificate(tmp_path, pixels=True)


@pytest.fixture(scope="module")
def oblique_tilted(tmp_path_factory):
    """The plan of 7 slices 5 mm thick, tilted by 12 degrees and oblique, and the report of their volume."""
    folder = tmp_path_factory.mktemp("oblique")
    plan = Plan(shape=(7, 5, 6), pixel_spacing=(0.7, 0.5), gap=1.25, tilt_deg=12, angles=(3, 4, -5))
    write_series(folder, plan, set_values(PatientPosition="FFP", SliceThickness=5.0))
    return plan, read_volume(folder).report


def test_certificate_of_an_oblique_tilted_series_has_its_geometry(oblique_tilted):
    _, report = oblique_tilted
    assert report["extent_mm"] == pytest.approx([6 * 0.5, 5 * 0.7, 7 * 1.25])
    assert report["gap_mm"] == pytest.approx({"min": 1.25, "max": 1.25, "median": 1.25})
    assert report["tilt_deg"] == pytest.approx(-12.0, abs=1e-6)  # the plan's 12: the back edge towards the head
    assert report["grid_residual_max_mm"] <= tolerances.AFFINE_MM
    assert report["grid_tolerance_mm"] == pytest.approx(0.0125)  # a hundredth of the gap


def test_certificate_of_an_oblique_series_has_its_directions(oblique_tilted):
    plan, report = oblique_tilted
    orientation, (row, column, normal) = report["orientation"], plan.directions
    assert orientation["row"] == pytest.approx(list(row), abs=1e-8)  # written with nine decimals
    assert orientation["column"] == pytest.approx(list(column), abs=1e-8)
    assert orientation["normal"] == pytest.approx(list(normal), abs=1e-8)
    assert orientation["off_axis_deg"] == pytest.approx(np.degrees(np.arccos(normal[2])))
    assert (orientation["axes"], orientation["right_handed"]) == ("LPS", True)
    assert report["patient_position"] == "FFP"


def test_certificate_of_an_even_series_misses_nothing_and_passes_its_gates(oblique_tilted):
    _, report = oblique_tilted
    assert (report["uneven"], report["gap_runs"], report["slice_positions_mm"]) == (False, None, None)
    assert (report["slices"], report["slices_missing"], report["dropped"]) == (7, 0, {})
    assert failed_gates(report) == set()


def test_slices_thicker_than_their_gap_overlap(oblique_tilted):
    """Slices 5 mm thick every 1.25 mm share 3.75 mm, three times the gap."""
    _, report = oblique_tilted
    assert report["thickness"] == {
        "min_mm": 5.0, "max_mm": 5.0, "median_mm": 5.0, "overlap_percent": pytest.approx(300.0),
        "overlap_mm": pytest.approx({"min": 3.75, "max": 3.75, "median": 3.75}),
    }  # fmt: skip


def test_slices_thinner_than_their_gap_have_a_negative_overlap(tmp_path):
    def thin(ds, k):
        ds.SliceThickness = 1.0 if k < 3 else 0.5

    write_series(tmp_path, Plan(shape=(7, 5, 6), gap=1.25), thin)
    thickness = read_certificate(tmp_path)["thickness"]
    assert (thickness["min_mm"], thickness["max_mm"], thickness["median_mm"]) == (0.5, 1.0, 0.5)
    assert thickness["overlap_mm"] == pytest.approx({"min": 0.5 - 1.25, "max": 1.0 - 1.25, "median": -0.625})
    assert thickness["overlap_percent"] == pytest.approx(-50.0)


def test_thickness_that_one_slice_does_not_state_is_not_in_the_certificate(tmp_path):
    write_series(tmp_path, change=set_values(only=2, SliceThickness=None))
    assert read_certificate(tmp_path)["thickness"] is None


@pytest.mark.parametrize(
    ("steps", "axes", "right_handed", "off_axis"),
    [
        (((1, 0, 0), (0, 1, 0), (0, 0, 1)), "LPS", True, 0.0),
        (((-1, 0, 0), (0, -1, 0), (0, 0, 2)), "RAS", True, 0.0),
        (((0, 2, 0), (0, 0, -3), (-1, 0, 0)), "PIR", True, 0.0),
        (((1, 0, 0), (0, 1, 0), (0, 0, -1)), "LPS", False, 0.0),
        (((0.8, 0.6, 0), (-0.6, 0.8, 0), (0, 0, 1)), "LPS", True, 0.0),
        (((1, 0, 0), (0, 0.8, 0.6), (0, -0.6, 0.8)), "LPS", True, np.degrees(np.arccos(0.8))),
    ],
)
def test_directions_of_the_axes_are_named_by_letters_of_the_patient(steps, axes, right_handed, off_axis):
    i_step, j_step, k_step = steps
    found = facts_of_orientation(compose_affine(i_step, j_step, k_step, (0, 0, 0)))
    assert (found["axes"], found["right_handed"]) == (axes, right_handed)
    assert found["off_axis_deg"] == pytest.approx(off_axis)


def test_runs_of_equal_gaps_are_listed_with_their_count():
    distances = np.cumsum([0.0, *[4.002] * 3, 1.081, *[6.999] * 2])
    assert summarise_gaps(distances) == [
        {"count": 3, "gap_mm": pytest.approx(4.002)},
        {"count": 1, "gap_mm": pytest.approx(1.081)},
        {"count": 2, "gap_mm": pytest.approx(6.999)},
    ]
    assert summarise_gaps(distances[:1]) == []


def test_certificate_of_an_uneven_series_has_the_position_of_each_slice(tmp_path):
    plan = write_series(tmp_path, Plan(shape=(7, 5, 6), offsets={3: 0.15}))
    certificate = read_certificate(tmp_path)
    assert certificate["uneven"]
    assert "grid_residual" in failed_gates(certificate)
    assert [run["count"] for run in certificate["gap_runs"]] == [2, 1, 1, 2]
    expected = [list(plan.position(k)) for k in range(7)]
    np.testing.assert_allclose(certificate["slice_positions_mm"], expected, atol=tolerances.AFFINE_MM)


SKEWED = "1\\0\\0\\5e-4\\0.9999999\\0"
ONE_GATE = {
    "hu_known": (Plan(), set_values(RescaleType="US")),
    "hu_known, no slope": (Plan(), set_values(only=3, RescaleSlope=None)),
    "lossless": (Plan(), set_values(only=3, LossyImageCompression="01")),
    "measured_images": (Plan(), set_values(ImageType=["DERIVED", "SECONDARY", "MPR"])),
    "stated_gap": (Plan(gap=1.25), set_values(SpacingBetweenSlices=0.625)),
    "stated_gap, below zero": (Plan(gap=1.25), set_values(SpacingBetweenSlices=-1.25)),
    "orientation_exact": (Plan(), set_raw("ImageOrientationPatient", SKEWED)),
}


@pytest.mark.parametrize("case", ONE_GATE)
def test_series_that_fails_one_gate_is_read_with_a_warning(tmp_path, case):
    plan, change = ONE_GATE[case]
    write_series(tmp_path, plan, change)
    report = read_volume(tmp_path).report
    assert failed_gates(report) == {case.partition(",")[0]}
    assert report["warnings"] != []  # who does not ask for gates is told all the same
    assert report["problems"] == []


@pytest.mark.parametrize(
    "stated", [round(1.25 / np.cos(np.radians(20)), 4), 1.25], ids=["along the table", "along the normal"]
)
def test_gap_of_tilted_slices_may_be_stated_along_table_or_normal(tmp_path, stated):
    write_series(tmp_path, Plan(tilt_deg=20, gap=1.25), set_values(SpacingBetweenSlices=stated))
    certificate = read_certificate(tmp_path)
    assert failed_gates(certificate) == set()
    assert not [warning for warning in certificate["warnings"] if "SpacingBetweenSlices" in warning]


def test_series_with_a_hole_of_two_slices_fails_the_gate_of_missing_slices_and_has_no_affine(tmp_path):
    write_series(tmp_path, Plan(shape=(9, 5, 6), leave_out=(4, 5)))
    certificate = read_certificate(tmp_path)
    assert certificate["slices_missing"] == 2
    assert failed_gates(certificate) >= {"usable", "missing_slices"}
    assert certificate["affine_ijk_to_lps_mm"] is None
    assert certificate["problems"] != []


def test_series_with_a_cut_file_fails_the_gates_of_files_and_of_use(tmp_path):
    write_series(tmp_path)
    first = tmp_path / "slice000.dcm"
    first.write_bytes(first.read_bytes()[:500])
    assert failed_gates(read_certificate(tmp_path)) == {"usable", "readable"}


def test_padding_of_four_fifths_of_the_voxels_fails_its_gate_where_pixels_are_read(tmp_path):
    def pad(ds, k):
        ds.PixelPaddingValue = -2000
        pixels = np.full(5 * 6, -2000, "i2")
        pixels[:6] = 1000
        ds.PixelData = pixels.tobytes()

    write_series(tmp_path, Plan(shape=(7, 5, 6)), pad)
    report = read_volume(tmp_path).report
    assert report["padding_share"] == pytest.approx(0.8)
    assert failed_gates(report) == {"padding_share"}
    assert any("padding" in text for text in report["warnings"])
    assert failed_gates(read_certificate(tmp_path)) == set()


def test_certificate_holds_no_patient_no_date_and_no_folder(tmp_path):
    def spoil(ds, k):
        IDENTITY(ds, k)
        ds.RescaleType = "US"
        ds.LossyImageCompression = "01"
        ds.SpacingBetweenSlices = 3
        ds.ImageType = ["DERIVED", "SECONDARY", "MIP"]
        ds.PhotometricInterpretation = "MONOCHROME1"
        ds.PatientPosition = "SECRET"

    write_series(tmp_path, Plan(tilt_deg=5, name="SECRET{}.dcm".format), spoil)
    write_series(tmp_path, Plan(series=2, shape=(3, 5, 6), name="SECRET_b{}.dcm".format), IDENTITY)
    (tmp_path / "SECRET.dcm").write_bytes(b"\0" * 128 + b"DICM" + b"\xff" * 40)
    listing = list_series(tmp_path, pixels=True)
    certificate = dict(listing.certificate or {})
    assert len(certificate["warnings"]) == 8  # five of tags above, the tilt, the corrupt file and the other series
    certificate.pop("problems")  # a refusal names files, on the terminal alone
    text = json.dumps(certificate)
    assert [word for word in ("SECRET", "1901", str(tmp_path)) if word in text] == []


@pytest.mark.parametrize(("name", "slices"), [("lumbar_4p25mm", 99), ("thoracic_0p8mm", 95)])
def test_real_series_passes_all_gates(real_data, name, slices):
    certificate = read_certificate(real_data / name, pixels=True)
    assert certificate["slices"] == slices
    assert failed_gates(certificate) == set()


def test_real_series_with_three_gaps_has_them_as_runs_and_fails_the_gate_of_the_grid(real_data):
    certificate = read_certificate(real_data / "head_tilt_gaps")
    runs = [(run["count"], round(run["gap_mm"], 3)) for run in certificate["gap_runs"]]
    assert runs == [(13, 4.002), (1, 1.081), (13, 6.999)]
    assert "grid_residual" in failed_gates(certificate)


@pytest.mark.parametrize(
    "orientation", [[1, 0.01, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0]], ids=["not at right angles", "zeros"]
)
def test_stack_without_sound_directions_fails_that_gate_in_strict_json(tmp_path, orientation):
    write_series(tmp_path, change=set_values(ImageOrientationPatient=orientation))
    certificate = list_series(tmp_path, series=1).certificate
    assert json.dumps(certificate, allow_nan=False)
    gates = {gate["name"]: gate for gate in certificate["gates"]}
    assert gates["orientation_exact"]["ok"] is False
    assert (gates["orientation_same"]["ok"], gates["orientation_same"]["measured"]) == (None, None)


@pytest.mark.parametrize(("value", "told"), [("QUADRUPED", True), ("BIPED", False), (None, False)])
def test_directions_of_a_quadruped_are_warned_of_and_explained_by_info(tmp_path, printed, value, told):
    """The letters of directions mean other ones, in pictures too."""
    change = set_values(AnatomicalOrientationType=value) if value else set_values()
    write_series(tmp_path, Plan(), change)
    report = read_volume(tmp_path).report
    assert report["anatomical_orientation"] == ("QUADRUPED" if told else None)
    assert any("QUADRUPED" in text and "A as ventral" in text for text in report["warnings"]) is told
    assert main(["info", str(tmp_path)]) == 0
    assert ("back is dorsal" in printed().everything) is told
