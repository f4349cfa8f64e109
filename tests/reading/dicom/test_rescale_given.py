"""Slope and intercept as the user gives them."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan
from refusals import refused
from value_series import SHAPE, make_body, write_values
from variants import FOR_RELEASE

from clrecon import Volume, list_series, read_volume
from clrecon.cli.main import main
from clrecon.errors import RefusedInputError, UsageError

GIVEN_WARNING = "HU are 1 x the stored value -1024, as given: not what the files say"
NO_RESCALE = {"RescaleSlope": None, "RescaleIntercept": None}


def failed_gates(report):
    return {gate["name"] for gate in report["gates"] if gate["ok"] is False}


DOUBTFUL_RESCALES = pytest.mark.parametrize(
    "values",
    [NO_RESCALE, {"RescaleSlope": 7, "RescaleIntercept": -7000}, {"RescaleType": "US"}],
    ids=["none", "another", "not HU"],
)


@DOUBTFUL_RESCALES
def test_values_of_a_series_with_a_doubtful_rescale_are_hu_by_the_given_one(tmp_path, values):
    write_values(tmp_path, make_body(), **values)
    volume = read_volume(tmp_path, rescale=(1, -1024))
    assert np.array_equal(volume.voxels, make_body())
    assert volume.report["rescale"] == {
        "slope": [1.0, 1.0], "intercept": [-1024.0, -1024.0], "type": "HU", "given": True
    }  # fmt: skip


@DOUBTFUL_RESCALES
def test_gates_that_a_doubtful_rescale_fails_pass_with_a_given_one_and_a_warning(tmp_path, values):
    write_values(tmp_path, make_body(), **values)
    assert failed_gates(read_volume(tmp_path).report)
    report = read_volume(tmp_path, rescale=(1, -1024)).report
    assert failed_gates(report) == set()
    assert report["warnings"] == [f"{GIVEN_WARNING} (all slices)"]


@DOUBTFUL_RESCALES
def test_certificate_of_a_listing_with_a_given_rescale_is_that_of_the_volume(tmp_path, values):
    write_values(tmp_path, make_body(), **values)
    listed = list_series(tmp_path, rescale=(1, -1024), pixels=True).certificate
    assert listed == read_volume(tmp_path, rescale=(1, -1024)).report


def test_values_of_a_grid_file_are_hu_by_the_given_rescale_with_a_warning(tmp_path):
    path = tmp_path / "a.nii.gz"
    Volume((make_body() + 1024).astype(np.int16), np.diag([1.0, 1.0, 2.0, 1.0])).save(path)
    assert "hu_known" in failed_gates(read_volume(path).report)

    volume = read_volume(path, rescale=(1, -1024))

    assert np.array_equal(volume.voxels, make_body())
    assert failed_gates(volume.report) == set()
    assert volume.report["rescale"]["given"]
    assert GIVEN_WARNING in volume.report["warnings"]


def test_report_without_a_given_rescale_does_not_call_it_given(tmp_path):
    assert "given" not in read_volume(write_values(tmp_path, make_body())).report["rescale"]


@pytest.mark.parametrize("given", [(0, 1), (1,), (1, 2, 3), 5, "ab", (1, float("nan")), (float("inf"), 0), (1e7, 0)])
def test_rescale_that_is_no_slope_and_intercept_is_refused(tmp_path, given):
    folder = write_values(tmp_path, make_body())
    with refused(UsageError, 0, "rescale"):
        read_volume(folder, rescale=given)


def test_rescale_of_none_is_that_of_the_files(tmp_path):
    folder = write_values(tmp_path, make_body())
    assert read_volume(folder, rescale=None).hu_range == (make_body().min(), make_body().max())


def test_command_info_passes_its_gates_with_the_right_rescale(tmp_path, printed):
    folder = str(write_values(tmp_path, make_body(), RescaleIntercept=0))
    assert main(["info", folder, "--pixels", "--strict", "--rescale", "1,-1024"]) == 0
    printed().assert_output("given", -1024)


@pytest.mark.parametrize(
    ("given", "facts"),
    [("1", ("SLOPE", "INTERCEPT", 1, -1024)), ("0,3", ("--rescale", 0))],
    ids=["one number", "slope of 0"],
)
def test_command_info_refuses_a_rescale_that_is_no_slope_and_intercept(tmp_path, printed, given, facts):
    folder = str(write_values(tmp_path, make_body()))
    assert main(["info", folder, "--rescale", given]) == UsageError.exit_code
    printed().assert_error(*facts)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((NO_RESCALE, 1700), id="no rescale"),
        pytest.param(({"RescaleIntercept": -700}, 1000), marks=FOR_RELEASE, id="another intercept"),
        pytest.param(({"RescaleType": "US"}, 700), marks=FOR_RELEASE, id="not HU"),
    ],
)
def scan_not_in_hu(request, tmp_path_factory):
    """A series whose values are not known to be HU, and a level of its bone, each some 690 HU by the true rescale."""
    values, level = request.param
    return str(write_values(tmp_path_factory.mktemp("ct"), make_body(), Plan(shape=SHAPE), **values)), level


def print_command(scan, output, device):
    return ["mesh", scan, "-o", str(output), "--for", "print", "--device", str(device.index)]


@pytest.mark.seconds
@pytest.mark.parametrize("choice", [[], ["--hu", "auto"], ["--preset", "bone"]], ids=["default", "auto", "preset"])
def test_print_of_values_not_known_to_be_hu_is_refused_with_the_options_that_help(
    scan_not_in_hu, tmp_path, device, capsys, choice
):
    scan, _ = scan_not_in_hu
    output = tmp_path / "a.stl"
    assert main([*print_command(scan, output, device), *choice]) == RefusedInputError.exit_code
    text = capsys.readouterr().err
    assert "a print needs a level of bone, and the values of this scan are not known to be HU" in text
    assert "(--hu N" in text
    assert "(--rescale SLOPE,INTERCEPT)" in text
    assert ("without a print --hu auto says which it finds" in text) == ("auto" in choice)
    assert not output.exists()


@pytest.mark.seconds
def test_print_of_values_not_known_to_be_hu_is_written_with_a_given_level(scan_not_in_hu, tmp_path, device):
    scan, level = scan_not_in_hu
    output = tmp_path / "a.stl"
    assert main([*print_command(scan, output, device), "--hu", str(level)]) == 0
    assert output.exists()


@pytest.mark.seconds
def test_print_of_values_not_known_to_be_hu_is_written_with_a_given_rescale(scan_not_in_hu, tmp_path, device):
    scan, _ = scan_not_in_hu
    output = tmp_path / "a.stl"
    assert main([*print_command(scan, output, device), "--rescale", "1,-1024"]) == 0
    assert output.exists()
