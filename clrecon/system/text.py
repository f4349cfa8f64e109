"""Text from files, made safe to print: file names and DICOM text fields are written by strangers."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import lru_cache

__all__ = ["escape_text", "hash_uid", "join_names"]

TEXT_LIMIT = 64
NAMES_SHOWN = 5


def escape_text(text: str, limit: int = TEXT_LIMIT) -> str:
    """Return `text` in one printable line of at most `limit` characters.

    Control characters, line breaks, terminal escapes and direction marks come out as ``\\xNN`` or ``\\uNNNN``.
    """
    if text.isprintable() and len(text) <= limit:
        return text
    safe = "".join(c if c.isprintable() else c.encode("unicode_escape", "replace").decode("ascii") for c in text)
    return safe if len(safe) <= limit else safe[: limit - 3] + "..."


@lru_cache(1024)
def hash_uid(uid: str) -> str | None:
    """Return the first 16 hexadecimal digits of the SHA-256 of a UID: a name that does not reveal the UID.

    None for an empty UID.
    """
    if not uid:
        return None
    return hashlib.sha256(uid.encode("utf-8", "replace")).hexdigest()[:16]


def join_names(names: Iterable[object]) -> str:
    """Join the first few names for a message, then a count; only the names that are shown are converted to text."""
    names = list(names)
    shown = ", ".join(map(str, names[:NAMES_SHOWN]))
    return shown if len(names) <= NAMES_SHOWN else f"{shown} and {len(names) - NAMES_SHOWN} more"
