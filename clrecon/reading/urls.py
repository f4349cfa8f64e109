"""URLs as inputs: which there are, how messages name them, and how much may arrive from one.

No message shows what may be a secret (a password, a query) or the UIDs of patients.
"""

from __future__ import annotations

import re
from pathlib import Path
from shutil import disk_usage
from typing import NamedTuple
from urllib.parse import SplitResult, quote, urlsplit

from clrecon.errors import RefusedInputError, UsageError
from clrecon.reading.archives import Limits
from clrecon.system.text import escape_text, format_bytes

DICOMWEB = ("dicomweb+https", "dicomweb+http")
WEB = ("https", "http")
BUCKETS = ("s3", "s3a", "gs", "az", "azure", "adl", "abfs", "abfss")

_URL = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)
_SERIES = re.compile(r".*/studies/[0-9.]{1,64}(/series/[0-9.]{1,64})?")
_LOOPBACK = re.compile(r"localhost|127(\.\d{1,3}){3}|::1")
_SHOWN = 200
_SHARE_OF_DISK = 0.9


class Entry(NamedTuple):
    """A file of a URL: its name below it, its size where that is known, and what changes with its content."""

    name: str
    size: int | None
    version: str


def is_url(source: object) -> bool:
    """Tell whether a source is a URL, such as ``s3://bucket/folder``; ``C://folder`` is none."""
    return isinstance(source, str) and _URL.match(source) is not None


def refuse_url(source: object, noun: str) -> None:
    """Raise `UsageError` for a URL of what only files are: a `noun`."""
    if is_url(source):
        raise UsageError(f"a {noun} is read from a file, not from a URL: download it first")


def check_url(url: str) -> SplitResult:
    """Return the parts of a URL; a `UsageError` says why it can be no input."""
    try:
        parts = urlsplit(url)
        host, password = parts.hostname, parts.password
        _ = parts.port
    except ValueError:
        raise UsageError(f"a URL of the kind {url.partition('://')[0]:.20}:// with a wrong host or port") from None
    scheme = parts.scheme
    if password is not None or ("@" in parts.netloc and scheme in (*DICOMWEB, *WEB)):
        raise UsageError(
            f"the URL of {host or scheme} holds a user or a password, which others can see: take them out, and put them"
            " into the netrc file or the environment (docs/sources.md)"
        )
    if not url.isprintable() or " " in url:
        raise UsageError(f"the URL {shown_url(url)} holds blanks or control characters: write them as %20 and so on")
    if scheme == "file":
        raise UsageError("a file of this computer is given by its path, without file://")
    if not host and scheme in (*DICOMWEB, *WEB, *BUCKETS):
        raise UsageError(f"the URL {shown_url(url)} names no host or bucket")
    if scheme == "dicomweb" or (scheme in WEB and _SERIES.match(parts.path)):
        raise UsageError("a series of a DICOMweb archive is dicomweb+https://HOST/PATH/studies/UID/series/UID")
    if scheme in DICOMWEB:
        if not _SERIES.fullmatch(parts.path.rstrip("/")) or parts.query or parts.fragment:
            raise UsageError(
                f"the URL of {shown_url(url)} ends with something else than /studies/UID or /studies/UID/series/UID"
            )
        parts = parts._replace(path=parts.path.rstrip("/"))
    check_encrypted(parts)
    return parts


def check_encrypted(parts: SplitResult) -> None:
    """Refuse HTTP without encryption, except on this computer: others could read the scan and the credentials."""
    if parts.scheme.endswith("http") and not is_loopback(parts.hostname or ""):
        raise UsageError(
            f"http:// sends the scan of {shown_url(parts.geturl())} where others can read it: write https, or go"
            " through a tunnel (ssh -L 8042:HOST:8042) to localhost"
        )


def is_loopback(host: str) -> bool:
    return _LOOPBACK.fullmatch(host) is not None


def shown_url(url: str) -> str:
    """Return a URL for messages: of a DICOMweb archive its host alone, of others no query and no user."""
    scheme, _, rest = url.partition("://")
    host, slash, path = re.split(r"[?#]", rest, maxsplit=1)[0].partition("/")
    host = host.rpartition("@")[2]
    return escape_text(host if scheme.lower() in DICOMWEB else f"{scheme}://{host}{slash}{path}", _SHOWN)


def web_url(parts: SplitResult) -> str:
    path, query = (quote(text, safe="%/:;,=&?~+!$'()*@[]-._") for text in (parts.path or "/", parts.query))
    return parts._replace(scheme=parts.scheme.removeprefix("dicomweb+"), path=path, query=query, fragment="").geturl()


class Room:
    """How many bytes may still arrive; `advice` is for who sends more."""

    def __init__(self, name: str, allowed: int, advice: str):
        self._name, self._advice = name, advice
        self._allowed = allowed
        self._taken = 0

    @classmethod
    def on_disk(cls, name: str, folder: Path, limits: Limits) -> Room:
        """Return the room of a folder: most of its disk, up to the limit."""
        free = disk_usage(folder).free
        folder_has = f"the folder for temporary files has {format_bytes(free)}"
        advice = f"{folder_has}: name another with TMPDIR, or download it yourself"
        return cls(name, min(limits.fetched_bytes, int(_SHARE_OF_DISK * free)), advice)

    def check(self, wanted: int) -> None:
        """Refuse so many bytes more than have arrived."""
        if self._taken + wanted > self._allowed:
            raise RefusedInputError(f"{self._name} sends more than {format_bytes(self._allowed)}: {self._advice}")

    def take(self, count: int) -> None:
        self.check(count)
        self._taken += count
