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


def certify(folder, **options):
    certificate = list_series(folder, **options).certificate
    assert certificate is not None
    return certificate


def failed(certificate) -> set[str]:
    return {gate["name"] for gate in certificate["gates"] if gate["ok"] is False}


def unmeasured(certificate) -> set[str]:
    return {gate["name"] for gate in certificate["gates"] if gate["ok"] is None}


def test_certificate_has_the_names_of_the_contract(tmp_path):
    write_series(tmp_path)
    from_headers, from_pixels, report = certify(tmp_path), certify(tmp_path, pixels=True), read_volume(tmp_path).report
    assert find_faults(from_headers, "certificate") == find_faults(report, "certificate") == []
    assert from_pixels == report
    assert json.loads(json.dumps(report)) == report


def test_certificate_has_the_gates_of_the_contract(tmp_path):
    write_series(tmp_path)
    contract = (Path(__file__).resolve().parents[3] / "docs" / "contract.md").read_text(encoding="utf-8")
    table = contract.split("table gives what passes each gate:\n\n| gate | bound |\n|---|---|\n")[1].split("\n\n")[0]
    named = {name for row in table.splitlines() for name in re.findall(r"`(\w+)`", row.split("|")[1])}

    assert {gate["name"] for gate in read_volume(tmp_path).report["gates"]} == named


def test_headers_alone_say_nothing_of_pixels(tmp_path, monkeypatch):
    write_series(tmp_path)

    def refuse(*_):
        raise AssertionError("pixels were read")

    monkeypatch.setattr(reader, "read_voxels", refuse)
    certificate = certify(tmp_path)
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
        certify(tmp_path, pixels=True)


@pytest.fixture(scope="module")
def oblique_tilted(tmp_path_factory):
    """The plan of 7 slices of 6 x 5 pixels, tilted by 12 degrees and oblique, and the report of their volume."""
    folder = tmp_path_factory.mktemp("oblique")
    plan = write_series(folder, Plan(tilt_deg=12, angles=(3, 4, -5)), set_values(PatientPosition="FFP"))
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
    assert orientation["row"] == pytest.approx(list(row), abs=1e-8)
    assert orientation["column"] == pytest.approx(list(column), abs=1e-8)
    assert orientation["normal"] == pytest.approx(list(normal), abs=1e-8)
    assert orientation["off_axis_deg"] == pytest.approx(np.degrees(np.arccos(normal[2])))
    assert (orientation["axes"], orientation["right_handed"]) == ("LPS", True)
    assert report["patient_position"] == "FFP"


def test_certificate_of_an_even_series_misses_nothing_and_passes_its_gates(oblique_tilted):
    _, report = oblique_tilted
    assert (report["uneven"], report["gap_runs"], report["slice_positions_mm"]) == (False, None, None)
    assert (report["slices"], report["slices_missing"], report["dropped"]) == (7, 0, {})
    assert failed(report) == set()


def test_slices_thicker_than_their_gap_overlap(oblique_tilted):
    """Slices 5 mm thick every 1.25 mm share 3.75 mm, three times the gap."""
    assert oblique_tilted[1]["thickness"] == {
        "min_mm": 5.0, "max_mm": 5.0, "median_mm": 5.0, "overlap_percent": pytest.approx(300.0),
        "overlap_mm": pytest.approx({"min": 3.75, "max": 3.75, "median": 3.75}),
    }  # fmt: skip


def test_thickness_that_leaves_tissue_unmeasured_has_a_negative_overlap(tmp_path):
    def thin(ds, k):
        ds.SliceThickness = 1.0 if k < 3 else 0.5

    write_series(tmp_path, change=thin)
    thickness = certify(tmp_path)["thickness"]
    assert (thickness["min_mm"], thickness["max_mm"], thickness["median_mm"]) == (0.5, 1.0, 0.5)
    assert thickness["overlap_mm"] == pytest.approx({"min": -0.75, "max": -0.25, "median": -0.625})
    assert thickness["overlap_percent"] == pytest.approx(-50.0)
    write_series(tmp_path, change=set_values(only=2, SliceThickness=None))
    assert certify(tmp_path)["thickness"] is None


@pytest.mark.parametrize(
    ("steps", "axes", "right_handed", "off_axis"),
    [
        (((1, 0, 0), (0, 1, 0), (0, 0, 1)), "LPS", True, 0.0),
        (((-1, 0, 0), (0, -1, 0), (0, 0, 2)), "RAS", True, 0.0),
        (((0, 2, 0), (0, 0, -3), (-1, 0, 0)), "PIR", True, 0.0),
        (((1, 0, 0), (0, 1, 0), (0, 0, -1)), "LPS", False, 0.0),
        (((0.8, 0.6, 0), (-0.6, 0.8, 0), (0, 0, 1)), "LPS", True, 0.0),
        (((1, 0, 0), (0, 0.8, 0.6), (0, -0.6, 0.8)), "LPS", True, 36.8698976),
    ],
)
def test_directions_are_named_in_the_patient(steps, axes, right_handed, off_axis):
    i_step, j_step, k_step = steps
    found = facts_of_orientation(compose_affine(i_step, j_step, k_step, (0, 0, 0)))
    assert (found["axes"], found["right_handed"]) == (axes, right_handed)
    assert found["off_axis_deg"] == pytest.approx(off_axis)


def test_runs_of_equal_gaps_are_summed_up():
    distances = np.cumsum([0.0, *[4.002] * 3, 1.081, *[6.999] * 2])
    assert summarise_gaps(distances) == [
        {"count": 3, "gap_mm": pytest.approx(4.002)},
        {"count": 1, "gap_mm": pytest.approx(1.081)},
        {"count": 2, "gap_mm": pytest.approx(6.999)},
    ]
    assert summarise_gaps(distances[:1]) == []


def test_an_uneven_series_says_where_each_slice_is(tmp_path):
    plan = write_series(tmp_path, Plan(offsets={3: 0.15}))
    found = certify(tmp_path)
    assert found["uneven"] and "grid_residual" in failed(found)
    assert [run["count"] for run in found["gap_runs"]] == [2, 1, 1, 2]
    expected = [list(plan.position(k)) for k in range(7)]
    np.testing.assert_allclose(found["slice_positions_mm"], expected, atol=tolerances.AFFINE_MM)


SKEWED = "1\\0\\0\\5e-4\\0.9999999\\0"
ONE_GATE = {
    "hu_known": (Plan(), set_values(RescaleType="US")),
    "hu_known, no slope": (Plan(), set_values(only=3, RescaleSlope=None)),
    "lossless": (Plan(), set_values(only=3, LossyImageCompression="01")),
    "measured_images": (Plan(), set_values(ImageType=["DERIVED", "SECONDARY", "MPR"])),
    "stated_gap": (Plan(), set_values(SpacingBetweenSlices=0.625)),
    "stated_gap, below zero": (Plan(), set_values(SpacingBetweenSlices=-1.25)),
    "orientation_exact": (Plan(), set_raw("ImageOrientationPatient", SKEWED)),
}


@pytest.mark.parametrize("case", ONE_GATE)
def test_series_that_fails_one_gate_is_read_with_a_warning(tmp_path, case):
    plan, change = ONE_GATE[case]
    write_series(tmp_path, plan, change)
    report = read_volume(tmp_path).report
    assert failed(report) == {case.partition(",")[0]}
    assert report["warnings"] != []  # who does not ask for gates is told all the same
    assert report["problems"] == []


def test_the_gap_may_be_stated_along_the_table(tmp_path):
    along = 1.25 / np.cos(np.radians(20))
    write_series(tmp_path / "table", Plan(tilt_deg=20), set_values(SpacingBetweenSlices=round(along, 4)))
    write_series(tmp_path / "normal", Plan(tilt_deg=20), set_values(SpacingBetweenSlices=1.25))
    for folder in ("table", "normal"):
        certificate = certify(tmp_path / folder)
        assert failed(certificate) == set()
        assert not [text for text in certificate["warnings"] if "SpacingBetweenSlices" in text]


def test_a_hole_and_a_doubled_slice_are_counted(tmp_path):
    write_series(tmp_path / "hole", Plan(shape=(9, 5, 6), leave_out=(4, 5)))
    hole = certify(tmp_path / "hole")
    assert hole["slices_missing"] == 2 and failed(hole) >= {"usable", "missing_slices"}
    write_series(tmp_path / "doubled")
    write_series(tmp_path / "doubled", Plan(shape=(1, 5, 6), name="again{}".format), set_values(RescaleIntercept=7))
    doubled = list_series(tmp_path / "doubled").certificate
    assert doubled is None or failed(doubled) >= {"usable", "duplicate_slices"}
    assert hole["affine_ijk_to_lps_mm"] is None and hole["problems"] != []


def test_files_that_cannot_be_read_fail_a_gate(tmp_path):
    write_series(tmp_path)
    first = tmp_path / "slice000.dcm"
    first.write_bytes(first.read_bytes()[:500])
    assert failed(certify(tmp_path)) == {"usable", "readable"}


def test_padding_that_masks_nearly_all_fails_its_gate(tmp_path):
    def pad(ds, k):
        ds.PixelPaddingValue = -2000
        pixels = np.full(30, -2000, "i2")
        pixels[:6] = 1000
        ds.PixelData = pixels.tobytes()

    write_series(tmp_path, change=pad)
    report = read_volume(tmp_path).report
    assert report["padding_share"] == pytest.approx(0.8)
    assert failed(report) == {"padding_share"}
    assert any("padding" in text for text in report["warnings"])
    assert failed(certify(tmp_path)) == set()


def test_certificate_holds_nothing_of_the_patient(tmp_path):
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
    assert len(certificate["warnings"]) >= 6
    certificate.pop("problems")  # a refusal names files, on the terminal alone
    text = json.dumps(certificate)
    assert "SECRET" not in text and "1901" not in text and str(tmp_path) not in text


def test_real_series_keep_their_gates(real_data):
    for name, slices in (("lumbar_4p25mm", 99), ("thoracic_0p8mm", 95)):
        certificate = certify(real_data / name, pixels=True)
        assert (certificate["slices"], failed(certificate)) == (slices, set())
    gaps = certify(real_data / "head_tilt_gaps")
    assert [(run["count"], round(run["gap_mm"], 3)) for run in gaps["gap_runs"]] == [
        (13, 4.002),
        (1, 1.081),
        (13, 6.999),
    ]
    assert "grid_residual" in failed(gaps)


@pytest.mark.parametrize("orientation", [[1, 0.01, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0]])
def test_a_stack_without_directions_has_a_certificate_in_strict_json(tmp_path, orientation):
    write_series(tmp_path, change=set_values(ImageOrientationPatient=orientation))
    certificate = list_series(tmp_path, 1).certificate
    json.dumps(certificate, allow_nan=False)
    gates = {gate["name"]: gate for gate in certificate["gates"]}
    assert gates["orientation_exact"]["ok"] is False
    assert gates["orientation_same"]["ok"] is None and gates["orientation_same"]["measured"] is None


@pytest.mark.parametrize(("value", "told"), [("QUADRUPED", True), ("BIPED", False), (None, False)])
def test_animals_on_four_legs_are_said(tmp_path, capsys, value, told):
    """The letters of directions mean other ones, in pictures too."""
    change = set_values(AnatomicalOrientationType=value) if value else set_values()
    write_series(tmp_path, Plan(), change)
    report = read_volume(tmp_path).report
    assert report["anatomical_orientation"] == ("QUADRUPED" if told else None)
    assert any("QUADRUPED" in text and "A as ventral" in text for text in report["warnings"]) is told
    assert main(["info", str(tmp_path)]) == 0
    assert ("back is dorsal" in capsys.readouterr().out) is told
