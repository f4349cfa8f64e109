"""DICOMweb as an input: a series is read as its folder, and what a server does wrong is told or tried again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from dicom_series import Plan, write_series
from refusals import refused
from web_servers import SERIES, STORED, STUDY, Archive, Server, answering, join_parts, list_entry, running, send

from clrecon import list_series, read_volume
from clrecon.cli.main import main
from clrecon.errors import ClreconError, NoDicomError, RefusedInputError, UnreachableError, UsageError
from clrecon.reading.archives import Limits
from clrecon.reading.dicomweb import Instances, Multipart
from clrecon.reading.sources import opened
from clrecon.reading.web import TOKEN_VARIABLE, Patience
from clrecon.system.progress import ignore_progress

pytestmark = pytest.mark.unit

SLICES = 7


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the slices of a tilted scan."""
    folder = tmp_path_factory.mktemp("scan")
    write_series(folder, Plan(tilt_deg=12, angles=(3, 4, -5), shape=(SLICES, 5, 6)))
    return folder


@pytest.fixture
def archive(scan: Path) -> Iterator[Archive]:
    """A server that has the scan, and answers as the standard says unless a test gives it other answers."""
    with running(Archive(scan)) as server:
        yield server


@pytest.fixture
def elsewhere() -> Iterator[Server]:
    """A server of another origin."""
    with running(Server()) as server:
        yield server


@pytest.fixture(autouse=True)
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The seconds that would have been waited; and no credentials of who runs the tests."""
    monkeypatch.setenv("NETRC", "")
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    seconds: list[float] = []
    monkeypatch.setattr("time.sleep", seconds.append)
    return seconds


@pytest.fixture(autouse=True)
def nothing_left(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Each test leaves no temporary file."""
    folder = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    yield
    assert list(folder.iterdir()) == []


def fetch(url: str, **limits: Any) -> int:
    """Fetch what a URL names; return the number of its files."""
    with opened(url, ignore_progress, Limits(**limits)) as inside:
        return len(list(Path(inside).iterdir()))


def test_series_of_an_archive_is_read_as_its_folder(archive: Archive, scan: Path) -> None:
    of_archive, of_folder = read_volume(archive.url), read_volume(scan)

    np.testing.assert_array_equal(of_archive.voxels, of_folder.voxels)
    np.testing.assert_array_equal(of_archive.affine, of_folder.affine)
    assert of_archive.report == of_folder.report


def test_study_of_an_archive_is_listed_as_its_folder(archive: Archive, scan: Path) -> None:
    assert list_series(archive.study).certificate == list_series(scan).certificate


def test_instances_that_are_listed_in_pages_are_all_counted(archive: Archive) -> None:
    archive.page = 3

    assert fetch(archive.url) == SLICES


def test_list_that_is_the_same_from_any_number_on_ends(archive: Archive) -> None:
    whole = json.dumps([list_entry(uid) for uid in archive.uids]).encode()
    archive.answers = [answering(whole, kind="application/dicom+json")] * 2

    assert fetch(archive.url) == SLICES


# What a second try mends.


def cut(handler: Any) -> None:
    """Send half of what was announced."""
    content = join_parts([bytes(100_000)])
    send(handler, content[:50_000], kind=STORED, Content_Length=str(len(content)))


def end_early(handler: Any) -> None:
    """Send a body without a length and without its last boundary."""
    send(handler, join_parts([b"DICM"])[:-9], kind=STORED, Content_Length="")


PASSING = {
    "503": answering(status=503),
    "429": answering(status=429),
    "cut": cut,
    "no last boundary": end_early,
    "nothing": lambda handler: None,
    "no HTTP": lambda handler: handler.wfile.write(b"hello\r\n\r\n"),
}


@pytest.mark.parametrize("fault", PASSING)
def test_series_is_read_after_a_fault_that_passes(fault: str, archive: Archive) -> None:
    archive.answers = [archive.answer, archive.answer, PASSING[fault]]  # both lists are whole

    assert fetch(archive.url) == SLICES


def test_server_that_stays_busy_is_unreachable_after_four_tries_with_longer_pauses(
    archive: Archive, pauses: list[float]
) -> None:
    archive.answers = [answering(status=503)] * 4

    status, tries = 503, 4
    with refused(UnreachableError, archive.host, status, tries) as caught:
        read_volume(archive.url)

    assert pauses == [0.5, 1.0, 2.0]
    assert caught.value.exit_code == 9  # type: ignore[attr-defined]


@pytest.mark.parametrize(("asked", "waited"), [("7", 7.0), ("3600", 60.0), ("soon", 0.5)])
def test_pause_that_the_server_asks_for_is_kept_up_to_a_minute(
    asked: str, waited: float, archive: Archive, pauses: list[float]
) -> None:
    archive.answers = [answering(status=503, Retry_After=asked)]

    fetch(archive.url)

    assert pauses == [waited]


def test_port_where_nobody_listens_is_unreachable(archive: Archive) -> None:
    archive.close()

    with refused(UnreachableError, archive.host):
        read_volume(archive.url)


def drip(handler: Any) -> None:
    """Send a byte at a time, for ever."""
    from threading import Event

    send(handler, b"", kind=STORED, Content_Length="")
    while True:
        handler.wfile.write(b"\r")
        Event().wait(0.02)


@pytest.mark.parametrize("answer", [drip, lambda handler: handler.rfile.read(1)], ids=["drips", "is silent"])
def test_server_that_never_comes_to_an_end_is_unreachable(answer: Any, archive: Archive, tmp_path: Path) -> None:
    archive.answers = [archive.answer, archive.answer, answer]
    patience = Patience(tries=1, silence_s=0.2)

    with refused(UnreachableError, archive.host):
        Instances(urlsplit(archive.url), patience).fetch(tmp_path, ignore_progress, Limits())


# What is refused.


@pytest.mark.parametrize("sent", [SLICES - 2, SLICES + 1])
def test_other_number_of_instances_than_listed_is_refused_with_it(sent: int, archive: Archive) -> None:
    archive.instances = (archive.instances * 2)[:sent]

    with refused(RefusedInputError, archive.host, SLICES):
        read_volume(archive.url)


def test_parts_without_an_end_are_refused_where_there_are_more_than_listed(archive: Archive) -> None:
    def send_on(handler: Any) -> None:
        send(handler, b"", kind=STORED, Content_Length="")
        while True:
            handler.wfile.write(join_parts([b"DICM"])[: -len(join_parts([]))])

    archive.answers = [archive.answer, archive.answer, send_on]

    with refused(RefusedInputError, archive.host, SLICES):
        fetch(archive.url, fetched_bytes=1 << 20)


def test_incomplete_series_is_refused_with_both_counts(archive: Archive) -> None:
    del archive.instances[2:]

    with refused(RefusedInputError, SLICES, 2):
        read_volume(archive.url)


def parts_with(border: str) -> Any:
    return answering(join_parts([b"DICM"]), kind=f'multipart/related; boundary="{border}"')


BAD_ANSWERS = {
    "page of a login": (answering(b"<html>log in</html>", kind="text/html"), ("text/html",)),
    "parts of another kind": (answering(join_parts([b"a"], kind="text/html"), kind=STORED), ("text/html", 1)),
    "no boundary": (answering(b"", kind="multipart/related"), ("multipart/related",)),
    "boundary of too many letters": (parts_with("a" * 71), ("multipart/related",)),
    "boundary that never comes": (answering(bytes(70_000), kind=STORED), (65_536,)),
    "headers that never end": (answering(join_parts([])[:-4] + bytes(70_000), kind=STORED), (65_536,)),
    "length of a part too large": (answering(join_parts([b"DICM"], length=5), kind=STORED), (4, 5)),
    "length of a part too small": (answering(join_parts([b"DICM"], length=3), kind=STORED), (4, 3)),
    "length of a part in more digits than Python reads": (
        answering(join_parts([b"DICM"], length="9" * 5000), kind=STORED),
        (4,),
    ),
    "empty part": (answering(join_parts([b""]), kind=STORED), (1, 0)),
    "packed": (answering(b"", kind=STORED, Content_Encoding="gzip"), ("gzip",)),
    "406": (answering(status=406), (406,)),
}


@pytest.mark.parametrize("fault", BAD_ANSWERS)
def test_answer_that_no_try_mends_is_refused_at_once(fault: str, archive: Archive, pauses: list[float]) -> None:
    answer, facts = BAD_ANSWERS[fault]
    archive.answers = [archive.answer, archive.answer, answer]

    with refused(RefusedInputError, archive.host, *facts):
        read_volume(archive.url)

    assert pauses == []


@pytest.mark.parametrize(
    "content",
    [b"<html>", b"{}", b"[{}]", b'[{"00080018": {"Value": ["../1"]}}]', b"[" * 100_000],
    ids=["page", "no list", "no UID", "path", "deep"],
)
def test_list_that_is_no_dicom_json_is_refused(content: bytes, archive: Archive) -> None:
    archive.answers = [answering(content, kind="application/json")]

    with refused(RefusedInputError, archive.host, "JSON"):
        read_volume(archive.url)


def test_more_bytes_than_allowed_are_refused_before_they_arrive(archive: Archive) -> None:
    announces_2000 = answering(b"", kind=STORED, Content_Length="2000")  # none of them arrives
    archive.answers = [archive.answer, archive.answer, announces_2000]

    with refused(RefusedInputError, archive.host, "TMPDIR"):
        fetch(archive.url, fetched_bytes=1999)


def test_endless_answer_is_refused_where_it_has_more_bytes_than_allowed(archive: Archive) -> None:
    def send_on(handler: Any) -> None:
        send(handler, join_parts([])[:-4] + b"\r\n\r\n", kind=STORED, Content_Length="")
        while True:
            handler.wfile.write(bytes(1 << 16))

    archive.answers = [archive.answer, archive.answer, send_on]

    with refused(RefusedInputError, archive.host, "TMPDIR"):
        fetch(archive.url, fetched_bytes=1 << 20)


def test_more_instances_than_allowed_are_refused(archive: Archive) -> None:
    with refused(RefusedInputError, SLICES - 1):
        fetch(archive.url, entries=SLICES - 1)


@pytest.mark.parametrize(
    "answer",
    [answering(b"[]"), answering(status=204), answering(status=404)],
    ids=["empty list", "no content", "not found"],
)
def test_series_that_the_archive_does_not_have_is_no_dicom(answer: Any, archive: Archive) -> None:
    archive.answers = [answer]

    with refused(NoDicomError, archive.host):
        read_volume(archive.url)


def test_parts_are_the_same_in_whatever_pieces_they_arrive() -> None:
    contents = [b"\r\n--border", b"\r\n-", b"a" * 50]
    body = b"preamble" + b"\r\n" + join_parts(contents) + b"epilogue"

    for size in (1, 2, 7, len(body)):
        pieces = iter([body[start : start + size] for start in range(0, len(body), size)])
        parts = Multipart(pieces, b"border of parts", "host")
        read = []
        while parts.next_head() is not None:
            read.append(b"".join(parts.next_content()))
        assert read == contents


# Credentials.


@pytest.fixture
def netrc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file in use, with a password for 127.0.0.1 and another for all hosts."""
    path = tmp_path / "netrc"
    path.write_text("machine 127.0.0.1 login me password sesame\ndefault login all password open\n")
    path.chmod(0o600)
    monkeypatch.setenv("NETRC", str(path))
    return path


BASIC = "Basic bWU6c2VzYW1l"
"""The user me with the password sesame."""


def test_password_of_the_netrc_file_is_sent_to_its_host(archive: Archive, netrc: Path) -> None:
    fetch(archive.url)

    assert set(archive.tokens()) == {BASIC}


def test_entry_of_the_netrc_file_for_all_hosts_is_not_sent(archive: Archive, netrc: Path) -> None:
    fetch(archive.url.replace("127.0.0.1", "localhost"))

    assert set(archive.tokens()) == {None}


@pytest.mark.parametrize("host", ["127.0.0.1", "{host}"], ids=["host", "host and port"])
def test_token_of_the_environment_is_sent_to_its_host(
    host: str, archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, f"{host.format(host=archive.host)} abc.def")

    fetch(archive.url)

    assert set(archive.tokens()) == {"Bearer abc.def"}


def test_token_of_the_environment_is_not_sent_to_another_host(
    archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, "pacs.example abc.def")

    fetch(archive.url)

    assert set(archive.tokens()) == {None}


@pytest.mark.parametrize("value", ["sesame", "pacs.example sesame\nX: y", "a b sesame"])
def test_token_without_a_host_or_of_several_words_is_refused_and_not_quoted(
    value: str, archive: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, value)

    with refused(UsageError, TOKEN_VARIABLE) as caught:
        read_volume(archive.url)

    assert "sesame" not in str(caught.value)


@pytest.mark.parametrize("text", ["machine 127.0.0.1 sesame", "\xff"], ids=["words", "no UTF-8"])
def test_damaged_netrc_file_is_refused_and_not_quoted(text: str, archive: Archive, netrc: Path) -> None:
    netrc.write_text(text, encoding="latin-1")

    with refused(UsageError, "netrc") as caught:
        read_volume(archive.url)

    assert "sesame" not in str(caught.value)


@pytest.mark.parametrize("status", [401, 403])
def test_missing_or_wrong_credentials_are_wrong_usage_that_says_where_they_stand(status: int, archive: Archive) -> None:
    archive.answers = [answering(status=status)]

    with refused(UsageError, archive.host, status, TOKEN_VARIABLE, "netrc"):
        read_volume(archive.url)


def test_redirection_on_the_same_host_is_followed_with_credentials(archive: Archive, netrc: Path) -> None:
    archive.answers = [answering(status=302, Location=f"/dicom-web/studies/{STUDY}/series/{SERIES}/instances")]

    fetch(archive.url)

    assert archive.tokens()[:2] == [BASIC, BASIC]


def test_redirection_to_another_host_is_followed_without_credentials(
    archive: Archive, elsewhere: Server, netrc: Path
) -> None:
    stored = answering(join_parts(archive.instances), kind=STORED)
    elsewhere.answers = [stored]
    archive.answers = [
        archive.answer,
        archive.answer,
        answering(status=307, Location=f"http://{elsewhere.host}/somewhere"),
    ]

    assert fetch(archive.url) == SLICES
    assert elsewhere.tokens() == [None]


def test_redirection_back_from_another_host_stays_without_credentials(
    archive: Archive, elsewhere: Server, netrc: Path
) -> None:
    elsewhere.answers = [answering(status=302, Location=f"http://{archive.host}/back")]
    archive.answers = [answering(status=302, Location=f"http://{elsewhere.host}/there"), answering(b"[]")]

    with pytest.raises(NoDicomError):
        read_volume(archive.url)

    assert archive.tokens() == [BASIC, None]


@pytest.mark.parametrize(
    ("location", "kind", "facts"),
    [
        ("file:///etc/passwd", RefusedInputError, ("127.0.0.1", "redirects")),
        ("ftp://127.0.0.1/a", RefusedInputError, ("127.0.0.1", "redirects")),
        ("http://pacs.example/a", UsageError, ("pacs.example",)),
        ("http://[", RefusedInputError, ("127.0.0.1", "redirects")),
        ("", RefusedInputError, ("127.0.0.1", "redirects")),
    ],
)
def test_redirection_to_another_scheme_a_host_in_the_clear_or_no_address_is_refused(
    location: str, kind: type[ClreconError], facts: tuple[str, ...], archive: Archive
) -> None:
    archive.answers = [answering(status=302, Location=location)]

    with refused(kind, *facts):
        read_volume(archive.url)


def test_redirections_without_an_end_are_refused(archive: Archive) -> None:
    archive.answers = [answering(status=302, Location="/again")] * 10

    most = 5
    with refused(RefusedInputError, archive.host, most):
        read_volume(archive.url)


def test_reports_and_output_show_no_credentials_and_no_uid(
    archive: Archive, netrc: Path, tmp_path: Path, printed: Any
) -> None:
    assert main(["export", archive.url, "-o", str(tmp_path / "ct.nii"), "--report", str(tmp_path / "r.json")]) == 0

    texts = (tmp_path / "r.json").read_text() + printed().everything
    assert not [secret for secret in ("sesame", BASIC, SERIES, archive.host) if secret in texts]
