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
from clrecon.errors import UsageError

SAID = "HU are 1 x the stored value -1024, as given: not what the files say"
NO_RESCALE = {"RescaleSlope": None, "RescaleIntercept": None}


def failed(report):
    return {gate["name"] for gate in report["gates"] if gate["ok"] is False}


@pytest.mark.parametrize("values", [NO_RESCALE, {"RescaleSlope": 7, "RescaleIntercept": -7000}, {"RescaleType": "US"}])
def test_hu_are_those_of_the_given_rescale(tmp_path, values):
    write_values(tmp_path, make_body(), **values)
    assert failed(read_volume(tmp_path).report)
    volume = read_volume(tmp_path, rescale=(1, -1024))
    assert np.array_equal(volume.voxels, make_body())
    report = volume.report
    assert failed(report) == set() and report["warnings"] == [f"{SAID} (all slices)"]
    assert report["rescale"] == {"slope": [1.0, 1.0], "intercept": [-1024.0, -1024.0], "type": "HU", "given": True}
    assert list_series(tmp_path, rescale=(1, -1024), pixels=True).certificate == report


def test_given_rescale_makes_hu_of_a_grid_file(tmp_path):
    path = tmp_path / "a.nii.gz"
    Volume((make_body() + 1024).astype(np.int16), np.diag([1.0, 1.0, 2.0, 1.0])).save(path)
    assert "hu_known" in failed(read_volume(path).report)
    volume = read_volume(path, rescale=(1, -1024))
    assert np.array_equal(volume.voxels, make_body()) and failed(volume.report) == set()
    assert volume.report["rescale"]["given"] and SAID in volume.report["warnings"]


def test_report_without_a_given_rescale_says_none(tmp_path):
    assert "given" not in read_volume(write_values(tmp_path, make_body())).report["rescale"]


@pytest.mark.parametrize(
    "given", [(0, 1), (1,), (1, 2, 3), 5, "ab", (1, float("nan")), (float("inf"), 0), (1e7, 0), None]
)
def test_rescale_that_is_no_slope_and_intercept_is_refused(tmp_path, given):
    folder = write_values(tmp_path, make_body())
    if given is None:
        assert read_volume(folder, rescale=given).hu_range == (make_body().min(), make_body().max())
        return
    with refused(UsageError, 0, "rescale"):
        read_volume(folder, rescale=given)


def test_info_takes_rescale_as_slope_and_intercept(tmp_path, printed):
    folder = str(write_values(tmp_path, make_body(), RescaleIntercept=0))
    assert main(["info", folder, "--pixels", "--strict", "--rescale", "1,-1024"]) == 0
    shown = printed()
    shown.assert_output(1, -1024)
    assert main(["info", folder, "--rescale", "1"]) == 3
    printed().assert_error("SLOPE", "INTERCEPT", 1, -1024)
    assert main(["info", folder, "--rescale", "0,3"]) == 3
    printed().assert_error("--rescale", 0)


@pytest.mark.seconds
@pytest.mark.parametrize(
    ("values", "level"),
    [
        (NO_RESCALE, 1700),
        *(
            pytest.param(values, level, marks=FOR_RELEASE)
            for values, level in (({"RescaleIntercept": -700}, 1000), ({"RescaleType": "US"}, 700))
        ),
    ],
)
def test_a_print_needs_a_level_where_values_are_not_hu(tmp_path, device, capsys, values, level):
    folder = str(write_values(tmp_path / "ct", make_body(), Plan(shape=SHAPE), **values))
    out = tmp_path / "a.stl"
    command = ["mesh", folder, "-o", str(out), "--for", "print", "--device", str(device.index)]
    for choice in ([], ["--hu", "auto"], ["--preset", "bone"]):
        assert main([*command, *choice]) == 4
        text = capsys.readouterr().err
        assert "a print needs a level of bone, and the values of this scan are not known to be HU" in text
        assert "(--hu N" in text and "(--rescale SLOPE,INTERCEPT)" in text
        assert ("without a print --hu auto says which it finds" in text) == ("auto" in choice)
        assert not out.exists()
    assert main([*command, "--hu", str(level)]) == 0 and out.exists()
    out.unlink()
    assert main([*command, "--rescale", "1,-1024"]) == 0 and out.exists()
