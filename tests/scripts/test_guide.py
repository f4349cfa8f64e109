"""The Guide is built without a warning, holds every name and command, asks no server for anything, and its links lead
somewhere."""

from __future__ import annotations

import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from build_guide import NEEDED, build_guide
from guide_api import names_by_subject
from guide_commands import command_parser, describe_options
from guide_gallery import read_script
from guide_sources import rewrite_links, site_pages
from house import ROOT
from made_once import make_once

import clrecon
from clrecon.cli.main import COMMANDS

LOADED = {
    "script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src", "video": "src", "audio": "src",
    "embed": "src", "object": "data", "image": "href", "use": "href",
}  # fmt: skip
"""Elements whose attribute a browser fetches when it opens a page."""

FETCHED_BY_STYLE = re.compile(r"""(?:url\(\s*["']?|@import\s+["'])((?:https?:)?//[^"')\s]+)""")


class Page(HTMLParser):
    """What a page loads, links to and can be linked to by."""

    def __init__(self, text: str):
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attributes}
        if tag in LOADED and LOADED[tag] in given:
            self.loads.append(given[LOADED[tag]])
        if "srcset" in given:
            self.loads += [part.split()[0] for part in given["srcset"].split(",")]
        self.loads += FETCHED_BY_STYLE.findall(given.get("style", ""))
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if "id" in given:
            self.anchors.add(given["id"])


def find_outside(name: str, text: str) -> list[str]:
    """Resources of other servers that a file of the site loads when it is opened."""
    if name.endswith(".css"):
        return FETCHED_BY_STYLE.findall(text)
    styles = "".join(re.findall(r"<style[^>]*>(.*?)</style>", text, re.DOTALL))
    loads = [url for url in Page(text).loads if re.match(r"(?:[a-z]+:)?//", url, re.IGNORECASE)]
    return loads + FETCHED_BY_STYLE.findall(styles)


@pytest.fixture(scope="module")
def site(shared_folder: Path) -> Path:
    """The Guide, built with warnings as errors."""
    for name in NEEDED:
        pytest.importorskip(name, reason="the Guide is built with the extra docs, which is not installed")

    def make(folder: Path) -> None:
        assert build_guide(folder) == 0

    return make_once(shared_folder, "guide-site", make)


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, Page]:
    files = [
        path for path in sorted(site.rglob("*.html")) if "_static" not in path.parts
    ]  # there: the theme's templates
    return {path.relative_to(site).as_posix(): Page(path.read_text(encoding="utf-8")) for path in files}


@pytest.mark.release
def test_no_page_asks_another_server_for_anything(site: Path) -> None:
    files = [path for kind in ("*.html", "*.css") for path in sorted(site.rglob(kind))]
    assert len(files) > 80
    found = {str(path): find_outside(path.name, path.read_text(encoding="utf-8")) for path in files}
    assert {name: urls for name, urls in found.items() if urls} == {}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.html", '<script src="https://x.org/a.js"></script>'),
        ("a.html", '<link rel="stylesheet" href="//x.org/a.css">'),
        ("a.html", '<img src="HTTP://x.org/a.png">'),
        ("a.html", "<style>@import 'https://x.org/a.css';</style>"),
        ("a.css", "a { src: url(https://x.org/a.woff2) }"),
    ],
)
def test_a_resource_of_another_server_is_found(name: str, text: str) -> None:
    assert len(find_outside(name, text)) == 1
    assert find_outside(name, text.replace("https://x.org/", "").replace("//x.org/", "").replace("HTTP:", "")) == []


@pytest.mark.release
def test_every_link_within_the_site_leads_somewhere(site: Path, pages: dict[str, Page]) -> None:
    wrong = []
    for name, page in pages.items():
        for link in [*page.links, *page.loads]:
            path, _, anchor = unquote(link).partition("#")
            if re.match(r"[a-z]+:", path) or path.startswith("//"):
                continue
            target = (site / name).parent / path.partition("?")[0] if path else site / name
            there = target.resolve().relative_to(site.resolve()).as_posix()
            if not target.is_file() or (anchor and there in pages and anchor not in pages[there].anchors):
                wrong.append((name, link))
    assert wrong == []


@pytest.mark.release
def test_every_document_and_every_picture_of_a_page_is_in_the_site(site: Path) -> None:
    for page in site_pages(ROOT).values():
        if page.endswith(".md"):
            assert (site / page).with_suffix(".html").is_file(), page


def test_every_public_name_stands_on_one_page() -> None:
    names = Counter(name for names in names_by_subject().values() for name in names)
    assert set(names) == set(clrecon.__all__) - {"__version__"}
    assert set(names.values()) == {1}
    assert all(names_by_subject().values())


@pytest.mark.release
def test_every_public_name_has_its_entry(pages: dict[str, Page]) -> None:
    entries = Counter(anchor for name, page in pages.items() if name.startswith("api/") for anchor in page.anchors)
    assert {name: entries[f"clrecon.{name}"] for name in clrecon.__all__[1:] if entries[f"clrecon.{name}"] != 1} == {}


@pytest.mark.release
def test_every_command_has_a_page_with_its_options(site: Path) -> None:
    for command in COMMANDS:
        text = (site / "commands" / f"{command}.html").read_text(encoding="utf-8")
        options = [name for action in command_parser(command)._actions for name in action.option_strings]
        assert [name for name in options if name not in text] == [], command
        assert "\u2013" not in text, "two hyphens of an option became a dash"


def test_options_are_those_of_the_help() -> None:
    text = describe_options("distance")
    assert "`--picture FILE`\n: draw the coloured mesh with its scale" in text
    assert text.startswith("## Options\n") and "clrecon distance printed.stl bone.stl" in text


def test_links_are_written_anew_for_the_place_of_a_page_in_the_site() -> None:
    pages = {
        "README.md": "readme.md",
        "docs/labels.md": "methods/labels.md",
        "docs/guide/commands/mesh.md": "commands/mesh.md",
        "docs/images/a.png": "images/a.png",
    }
    text = (
        "See [`this`](docs/labels.md#solid-labels), [that](LICENSE), ![a](docs/images/a.png), [x](https://x.org/y.md),"
        " [b](#below) and `[code](docs/labels.md)`.\n\n    [block](docs/labels.md)\n"
    )
    assert rewrite_links(text, "README.md", pages) == (
        "See [`this`](methods/labels.md#solid-labels), that, ![a](images/a.png), [x](https://x.org/y.md),"
        " [b](#below) and `[code](docs/labels.md)`.\n\n    [block](docs/labels.md)\n"
    )
    above = rewrite_links("[a](../../labels.md) [b](../../../README.md#x)", "docs/guide/commands/mesh.md", pages)
    assert above == "[a](../methods/labels.md) [b](../readme.md#x)"


def test_a_script_of_the_gallery_is_a_title_a_text_and_code(tmp_path: Path) -> None:
    script = tmp_path / "a.py"
    script.write_text('"""A torus.\n\nIt is round.\n"""\n\nimport clrecon\n', encoding="utf-8")
    assert read_script(script) == ("A torus", "It is round.", "import clrecon")
