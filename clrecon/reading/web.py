"""HTTP for inputs: credentials that reach their own host alone, tries with pauses, and answers within bounds."""

from __future__ import annotations

import http.client
import os
import re
import ssl
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from http import HTTPStatus
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.error import URLError
from urllib.parse import SplitResult, urljoin, urlsplit
from urllib.request import HTTPHandler, HTTPSHandler, OpenerDirector, ProxyHandler, Request

from clrecon.errors import NoDicomError, RefusedInputError, UnreachableError, UsageError
from clrecon.reading.archives import Limits
from clrecon.reading.urls import Entry, Room, check_encrypted, is_loopback, shown_url, web_url
from clrecon.system.progress import Progress
from clrecon.system.text import count_of, escape_text

TOKEN_VARIABLE = "CLRECON_WEB_TOKEN"
"""Of the environment: a host and the token for it.  A manifest may name other hosts, which must not get it."""

_TOKEN = re.compile(r"\s*(\S+)\s+([A-Za-z0-9._~+/=-]+)\s*")
_MOST_REDIRECTS = 5
_REDIRECTS = (301, 302, 303, 307, 308)
_PARTLY = (202, 409)
"""What was sent is stored with a warning, or not; the content of the answer says why."""
_BUSY = (408, 425, 429)
_PIECE = 1 << 20
_LEAST_BYTES = 1 << 16
"""Bytes of an answer that arrive in the time of `Patience.silence_s`, unless the server has hung."""

Done = TypeVar("Done")


class Patience(NamedTuple):
    """How often a server is asked, with pauses that double, and how long it may be silent."""

    tries: int = 4
    pause_s: float = 0.5
    longest_pause_s: float = 60.0
    silence_s: float = 60.0


class Lost(Exception):
    """No answer, or one that ended early: the next try may do better, after the pause that the server asks for."""

    def __init__(self, reason: str, pause_s: float = 0.0, *, is_final: bool = False):
        super().__init__(reason)
        self.pause_s, self.is_final = pause_s, is_final


def persist(work: Callable[[], Done], name: str, patience: Patience) -> Done:
    """Return the result of work that the network may interrupt, tried again after pauses."""
    for number in range(1, patience.tries + 1):
        try:
            return work()
        except Lost as lost:
            if number == patience.tries or lost.is_final:
                tries = f" ({count_of(number, 'try', 'tries')})"
                raise UnreachableError(f"{name} cannot be reached, or fails: {lost}{tries}; try again later") from lost
            pause = max(patience.pause_s * 2 ** (number - 1), lost.pause_s)
        time.sleep(min(pause, patience.longest_pause_s))
    raise AssertionError("a patience has at least one try")


class Answer:
    """The answer of a server, read in pieces as they arrive."""

    def __init__(self, response: Any, url: str, patience: Patience):
        self._response, self._patience = response, patience
        self.status: int = response.status
        self.headers: http.client.HTTPMessage = response.headers
        self.length: int | None = response.length
        encoding = self.headers.get("Content-Encoding", "identity")
        if encoding.lower() != "identity":
            raise RefusedInputError(
                f"{shown_url(url)} sends {escape_text(encoding, 20)}, a coding that nobody asked for"
            )

    def pieces(self, room: Room) -> Iterator[bytes]:
        """Yield the content; what is cut or stands still is `Lost`, what has no room is refused as it arrives."""
        room.check(self.length or 0)
        waited, count = 0.0, 0
        while True:
            start = time.monotonic()
            try:
                piece: bytes = self._response.read1(_PIECE)
            except (OSError, http.client.HTTPException, ValueError) as error:
                raise Lost(_describe_error(error)) from error
            if not piece:
                if self._response.length:
                    raise Lost(f"the answer ended {count_of(self._response.length, 'byte')} early")
                return
            waited, count = waited + time.monotonic() - start, count + len(piece)
            if waited > self._patience.silence_s:
                if count < _LEAST_BYTES:
                    raise Lost(f"{count_of(count, 'byte')} in {waited:.0f} s")
                waited, count = 0.0, 0
            room.take(len(piece))
            yield piece


class Content(NamedTuple):
    kind: str
    data: bytes


@contextmanager
def ask_server(url: str, accept: str, patience: Patience, content: Content | None = None) -> Iterator[Answer]:
    """Ask for a URL and give the answer; redirections to other hosts get no credentials, none gets the `content`."""
    origin, target = _origin(urlsplit(url)), url
    for _ in range(_MOST_REDIRECTS + 1):
        parts = urlsplit(target)
        headers = {"Accept": accept, "User-Agent": "clrecon"}
        if content is not None:
            headers["Content-Type"] = content.kind
        request = Request(target, None if content is None else content.data, headers)
        credentials = _find_credentials(parts) if _origin(parts) == origin else None
        if credentials:
            request.add_unredirected_header("Authorization", credentials)
        try:
            response = _make_opener(parts.scheme, parts.hostname or "").open(request, timeout=patience.silence_s)
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise _lost(error) from error
        with response:
            if response.status not in _REDIRECTS or content is not None:
                if content is None or response.status not in _PARTLY:
                    _refuse_status(response, parts, has_credentials=credentials is not None)
                yield Answer(response, url, patience)
                return
            target = _follow(target, response.headers.get("Location", ""))
            if _origin(urlsplit(target)) != origin:
                origin = ("", "", None)  # and stays without credentials
    raise RefusedInputError(f"{shown_url(url)} redirects more than {_MOST_REDIRECTS} times")


def _origin(parts: SplitResult) -> tuple[str, str, int | None]:
    return parts.scheme, parts.hostname or "", parts.port


def _follow(url: str, location: str) -> str:
    """Return where an answer leads; never out of the web, and never from HTTPS to HTTP."""
    before = urlsplit(url)
    try:
        parts = urlsplit(urljoin(url, location))
        is_sound = parts.port != 0 and bool(parts.hostname) and bool(location)
    except ValueError:
        is_sound = False
    if not is_sound or not (parts.scheme == "https" or parts.scheme == before.scheme == "http"):
        raise RefusedInputError(f"{before.netloc} redirects to what is no URL of HTTPS")
    check_encrypted(parts)
    return web_url(parts)


def _make_opener(scheme: str, host: str) -> OpenerDirector:
    """Return what opens URLs of the web alone, with the proxies of the environment, and takes any status."""
    opener = OpenerDirector()
    if not is_loopback(host):
        opener.add_handler(ProxyHandler())
    opener.add_handler(HTTPHandler())
    if scheme == "https":
        opener.add_handler(HTTPSHandler(context=_trusted()))
    return opener


@cache
def _trusted() -> ssl.SSLContext:
    """Return the certificates that are trusted; to load them takes as long as a request."""
    return ssl.create_default_context()


def _find_credentials(parts: SplitResult) -> str | None:
    """Return the header of a host: the token of the environment if it is for this host, or user and password."""
    given, host = os.environ.get(TOKEN_VARIABLE), parts.hostname or ""
    if given:
        match = _TOKEN.fullmatch(given)
        if match is None:
            raise UsageError(f"{TOKEN_VARIABLE} is not HOST TOKEN, a host, a blank and the token for this host alone")
        if match[1].lower() in (host, parts.netloc.lower()):
            return f"Bearer {match[2]}"
    return _find_password(host)


def _find_password(host: str) -> str | None:
    """Return the header of a host in the netrc file; its entry for all other hosts counts for none."""
    import netrc

    path = os.environ.get("NETRC")
    try:
        known = netrc.netrc(path).hosts.get(host)
    except netrc.NetrcParseError as error:  # its own message may quote a password
        raise UsageError(f"line {error.lineno} of the netrc file is wrong, or others can read the file") from None
    except OSError as error:
        if path:
            raise UsageError(f"the netrc file that NETRC names cannot be read: {error.strerror}") from None
        return None
    except UnicodeDecodeError:
        raise UsageError("the netrc file is no text in UTF-8") from None
    if known is None or host == "default":
        return None
    return f"Basic {b64encode(f'{known[0]}:{known[2]}'.encode()).decode('ascii')}"


def _refuse_status(response: Any, parts: SplitResult, *, has_credentials: bool) -> None:
    status, host = response.status, parts.netloc
    if status in (200, 204):
        return
    known = [each.phrase for each in HTTPStatus if each == status]
    answered = f"{host} answers {status}{''.join(f' ({phrase})' for phrase in known)}"
    if status in (401, 403, 407):
        wrong = "does not accept the credentials for it" if has_credentials else "wants credentials"
        raise UsageError(
            f"{answered}: it {wrong}; they stand in {TOKEN_VARIABLE}, as HOST TOKEN, or in the netrc file"
            " (docs/sources.md)"
        )
    if status in (404, 410):
        raise NoDicomError(f"{answered}: there is nothing at this URL")
    if status in _BUSY or status >= 500:
        after = response.headers.get("Retry-After", "")
        raise Lost(f"it answers {status}", float(after) if after.isdecimal() else 0.0)
    raise RefusedInputError(f"{answered}, where the scan should be")


def _lost(error: Exception) -> Lost:
    cause = error.reason if isinstance(error, URLError) else error
    return Lost(_describe_error(cause), is_final=isinstance(cause, ssl.SSLCertVerificationError))


def _describe_error(error: object) -> str:
    """Describe an error of the network, without what the server sent."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted, {error.verify_message} (SSL_CERT_FILE names others)"
    if isinstance(error, TimeoutError):
        return "no answer in time"
    if isinstance(error, http.client.IncompleteRead | http.client.RemoteDisconnected):
        return "the connection was closed before the answer was whole"
    if isinstance(error, OSError):
        return escape_text(error.strerror or type(error).__name__, 100)
    return "no answer in HTTP" if isinstance(error, http.client.HTTPException) else "an answer that is no HTTP"


class WebFile:
    def __init__(self, parts: SplitResult, patience: Patience = Patience()):  # noqa: B008 (a tuple)
        self._url, self._patience = web_url(parts), patience
        self._name = shown_url(self._url)

    def list_entries(self) -> list[Entry]:
        return persist(self._ask_entries, self._name, self._patience)

    def _ask_entries(self) -> list[Entry]:
        with ask_server(self._url, "*/*", self._patience) as answer:
            versions = [answer.headers.get(name, "") for name in ("ETag", "Last-Modified")]
            return [Entry("", answer.length, "\0".join(versions))]

    def fetch(self, folder: Path, progress: Progress, limits: Limits) -> None:
        name = re.sub(r"[^A-Za-z0-9._-]", "_", urlsplit(self._url).path.rpartition("/")[2])[-100:]
        file = folder / (name.lstrip(".") or "scan")

        def fetch_whole() -> None:
            progress("fetch", 0, 0)
            with ask_server(self._url, "*/*", self._patience) as answer, file.open("wb") as stream:
                for piece in answer.pieces(Room.on_disk(self._name, folder, limits)):
                    stream.write(piece)
                    progress("fetch", 0, 0)

        persist(fetch_whole, self._name, self._patience)
        if not file.stat().st_size:
            raise RefusedInputError(f"{self._name} sends an empty file: there is no scan in it")
