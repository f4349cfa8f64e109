"""Text files of meshes, whatever program and system wrote them."""

from __future__ import annotations

MARK = b"\xef\xbb\xbf"
"""Byte order mark of UTF-8."""


def plain_lines(data: bytes) -> bytes:
    """Return a text without its byte order mark, with a line feed at the end of each line."""
    return data.removeprefix(MARK).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
