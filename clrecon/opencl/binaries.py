"""Built programs in the user's cache folder, for drivers whose own cache is slow.

PoCL keeps built programs, but to find one it runs its compiler's preprocessor over the whole source: 25 ms for each
program.  From the binary that it returns, the same program is made in 2 ms.

A file is named by a hash of everything that the binary depends on, and contains a hash of itself: a program is built
again if its file was cut or changed.  Like the driver's own cache, the folder belongs to the user alone, since its
contents are executed.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from clrecon.system.log import get_logger

__all__ = ["binary_key", "read_binary", "store_binary"]

log = get_logger(__name__)

_MAGIC = b"clrecon kernels 1\n"
_MOST_FILES = 64


def binary_key(*parts: str) -> str:
    """Return a hash of everything that a binary depends on: device, driver, options, source."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(str(len(part)).encode() + b":" + part.encode())
    return digest.hexdigest()


def _folder() -> Path:
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return home / "clrecon" / "kernels"


def _is_private(folder: Path) -> bool:
    """True when no other user can put a file there."""
    if not hasattr(os, "getuid"):  # Windows: the profile folder belongs to the user
        return folder.is_dir()
    try:
        state = folder.stat()
    except OSError:
        return False
    return state.st_uid == os.getuid() and not state.st_mode & 0o022


def read_binary(key: str) -> bytes | None:
    """Return the binary kept under `key`; None where there is none, or none that can be trusted."""
    folder = _folder()
    if not _is_private(folder):
        return None
    try:
        content = (folder / key).read_bytes()
    except OSError:
        return None
    head, binary = content[: len(_MAGIC) + 32], content[len(_MAGIC) + 32 :]
    if head != _MAGIC + hashlib.sha256(binary).digest():
        log.info("a kept binary is damaged: it is built anew and replaced")
        return None
    return binary


def store_binary(key: str, binary: bytes) -> None:
    """Keep `binary` under `key`, as a whole or not at all; the oldest binaries are removed when there are many.

    A folder that cannot be written gives no error: this process has the program, and the next one builds it again.
    """
    folder = _folder()
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(folder):
            return
        handle, name = tempfile.mkstemp(prefix=".new-", dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_MAGIC + hashlib.sha256(binary).digest() + binary)
            os.replace(name, folder / key)
        except OSError:
            os.unlink(name)
            raise
        _prune(sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime))


def _prune(files: Sequence[Path]) -> None:
    for path in files[:-_MOST_FILES]:
        path.unlink(missing_ok=True)
