"""The script that tries a graphics card: it compares results of two devices, writes a page, runs steps in processes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture
def script(monkeypatch):
    """scripts/gpu_check.py as a module."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import gpu_check

    return gpu_check


@pytest.mark.parametrize(
    ("ours", "theirs", "comparison"),
    [
        pytest.param({"sha256": "b"}, {"sha256": "b"}, "equal", id="equal hashes"),
        pytest.param({"error": "no room"}, {"sha256": "d"}, "no room", id="error on one device"),
        pytest.param({}, {"sha256": "e"}, "not reached on one of the devices", id="missing on one device"),
    ],
)
def test_results_of_two_devices_compare_by_hash_error_or_as_not_reached(script, tmp_path, ours, theirs, comparison):
    folders = tmp_path, tmp_path
    assert script.compare({"mesh": ours}, {"mesh": theirs}, folders) == {"mesh": comparison}


def test_arrays_of_results_with_different_hashes_are_compared_number_by_number(script, tmp_path):
    folders = tmp_path / "ours", tmp_path / "theirs"
    for folder, number in zip(folders, (1.0, 1.5), strict=True):
        folder.mkdir()
        np.savez(folder / "0.npz", points=np.array([0.0, number, np.nan]), hu=np.zeros(2))
    ours, theirs = ({"cloud": {"sha256": name, "file": "0.npz"}} for name in ("a", "c"))
    assert script.compare(ours, theirs, folders) == {
        "cloud": {"points": "1 of 3 differ, by at most 0.5", "hu": "equal"}
    }


def test_entries_that_are_no_results_are_not_compared(script, tmp_path):
    theirs = {"device": "a name", "folder": tmp_path}
    assert script.compare({}, theirs, (tmp_path, tmp_path)) == {}


def test_page_has_the_comparison_and_the_error_of_each_step_that_failed(script):
    failed = {"error": "exit code -11", "output": "Segmentation fault"}
    steps = dict.fromkeys(("reference", "copies", "times", "selftest", "times of the reference"), failed)
    results = {"steps": {"device": {"name": "card"}, **steps}, "comparison": {"mesh": "equal"}, "seconds": 3.0}
    text = "\n".join(script.page(results))
    assert "card" in text
    assert "1 of 1 are the reference's byte for byte" in text
    assert text.count("exit code -11\nSegmentation fault") == len(steps)


def test_step_devices_writes_the_name_and_the_properties_of_the_device(device, tmp_path):
    out = tmp_path / "step.json"
    command = [sys.executable, str(SCRIPTS / "gpu_check.py"), "--step", "devices", "--device", str(device.index)]
    subprocess.run([*command, "--out", str(out)], check=True)
    written = json.loads(out.read_text())
    assert written["name"] == device.name
    assert written["driver says"]["max_compute_units"] == device.compute_units
