"""The script that tries a graphics card: results of two devices compared, its page of text, a step in its process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import gpu_check

    return gpu_check


def test_results_are_equal_or_differ_by_numbers(script, tmp_path):
    folders = tmp_path / "ours", tmp_path / "theirs"
    for folder, number in zip(folders, (1.0, 1.5), strict=True):
        folder.mkdir()
        np.savez(folder / "0.npz", points=np.array([0.0, number, np.nan]), hu=np.zeros(2))
    ours = {"cloud": {"sha256": "a", "file": "0.npz"}, "slice": {"sha256": "b"}, "mesh": {"error": "no room"}}
    theirs: dict[str, Any] = {
        "cloud": {"sha256": "c", "file": "0.npz"},
        "slice": {"sha256": "b"},
        "mesh": {"sha256": "d"},
    }
    theirs |= {"normals": {"sha256": "e"}, "device": "a name", "folder": folders[1]}
    assert script.compare(ours, theirs, folders) == {
        "cloud": {"points": "1 of 3 differ, by at most 0.5", "hu": "equal"},
        "slice": "equal",
        "mesh": "no room",
        "normals": "not reached on one of the devices",
    }


def test_the_page_goes_on_where_steps_failed(script):
    failed = {"error": "exit code -11", "output": "Segmentation fault"}
    steps = dict.fromkeys(("reference", "copies", "times", "selftest", "times of the reference"), failed)
    told = {"steps": {"device": {"name": "card"}, **steps}, "comparison": {"mesh": "equal"}, "seconds": 3.0}
    text = "\n".join(script.page(told))
    assert "card" in text and "1 of 1 are the reference's byte for byte" in text
    assert text.count("exit code -11\nSegmentation fault") == 5


def test_a_step_writes_what_the_driver_says(device, tmp_path):
    out = tmp_path / "step.json"
    command = [sys.executable, str(SCRIPTS / "gpu_check.py"), "--step", "devices", "--device", str(device.index)]
    subprocess.run([*command, "--out", str(out)], check=True)
    told = json.loads(out.read_text())
    assert told["name"] == device.name and told["driver says"]["max_compute_units"] == device.compute_units
