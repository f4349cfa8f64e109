"""The log of clrecon by Python's logging: what a job did, nothing about a patient, and not printed by itself."""

from __future__ import annotations

import logging
import subprocess
import sys
from dataclasses import dataclass
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
SHAPE = (20, 31, 30)


@pytest.fixture(scope="module")
def scan_of_mueller(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A series whose folder, files and headers name the patient, and whose lossy compression is warned of."""
    folder = tmp_path_factory.mktemp("log") / NAME
    plan = Plan(shape=SHAPE, name=f"{NAME}_{{:03d}}.dcm".format)
    write_series(folder, plan, set_values(PatientName=NAME, SeriesDescription=NAME, LossyImageCompression="01"))
    return folder


class CollectedRecords(logging.Handler):
    """All records of a log."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


@dataclass
class LoggedJob:
    """A job that made a mesh: its report, the file that it wrote, and what it logged."""

    report: dict[str, Any]
    written: Path
    records: list[logging.LogRecord]

    @property
    def messages(self) -> list[str]:
        return [record.getMessage() for record in self.records]


@pytest.fixture(scope="module")
def job(device: Any, scan_of_mueller: Path, tmp_path_factory: pytest.TempPathFactory) -> LoggedJob:
    """A mesh of the scan, in a file named as the patient."""
    written = tmp_path_factory.mktemp("job") / f"{NAME}.stl"
    settings = MeshSettings(iso_value=200.0, device=str(device.index))
    collected = CollectedRecords()
    logger = logging.getLogger("clrecon")
    level = logger.level
    logger.addHandler(collected)
    logger.setLevel(logging.DEBUG)
    try:
        report = make_mesh(scan_of_mueller, written, settings, report_path=written.with_name("a.json"))
    finally:
        logger.removeHandler(collected)
        logger.setLevel(level)
    return LoggedJob(report, written, collected.records)


def test_log_of_a_job_has_its_device_series_file_and_meshes(job: LoggedJob, device: Any) -> None:
    [chosen] = [text for text in job.messages if text.startswith(f"device {device.index} chosen of")]
    [made] = [text for text in job.messages if text.startswith("1 meshes made, ")]
    assert device.label in chosen
    assert device.label in made
    assert f"series 1 of 1 read: {SHAPE[::-1]} voxels int16" in job.messages
    assert f"file written: {job.written.stat().st_size} bytes" in job.messages


def test_log_of_a_job_has_each_of_its_stages(job: LoggedJob) -> None:
    assert {text.split(":")[0] for text in job.messages} > {"read", "device", "surface", "measure", "write"}


def test_log_of_a_job_has_each_warning_of_its_report_once(job: LoggedJob) -> None:
    warnings = [record.getMessage() for record in job.records if record.levelno >= logging.WARNING]
    assert warnings
    assert sorted(warnings) == sorted(job.report["warnings"])


def test_log_of_a_job_comes_from_loggers_of_clrecon(job: LoggedJob) -> None:
    assert job.records
    assert all(record.name.startswith("clrecon.") for record in job.records)


def test_log_of_a_job_names_no_patient_and_no_folder(job: LoggedJob) -> None:
    log = "\n".join(job.messages)
    assert "read" in log
    assert "Mueller" not in log
    assert str(job.written.parent) not in log


@pytest.fixture
def binary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Path:
    """The folder of built programs, whose log is read."""
    caplog.set_level(logging.INFO, "clrecon")
    caches = prepare_caches()._replace(binaries=tmp_path)
    monkeypatch.setattr(cache, "prepare_caches", lambda: caches)
    return tmp_path


@pytest.mark.parametrize("content", [b"", b"damaged"])
def test_damaged_binary_of_a_program_is_logged(
    content: bytes, binary_folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache.store_binary("key", b"binary")
    (binary_folder / "key").write_bytes(content)
    cache.read_binary("key")
    assert caplog.messages == ["a kept binary is damaged: it is built anew and replaced"]


@pytest.mark.usefixtures("binary_folder")
def test_missing_and_whole_binaries_of_programs_are_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    assert cache.read_binary("key") is None
    cache.store_binary("key", b"binary")
    assert cache.read_binary("key") == b"binary"
    assert caplog.messages == []


def test_log_of_reading_is_not_printed_without_a_handler(scan_of_mueller: Path) -> None:
    code = "import clrecon, sys; volume = clrecon.read_volume(sys.argv[1]); assert volume.report['warnings']"
    done = subprocess.run([sys.executable, "-c", code, str(scan_of_mueller)], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_import_and_help_do_not_load_logging() -> None:
    code = "import sys, clrecon, clrecon.cli.main, clrecon.cli.mesh; print('logging' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert done.stdout == "False\n"


def test_volume_made_from_an_array_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "clrecon")
    assert clrecon.Volume(np.zeros((2, 3, 4), np.int16), np.eye(4)).hu_range == (0.0, 0.0)
    assert caplog.records == []
