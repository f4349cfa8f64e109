"""Meshes in an archive: what is stored is the file with the patient of the scan, and nothing is half done."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pydicom
import pytest
from ct_files import PATIENT, PATIENT_WORDS, find_words, write_series
from refusals import refused
from web_servers import Archive, answering, running

from clrecon import Volume, read_volume
from clrecon.cli.main import main
from clrecon.errors import OutputError, RefusedInputError
from clrecon.reading.common.selection import Selection
from clrecon.reading.dicom.storing import encode_model, read_origin
from clrecon.reading.dicomweb import Store


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A DICOM series of a ball, of the patient PATIENT."""
    return write_series(tmp_path_factory.mktemp("scan"))


@pytest.fixture
def archive(scan: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Archive]:
    """A server that has the scan, and keeps what is stored; no test waits before it asks again."""
    monkeypatch.setenv("NETRC", "")
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    with running(Archive(scan)) as server:
        yield server


def store(scan: Path, folder: Path, url: str, *options: str) -> int:
    """Mesh a scan to b.stl and store it at a URL; return the exit code."""
    return main(["mesh", str(scan), "-o", str(folder / "b.stl"), "--hu", "0", "-q", "--store", url, *options])


def test_stored_mesh_is_the_file_with_the_patient_the_study_and_the_slices_of_the_scan(
    archive: Archive, scan: Path, tmp_path: Path
) -> None:
    assert store(scan, tmp_path, archive.study, "--report", str(tmp_path / "r.json")) == 0

    [model], first = archive.stored(), pydicom.dcmread(next(scan.iterdir()))
    written = (tmp_path / "b.stl").read_bytes()
    assert model.EncapsulatedDocument[: model.EncapsulatedDocumentLength] == written
    assert (model.PatientName, model.StudyInstanceUID) == (PATIENT, first.StudyInstanceUID)
    assert model.FrameOfReferenceUID == first.FrameOfReferenceUID
    slices = model.ReferencedSeriesSequence[0].ReferencedInstanceSequence
    assert {item.ReferencedSOPInstanceUID for item in slices} == set(archive.uids)
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["stored"]["instances"] == 1
    assert find_words(written + json.dumps(report).encode(), PATIENT_WORDS) == []


def test_mesh_in_another_frame_is_stored_in_that_of_the_scan(archive: Archive, scan: Path, tmp_path: Path) -> None:
    assert store(scan, tmp_path, archive.study, "--space", "ras") == 0

    (model,) = archive.stored()
    assert model.EncapsulatedDocument.startswith(b"clrecon SPACE=LPS")  # the header of the STL


@pytest.mark.parametrize(
    ("answers", "code"),
    [
        # FailedSOPSequence, with the FailureReason of its only item
        ([answering(b"[]"), answering(b'{"00081198": {"Value": [{"00081197": {"Value": [272]}}]}}', status=409)], 6),
        ([answering(b"[]"), answering(b"<html>")], 6),
        ([answering(status=401)], 3),
        ([answering(status=404)], 3),
        ([answering(status=503)] * 4, 9),
        ([answering(b"[]"), *[answering(status=503)] * 4], 9),
        ([answering(b"[]"), answering(status=302, Location="/dicom-web/studies")], 4),
    ],
    ids=["refused", "no answer", "no credentials", "no archive", "busy", "busy later", "redirection"],
)
def test_mesh_that_is_not_stored_is_not_written_either(
    answers: list[Any], code: int, archive: Archive, scan: Path, tmp_path: Path
) -> None:
    archive.answers = answers

    assert store(scan, tmp_path, archive.study) == code
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "reply",  # 00081199: ReferencedSOPSequence, what was stored; 00081198: FailedSOPSequence; 00081197: FailureReason
    [
        "[]",
        "{",
        '{"00081199": 1}',
        '{"00081199": {"Value": [{}]}}',
        '{"00081198": {"Value": [{"00081197": {"Value": ["a"]}}]}}',
    ],
    ids=["list", "cut", "number", "empty item", "text as reason"],
)
def test_reply_that_does_not_confirm_is_no_success(reply: str, archive: Archive) -> None:
    archive.answers = [answering(reply.encode())]

    with refused(OutputError, archive.host):
        Store(archive.study).store("1.2", b"DICM")


def test_reason_of_an_archive_that_does_not_store_is_told(archive: Archive) -> None:
    reply = {"00081198": {"Value": [{"00081197": {"Value": [0x0110]}}]}}
    archive.answers = [answering(json.dumps(reply).encode(), status=409)]

    with refused(OutputError, archive.host, "0x0110"):
        Store(archive.study).store("1.2", b"DICM")


@pytest.mark.parametrize("url", ["s3://bucket/a", "pacs", "dicomweb+http://pacs.example"])
def test_url_of_no_archive_is_refused_before_the_scan_is_read(url: str, tmp_path: Path, printed: Any) -> None:
    assert store(tmp_path / "none", tmp_path, url) == 3
    assert printed().error_lines == 1


def test_scan_that_is_no_dicom_cannot_be_stored(archive: Archive, scan: Path, tmp_path: Path) -> None:
    (tmp_path / "grid").mkdir()
    volume: Volume = read_volume(scan)
    volume.save(tmp_path / "grid" / "ct.nrrd")

    assert store(tmp_path / "grid" / "ct.nrrd", tmp_path, archive.study) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["grid"]


def test_same_mesh_of_the_same_scan_has_the_same_uid_and_another_mesh_another(scan: Path) -> None:
    origin = read_origin(scan, Selection())

    first, again, another = (
        encode_model(stl, origin, "bone", is_modified=False)[0] for stl in (b"a", b"a", b"b")
    )  # each with its instance

    assert first == again != another


@pytest.mark.parametrize("keyword", ["StudyInstanceUID", "FrameOfReferenceUID"])
def test_scan_without_the_uids_of_an_archive_is_refused_with_what_is_missing(
    keyword: str, scan: Path, tmp_path: Path
) -> None:
    for path in scan.iterdir():
        header = pydicom.dcmread(path)
        delattr(header, keyword)
        header.save_as(tmp_path / path.name)

    with refused(RefusedInputError, keyword):
        read_origin(tmp_path, Selection())
