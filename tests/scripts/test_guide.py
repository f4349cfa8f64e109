"""The Guide is built without a warning, has every name and command, and loads nothing from other servers; its links
have targets."""

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
    """The pages of the Guide by their paths in it."""
    files = [
        path for path in sorted(site.rglob("*.html")) if "_static" not in path.parts
    ]  # there: the theme's templates
    return {path.relative_to(site).as_posix(): Page(path.read_text(encoding="utf-8")) for path in files}


@pytest.mark.release
def test_no_page_of_the_guide_loads_anything_from_another_server(site: Path) -> None:
    files = [path for kind in ("*.html", "*.css") for path in sorted(site.rglob(kind))]
    assert len(files) > 80  # `site_pages` names 85 texts of the project, the others list its names
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
def test_resource_of_another_server_is_found_and_one_of_the_site_is_not(name: str, text: str) -> None:
    assert len(find_outside(name, text)) == 1
    of_site = re.sub(r"(https?:)?//x\.org/", "", text, flags=re.IGNORECASE)
    assert find_outside(name, of_site) == []


@pytest.mark.release
def test_every_link_within_the_guide_has_a_target(site: Path, pages: dict[str, Page]) -> None:
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
def test_every_document_is_a_page_of_the_guide(site: Path) -> None:
    documents = [page for page in site_pages(ROOT).values() if page.endswith(".md")]
    assert documents
    assert [page for page in documents if not (site / page).with_suffix(".html").is_file()] == []


def test_every_public_name_is_on_one_page_of_the_guide() -> None:
    names = Counter(name for names in names_by_subject().values() for name in names)
    assert set(names) == set(clrecon.__all__) - {"__version__"}
    assert set(names.values()) == {1}


def test_no_page_of_the_guide_is_without_public_names() -> None:
    assert [subject for subject, names in names_by_subject().items() if not names] == []


@pytest.mark.release
def test_every_public_name_has_one_entry_in_the_guide(pages: dict[str, Page]) -> None:
    entries = Counter(anchor for name, page in pages.items() if name.startswith("api/") for anchor in page.anchors)
    assert {name: entries[f"clrecon.{name}"] for name in clrecon.__all__[1:] if entries[f"clrecon.{name}"] != 1} == {}


@pytest.mark.release
@pytest.mark.parametrize("command", COMMANDS)
def test_page_of_a_command_in_the_guide_has_its_options_with_two_hyphens(command: str, site: Path) -> None:
    text = (site / "commands" / f"{command}.html").read_text(encoding="utf-8")
    options = [name for action in command_parser(command)._actions for name in action.option_strings]
    assert [name for name in options if name not in text] == []
    en_dash = "\u2013"
    assert en_dash not in text, "two hyphens of an option became a dash"


def test_options_of_a_command_are_described_by_its_help_and_examples() -> None:
    text = describe_options("distance")
    assert text.startswith("## Options\n")
    assert "`--picture FILE`\n: draw the coloured mesh with its scale" in text
    assert "clrecon distance printed.stl bone.stl" in text


SITE = {
    "README.md": "readme.md",
    "docs/labels.md": "methods/labels.md",
    "docs/guide/commands/mesh.md": "commands/mesh.md",
    "docs/images/a.png": "images/a.png",
}
"""Pages of the site by their files."""


@pytest.mark.parametrize(
    ("page", "text", "rewritten"),
    [
        ("README.md", "[`a`](docs/labels.md#solid-labels)", "[`a`](methods/labels.md#solid-labels)"),
        ("README.md", "![a](docs/images/a.png)", "![a](images/a.png)"),
        ("README.md", "[that](LICENSE)", "that"),
        ("README.md", "[x](https://x.org/y.md) [b](#below)", "[x](https://x.org/y.md) [b](#below)"),
        ("README.md", "`[code](docs/labels.md)`", "`[code](docs/labels.md)`"),
        ("README.md", "x\n\n    [block](docs/labels.md)\n", "x\n\n    [block](docs/labels.md)\n"),
        ("docs/guide/commands/mesh.md", "[a](../../labels.md)", "[a](../methods/labels.md)"),
        ("docs/guide/commands/mesh.md", "[b](../../../README.md#x)", "[b](../readme.md#x)"),
    ],
    ids=[
        "page",
        "picture",
        "file that is no page",
        "other targets",
        "code",
        "block of code",
        "up one",
        "up to the top",
    ],
)
def test_link_to_a_file_becomes_one_to_its_page_of_the_site(page: str, text: str, rewritten: str) -> None:
    assert rewrite_links(text, page, SITE) == rewritten


def test_script_of_the_gallery_is_divided_into_title_text_and_code(tmp_path: Path) -> None:
    script = tmp_path / "a.py"
    script.write_text('"""A torus.\n\nIt is round.\n"""\n\nimport clrecon\n', encoding="utf-8")
    assert read_script(script) == ("A torus", "It is round.", "import clrecon")
