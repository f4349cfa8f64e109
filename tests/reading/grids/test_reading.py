"""One door for every input: the kind is told from the content, and what is for DICOM alone is refused elsewhere."""

from __future__ import annotations

import json
import shutil
import sys

import numpy as np
import pytest
from dicom_series import Plan, write_series
from label_files import OBLIQUE
from refusals import refused
from volume_files import WRITERS, make_ct, write_metaimage

import clrecon
from clrecon.cli.main import main
from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.jobs.info import describe_input
from clrecon.jobs.settings import InfoSettings

pytest.importorskip("nibabel")
pytest.importorskip("nrrd")
pytest.importorskip("SimpleITK")


@pytest.mark.parametrize("other_name", ["plain", "b.dcm", "c.nii.gz", "d.mha", "e.nrrd"])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "gzip.nrrd", "packed.mha"])
def test_grid_file_is_read_by_its_content_under_any_name(tmp_path, name, other_name):
    path = WRITERS[name](tmp_path / name, make_ct(), OBLIQUE)
    shutil.copy(path, tmp_path / other_name)
    assert np.array_equal(clrecon.read_volume(tmp_path / other_name).voxels, make_ct())


def test_dicom_named_nii_with_the_marks_of_grid_files_in_its_preamble_is_read_as_dicom(tmp_path):
    plan = Plan()
    write_series(tmp_path, plan)
    for n, file in enumerate(sorted(tmp_path.iterdir())):
        content = bytearray(file.read_bytes())
        content[:4] = (b"NRRD", b"\x5c\x01\0\0", b"NDim")[n % 3]  # NRRD, NIfTI and MetaImage begin with these
        file.unlink()
        (tmp_path / f"{n}.nii").write_bytes(content)
    assert np.array_equal(clrecon.read_volume(tmp_path).voxels, plan.hu())
    assert clrecon.list_series(tmp_path / "0.nii").series[0].modality == "CT"


NEITHER_KIND = pytest.mark.parametrize(
    "content", [b"", b"hello", b"\x1f\x8b nonsense", bytes(600)], ids=["empty", "text", "not gzip", "zeros"]
)


@NEITHER_KIND
def test_file_of_neither_kind_named_as_nifti_is_refused_as_that(tmp_path, content):
    (tmp_path / "a.nii.gz").write_bytes(content)
    with refused(RefusedInputError, "a.nii.gz", "NIfTI"):
        clrecon.read_volume(tmp_path / "a.nii.gz")


@NEITHER_KIND
def test_file_of_neither_kind_under_another_name_is_refused_as_no_dicom(tmp_path, content):
    (tmp_path / "a").write_bytes(content)
    with refused(NoDicomError, "DICOM"):
        clrecon.read_volume(tmp_path / "a")


@pytest.mark.parametrize(
    ("path", "kind", "fact"),
    [("", UsageError, "empty"), (None, UsageError, "NoneType"), ("none.nii", NoDicomError, "none.nii")],
    ids=["empty", "None", "missing"],
)
def test_path_that_is_empty_none_or_missing_is_refused(path, kind, fact):
    with refused(kind, fact):
        clrecon.read_volume(path)


@pytest.mark.parametrize("option", [{"series": 1}, {"series": "x"}, {"phase": 2}, {"allow_gaps": True}])
def test_option_for_dicom_alone_is_refused_for_a_grid_file(tmp_path, option):
    path = WRITERS["a.nii"](tmp_path / "a.nii", make_ct(), OBLIQUE)
    with pytest.raises(UsageError, match=f"{next(iter(option))}: only for DICOM, and the input is NIfTI"):
        clrecon.read_volume(path, **option)


def test_options_for_dicom_at_their_defaults_are_accepted_for_a_grid_file(tmp_path):
    path = WRITERS["a.nii"](tmp_path / "a.nii", make_ct((4, 6, 7)), OBLIQUE)
    assert clrecon.read_volume(path, series=None, allow_gaps=False, phase=None).voxels.shape == (4, 6, 7)


def test_choice_of_a_series_is_refused_where_a_grid_file_is_listed(tmp_path):
    path = WRITERS["a.nii"](tmp_path / "a.nii", make_ct(), OBLIQUE)
    with refused(UsageError, "series", "DICOM"):
        describe_input(path, InfoSettings(series="1"))


@pytest.mark.parametrize(
    ("name", "module", "package"),
    [("a.nii", "nibabel", "nibabel"), ("raw.nrrd", "nrrd", "pynrrd"), ("a.mha", "SimpleITK", "SimpleITK")],
)
def test_grid_file_whose_package_is_missing_is_refused_with_its_name(tmp_path, monkeypatch, name, module, package):
    path = WRITERS[name](tmp_path / name, make_ct(), OBLIQUE)
    monkeypatch.setitem(sys.modules, module, None)
    with refused(UsageError, package):
        clrecon.read_volume(path)


@pytest.fixture(params=WRITERS)
def grid_file(request, tmp_path):
    """A volume of 4 slices of 6 x 7 voxels in one of the formats, and with one of the encodings of each."""
    return WRITERS[request.param](tmp_path / request.param, make_ct((4, 6, 7)), OBLIQUE)


def test_certificate_of_a_grid_file_has_the_entries_of_dicom(grid_file, tmp_path):
    write_series(tmp_path / "ct", Plan())
    of_dicom = clrecon.read_volume(tmp_path / "ct").report
    of_grid = clrecon.read_volume(grid_file).report
    assert set(of_dicom) == set(of_grid)


def test_certificate_of_a_grid_file_is_json_with_its_size_and_spacing(grid_file):
    volume = clrecon.read_volume(grid_file)
    assert volume.report == json.loads(json.dumps(volume.report))
    assert volume.report["shape_ijk"] == [7, 6, 4]
    assert volume.report["slices"] == 4
    assert volume.report["spacing_mm"] == pytest.approx(volume.spacing)


def test_listing_of_a_grid_file_has_one_series_with_the_entries_of_dicom(grid_file, tmp_path):
    write_series(tmp_path / "ct", Plan())
    listing = describe_input(grid_file).listing
    (series,) = listing["series"]
    assert listing["chosen"] == 1
    assert set(series) == set(describe_input(tmp_path / "ct").listing["series"][0])


def test_series_of_a_grid_file_has_its_affine_and_no_problem(grid_file):
    (series,) = describe_input(grid_file).listing["series"]
    assert series["affine_ijk_to_lps_mm"] == clrecon.read_volume(grid_file).affine.tolist()
    assert series["problems"] == []
    assert series["modality"] == "unknown"
    assert series["description"].endswith("voxels int16")


def test_certificate_in_the_listing_of_a_grid_file_is_that_of_the_volume_where_voxels_are_read(grid_file):
    assert describe_input(grid_file).listing["certificate"]["hu_range"] is None  # voxels were not read
    with_voxels = describe_input(grid_file, InfoSettings(pixels=True)).listing["certificate"]
    assert with_voxels == clrecon.read_volume(grid_file).report


def failed_gates(path):
    return [gate["name"] for gate in clrecon.read_volume(path).report["gates"] if gate["ok"] is False]


def problem_with_strict_gates(path):
    """What `info --pixels --strict` says against a file; None if all gates pass."""
    return describe_input(path, InfoSettings(pixels=True, strict=True)).problem


def test_grid_file_of_hu_fails_no_gate(tmp_path):
    path = WRITERS["a.nii"](tmp_path / "a.nii", make_ct(), OBLIQUE)
    assert failed_gates(path) == []
    assert problem_with_strict_gates(path) is None


def test_grid_file_without_a_negative_value_fails_the_gate_of_hu(tmp_path):
    path = WRITERS["raw.nrrd"](tmp_path / "a.nrrd", make_ct((8, 20, 20), low=0), OBLIQUE)
    assert failed_gates(path) == ["hu_known"]
    assert "fails 1 gate: hu_known: " in str(problem_with_strict_gates(path))


def test_metaimage_that_does_not_say_its_byte_order_fails_the_gate_of_headers(tmp_path):
    path = write_metaimage(tmp_path / "a.mha", make_ct(), BinaryDataByteOrderMSB=None)
    assert failed_gates(path) == ["header_clear"]
    assert "fails 1 gate: header_clear: " in str(problem_with_strict_gates(path))


def assert_one_gate_fails_with_a_warning(path, name, words):
    report = clrecon.read_volume(path).report
    (failed,) = [gate for gate in report["gates"] if gate["ok"] is False]
    assert failed["name"] == name
    assert words in failed["text"]
    assert any(failed["text"] in warning for warning in report["warnings"])
    assert f"fails 1 gate: {name}: " in str(problem_with_strict_gates(path))


def test_grid_file_in_metres_fails_the_gate_of_spacing(tmp_path):
    in_metres = np.diag((0.001, 0.001, 0.001, 1.0)) @ OBLIQUE
    path = WRITERS["a.nii"](tmp_path / "a.nii", make_ct(), in_metres)
    assert_one_gate_fails_with_a_warning(path, "plausible_spacing", "pixels of 0.000")


def test_grid_file_with_a_voxel_of_80_000_hu_fails_the_gate_of_plausible_hu(tmp_path):
    bright = make_ct().astype(np.int32)
    bright[1, 2, 3] = 80_000
    path = WRITERS["raw.nrrd"](tmp_path / "a.nrrd", bright, OBLIQUE)
    assert_one_gate_fails_with_a_warning(path, "plausible_hu", "densest voxel 80000 HU")


def write_body(path, axis, alternating):
    """Slices 3 mm apart along an axis (k, j, i) of the file: of one body, or of two bodies by turns."""
    k, j, i = np.indices((24, 40, 40))
    bodies = [40.0 + 900.0 * (np.hypot(j - 20 - 6 * shift, i - 20 + k / 8) < 9) for shift in (0, 1)]
    hu = np.where((k % 2 == 1) & alternating, bodies[1], bodies[0]) - 1000.0 * (np.hypot(j - 20, i - 20) > 19)
    steps = np.ones(3)
    steps[2 - axis] = 3.0
    voxels = np.ascontiguousarray(np.moveaxis(np.rint(hu), 0, axis)).astype(np.int16)
    return WRITERS["a.nii"](path, voxels, np.diag((*steps, 1.0)))


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["k", "j", "i"])
@pytest.mark.parametrize("alternating", [False, True], ids=["one body", "two bodies"])
def test_slices_of_two_bodies_by_turns_fail_the_gate_of_one_volume_along_any_axis(tmp_path, axis, alternating):
    report = clrecon.read_volume(write_body(tmp_path / "a.nii", axis, alternating)).report
    gates = {gate["name"]: gate for gate in report["gates"]}
    assert gates["one_volume"]["measured"] == int(alternating)
    assert any("between each other" in warning for warning in report["warnings"]) == alternating


def test_gates_of_voxels_are_not_measured_in_a_listing_that_reads_none(tmp_path):
    path = write_body(tmp_path / "a.nii", axis=0, alternating=True)
    gates = {gate["name"]: gate["ok"] for gate in describe_input(path).listing["certificate"]["gates"]}
    assert gates["one_volume"] is gates["plausible_hu"] is None


@pytest.fixture
def packed_sphere(tmp_path):
    """A packed MetaImage of a sphere of 7 voxels, its surface at 1000 HU."""
    distance = np.linalg.norm(np.indices((24, 24, 24)) - 11.7, axis=0)
    hu = np.clip(1000 - 250 * (distance - 7), -1000, 1000).astype(np.int16)
    return WRITERS["packed.mha"](tmp_path / "a.mha", hu, OBLIQUE)


def test_command_info_lists_a_grid_file(packed_sphere, printed):
    assert main(["info", str(packed_sphere), "--json"]) == 0
    assert printed().report()["series"][0]["shape_ijk"] == [24, 24, 24]


def test_command_mesh_makes_a_closed_mesh_of_a_grid_file_and_warns_that_it_is_not_dicom(
    packed_sphere, tmp_path, printed, device
):
    output = tmp_path / "bone.stl"
    assert main(["mesh", str(packed_sphere), "-o", str(output), "--device", str(device.index), "--json"]) == 0
    report = printed().report()
    assert report["closed"]
    assert report["volume"]["format"] == "MetaImage"
    assert any(warning.startswith("not DICOM") for warning in report["warnings"])
    assert output.stat().st_size == 84 + 50 * report["triangles"]  # bytes of a binary STL: its head, its triangles


def test_command_mesh_refuses_the_choice_of_a_series_for_a_grid_file(packed_sphere, tmp_path):
    output = tmp_path / "bone.stl"
    assert main(["mesh", str(packed_sphere), "-o", str(output), "--series", "1"]) == UsageError.exit_code
    assert not output.exists()
