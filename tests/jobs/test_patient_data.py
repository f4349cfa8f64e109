"""Nothing that clrecon writes or says names the patient; hashes of UIDs come where they are asked for."""

from __future__ import annotations

import hashlib
import logging
import re
import zipfile
from pathlib import Path
from typing import Any

import ct_files
import pydicom
import pytest
from ct_files import write_series
from printed_text import Printer
from variants import but_seldom, daily

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
SERIES_HASH, FRAME_HASH = HASHES = [
    hashlib.sha256(uid.encode()).hexdigest()[:16] for uid in (SERIES_UID, SECRETS["FrameOfReferenceUID"])
]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two series of one patient, numbers 1 and 2, with `SECRETS` in their headers."""
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


MESHES_AND_PICTURES = [what for what in COMMANDS if what not in ("bench", "compare")]


@pytest.fixture
def command_for(device: Any, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that gives the words of one of `COMMANDS`; the working folder is that of the test."""
    monkeypatch.chdir(tmp_path)
    return lambda what: [*COMMANDS[what].format(scan=scan).split(), "--series", "1", "--device", str(device.index)]


@pytest.mark.fault_row(69)
@pytest.mark.parametrize("what", but_seldom(COMMANDS, ("mesh .obj", "mesh .glb", "mesh .vtp", "bench", "compare")))
def test_files_words_and_log_of_a_command_do_not_name_the_patient(
    what: str, command_for: Any, tmp_path: Path, printed: Printer, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.DEBUG):
        assert main([*command_for(what), "-v"]) == 0
        assert main([*command_for(what), "--json"]) == 0

    assert find_words(tmp_path, printed().everything, caplog.text) == []


@pytest.mark.fault_row(69)
@pytest.mark.parametrize("what", but_seldom(MESHES_AND_PICTURES, ("mesh .obj", "mesh .glb", "mesh .vtp")))
def test_report_has_hashes_of_series_and_frame_of_reference_where_they_are_asked_for(
    what: str, command_for: Any, tmp_path: Path, printed: Printer
) -> None:
    assert main([*command_for(what), "--json", "--keep-ids"]) == 0

    volume = printed().report()["volume"]
    assert (volume["series"]["uid_hash"], volume["frame_of_reference_hash"]) == (SERIES_HASH, FRAME_HASH)
    assert find_words(tmp_path) == [SERIES_HASH, FRAME_HASH]  # and no word of the patient


@pytest.mark.fault_row(69)
@pytest.mark.parametrize("kind", daily(1, ["ply", "obj", "glb", "vtp"]))
def test_comment_of_a_mesh_has_the_hash_of_its_frame_of_reference_where_it_is_asked_for(
    kind: str, command_for: Any, tmp_path: Path
) -> None:
    assert main([*command_for(f"mesh .{kind}"), "--keep-ids"]) == 0

    (tmp_path / "r.json").unlink()
    assert find_words(tmp_path) == [FRAME_HASH]


@pytest.mark.fault_row(69)
def test_model_of_a_3mf_has_the_hash_of_its_frame_of_reference_where_it_is_asked_for(
    command_for: Any, tmp_path: Path
) -> None:
    assert main([*command_for("mesh .3mf"), "--keep-ids"]) == 0

    with zipfile.ZipFile(tmp_path / "a.3mf") as archive:
        assert FRAME_HASH.encode() in archive.read("3D/3dmodel.model")


@pytest.mark.fault_row(69)
@pytest.mark.parametrize("what", ["mesh .stl", "picture", "movie"])
def test_file_without_room_for_a_comment_has_no_hash(what: str, command_for: Any, tmp_path: Path) -> None:
    assert main([*command_for(what), "--keep-ids"]) == 0

    (tmp_path / "r.json").unlink()
    assert find_words(tmp_path) == []


@pytest.mark.fault_row(69)
@pytest.mark.parametrize("form", ["--json", "--debug"])
@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--series", "no such text"], 3),
        (["--series", "knochen von"], 3),  # which both have
        (["--series", "1", "--phase", "9"], 3),
        ([], 4),  # two of one size
        (["--series", "1", "--labels", "{scan}/s1_000.dcm"], 4),
    ],
    ids=["no series", "both series", "missing phase", "no choice", "slice as label map"],
)
def test_errors_do_not_name_the_patient_in_json_nor_with_their_traceback(
    arguments: list[str], code: int, form: str, device: Any, scan: Path, tmp_path: Path, printed: Printer
) -> None:
    given = [argument.format(scan=scan) for argument in arguments]
    command = ["mesh", str(scan), "-o", str(tmp_path / "a.stl"), "--device", str(device.index), *given]

    assert main([*command, form]) == code

    said = printed()
    assert said.everything
    assert find_words(tmp_path, said.everything) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.fault_row(69)
@pytest.mark.parametrize("form", ["--pixels", "--json"])
def test_info_shows_description_and_hashes_of_a_series_and_nothing_else_of_the_patient(
    form: str, scan: Path, tmp_path: Path, printed: Printer
) -> None:
    assert main(["info", str(scan), "--series", "1", form]) == 0

    shown = printed().everything
    description = SECRETS["SeriesDescription"]
    assert description in shown
    assert find_words(tmp_path, shown.replace(description, "")) == [SERIES_HASH, FRAME_HASH]
