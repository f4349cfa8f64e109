"""Files that a browser asked for: written into a folder of the server, fetched once, and removed."""

from __future__ import annotations

import secrets
import shutil
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Download:
    """A finished file.

    ticket: Random, part of its address; it counts as the secret does, once.
    path: In a folder of its own.
    """

    ticket: str
    path: Path

    @property
    def size(self) -> int:
        """Bytes."""
        return self.path.stat().st_size


class Downloads:
    """The finished files of one browser.

    folder: Where each gets a folder of its own; only the owner of the process can read it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._waiting: dict[str, Download] = {}

    def reserve(self, name: str) -> Download:
        """Return a place for a file of this name; it can be fetched after `offer`."""
        ticket = secrets.token_urlsafe(24)
        own = self._folder / ticket
        own.mkdir(mode=0o700)
        return Download(ticket, own / name)

    def offer(self, download: Download) -> None:
        """Let a finished file be fetched, and remove those that were not."""
        for older in list(self._waiting):
            self.drop(self._waiting.pop(older))
        self._waiting[download.ticket] = download

    def take(self, ticket: str) -> Download | None:
        """Return the file of a ticket, which is void from now on."""
        return self._waiting.pop(ticket, None)

    def drop(self, download: Download) -> None:
        """Remove a file with its folder."""
        shutil.rmtree(download.path.parent, ignore_errors=True)

    def close(self) -> None:
        """Remove what was not fetched."""
        for ticket in list(self._waiting):
            self.drop(self._waiting.pop(ticket))
