"""The port on the loopback address, and the browser that is opened on wish."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import sys
import tempfile
import threading
import webbrowser
from html import escape
from pathlib import Path

from clrecon.errors import UsageError
from clrecon.system.arguments import name_parameter
from clrecon.viewer.web.admission import LOOPBACK

LARGEST_PORT = 65535
_WAITING = 64


def bind_port(port: int | None = None) -> socket.socket:
    """Return a socket that listens on a port of 127.0.0.1; it is closed by the caller.

    port: Default: a free one.
    """
    if port is not None and (isinstance(port, bool) or not 1 <= port <= LARGEST_PORT):
        raise UsageError(f"a port is a whole number from 1 to {LARGEST_PORT}, not {port!r}")
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if sys.platform == "win32":  # there the other option would let two programs share a port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:  # a server that has just ended does not block its port for a minute
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((LOOPBACK, port or 0))
        listener.listen(_WAITING)
    except OSError as error:
        listener.close()
        other = f"name another with {name_parameter('port', 'N')}, or leave it out for a free one"
        if error.errno == errno.EADDRINUSE:
            raise UsageError(f"port {port} of {LOOPBACK} is taken by another program: {other}") from error
        if error.errno == errno.EACCES:
            raise UsageError(f"port {port} is reserved by the system: {other}") from error
        raise UsageError(f"port {port or 'any'} of {LOOPBACK} cannot be used ({error.strerror}): {other}") from error
    return listener


def has_screen() -> bool:
    """False where a browser would have to open in the terminal, or nowhere."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_browser(address: str, folder: Path) -> None:
    """Open an address in the user's browser, without waiting for it.

    The browser gets the name of a file in `folder` that leads to the address: other users of the machine can see the
    words with which a program was started, and the address holds the secret.
    """
    with tempfile.NamedTemporaryFile(
        "w", encoding="utf-8", suffix=".html", dir=folder, delete=False
    ) as file:  # only its owner can read it
        shown = escape(address)
        file.write(
            f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={shown}"><a href="{shown}">clrecon</a>\n'
        )

    def start() -> None:
        with contextlib.suppress(Exception):  # the address was printed
            webbrowser.open(Path(file.name).as_uri())

    threading.Thread(target=start, name="clrecon-open-browser", daemon=True).start()
