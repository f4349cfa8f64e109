"""A strict look at an HTML page: tags are closed in their order, identities unique, nothing comes from elsewhere."""

from __future__ import annotations

import re
from html.parser import HTMLParser

VOID = {"meta", "img", "br", "hr", "link", "input"}


class PageCheck(HTMLParser):
    """Faults of a page, its texts by cell of a table, and its pictures."""

    def __init__(self, page: str):
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.faults: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.pictures: list[dict[str, str]] = []
        self.tables: list[list[list[str]]] = []
        self.tags: set[str] = set()
        self._cell: list[str] | None = None
        self._small = 0
        self.feed(page)
        self.close()
        self.faults += [f"<{tag}> is not closed" for tag in self.open]
        self.faults += [f"id {name} twice" for name in {name for name in self.ids if self.ids.count(name) > 1}]
        self.faults += [f"#{name} is nowhere" for name in self.references if name not in self.ids]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self._cell = []
        elif tag == "small":
            self._small += 1

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look(tag, attrs)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open[-1] != tag:
            self.faults.append(f"</{tag}> closes {self.open[-1:] or 'nothing'} at {self.getpos()}")
        else:
            self.open.pop()
        if tag in ("td", "th") and self._cell is not None:
            self.tables[-1][-1].append("".join(self._cell).strip())
            self._cell = None
        elif tag == "small":
            self._small -= 1

    def handle_data(self, data: str) -> None:
        if self._cell is not None and not self._small:
            self._cell.append(data)

    def _look(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        names = [name for name, _ in attrs]
        self.faults += [f"{name} twice in <{tag}>" for name in set(names) if names.count(name) > 1]
        own = {name: value or "" for name, value in attrs}
        self.faults += [f"<{tag}> has {name}" for name in own if name.startswith("on")]
        if "id" in own:
            self.ids.append(own["id"])
        for name, value in own.items():
            self.references += re.findall(r"url\(#([^)]*)\)", value)
            if name == "href" and value.startswith("#"):
                self.references.append(value[1:])
            elif name in ("href", "src", "srcset", "action", "poster") and not value.startswith("data:"):
                self.faults.append(f"<{tag} {name}={value[:60]}>")
        if tag == "img":
            self.pictures.append(own)
            self.faults += [f"a picture has no {name}" for name in ("alt", "width", "height") if not own.get(name)]


def find_faults(page: str) -> list[str]:
    """What is wrong with a page that shall stand alone: no script, no address of another place."""
    check = PageCheck(page)
    faults = list(check.faults)
    if not page.startswith("<!DOCTYPE html>"):
        faults.append("no document type")
    faults += [f"<{tag}>" for tag in ("script", "link", "iframe", "object", "embed", "form") if tag in check.tags]
    faults += re.findall(r"(?:https?:)?//[\w.-]+|@import[^;]*|url\((?!#)[^)]*\)", re.sub(r"data:[^\"]*", "", page))
    return faults
