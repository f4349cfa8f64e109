"""Built programs in the user's cache folder, for drivers that keep none.

A file is named by a hash of everything that its binary depends on, and contains that name and a hash of name and
binary together: a program is built again if its file was cut, changed, or takes the place of another.  The folder
belongs to the user alone (`clrecon.opencl.cache.folders`), since its contents are executed.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from clrecon.opencl.cache.folders import prepare_caches
from clrecon.system.log import get_logger

log = get_logger(__name__)

_MAGIC = b"clrecon kernels 2\n"
_MOST_FILES = 512


def binary_key(*parts: str) -> str:
    """Return a hash of everything that a binary depends on: device, driver, options, source."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(str(len(part)).encode() + b":" + part.encode())
    return digest.hexdigest()


def _head(key: str, binary: bytes) -> bytes:
    name = key.encode()
    return _MAGIC + name + hashlib.sha256(name + binary).digest()


def read_binary(key: str) -> bytes | None:
    """Return the binary kept under `key`; None where there is none, or none that can be trusted."""
    folder = prepare_caches().binaries
    if folder is None:
        return None
    try:
        content = (folder / key).read_bytes()
    except OSError:
        return None
    binary = content[len(_head(key, b"")) :]
    if content != _head(key, binary) + binary:
        log.info("a kept binary is damaged: it is built anew and replaced")
        return None
    return binary


def store_binary(key: str, binary: bytes) -> None:
    """Keep `binary` under `key`, as a whole or not at all; the oldest binaries are removed when there are many.

    A folder that cannot be written gives no error: this process has the program, and the next one builds it again.
    """
    folder = prepare_caches().binaries
    if folder is None:
        return
    with suppress(OSError):
        handle, name = tempfile.mkstemp(prefix=".new-", dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_head(key, binary) + binary)
            os.replace(name, folder / key)
        except OSError:
            os.unlink(name)
            raise
        _prune(sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime))


def _prune(files: Sequence[Path]) -> None:
    for path in files[:-_MOST_FILES]:
        path.unlink(missing_ok=True)
