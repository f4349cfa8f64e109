"""Nothing that clrecon writes or says names the patient; hashes of UIDs come where they are asked for."""

from __future__ import annotations

import hashlib
import logging
import re
from pathlib import Path
from typing import Any

import ct_files
import pydicom
import pytest
from ct_files import write_series
from printed_text import Printer
from variants import but_seldom

from clrecon.cli.main import main

SECRETS = {
    "PatientName": "Geheim^Jolanthe^Maria", "PatientID": "ID-471147114711-QX", "PatientBirthDate": "19500102",
    "PatientAddress": "Rosengasse 7", "OtherPatientIDs": "OTHER-99-QX", "PatientComments": "weint nachts",
    "AccessionNumber": "ACC-556-QX", "ReferringPhysicianName": "Zauber^Ignaz", "InstitutionName": "Klinik Nimmerland",
    "StudyDescription": "Wirbel von Jolanthe", "SeriesDescription": "Knochen von Jolanthe", "StudyID": "STUDY-QX",
    "ProtocolName": "Protokoll Jolanthe", "StationName": "ROEHRE-QX", "DeviceSerialNumber": "SERIAL-QX",
    "StudyDate": "20190304", "SeriesDate": "20190305", "AcquisitionDate": "20190306", "ContentDate": "20190307",
    "StudyInstanceUID": "1.2.276.47114711.1", "FrameOfReferenceUID": "1.2.276.47114711.3",
    "ImageComments": "Kommentar-QX", "OperatorsName": "Knall^Olga",
}  # fmt: skip
SERIES_UID = "1.2.276.47114711.2"
WORDS = [
    *(part for text in SECRETS.values() for part in re.split(r"\^", text)), "Jolanthe", "1.2.276.47114711",
]  # fmt: skip
"""Words so long that no picture or figure has them by chance."""
HASHES = [hashlib.sha256(uid.encode()).hexdigest()[:16] for uid in (SERIES_UID, SECRETS["FrameOfReferenceUID"])]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_series(tmp_path_factory.mktemp("patient") / "ct")
    write_series(folder, number=2)
    for place, path in enumerate(sorted(folder.iterdir())):
        dataset = pydicom.dcmread(path)
        number = dataset.SeriesNumber
        for keyword, text in SECRETS.items():
            setattr(dataset, keyword, text)
        dataset.SeriesInstanceUID = SERIES_UID if number == 1 else f"{SERIES_UID}.2"
        dataset.file_meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID = f"{SERIES_UID}.{place + 7}"
        dataset.file_meta.PrivateInformationCreatorUID = f"{SERIES_UID}.5"
        dataset.file_meta.PrivateInformation = b"Jolanthe"
        dataset.save_as(path)
    return folder


def find_words(folder: Path, *said: str) -> list[str]:
    """Words of the patient, and hashes, in names and contents of files and in texts."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert files or said
    written = b"\n".join([path.name.encode() for path in files] + [path.read_bytes() for path in files])
    return ct_files.find_words(written + "\n".join(("", *said)).encode(), (*WORDS, *HASHES))


COMMANDS = {
    **{
        f"mesh .{kind}": f"mesh {{scan}} -o a.{kind} --hu 0 --report r.json"
        for kind in ("stl", "ply", "obj", "glb", "vtp", "3mf")
    },
    "picture": "render {scan} -o a.png --depth d.tif --size 64 --letters --report r.json",
    "movie": "render {scan} --turntable a.gif --frames 2 --size 32 --report r.json",
    "bench": "bench {scan} --runs 1 --hu 0 --report r.json",
    "compare": "compare {scan} -o report --methods t-mc --hu 0 --repeat 1 --paper",
}  # fmt: skip


@pytest.mark.parametrize("what", but_seldom(COMMANDS, ("mesh .obj", "mesh .glb", "mesh .vtp", "bench", "compare")))
def test_row_69_no_file_and_no_word_names_the_patient(
    what: str,
    device: Any,
    scan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    printed: Printer,
    caplog: pytest.LogCaptureFixture,
) -> None:
    command = [*COMMANDS[what].format(scan=scan).split(), "--series", "1", "--device", str(device.index)]
    monkeypatch.chdir(tmp_path)
    with caplog.at_level(logging.DEBUG):
        assert main([*command, "-v"]) == 0
        assert main([*command, "--json"]) == 0
    assert find_words(tmp_path, printed().everything, caplog.text) == []
    if what in ("bench", "compare"):
        return
    assert main([*command, "--json", "--keep-ids"]) == 0
    report = printed().report()["volume"]
    assert [report["series"]["uid_hash"], report["frame_of_reference_hash"]] == HASHES
    assert find_words(tmp_path) == HASHES
    (tmp_path / "r.json").unlink()
    in_comments = what.startswith("mesh") and what[-3:] != "stl"
    packed = what.endswith("3mf")
    assert find_words(tmp_path) == (HASHES[1:] if in_comments and not packed else [])
    if packed:
        import zipfile

        with zipfile.ZipFile(tmp_path / "a.3mf") as archive:
            assert HASHES[1].encode() in archive.read("3D/3dmodel.model")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--series", "no such text"], 3),
        (["--series", "knochen von"], 3),  # which both have
        (["--series", "1", "--phase", "9"], 3),
        ([], 4),  # two of one size
        (["--series", "1", "--labels", "{scan}/s1_000.dcm"], 4),
    ],
    ids=["none", "both", "phase", "choice", "labels"],
)
def test_row_69_errors_name_a_series_by_its_number(
    arguments: list[str], code: int, device: Any, scan: Path, tmp_path: Path, printed: Printer
) -> None:
    said = [argument.format(scan=scan) for argument in arguments]
    command = ["mesh", str(scan), "-o", str(tmp_path / "a.stl"), "--device", str(device.index), *said]
    assert main([*command, "--json"]) == code
    assert find_words(tmp_path, printed().everything) == []
    assert main([*command, "--debug"]) == code
    said = printed()
    said.assert_error("Traceback")
    assert find_words(tmp_path, said.everything) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", ["--pixels", "--json"])
def test_row_69_info_describes_a_series_and_says_no_more(
    form: str, scan: Path, tmp_path: Path, printed: Printer
) -> None:
    assert main(["info", str(scan), "--series", "1", form]) == 0
    shown = printed().everything
    assert SECRETS["SeriesDescription"] in shown and HASHES[0] in shown
    assert find_words(tmp_path, shown.replace(SECRETS["SeriesDescription"], "")) == HASHES
