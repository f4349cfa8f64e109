"""DICOMweb as an input: a study or a series by WADO-RS, whose instances are counted by QIDO-RS.

Source: DICOM PS3.18, 8.7.1 and 10.4 (retrieve), 8.3.4 and 10.6 (search); RFC 2046, 5.1.1 (parts and boundaries).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from email.message import Message
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, urlsplit

from clrecon.errors import NoDicomError, OutputError, RefusedInputError, UsageError
from clrecon.reading.archives import Limits
from clrecon.reading.urls import DICOMWEB, Entry, Room, check_url, shown_url, web_url
from clrecon.reading.web import Answer, Content, Lost, Patience, ask_server, persist
from clrecon.system.progress import Progress
from clrecon.system.text import count_of, escape_text

_STORED = 'multipart/related; type="application/dicom"; transfer-syntax=*'
"""As they are stored: without the last parameter archives unpack all pixels."""

_LISTED = "application/dicom+json"
_INSTANCE_UID = "00080018"
_FAILED_ITEMS, _STORED_ITEMS = "00081198", "00081199"
_SHOWN = 3
_UID = re.compile(r"[0-9.]{1,64}")
_LARGEST_LIST = 1 << 26
_LARGEST_HEAD = 1 << 16
"""Bytes of the headers of a part, and of what stands before the first."""

_BOUNDARY = re.compile(r"[0-9A-Za-z'()+_,./:=? -]{0,69}[0-9A-Za-z'()+_,./:=?-]")


class Instances:
    def __init__(self, parts: SplitResult, patience: Patience = Patience()):  # noqa: B008 (a tuple)
        self._url, self._patience = web_url(parts), patience
        self._name = shown_url(parts.geturl())

    def list_entries(self, limits: Limits = Limits()) -> list[Entry]:  # noqa: B008 (a tuple)
        """List the UIDs of the instances, which change with their content."""
        uids: dict[str, None] = {}
        while True:
            page = persist(partial(self._ask_page, len(uids)), self._name, self._patience)
            new = dict.fromkeys(page).keys() - uids.keys()
            if not new:
                return [Entry(uid, None, "") for uid in sorted(uids)]
            uids.update(dict.fromkeys(new))
            if len(uids) > limits.entries:
                raise RefusedInputError(f"{self._name} lists more than {limits.entries:,} instances")

    def _ask_page(self, offset: int) -> list[str]:
        """Return the UIDs that the archive lists from a number on; many give a hundred or a thousand at once."""
        query = f"/instances?offset={offset}" if offset else "/instances"
        content = bytearray()
        with ask_server(self._url + query, _LISTED, self._patience) as answer:
            for piece in answer.pieces(Room(self._name, _LARGEST_LIST, "that is no list of instances")):
                content += piece
            if answer.status == 204 or not content:
                return []
        try:
            entries = json.loads(content)
            uids = [str(entry[_INSTANCE_UID]["Value"][0]) for entry in entries]
        except (ValueError, LookupError, TypeError, RecursionError):
            entries, uids = None, []
        if not isinstance(entries, list) or not all(map(_UID.fullmatch, uids)):
            raise RefusedInputError(
                f"{self._name} does not list the instances as DICOM JSON, but as {_kind_of(answer.headers)}: is it a"
                " DICOMweb archive, and the URL whole?"
            )
        return uids

    def fetch(self, folder: Path, progress: Progress, limits: Limits) -> None:
        progress("fetch", 0, 0)
        expected = len(self.list_entries(limits))
        if not expected:
            raise NoDicomError(f"{self._name} has no instance of this study or series")

        def fetch_all() -> int:
            for path in folder.iterdir():  # of a try that was cut off
                path.unlink()
            with ask_server(self._url, _STORED, self._patience) as answer:
                return _save_parts(answer, self._name, folder, expected, progress, limits)

        count = persist(fetch_all, self._name, self._patience)
        if count != expected:
            raise RefusedInputError(
                f"{self._name} lists {count_of(expected, 'instance')} and sends {count:,}: the series is incomplete,"
                " or still being stored"
            )


class Store:
    """An archive that is to store instances, by STOW-RS; its URL may be that of a study or series in it."""

    def __init__(self, url: str, patience: Patience = Patience()):  # noqa: B008 (a tuple)
        parts = urlsplit(url)
        root = parts.path.partition("/studies")[0].rstrip("/")
        check_url(parts._replace(path=f"{root}/studies/0").geturl())
        if parts.scheme not in DICOMWEB:
            raise UsageError("an archive that stores meshes is dicomweb+https://HOST/PATH")
        self._url = web_url(parts._replace(path=f"{root}/studies", query="", fragment=""))
        self._name, self._patience = shown_url(url), patience

    def check(self) -> None:
        """Ask for nothing, to find out before any work whether the archive answers and accepts the credentials."""
        try:
            persist(self._check, self._name, self._patience)
        except NoDicomError:
            raise UsageError(f"{self._name} has no DICOMweb archive at this path: it has no list of studies") from None

    def _check(self) -> None:
        with ask_server(f"{self._url}?limit=1", _LISTED, self._patience):
            pass

    def store(self, uid: str, instance: bytes) -> None:
        """Store an instance; an `OutputError` where the archive does not say that it has it."""
        border = f"clrecon-{uid}"  # with the hash of the instance
        head = f"--{border}\r\nContent-Type: application/dicom\r\n\r\n".encode()
        data = b"".join((head, instance, f"\r\n--{border}--\r\n".encode()))
        content = Content(f'multipart/related; type="application/dicom"; boundary="{border}"', data)
        reply = persist(partial(self._send, content), self._name, self._patience)
        if uid not in _find_values(reply, _STORED_ITEMS, "00081155"):
            codes = [f"0x{code:04X}" for code in _find_values(reply, _FAILED_ITEMS, "00081197") if type(code) is int]
            reasons = f" (failure reason {', '.join(codes[:_SHOWN])})" if codes else ""
            raise OutputError(f"{self._name} did not store the result{reasons}; no file was written")

    def _send(self, content: Content) -> Any:
        with ask_server(self._url, _LISTED, self._patience, content) as answer:
            room = Room(self._name, _LARGEST_HEAD << 4, "that is no answer to a mesh")
            try:
                return json.loads(b"".join(answer.pieces(room)))
            except (ValueError, RecursionError):
                return {}


def _find_values(reply: Any, sequence: str, tag: str) -> list[Any]:
    """Return the first value of an element in each item of a sequence in DICOM JSON; none where the form is another."""
    try:
        return [item[tag]["Value"][0] for item in reply[sequence]["Value"]]
    except (LookupError, TypeError):
        return []


def _save_parts(answer: Answer, name: str, folder: Path, expected: int, progress: Progress, limits: Limits) -> int:
    """Write each part of an answer into a file of its own, as it arrives; return their number."""
    boundary = answer.headers.get_boundary() or ""
    if answer.headers.get_content_type() != "multipart/related" or not _BOUNDARY.fullmatch(boundary):
        raise RefusedInputError(
            f"{name} sends {_kind_of(answer.headers)}, not the instances in parts (multipart/related with a boundary)"
        )
    parts = Multipart(answer.pieces(Room.on_disk(name, folder, limits)), boundary.encode("ascii"), name)
    count = 0
    while (head := parts.next_head()) is not None:
        if count == expected:
            raise RefusedInputError(f"{name} lists {count_of(expected, 'instance')} and sends more")
        kind = head.get_content_type() if "Content-Type" in head else "application/dicom"
        if kind != "application/dicom":
            raise RefusedInputError(f"{name} sends {_kind_of(head)} as part {count + 1}, not application/dicom")
        size = 0
        with (folder / f"{count + 1:06d}.dcm").open("xb") as stream:
            for piece in parts.next_content():
                size += stream.write(piece)
        stated = head.get("Content-Length", "").strip()
        if size == 0 or (stated.isdecimal() and stated.lstrip("0") != str(size)):
            raise RefusedInputError(
                f"{name} sends part {count + 1} with {size:,} bytes and states {escape_text(stated, 20) or 'none'}: its"
                " boundary or its length is wrong"
            )
        count += 1
        progress("fetch", count, expected)
    return count


def _kind_of(headers: Message) -> str:
    return escape_text(headers.get("Content-Type", "an unknown type").partition(";")[0], 60)


class Multipart:
    """A body of parts, split at its boundary as its `pieces` arrive; the lengths that parts state play no role."""

    def __init__(self, pieces: Iterator[bytes], boundary: bytes, name: str):
        self._pieces, self._name = pieces, name
        self._mark = b"\r\n--" + boundary
        self._buffer = b"\r\n"  # the first boundary may stand at the very beginning
        self._is_begun = False

    def next_head(self) -> Message | None:
        """Return the headers of the next part; None at the end."""
        if not self._is_begun:
            self._is_begun = True
            for _ in self._until(self._mark, _LARGEST_HEAD, "before its first boundary"):
                pass
        while len(self._buffer) < 2:
            self._read_on()
        if self._buffer.startswith(b"--"):
            return None
        text = b"".join(self._until(b"\r\n\r\n", _LARGEST_HEAD, "of headers of a part"))
        blank, _, lines = text.partition(b"\r\n")
        if blank.strip(b" \t"):
            raise RefusedInputError(f"{self._name} has a boundary between its parts that goes on behind its end")
        head = Message()
        for line in lines.split(b"\r\n") if lines else ():
            word, _, value = line.partition(b":")
            head[word.decode("latin-1")] = value.decode("latin-1").strip()
        return head

    def next_content(self) -> Iterator[bytes]:
        """Yield the content of a part; it has to be read before the next headers."""
        return self._until(self._mark)

    def _until(self, end: bytes, limit: int | None = None, subject: str = "") -> Iterator[bytes]:
        """Yield what stands before `end`, and leave what follows; refuse more than `limit` bytes."""
        count = 0
        while True:
            position = self._buffer.find(end)
            ready = max(0, len(self._buffer) - len(end) + 1) if position < 0 else position
            count += ready
            if limit is not None and count > limit:
                raise RefusedInputError(f"{self._name} sends more than {limit:,} bytes {subject}")
            yield self._buffer[:ready]
            self._buffer = self._buffer[ready if position < 0 else position + len(end) :]
            if position >= 0:
                return
            self._read_on()

    def _read_on(self) -> None:
        piece = next(self._pieces, None)
        if piece is None:
            raise Lost("the answer ended before its last part")
        self._buffer += piece
