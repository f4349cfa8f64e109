"""Who is let in: requests from this machine that know the secret, and no page of another server.

The server listens on the loopback address alone, where every user and every program of the machine can reach it, and so
can the pages that a browser has open.  Three checks, each of which a request has to pass:

- *Host* is a loopback name.  A page whose own name was turned to 127.0.0.1 (DNS rebinding) sends that name.  The port
  is not compared: behind a tunnel it is another one.
- *Origin*, which browsers send with what a page asks for, is the server itself.
- The *secret* of 256 random bits is in the address.  There is no cookie: a browser would send it to every other port of
  the machine as well, where servers of other users may listen.
"""

from __future__ import annotations

import hmac
import re
import secrets

LOOPBACK = "127.0.0.1"

_OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)


def make_secret() -> str:
    """Return 256 random bits as text for an address."""
    return secrets.token_urlsafe(32)


def refuse_request(
    host: str | None, origin: str | None, given: str | None, secret: str, *, by_page: bool = False
) -> str | None:
    """Return why a request is refused, or None for one that is let in.

    host, origin: The header fields of these names.
    given: The secret of its address.
    secret: The right one.
    by_page: True for what only scripts of pages ask for: a request without an Origin is refused too.

    Returns: One line that holds nothing of the request.
    """
    if host is None or not _OWN_HOST.fullmatch(host):
        return "refused: this server answers to 127.0.0.1 and localhost alone"
    if (origin is not None or by_page) and origin != f"http://{host}":
        return "refused: the request comes from a page of another server"
    if not hmac.compare_digest((given or "").encode("utf-8", "replace"), secret.encode()):
        return "refused: the secret is missing or wrong, open the whole address that clrecon printed"
    return None
