"""The pages that the Guide is built from, gathered in one folder.

Every page stays where the code host shows it, with links that work there: README and CHANGELOG at the root, docs/*.md,
docs/guide/*.md.  In the gathered folder they have other places, and each link is written anew; a link to a file that
the site has not (a script, the licence) becomes the name of that file.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

from guide_api import write_api
from guide_commands import describe_options
from guide_gallery import write_gallery

from clrecon.cli.main import COMMANDS

_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]*)(#[^)\s]*)?\)")
_CODE = re.compile(r"(^```[\s\S]*?^```|^(?: {4}.*\n)+|`[^`\n]+`)", re.MULTILINE)

_TREES = {
    "index.md": """
```{{toctree}}
:hidden:

Quick start <quickstart>
concepts
Commands <commands/index>
How to <how_to>
Python <api/index>
gallery/index
In depth <methods/index>
limits
citing
README <readme>
changes
contributing
```
""",
    "contributing.md": """
```{{toctree}}
:hidden:
:glob:

development/*
```
""",
    "how_to.md": """# How to

```{{toctree}}
:maxdepth: 1

print_a_vertebra
labels_to_meshes
other_programs
napari
devices
```
""",
    "commands/index.md": """
```{{toctree}}
:maxdepth: 1

{commands}
```
""",
    "methods/index.md": """# In depth

```{{toctree}}
:glob:
:maxdepth: 1

*
```
""",
}
"""What the site's menus are made of: added to the end of a page, or a page."""

_BESIDE_THE_GUIDE = ("devices", "limits")
"""Pages of docs/ that stand in the menus beside those of docs/guide/, and not among the methods."""


def site_pages(root: Path) -> dict[str, str]:
    """Return the page of the site for each file of the project, both as paths with ``/``, by the file's."""
    pages = {"README.md": "readme.md", "CHANGELOG.md": "changes.md", "CONTRIBUTING.md": "contributing.md"}
    pages |= {f"docs/{path.name}": f"methods/{path.name}" for path in sorted(root.glob("docs/*.md"))}
    pages |= {f"docs/{name}.md": f"{name}.md" for name in _BESIDE_THE_GUIDE}
    for path in sorted(root.glob("docs/guide/**/*.md")):
        pages[path.relative_to(root).as_posix()] = path.relative_to(root / "docs" / "guide").as_posix()
    pages |= {f"docs/{path.name}": f"methods/{path.name}" for path in sorted(root.glob("docs/*.ipynb"))}  # to download
    pages |= {f"docs/images/{path.name}": f"images/{path.name}" for path in sorted(root.glob("docs/images/*.png"))}
    return pages


def rewrite_links(text: str, page: str, pages: dict[str, str]) -> str:
    """Write the links of a page anew for its place in the site.

    text: The Markdown of the page.
    page: Its path in the project.
    pages: What `site_pages` gave.
    Returns the same Markdown; code is as it was.
    """
    here = os.path.dirname(pages[page])

    def write_anew(found: re.Match[str]) -> str:
        picture, words, target, anchor = found[1], found[2], found[3], found[4] or ""
        if not target or "://" in target or target.startswith("mailto:"):
            return found[0]
        there = os.path.normpath(os.path.join(os.path.dirname(page), target)).replace(os.sep, "/")
        if there in pages:
            return f"{picture}[{words}]({os.path.relpath(pages[there], here or '.').replace(os.sep, '/')}{anchor})"
        return words if words.startswith("`") or words != target else f"`{words}`"

    return outside_of_code(text, lambda prose: _LINK.sub(write_anew, prose))


def outside_of_code(text: str, change: Callable[[str], str]) -> str:
    """Apply `change` to what is not code in a page.  A link whose words are code is no code."""
    kept: list[str] = []

    def keep(found: re.Match[str]) -> str:
        kept.append(found[0])
        return f"\0{len(kept) - 1}\0"

    prose = change(_CODE.sub(keep, text))
    return re.sub(r"\0(\d+)\0", lambda found: kept[int(found[1])], prose)


def gather_sources(root: Path, folder: Path) -> None:
    """Write the sources of the site.

    root: The project.
    folder: A new folder for them.
    """
    pages = site_pages(root)
    for source, page in pages.items():
        target = folder / page
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.suffix != ".md":
            shutil.copyfile(root / source, target)
            continue
        text = rewrite_links((root / source).read_text(encoding="utf-8"), source, pages)
        if page == "citing.md":
            text += f"\n```yaml\n{(root / 'CITATION.cff').read_text(encoding='utf-8')}```\n"
        if page.startswith("commands/") and target.stem in COMMANDS:
            text += "\n" + describe_options(target.stem)
        target.write_text(text, encoding="utf-8")
    for command, (_, said) in COMMANDS.items():
        page_of_command = folder / "commands" / f"{command}.md"
        if not page_of_command.exists():
            page_of_command.write_text(
                f"# clrecon {command}\n\n{said}\n\n{describe_options(command)}", encoding="utf-8"
            )
    for name in ("conf.py", "_static"):
        source_path = root / "docs" / "guide" / name
        if source_path.is_dir():
            shutil.copytree(source_path, folder / name)
        else:
            shutil.copyfile(source_path, folder / name)
    write_api(folder / "api")
    write_gallery(root / "docs" / "guide" / "gallery", folder / "gallery")
    for name, tree in _TREES.items():
        with open(folder / name, "a", encoding="utf-8") as file:
            file.write(tree.format(commands="\n".join(COMMANDS)))
