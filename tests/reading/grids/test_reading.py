"""One door for every input: the kind is told from the content, and what is for DICOM alone is refused elsewhere."""

from __future__ import annotations

import json
import shutil
import sys

import numpy as np
import pytest
from contract_tables import names_in
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


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "gzip.nrrd", "packed.mha"])
def test_grid_files_are_read_whatever_their_name(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct(), OBLIQUE)
    for other in ("plain", "b.dcm", "c.nii.gz", "d.mha", "e.nrrd"):
        shutil.copy(path, tmp_path / other)
        assert np.array_equal(clrecon.read_volume(tmp_path / other).voxels, make_ct())


def test_dicom_is_dicom_whatever_it_is_called_and_whatever_stands_before_it(tmp_path):
    plan = Plan()
    write_series(tmp_path, plan)
    for n, file in enumerate(sorted(tmp_path.iterdir())):
        content = bytearray(file.read_bytes())
        content[:4] = (b"NRRD", b"\x5c\x01\0\0", b"NDim")[n % 3]
        file.unlink()
        (tmp_path / f"{n}.nii").write_bytes(content)
    assert np.array_equal(clrecon.read_volume(tmp_path).voxels, plan.hu())
    assert clrecon.list_series(tmp_path / "0.nii").series[0].modality == "CT"


@pytest.mark.parametrize("content", [b"", b"hello", b"\x1f\x8b nonsense", bytes(600)])
def test_files_of_neither_kind_are_refused(tmp_path, content):
    (tmp_path / "a.nii.gz").write_bytes(content)
    with refused(RefusedInputError, "a.nii.gz", "NIfTI"):
        clrecon.read_volume(tmp_path / "a.nii.gz")
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(NoDicomError):
        clrecon.read_volume(tmp_path / "a")


def test_what_is_no_path_is_said_as_for_dicom(tmp_path):
    for nothing, kind, message in (("", UsageError, "empty"), (None, UsageError, "NoneType"),
                                   (tmp_path / "none.nii", NoDicomError, "none.nii")):  # fmt: skip
        with refused(kind, message):
            clrecon.read_volume(nothing)


@pytest.mark.parametrize("option", [{"series": 1}, {"series": "x"}, {"phase": 2}, {"allow_gaps": True}])
def test_options_for_dicom_alone_are_refused(tmp_path, option):
    path = WRITERS["a.nii"](tmp_path / "a.nii", make_ct(), OBLIQUE)
    with pytest.raises(UsageError, match=f"{next(iter(option))}: only for DICOM, the input is a NIfTI file"):
        clrecon.read_volume(path, **option)
    assert clrecon.read_volume(path, None, allow_gaps=False, phase=None).voxels.shape == (4, 6, 7)
    with pytest.raises(UsageError, match="series: only for DICOM"):
        describe_input(path, InfoSettings(series="1"))


@pytest.mark.parametrize(
    ("name", "module", "package"),
    [("a.nii", "nibabel", "nibabel"), ("raw.nrrd", "nrrd", "pynrrd"), ("a.mha", "SimpleITK", "SimpleITK")],
)
def test_without_its_package_the_command_is_named(tmp_path, monkeypatch, name, module, package):
    path = WRITERS[name](tmp_path / name, make_ct(), OBLIQUE)
    monkeypatch.setitem(sys.modules, module, None)
    with refused(UsageError, package):
        clrecon.read_volume(path)


@pytest.mark.parametrize("name", WRITERS)
def test_the_report_and_the_listing_have_the_entries_of_dicom(tmp_path, name):
    write_series(tmp_path / "ct", Plan())
    path = WRITERS[name](tmp_path / name, make_ct(), OBLIQUE)
    dicom, volume = clrecon.read_volume(tmp_path / "ct").report, clrecon.read_volume(path)
    assert set(dicom) == set(volume.report) == names_in("The certificate")
    assert volume.report == json.loads(json.dumps(volume.report))
    assert volume.report["shape_ijk"] == [7, 6, 4] and volume.report["slices"] == 4
    assert volume.report["spacing_mm"] == pytest.approx(volume.spacing)
    listing = describe_input(path).listing
    assert listing["chosen"] == 1 and len(listing["series"]) == 1
    entry = listing["series"][0]
    assert set(entry) == set(describe_input(tmp_path / "ct").listing["series"][0])
    assert entry["affine_ijk_to_lps_mm"] == volume.affine.tolist() and entry["problems"] == []
    assert listing["certificate"]["hu_range"] is None
    read = describe_input(path, InfoSettings(pixels=True)).listing["certificate"]
    assert read == volume.report
    assert entry["modality"] == "unknown" and entry["description"].endswith("voxels int16")


def test_doubtful_grid_files_fail_a_gate_that_strict_counts(tmp_path):
    plain = WRITERS["a.nii"](tmp_path / "a.nii", make_ct(), OBLIQUE)
    offset = WRITERS["raw.nrrd"](tmp_path / "a.nrrd", make_ct((8, 20, 20), low=0), OBLIQUE)
    unclear = write_metaimage(tmp_path / "a.mha", make_ct(), BinaryDataByteOrderMSB=None)
    for path, failed in ((plain, None), (offset, "hu_known"), (unclear, "header_clear")):
        gates = clrecon.read_volume(path).report["gates"]
        assert [gate["name"] for gate in gates if gate["ok"] is False] == [failed] * (failed is not None)
        problem = describe_input(path, InfoSettings(pixels=True, strict=True)).problem
        assert (problem is None) if failed is None else f"fails 1 gate: {failed}: " in str(problem)


def test_figures_that_no_scan_has_fail_gates_of_dicom_too(tmp_path):
    ct, metres = make_ct(), np.diag((0.001, 0.001, 0.001, 1.0)) @ OBLIQUE
    bright = ct.astype(np.int32)
    bright[1, 2, 3] = 80_000
    cases = [
        (WRITERS["a.nii"](tmp_path / "a.nii", ct, metres), "plausible_spacing", "pixels of 0.000"),
        (WRITERS["raw.nrrd"](tmp_path / "a.nrrd", bright, OBLIQUE), "plausible_hu", "densest voxel 80000 HU"),
    ]
    for path, name, said in cases:
        report = clrecon.read_volume(path).report
        (failed,) = [gate for gate in report["gates"] if gate["ok"] is False]
        assert failed["name"] == name and said in failed["text"]
        assert any(failed["text"] in text for text in report["warnings"])
        assert f"fails 1 gate: {name}: " in str(describe_input(path, InfoSettings(pixels=True, strict=True)).problem)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_two_volumes_between_each_other_show_in_any_order_of_the_axes(tmp_path, axis):
    """Slices along k, j or i of the file: those of one body, or of two that alternate."""
    k, j, i = np.indices((24, 40, 40))
    bodies = [40.0 + 900.0 * (np.hypot(j - 20 - 6 * shift, i - 20 + k / 8) < 9) for shift in (0, 1)]
    for mixed in (False, True):
        hu = np.where((k % 2 == 1) & mixed, bodies[1], bodies[0]) - 1000.0 * (np.hypot(j - 20, i - 20) > 19)
        steps = np.ones(3)
        steps[2 - axis] = 3.0  # the slices lie farthest apart
        voxels = np.ascontiguousarray(np.moveaxis(np.rint(hu), 0, axis)).astype(np.int16)
        path = WRITERS["a.nii"](tmp_path / f"{mixed}.nii", voxels, np.diag((*steps, 1.0)))
        report = clrecon.read_volume(path).report
        gates = {gate["name"]: gate for gate in report["gates"]}
        assert gates["one_volume"]["measured"] == int(mixed) and gates["plausible_hu"]["ok"]
        assert any("between each other" in text for text in report["warnings"]) == mixed
        listed = {gate["name"]: gate["ok"] for gate in describe_input(path).listing["certificate"]["gates"]}
        assert listed["one_volume"] is listed["plausible_hu"] is None


def test_commands_take_grid_files(tmp_path, printed, device):
    sphere = np.linalg.norm(np.indices((24, 24, 24)) - 11.7, axis=0)
    hu = np.clip(1000 - 250 * (sphere - 7), -1000, 1000).astype(np.int16)
    path = WRITERS["packed.mha"](tmp_path / "a.mha", hu, OBLIQUE)
    assert main(["info", str(path), "--json"]) == 0
    assert printed().report()["series"][0]["shape_ijk"] == [24, 24, 24]
    out = tmp_path / "bone.stl"
    assert main(["mesh", str(path), "-o", str(out), "--device", str(device.index), "--json"]) == 0
    report = printed().report()
    assert report["closed"] and report["volume"]["format"] == "MetaImage" and out.stat().st_size > 1000
    assert any(text.startswith("not DICOM") for text in report["warnings"])
    assert main(["mesh", str(path), "-o", str(out), "--series", "1"]) == 3
