"""Archives as inputs: what is in them is read as from its folder, and hostile ones are refused and leave nothing."""

from __future__ import annotations

import gzip
import io
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_series import Plan, write_series
from refusals import refused

from clrecon import list_series, read_volume
from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.reading.archives import PASSWORD_VARIABLE, Limits, unpacked
from clrecon.system.progress import ignore_progress

pytestmark = pytest.mark.unit


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of slices in a folder, of a tilted scan."""
    folder = tmp_path_factory.mktemp("scan")
    write_series(folder / "study" / "ct", Plan(tilt_deg=12, angles=(3, 4, -5)))
    return folder


@pytest.fixture(autouse=True)
def temporary(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files; it is empty after each test."""
    folder = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


@pytest.fixture(autouse=True)
def nothing_left(temporary: Path) -> Any:
    """Each test leaves no temporary file."""
    yield
    assert list(temporary.iterdir()) == []


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def zip_folder(folder: Path, path: Path) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files_of(folder):
            archive.write(file, file.relative_to(folder))
    return path


def zip_bytes(entries: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return stream.getvalue()


def tar_folder(folder: Path, path: Path) -> Path:
    with tarfile.open(path, "w:" + {".gz": "gz", ".tgz": "gz", ".bz2": "bz2", ".xz": "xz"}.get(path.suffix, "")) as tar:
        tar.add(folder, ".")
    return path


def zip_twice(folder: Path, path: Path) -> Path:
    """A zip file in a zip file."""
    inner = zip_folder(folder, path.with_name("inner.zip"))
    path.write_bytes(zip_bytes({"inner.zip": inner.read_bytes()}))
    return path


PACKED = {
    "scan.zip": zip_folder,
    "zip without an extension": zip_folder,
    "tar without an extension": tar_folder,
    "twice.zip": zip_twice,
    "scan.tar": tar_folder,
    "scan.tar.gz": tar_folder,
    "scan.tgz": tar_folder,
    "scan.tar.bz2": tar_folder,
    "scan.tar.xz": tar_folder,
}


@pytest.mark.parametrize(("name", "pack"), PACKED.items(), ids=PACKED)
def test_archive_is_read_as_its_folder(name: str, pack: Any, scan: Path, tmp_path: Path) -> None:
    of_folder, of_archive = read_volume(scan), read_volume(pack(scan, tmp_path / name))

    np.testing.assert_array_equal(of_archive.voxels, of_folder.voxels)
    np.testing.assert_array_equal(of_archive.affine, of_folder.affine)
    assert of_archive.report == of_folder.report


def test_archive_is_listed_as_its_folder(scan: Path, tmp_path: Path) -> None:
    of_folder, of_archive = list_series(scan), list_series(zip_folder(scan, tmp_path / "scan.zip"))

    assert of_archive.certificate == of_folder.certificate


def test_grid_file_in_an_archive_is_read_as_alone(scan: Path, tmp_path: Path) -> None:
    (tmp_path / "grid").mkdir()
    read_volume(scan).save(tmp_path / "grid" / "ct.nrrd")

    of_file = read_volume(tmp_path / "grid" / "ct.nrrd")
    of_archive = read_volume(zip_folder(tmp_path / "grid", tmp_path / "ct.zip"))

    np.testing.assert_array_equal(of_archive.voxels, of_file.voxels)
    assert of_archive.report == of_file.report


ESCAPES = {
    "folder above": "../outside.dcm",
    "folder above, further in": "a/../../outside.dcm",
    "absolute": "/tmp/outside.dcm",
    "drive": "C:\\outside.dcm",
    "backslashes": "..\\outside.dcm",
}


@pytest.mark.parametrize("name", ESCAPES.values(), ids=ESCAPES)
def test_path_that_leads_out_of_a_zip_file_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "hostile.zip").write_bytes(zip_bytes({name: b"x"}))

    with refused(RefusedInputError, "hostile.zip", "out", "outside.dcm"):
        read_volume(tmp_path / "hostile.zip")

    assert [path.name for path in tmp_path.rglob("*")] == ["hostile.zip"]


@pytest.mark.parametrize(
    "kind",
    [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE],
    ids=["link", "hard link", "pipe", "device"],
)
def test_link_or_device_in_a_tar_file_is_refused(kind: bytes, tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "hostile.tar", "w") as tar:
        entry = tarfile.TarInfo("passwords.dcm")
        entry.type, entry.linkname = kind, "/etc/passwd"
        tar.addfile(entry)

    with refused(RefusedInputError, "hostile.tar", "passwords.dcm", "link", "device"):
        read_volume(tmp_path / "hostile.tar")


def test_link_in_a_zip_file_is_refused(tmp_path: Path) -> None:
    entry = zipfile.ZipInfo("passwords.dcm")
    entry.external_attr = 0o120777 << 16  # the mode of a symbolic link
    with zipfile.ZipFile(tmp_path / "hostile.zip", "w") as archive:
        archive.writestr(entry, "/etc/passwd")

    with refused(RefusedInputError, "hostile.zip", "passwords.dcm", "link"):
        read_volume(tmp_path / "hostile.zip")


def unpack(path: Path, **limits: Any) -> None:
    with unpacked(path, ignore_progress, Limits(**limits)):
        pass


def tar_zeros(path: Path, *, count: int) -> None:
    with tarfile.open(path, "w:gz") as tar:
        entry = tarfile.TarInfo("air.dcm")
        entry.size = count
        tar.addfile(entry, io.BytesIO(bytes(count)))


def test_archive_of_more_than_100_times_its_size_is_refused_beyond_the_free_bytes(tmp_path: Path) -> None:
    tar_zeros(tmp_path / "bomb.tar.gz", count=1 << 20)  # zeros pack a thousand times

    with refused(RefusedInputError, "bomb.tar.gz", 100):
        unpack(tmp_path / "bomb.tar.gz", free_bytes=(1 << 20) - 1)


def test_archive_of_more_than_100_times_its_size_is_unpacked_up_to_the_free_bytes(tmp_path: Path) -> None:
    tar_zeros(tmp_path / "air.tar.gz", count=1 << 20)

    with unpacked(tmp_path / "air.tar.gz", ignore_progress, Limits(free_bytes=1 << 20)) as inside:
        assert Path(inside).stat().st_size == 1 << 20


@pytest.mark.parametrize("name", ["many.zip", "many.tar"])
def test_more_files_than_allowed_are_refused_with_their_limit(name: str, scan: Path, tmp_path: Path) -> None:
    path = PACKED[{"many.zip": "scan.zip", "many.tar": "scan.tar"}[name]](scan, tmp_path / name)

    with refused(RefusedInputError, name, len(files_of(scan)) - 1):
        unpack(path, entries=len(files_of(scan)) - 1)


def test_archives_three_deep_are_refused(tmp_path: Path) -> None:
    content = b"x"
    for name in ("c.dcm", "b.zip", "a.zip"):
        content = zip_bytes({name: content})
    (tmp_path / "deep.zip").write_bytes(content)

    with refused(RefusedInputError, "deep.zip", "archives"):
        read_volume(tmp_path / "deep.zip")


def test_archive_beside_the_slices_of_an_archive_is_skipped_as_in_a_folder(scan: Path, tmp_path: Path) -> None:
    (tmp_path / "both").mkdir()
    zip_folder(scan, tmp_path / "both" / "backup.zip")
    write_series(tmp_path / "both" / "ct", Plan(tilt_deg=12, angles=(3, 4, -5)))

    of_archive = read_volume(zip_folder(tmp_path / "both", tmp_path / "both.zip"))

    assert of_archive.report == read_volume(tmp_path / "both").report
    assert of_archive.report["files"]["skipped"] == {"zip archive": 1}


class Reads:
    """A stream that notes how many bytes were read of it."""

    def __init__(self, stream: Any):
        self._stream, self.count = stream, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def read(self, size: int = -1) -> bytes:
        piece = bytes(self._stream.read(size))
        self.count += len(piece)
        return piece


def test_packed_tar_file_beyond_its_limits_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tar_zeros(tmp_path / "bomb.tar.gz", count=1 << 26)
    opened: list[Reads] = []

    def open_noted(path: Path) -> Reads:
        opened.append(Reads(gzip.GzipFile(path)))
        return opened[-1]

    monkeypatch.setattr("gzip.open", open_noted)
    with refused(RefusedInputError, "bomb.tar.gz", 100):
        unpack(tmp_path / "bomb.tar.gz", free_bytes=0)

    assert sum(stream.count for stream in opened) == tarfile.BLOCKSIZE  # the first header


@pytest.mark.parametrize(
    ("size", "kind", "fact"),
    [(1 << 20, NoDicomError, "letter.txt"), ((16 << 20) + 1, RefusedInputError, "header")],
    ids=["1 MiB", "16 MiB and 1"],
)
def test_tar_file_is_damaged_where_a_header_has_more_than_16_mib(
    size: int, kind: type[Exception], fact: str, tmp_path: Path
) -> None:
    with tarfile.open(tmp_path / "long.tar.gz", "w:gz") as tar:
        entry = tarfile.TarInfo("letter.txt")
        entry.pax_headers = {"comment": "x" * size}  # a header of its own before that of the file, read as a whole
        tar.addfile(entry)

    with refused(kind, "long.tar.gz", fact):
        read_volume(tmp_path / "long.tar.gz")


def test_two_entries_of_one_name_are_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "twins.zip", "w") as archive, pytest.warns(UserWarning):
        archive.writestr("a.dcm", "1")
        archive.writestr("a.dcm", "2")

    with refused(RefusedInputError, "twins.zip", "a.dcm", "twice"):
        read_volume(tmp_path / "twins.zip")


@pytest.mark.parametrize(
    ("name", "share"),
    [("scan.zip", 0.3), ("scan.zip", 0.99), ("scan.tar", 0.3), ("scan.tar.gz", 0.3), ("scan.tar.xz", 0.3)],
)
def test_archive_that_ends_early_is_refused(name: str, share: float, scan: Path, tmp_path: Path) -> None:
    whole = PACKED[name](scan, tmp_path / f"whole{name}").read_bytes()
    (tmp_path / name).write_bytes(whole[: int(share * len(whole))])

    with refused(RefusedInputError, name, "unpacked"):
        read_volume(tmp_path / name)


def test_tar_file_that_ends_between_two_files_is_refused(scan: Path, tmp_path: Path) -> None:
    path = tar_folder(scan, tmp_path / "scan.tar")
    with tarfile.open(path) as tar:
        last = [member for member in tar if member.isfile()][-1]
    os.truncate(path, last.offset)

    with refused(RefusedInputError, "scan.tar", "early", "missing"):
        read_volume(path)


def test_archive_without_a_scan_is_no_dicom(tmp_path: Path) -> None:
    (tmp_path / "letter.zip").write_bytes(zip_bytes({"letter.txt": b"hello"}))

    with refused(NoDicomError, "letter.zip/letter.txt"):
        read_volume(tmp_path / "letter.zip")


@pytest.fixture(scope="module")
def encrypted(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A zip file with the password "secret", which Python reads and cannot write."""
    path = tmp_path_factory.mktemp("encrypted") / "scan.zip"
    try:
        subprocess.run(["zip", "-qr", "-P", "secret", str(path), "."], cwd=scan, check=True)
    except FileNotFoundError:
        pytest.skip("there is no program zip, which writes encrypted files")
    return path


def test_encrypted_archive_is_read_with_the_password_of_the_environment(
    encrypted: Path, scan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSWORD_VARIABLE, "secret")

    assert read_volume(encrypted).report == read_volume(scan).report


@pytest.mark.parametrize("password", ["", "wrong"], ids=["no password", "wrong password"])
def test_encrypted_archive_is_refused_and_the_variable_named(
    password: str, encrypted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSWORD_VARIABLE, password)

    with refused(UsageError, "scan.zip", PASSWORD_VARIABLE):
        read_volume(encrypted)


def test_wrong_password_that_passes_the_check_byte_is_refused_and_the_variable_named(
    encrypted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSWORD_VARIABLE, find_password_that_passes(encrypted))

    with refused(UsageError, "scan.zip", PASSWORD_VARIABLE):
        read_volume(encrypted)


def find_password_that_passes(path: Path) -> str:
    """Return a wrong password which the check of zip lets pass: it is a byte long."""
    with zipfile.ZipFile(path) as archive:
        name = next(entry.filename for entry in archive.infolist() if not entry.is_dir())
        for number in range(10_000):
            try:
                archive.open(name, pwd=str(number).encode()).close()
            except RuntimeError:
                continue
            return str(number)
    raise AssertionError("no password passes")


def test_modules_for_archives_are_not_loaded_for_a_folder(scan: Path) -> None:
    code = "import sys, clrecon; clrecon.read_volume(sys.argv[1]); print({'zipfile', 'tarfile'} & {*sys.modules})"

    loaded = subprocess.run(
        [sys.executable, "-c", code, str(scan)], capture_output=True, text=True, check=True, env={**os.environ}
    )

    assert loaded.stdout.strip() == "set()"
