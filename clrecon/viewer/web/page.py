"""The page of the view: one document with its own style and script, which loads nothing else."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from typing import NamedTuple

from clrecon.exchange.page import hash_code, read_page_code


class Page(NamedTuple):
    """The document and its Content-Security-Policy, which goes into the header of the answer."""

    content: bytes
    policy: str


def compose_page(host: str) -> Page:
    """Return the page for a server under the name `host`, as the browser calls it, with its port.

    The page may run its own script and style, whose hashes the policy names, show pictures that it received, and talk
    to this server.  Nothing else.
    """
    content, script, style = _compose()
    policy = (
        f"default-src 'none'; script-src '{script}'; style-src '{style}'; img-src blob: data:; connect-src 'self'"
        f" ws://{host}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return Page(content, policy)


@cache
def _compose() -> tuple[bytes, str, str]:
    """Return the document and the hashes of its script and style."""
    script = "\n".join((read_page_code("page_shared.js"), _code("page.js")))
    style = "\n".join((read_page_code("page.css"), _code("page.css")))
    filled = {"STYLE": style, "SCRIPT": script}
    document = re.sub("@([A-Z]+)@", lambda place: filled[place[1]], _code("page.html") + "\n")
    return document.encode(), hash_code(script), hash_code(style)


def _code(name: str) -> str:
    return (files(__package__) / name).read_text(encoding="utf-8").strip()
