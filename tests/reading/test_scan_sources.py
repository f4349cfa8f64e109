"""Inputs that are no path: bytes in memory, files of the web, buckets and other file systems, read as their folder."""

from __future__ import annotations

import io
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_series import Plan, write_series
from refusals import refused
from web_servers import BucketServer, Server, answering, running

from clrecon import list_series, read_labels, read_volume
from clrecon.cli.main import main
from clrecon.errors import NoDicomError, RefusedInputError, UnreachableError, UsageError
from clrecon.reading.archives import Limits
from clrecon.reading.buckets import foreign_errors
from clrecon.reading.sources import opened
from clrecon.reading.urls import check_url, is_url, shown_url
from clrecon.system.progress import ignore_progress

pytestmark = pytest.mark.unit

SECRET = "sesame"


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the slices of a tilted scan in study/ct."""
    folder = tmp_path_factory.mktemp("scan")
    write_series(folder / "study" / "ct", Plan(tilt_deg=12, angles=(3, 4, -5)))
    return folder


@pytest.fixture(scope="module")
def contents(scan: Path) -> dict[str, bytes]:
    """The files of the scan by their names in it."""
    return {path.relative_to(scan).as_posix(): path.read_bytes() for path in sorted(scan.rglob("*.dcm"))}


@pytest.fixture(scope="module")
def packed(contents: dict[str, bytes]) -> bytes:
    """The scan as a zip file."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return stream.getvalue()


@pytest.fixture(autouse=True)
def nothing_left(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Each test leaves no temporary file, and no credentials of who runs the tests are used."""
    monkeypatch.setenv("NETRC", "")
    folder = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    yield
    assert list(folder.iterdir()) == []


def assert_read_as(source: Any, scan: Path) -> None:
    of_source, of_folder = read_volume(source), read_volume(scan)
    np.testing.assert_array_equal(of_source.voxels, of_folder.voxels)
    np.testing.assert_array_equal(of_source.affine, of_folder.affine)
    assert of_source.report == of_folder.report


def test_bytes_of_the_files_of_a_scan_are_read_as_its_folder(contents: dict[str, bytes], scan: Path) -> None:
    assert_read_as(list(contents.values()), scan)


def test_bytes_of_an_archive_are_read_as_its_folder(packed: bytes, scan: Path) -> None:
    assert_read_as(packed, scan)


def test_bytes_of_a_scan_are_listed_as_its_folder(contents: dict[str, bytes], scan: Path) -> None:
    views = [memoryview(bytearray(content)) for content in contents.values()]

    assert list_series(views).certificate == list_series(scan).certificate


@pytest.mark.parametrize("extension", ["nii", "nii.gz", "nrrd", "mha"])
def test_bytes_of_a_grid_file_are_read_as_the_file(extension: str, tmp_path: Path) -> None:
    voxels = np.arange(-200, 40, dtype=np.int16).reshape(4, 6, 10)
    from clrecon import Volume

    path = tmp_path / f"ct.{extension}"
    Volume(voxels, np.diag([0.5, 0.75, 2.0, 1.0])).save(path)

    np.testing.assert_array_equal(read_volume(path.read_bytes()).voxels, voxels)


@pytest.mark.parametrize("source", [[], ["a.dcm"], [b"x", None]], ids=["nothing", "names", "None"])
def test_list_of_something_else_than_bytes_is_wrong_usage(source: Any) -> None:
    with refused(UsageError, "bytes"):
        read_volume(source)


def test_bytes_that_are_no_scan_are_no_dicom() -> None:
    with refused(NoDicomError, "bytes"):
        read_volume(b"hello")


# URLs.

WRONG_URLS = {
    "password": f"https://me:{SECRET}@pacs.example/scan.zip",
    "user": f"dicomweb+https://{SECRET}@pacs.example/studies/1.2",
    "password of a bucket": f"s3://me:{SECRET}@bucket/scan.zip",
    "not encrypted": "http://pacs.example/scan.zip",
    "archive that is not encrypted": "dicomweb+http://10.0.0.1/studies/1.2/series/3.4",
    "no series": "dicomweb+https://pacs.example/dicom-web",
    "one instance": "dicomweb+https://pacs.example/studies/1.2/series/3.4/instances/5.6",
    "query": f"dicomweb+https://pacs.example/studies/1.2?token={SECRET}",
    "scheme without HTTPS": "dicomweb://pacs.example/studies/1.2/series/3.4",
    "archive without its scheme": "https://pacs.example/dicom-web/studies/1.2/series/3.4",
    "file": "file:///data/scan",
    "no host": "https:///scan.zip",
    "no bucket": "s3:///scan.zip",
    "port": "https://pacs.example:none/scan.zip",
    "blank": "https://pacs.example/a scan.zip",
    "line": "https://pacs.example/scan.zip\r\nX: y",
    "unknown scheme": "foo://bar/scan.zip",
}


@pytest.mark.parametrize("what", WRONG_URLS)
def test_wrong_url_is_refused_in_a_line_without_what_may_be_secret(what: str, tmp_path: Path, printed: Any) -> None:
    pytest.importorskip("fsspec")
    assert main(["info", WRONG_URLS[what]]) == UsageError.exit_code

    told = printed()
    assert told.error_lines == 1
    assert SECRET not in told.everything


@pytest.mark.parametrize("text", ["C://scan", "scan", "./s3:/scan", "/a/b"])
def test_path_is_no_url(text: str) -> None:
    assert not is_url(text)


@pytest.mark.parametrize("what", ["password", "user", "password of a bucket"])
def test_url_with_a_user_or_password_is_refused_and_the_netrc_file_named(what: str) -> None:
    with refused(UsageError, "password", "netrc"):
        check_url(WRONG_URLS[what])


def test_messages_name_of_a_url_neither_user_nor_query_nor_the_uids_of_an_archive() -> None:
    assert shown_url(f"abfs://{SECRET}@a.example/scan") == "abfs://a.example/scan"
    assert shown_url(f"https://a.example/scan.zip?key={SECRET}#b") == "https://a.example/scan.zip"
    assert shown_url("dicomweb+https://a.example:8/x/studies/1.2/series/3.4") == "a.example:8"


def test_url_of_a_series_may_end_with_a_slash() -> None:
    assert check_url("dicomweb+https://a.example/studies/1.2/series/3.4/").path == "/studies/1.2/series/3.4"


@pytest.mark.parametrize("command", ["cloud", "view"])
def test_mesh_or_cloud_behind_a_url_is_refused(command: str, tmp_path: Path, printed: Any) -> None:
    output = ["-o", str(tmp_path / "c.ply")] if command == "cloud" else []
    assert main([command, "https://a.example/scan.ply", *output]) == UsageError.exit_code
    printed().assert_error(".ply", "URL")


def test_label_map_behind_a_url_is_refused() -> None:
    with refused(UsageError, "URL"):
        read_labels("https://a.example/labels.nii.gz")


# Files of the web.


@pytest.fixture
def server() -> Iterator[Server]:
    """A web server with the answers that a test gives it, else 404."""
    with running(Server()) as server:
        yield server


def test_archive_of_the_web_is_read_as_its_folder(server: Server, packed: bytes, scan: Path) -> None:
    server.answers = [answering(packed, kind="application/zip")]

    assert_read_as(f"http://{server.host}/a%20scan.zip?key=1", scan)
    assert [path for path, _headers in server.asked] == ["/a%20scan.zip?key=1"]


def test_file_of_the_web_that_was_cut_is_fetched_again(
    server: Server, packed: bytes, scan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    server.answers = [answering(packed[:-9], Content_Length=str(len(packed))), answering(packed)]

    assert_read_as(f"http://{server.host}/scan.zip", scan)


def test_file_of_the_web_that_is_not_there_is_no_dicom(server: Server) -> None:
    with refused(NoDicomError, server.host, 404):
        read_volume(f"http://{server.host}/scan.zip")


def test_empty_file_of_the_web_is_refused(server: Server) -> None:
    server.answers = [answering(b"")]
    with refused(RefusedInputError, server.host, "empty"):
        read_volume(f"http://{server.host}/scan.zip")


def test_file_of_the_web_of_unknown_length_is_refused_where_it_has_more_bytes_than_allowed(server: Server) -> None:
    server.answers = [answering(bytes(2000), Content_Length="")]

    with (
        refused(RefusedInputError, "TMPDIR"),
        opened(f"http://{server.host}/a", ignore_progress, Limits(fetched_bytes=1999)),
    ):
        pass


def test_file_of_the_web_larger_than_allowed_is_refused(server: Server) -> None:
    server.answers = [answering(Content_Length="2000")]  # none of them arrives

    with (
        refused(RefusedInputError, "TMPDIR"),
        opened(f"http://{server.host}/a", ignore_progress, Limits(fetched_bytes=1999)),
    ):
        pass


# Buckets.


@pytest.fixture
def bucket(contents: dict[str, bytes], packed: bytes, monkeypatch: pytest.MonkeyPatch) -> Iterator[BucketServer]:
    """The bucket "scans" with the scan in the folder "p 1" and as a zip file."""
    pytest.importorskip("obstore")
    objects = {f"p 1/{name}": content for name, content in contents.items()}
    with running(BucketServer({**objects, "p 1/study/": b"", "scan.zip": packed})) as server:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{server.host}")
        for name, value in {"ALLOW_HTTP": "true", "ACCESS_KEY_ID": "me", "SECRET_ACCESS_KEY": SECRET}.items():
            monkeypatch.setenv(f"AWS_{name}", value)
        yield server


@pytest.mark.parametrize("url", ["s3://scans/p%201/", "s3://scans/p%201", "s3://scans/scan.zip"])
def test_folder_or_archive_of_a_bucket_is_read_as_its_folder(url: str, bucket: BucketServer, scan: Path) -> None:
    assert_read_as(url, scan)


def test_object_that_ends_early_is_refused_with_both_sizes(bucket: BucketServer) -> None:
    listed = len(bucket.objects["scan.zip"])
    head = answering(bytes(listed), ETag='"1"', Last_Modified="Sat, 28 Nov 2026 12:00:00 GMT")
    bucket.objects["scan.zip"] = b"PK"
    bucket.answers = [head]

    with refused(RefusedInputError, "scan.zip", listed, 2):
        read_volume("s3://scans/scan.zip")


@pytest.mark.parametrize(
    "name", ["../../outside", "..\\..\\outside", "C:\\outside"], ids=["slashes", "backslashes", "drive"]
)
def test_object_whose_name_leads_out_of_the_folder_is_refused(name: str, bucket: BucketServer) -> None:
    bucket.objects = {f"p/{name}": b"x"}

    with refused(RefusedInputError, "s3://scans/p", "path", "out"):
        read_volume("s3://scans/p/")


def test_bucket_that_refuses_the_credentials_is_wrong_usage_without_quoting_its_answer(bucket: BucketServer) -> None:
    bucket.is_closed = True  # answers 403, and quotes the key AKIASECRET

    with refused(UsageError, "s3://scans/p") as caught:
        read_volume("s3://scans/p/")

    assert "AKIASECRET" not in str(caught.value)


def test_bucket_without_the_object_is_no_dicom(bucket: BucketServer) -> None:
    with refused(NoDicomError, "s3://scans/other"):
        read_volume("s3://scans/other/")


def test_bucket_that_nobody_serves_is_unreachable(bucket: BucketServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")

    with refused(UnreachableError, "s3://scans/p"):
        read_volume("s3://scans/p/")


@pytest.fixture
def memory(contents: dict[str, bytes], packed: bytes) -> Iterator[Any]:
    """The file system in memory of fsspec with the scan."""
    fsspec = pytest.importorskip("fsspec")
    system = fsspec.filesystem("memory")
    for name, content in {**{f"/scan/{name}": content for name, content in contents.items()}, "/s.zip": packed}.items():
        system.pipe(name, content)
    yield system
    system.rm("/", recursive=True)


@pytest.mark.parametrize("url", ["memory://scan", "memory://scan/", "memory://s.zip"])
def test_url_of_another_file_system_is_read_as_its_folder(url: str, memory: Any, scan: Path) -> None:
    assert_read_as(url, scan)


@pytest.mark.parametrize("more", [-1, 1])
def test_file_of_another_file_system_with_more_or_fewer_bytes_than_listed_is_refused_with_both_sizes(
    more: int, memory: Any, packed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = {"/s.zip": {"size": len(packed) + more, "type": "file"}}

    with monkeypatch.context() as lying, refused(RefusedInputError, f"{len(packed) + more:,}", f"{len(packed):,}"):
        lying.setattr(memory, "find", lambda path, detail: listed)
        read_volume("memory://s.zip")


def test_url_of_another_file_system_with_nothing_there_is_no_dicom(memory: Any) -> None:
    with refused(NoDicomError, "memory://none"):
        read_volume("memory://none")


def test_server_of_another_kind_that_does_not_answer_is_unreachable() -> None:
    pytest.importorskip("fsspec")
    with refused(UnreachableError, "ftp"):
        read_volume("ftp://127.0.0.1:1/x")  # a port where nothing listens


@pytest.mark.parametrize(("url", "package"), [("s3://a/b", "obstore"), ("sftp://a/b", "fsspec")])
def test_package_that_a_url_needs_is_named_where_it_is_missing(
    url: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)

    with refused(UsageError, package, "install"):
        read_volume(url)


def test_modules_of_the_network_are_not_loaded_for_a_folder(scan: Path) -> None:
    code = "import sys, clrecon; clrecon.read_volume(sys.argv[1]); print({'urllib.request', 'ssl'} & {*sys.modules})"

    loaded = subprocess.run([sys.executable, "-c", code, str(scan)], capture_output=True, text=True, check=True)

    assert loaded.stdout.strip() == "set()"


@pytest.mark.parametrize(
    ("url", "variable"),
    [
        ("s3://scans/a", "AWS_SKIP_SIGNATURE"),
        ("gs://scans/a", "GOOGLE_SKIP_SIGNATURE"),
        ("az://scans/a", "AZURE_SKIP_SIGNATURE"),
    ],
)
def test_refused_credentials_of_a_bucket_name_the_variables_of_its_cloud(url: str, variable: str) -> None:
    with refused(UsageError, variable), foreign_errors(url):
        raise PermissionError
