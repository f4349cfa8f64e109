"""Words of libraries, which are kept off the result of a command and out of its messages.

Libraries in C write to the file descriptors behind Python's streams: VTK a line to standard output, MetaIO several to
standard error for one bad header.  The command line owns the streams of its process and leaves such words out: the log
says that there were some, not which, for they can quote a header.  A caller in Python keeps his streams.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    import logging

_owned = False
_lock = threading.RLock()


@contextlib.contextmanager
def own_streams(*, show: bool = False) -> Iterator[None]:
    """In the ``with`` block, standard output belongs to Python alone, and warnings of libraries are left out.

    What a library in C writes to standard output comes out on standard error, unless `hush` takes it.  With `show` all
    foreign words come out there.
    """
    global _owned
    # where a standard stream is closed, the next file would get what is written to it
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    with contextlib.ExitStack() as stack:
        if not show:
            stack.enter_context(warnings.catch_warnings())
            warnings.showwarning = _log_warning
        _move_stdout(stack)
        before, _owned = _owned, not show
        try:
            yield
        finally:
            _owned = before


def _log_warning(message: Any, category: type[Warning], filename: str, lineno: int, *_: Any, **__: Any) -> None:
    _log().info("%s of a library in %s, line %d", category.__name__, Path(filename).name, lineno)


def _log() -> logging.Logger:
    from clrecon.system.log import get_logger  # loads logging, which takes milliseconds

    return get_logger(__name__)


def _move_stdout(stack: contextlib.ExitStack) -> None:
    """Give Python a descriptor of its own for standard output, and lead descriptor 1 to standard error until then."""
    stream = sys.stdout
    try:
        if stream is None or stream.fileno() != 1:
            return
        stream.flush()
        stdout_copy, errors = os.dup(1), os.dup(2)
    except (OSError, ValueError, AttributeError):  # a stream that is closed, or is no file: nothing to keep clean
        return
    os.dup2(errors, 1)
    os.close(errors)
    encoding, handling = stream.encoding, stream.errors
    sys.stdout = open(stdout_copy, "w", encoding=encoding, errors=handling, buffering=1 if stream.isatty() else -1)

    def restore(moved: TextIO = sys.stdout) -> None:
        os.dup2(moved.fileno(), 1)
        sys.stdout = stream
        with contextlib.suppress(OSError):  # reported before, when the result was written
            moved.close()

    stack.callback(restore)


@contextlib.contextmanager
def hush() -> Iterator[None]:
    """Leave out what a library in C writes to standard output and error in the ``with`` block, in a command.

    For short calls of libraries that are known to write there: a crash in the block leaves no word.
    """
    if not _owned:
        yield
        return
    import tempfile

    with _lock, tempfile.TemporaryFile() as words:
        with contextlib.ExitStack() as stack:
            for descriptor in (1, 2):
                _divert(stack, descriptor, words.fileno())
            yield
        size = words.seek(0, os.SEEK_END)
        if size:
            _log().info("words of a library left out: %d bytes", size)


def _divert(stack: contextlib.ExitStack, descriptor: int, target: int) -> None:
    try:
        saved = os.dup(descriptor)
    except OSError:  # closed
        return
    stack.callback(os.close, saved)
    stack.callback(os.dup2, saved, descriptor)
    os.dup2(target, descriptor)
