"""What clrecon says to Python's logging: enough to find out what happened, nothing about a patient, nothing unasked."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_series import Plan, set_values, write_series

import clrecon
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.opencl import cache
from clrecon.opencl.cache import prepare_caches

NAME = "Mueller^Hans"


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("log") / NAME
    plan = Plan(shape=(20, 31, 30), name=f"{NAME}_{{:03d}}.dcm".format)
    write_series(folder, plan, set_values(PatientName=NAME, SeriesDescription=NAME, LossyImageCompression="01"))
    return folder


def test_a_job_says_what_a_batch_looks_for(
    device: Any, scan: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "clrecon")
    settings = MeshSettings(iso_value=200.0, device=str(device.index))
    report = make_mesh(scan, tmp_path / f"{NAME}.stl", settings, report_path=tmp_path / "a.json")
    said = [record.getMessage() for record in caplog.records]
    assert any(text.startswith(f"device {device.index} chosen of") and device.label in text for text in said)
    assert "series 1 of 1 read: (30, 31, 20) voxels int16" in said
    assert f"file written: {(tmp_path / f'{NAME}.stl').stat().st_size} bytes" in said
    assert any(text.startswith("1 meshes made, ") and device.label in text for text in said)
    assert {text.split(":")[0] for text in said} > {"read", "device", "surface", "measure", "write"}
    assert all(record.name.startswith("clrecon.") for record in caplog.records)
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert report["warnings"]
    assert sorted(warnings) == sorted(report["warnings"])  # each once
    assert not any("Mueller" in text or str(tmp_path) in text for text in said)


@pytest.mark.parametrize("content", [b"", b"damaged"])
def test_a_kept_binary_that_is_damaged_is_said(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "clrecon")
    caches = prepare_caches()._replace(binaries=tmp_path)
    monkeypatch.setattr(cache, "prepare_caches", lambda: caches)
    assert cache.read_binary("key") is None  # none is there: nothing to say
    cache.store_binary("key", b"binary")
    assert cache.read_binary("key") == b"binary"
    assert caplog.messages == []
    (tmp_path / "key").write_bytes(content)
    assert cache.read_binary("key") is None
    assert caplog.messages == ["a kept binary is damaged: it is built anew and replaced"]


def test_log_is_not_printed_unasked(scan: Path) -> None:
    code = "import clrecon, sys; volume = clrecon.read_volume(sys.argv[1]); assert volume.report['warnings']"
    done = subprocess.run([sys.executable, "-c", code, str(scan)], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_import_and_help_do_not_load_logging() -> None:
    code = "import sys, clrecon, clrecon.cli.main, clrecon.cli.mesh; print('logging' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert done.stdout == "False\n"


def test_a_volume_made_from_arrays_says_nothing(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "clrecon")
    assert clrecon.Volume(np.zeros((2, 3, 4), np.int16), np.eye(4)).hu_range == (0.0, 0.0)
    assert caplog.records == []
