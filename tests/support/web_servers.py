"""Servers on loopback: a DICOMweb archive of one series, a bucket of S3, and any answer that a test wants instead."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

import pydicom

Handler = BaseHTTPRequestHandler
Answer = Callable[[Handler], None]

STUDY, SERIES = "1.2.3", "1.2.3.4"
BOUNDARY = "border of parts"
STORED = f'multipart/related; type="application/dicom"; boundary="{BOUNDARY}"'


class Server:
    """Answers each request by the next of `answers`, or by `answer` where there is none; `asked` has path and headers.

    Whoever asks for more than `answer` knows gets 404.
    """

    def __init__(self) -> None:
        self.answers: list[Answer] = []
        self.asked: list[tuple[str, dict[str, str]]] = []
        self.posted: list[bytes] = []
        server = self

        class Handling(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                server.asked.append((self.path, dict(self.headers)))
                if self.command == "POST":
                    server.posted.append(self.rfile.read(int(self.headers["Content-Length"])))
                self.close_connection = True
                answer = server.answers.pop(0) if server.answers else server.answer
                try:
                    answer(self)
                except (BrokenPipeError, ConnectionResetError):
                    pass  # the reader has enough

            do_HEAD = do_POST = do_GET

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handling)
        self._server.daemon_threads = True
        self.host = f"127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()

    def answer(self, handler: Handler) -> None:
        send(handler, b"", status=404)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def tokens(self) -> list[str | None]:
        """The credentials of each request."""
        return [headers.get("Authorization") for _, headers in self.asked]


@contextmanager
def running(server: Any) -> Iterator[Any]:
    """Close a server at the end."""
    try:
        yield server
    finally:
        server.close()


def send(handler: Handler, content: bytes, *, kind: str = "text/plain", status: int = 200, **headers: str) -> None:
    """Send an answer; headers of the same name, such as Content_Length, replace the true ones."""
    handler.send_response(status)
    named = {"Content-Type": kind, "Content-Length": str(len(content))}
    named |= {name.replace("_", "-"): value for name, value in headers.items()}
    for name, value in named.items():
        if value:
            handler.send_header(name, value)
    handler.end_headers()
    if handler.command != "HEAD":
        handler.wfile.write(content)


def answering(content: bytes = b"", *, kind: str = "text/plain", status: int = 200, **headers: str) -> Answer:
    """An answer with this content."""
    return lambda handler: send(handler, content, kind=kind, status=status, **headers)


def join_parts(contents: Sequence[bytes], *, kind: str = "application/dicom", length: int | str | None = None) -> bytes:
    """Return the body of an answer in parts; with `length` each part states so many bytes."""
    stated = "" if length is None else f"\r\nContent-Length: {length}"
    head = f"--{BOUNDARY}\r\nContent-Type: {kind}{stated}\r\n\r\n".encode()
    return b"".join(head + content + b"\r\n" for content in contents) + f"--{BOUNDARY}--\r\n".encode()


class Archive(Server):
    """The DICOM files of a folder as one series; `page` instances are listed at once."""

    def __init__(self, folder: Path):
        files = sorted(folder.rglob("*.dcm"))
        self.instances = [path.read_bytes() for path in files]
        self.uids = [str(pydicom.dcmread(path, specific_tags=["SOPInstanceUID"]).SOPInstanceUID) for path in files]
        self.page = 1000
        super().__init__()
        self.study = f"dicomweb+http://{self.host}/dicom-web/studies/{STUDY}"
        self.url = f"{self.study}/series/{SERIES}"

    def answer(self, handler: Handler) -> None:
        parts = urlsplit(handler.path)
        if handler.command == "POST":
            uid = self.stored()[-1].SOPInstanceUID
            send(handler, json.dumps({"00081199": {"vr": "SQ", "Value": [{"00081155": {"Value": [uid]}}]}}).encode())
            return
        top = f"/dicom-web/studies/{STUDY}"
        if parts.path in (top, f"{top}/series/{SERIES}") and "transfer-syntax=*" in handler.headers["Accept"]:
            send(handler, join_parts(self.instances), kind=STORED)
        elif parts.path == "/dicom-web/studies":
            send(handler, b"[]", kind="application/dicom+json")
        elif parts.path in (f"{top}/instances", f"{top}/series/{SERIES}/instances"):
            start = int(parse_qs(parts.query).get("offset", ["0"])[0])
            uids = self.uids[start : start + self.page]
            send(handler, json.dumps([list_entry(uid) for uid in uids]).encode(), kind="application/dicom+json")
        else:
            send(handler, b"", status=404)

    def stored(self) -> list[pydicom.Dataset]:
        """The instances that were posted, one a request."""
        parts = [body.split(b"\r\n\r\n", 1)[1].rpartition(b"\r\n--clrecon")[0] for body in self.posted]
        return [pydicom.dcmread(io.BytesIO(part)) for part in parts]


def list_entry(uid: str) -> dict[str, Any]:
    return {"00080018": {"vr": "UI", "Value": [uid]}}


class BucketServer(Server):
    """A bucket of S3 with these objects, by their names; `only_to` is the key that may read them."""

    def __init__(self, objects: dict[str, bytes]):
        self.objects = objects
        self.is_closed = False
        super().__init__()

    def answer(self, handler: Handler) -> None:
        parts = urlsplit(handler.path)
        key = unquote(parts.path).removeprefix("/scans").lstrip("/")
        if self.is_closed:
            text = b"<Error><Code>AccessDenied</Code><AWSAccessKeyId>AKIASECRET</AWSAccessKeyId></Error>"
            send(handler, text, kind="application/xml", status=403)
        elif key:
            self._send_object(handler, key)
        else:
            prefix = parse_qs(parts.query).get("prefix", [""])[0]
            send(handler, self._list_objects(prefix), kind="application/xml")

    def _send_object(self, handler: Handler, key: str) -> None:
        if key not in self.objects:
            send(handler, b"<Error><Code>NoSuchKey</Code></Error>", kind="application/xml", status=404)
            return
        modified = "Sat, 28 Nov 2026 12:00:00 GMT"
        send(handler, self.objects[key], kind="application/octet-stream", ETag='"1"', Last_Modified=modified)

    def _list_objects(self, prefix: str) -> bytes:
        entries = "".join(
            f"<Contents><Key>{escape(key)}</Key><Size>{len(content)}</Size><ETag>1</ETag>"
            "<LastModified>2026-11-28T12:00:00.000Z</LastModified></Contents>"
            for key, content in sorted(self.objects.items())
            if key.startswith(prefix)
        )
        return f"<ListBucketResult><IsTruncated>false</IsTruncated>{entries}</ListBucketResult>".encode()
