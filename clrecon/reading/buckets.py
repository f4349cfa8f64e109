"""Buckets of S3, Google Cloud and Azure as inputs, by obstore; the other URLs, by fsspec."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, unquote

from clrecon.errors import ClreconError, NoDicomError, RefusedInputError, UnreachableError, UsageError
from clrecon.reading.archives import Limits, safe_parts
from clrecon.reading.urls import BUCKETS, Entry, Room, shown_url
from clrecon.system.packages import import_package
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text

_AT_ONCE = 16
"""Objects that are fetched side by side: a slice takes longer to be found than to be sent."""

_PIECE = 1 << 20

_RETRIES = {"max_retries": 4, "retry_timeout": timedelta(minutes=1)}
_TIMES = {
    "connect_timeout": timedelta(seconds=10),
    "read_timeout": timedelta(minutes=1),  # without a byte
    "timeout": timedelta(hours=12),  # for a whole object
}
"""Of the request for one object; obstore itself doubles the pauses."""


class Bucket:
    """The objects below a folder of a bucket, or one object."""

    def __init__(self, parts: SplitResult):
        self._name = shown_url(parts.geturl())
        self._obstore = import_package("obstore", f"a URL {parts.scheme}://")
        import_package("obstore.store", "a bucket")
        folder, slash, key = parts.path.rpartition("/")
        self._key = unquote(key)
        self._is_ending = False
        options = {**_TIMES, "allow_http": os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")}
        url = parts._replace(path=folder + slash, query="", fragment="").geturl()
        try:
            self._store = self._obstore.store.from_url(url, client_options=options, retry_config=_RETRIES)
        except Exception:  # its text may quote what is a secret
            raise UsageError(
                f"{self._name} cannot be opened: its URL, or a variable of the environment for it, is wrong or missing"
                " (docs/sources.md)"
            ) from None

    def list_entries(self, limits: Limits = Limits()) -> list[Entry]:  # noqa: B008 (a tuple)
        with foreign_errors(self._name):
            return sorted(
                Entry(item["path"], item["size"], f"{item['e_tag']}\0{item['last_modified']}")
                for item in self._find_objects(limits)
            )

    def _find_objects(self, limits: Limits) -> list[Any]:
        if self._key:
            try:
                return [self._obstore.head(self._store, self._key)]
            except FileNotFoundError:
                pass  # it may be a folder
        objects: list[Any] = []
        for chunk in self._obstore.list(self._store, self._key or None):
            objects += [item for item in chunk if item["size"]]  # empty ones stand for folders
            if len(objects) > limits.entries:
                raise RefusedInputError(f"{self._name} holds more than {limits.entries:,} objects")
        return objects

    def fetch(self, folder: Path, progress: Progress, limits: Limits) -> None:
        progress("fetch", 0, 0)
        entries = self.list_entries(limits)
        targets = _make_targets(entries, self._name, folder, limits)
        pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="fetch")
        try:
            with foreign_errors(self._name):
                waiting = [pool.submit(self._fetch_one, *pair) for pair in zip(entries, targets, strict=True)]
                for number, done in enumerate(as_completed(waiting), start=1):
                    done.result()
                    progress("fetch", number, len(entries))
        finally:
            self._is_ending = True
            pool.shutdown(cancel_futures=True)

    def _fetch_one(self, entry: Entry, target: Path) -> None:
        pieces = iter(self._obstore.get(self._store, entry.name).stream(min_chunk_size=_PIECE))
        wanted = iter(lambda: b"" if self._is_ending else next(pieces, b""), b"")
        _write_pieces(wanted, entry, target, self._name)


class FileSystem:
    """What a URL of any other kind names, by fsspec and the package that it needs for it."""

    def __init__(self, url: str):
        self._name = shown_url(url)
        fsspec = import_package("fsspec", f"a URL {url.partition('://')[0]:.20}://")
        try:
            self._system, self._path = fsspec.core.url_to_fs(url)
        except (ValueError, ImportError) as error:
            raise UsageError(f"{self._name} cannot be opened: {escape_text(str(error), 120)}") from None
        except OSError as error:  # of a server that is asked at once, such as that of ftp
            raise _translate(self._name, type(error).__name__, str(error)) from None

    def list_entries(self, limits: Limits = Limits()) -> list[Entry]:  # noqa: B008 (a tuple)
        with foreign_errors(self._name):
            files = self._system.find(self._path, detail=True)
        if len(files) > limits.entries:
            raise RefusedInputError(f"{self._name} holds more than {limits.entries:,} files")
        times = ("ETag", "etag", "mtime", "created", "LastModified", "last_modified")
        return [
            Entry(name, facts.get("size"), "\0".join(str(facts.get(time, "")) for time in times))
            for name, facts in sorted(files.items())
        ]

    def fetch(self, folder: Path, progress: Progress, limits: Limits) -> None:
        progress("fetch", 0, 0)
        entries = self.list_entries(limits)
        top = self._path.rstrip("/")
        names = [entry.name.removeprefix(top).strip("/") or entry.name.rpartition("/")[2] for entry in entries]
        named = [entry._replace(name=name) for entry, name in zip(entries, names, strict=True)]
        room = Room.on_disk(self._name, folder, limits)
        for number, (entry, target) in enumerate(
            zip(entries, _make_targets(named, self._name, folder, limits), strict=True)
        ):
            progress("fetch", number, len(entries))
            with foreign_errors(self._name), self._system.open(entry.name, "rb") as stream:
                _write_pieces(iter(lambda: stream.read(_PIECE), b""), entry, target, self._name, room)


def _make_targets(entries: Sequence[Entry], name: str, folder: Path, limits: Limits) -> list[Path]:
    """Return the paths for files that are to be fetched, and refuse what has no room or no place in the folder."""
    if not entries:
        raise NoDicomError(f"there is nothing at {name}")
    Room.on_disk(name, folder, limits).check(sum(entry.size or 0 for entry in entries))
    targets = [folder.joinpath(*safe_parts(entry.name, name)) for entry in entries]
    for target in targets:
        target.parent.mkdir(parents=True, exist_ok=True)
    return targets


def _write_pieces(pieces: Iterable[Any], entry: Entry, target: Path, name: str, room: Room | None = None) -> None:
    """Write a file that has the size that was listed."""
    size = 0
    with target.open("xb") as stream:
        for piece in pieces:
            size += stream.write(piece)
            if entry.size is not None and size > entry.size:
                break
            if room is not None:
                room.take(len(piece))
    if entry.size not in (None, size):
        raise RefusedInputError(
            f"{name} lists {escape_text(entry.name, 80)} with {entry.size:,} bytes and sends {size:,}: it was changed,"
            " or its server is wrong"
        )


@contextmanager
def foreign_errors(name: str) -> Iterator[None]:
    """Turn errors of the packages into those of clrecon; their own texts may quote keys and signatures."""
    try:
        yield
    except ClreconError:
        raise
    except FileNotFoundError:
        raise NoDicomError(f"there is nothing at {name}") from None
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":  # obstore's, of a fault in it
            raise
        raise _translate(name, type(error).__name__, str(error)) from None


_STATUS = re.compile(r"status code: (\d{3})")
_DENIED = ("PermissionDeniedError", "UnauthenticatedError", "PermissionError", "NoCredentialsError")
_METADATA = ("169.254.169.254", "metadata.google")
"""Addresses at which a machine of the cloud would find its credentials; elsewhere nobody answers there."""


def _find_advice(name: str) -> str:
    scheme = name.partition(":")[0].lower()
    if scheme in ("s3", "s3a"):
        return "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket,"
    if scheme == "gs":
        return "GOOGLE_APPLICATION_CREDENTIALS, or GOOGLE_SKIP_SIGNATURE=true for a public bucket,"
    if scheme in BUCKETS:
        return "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY, or AZURE_SKIP_SIGNATURE=true,"
    return "those of its server"


def _translate(name: str, kind: str, text: str) -> ClreconError:
    if kind == "IsADirectoryError":
        return NoDicomError(f"{name} is a folder without a file that can be read")
    match = _STATUS.search(text)
    status = int(match[1]) if match else 0
    if status == 404:
        return NoDicomError(f"there is nothing at {name}")
    if kind in _DENIED or status in (401, 403) or any(address in text for address in _METADATA):
        return UsageError(
            f"{name} wants other credentials: set {_find_advice(name)} in the environment (docs/sources.md)"
        )
    if kind == "InvalidPathError":
        return RefusedInputError(f"{name} holds a path that leads out of it, or is none")
    if "redirect" in text and name.startswith("s3"):
        return UsageError(f"{name} lies in another region: set AWS_REGION to it")
    reason = f"it answers {status}" if status else f"{kind}, {'no answer' if 'request' in text else 'no sound answer'}"
    return UnreachableError(f"{name} cannot be reached, or fails: {reason}; try again later")
