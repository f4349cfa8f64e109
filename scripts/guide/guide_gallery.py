"""The gallery of the Guide: its scripts as pages, each with the picture that it makes."""

from __future__ import annotations

import ast
from pathlib import Path


def read_script(path: Path) -> tuple[str, str, str]:
    """Return the title of a script of the gallery, the text below it, and its code."""
    source = path.read_text(encoding="utf-8")
    said = ast.get_docstring(ast.parse(source)) or ""
    title, _, text = said.partition("\n")
    return title.rstrip("."), text.strip(), source.split('"""', 2)[2].strip()


def write_gallery(scripts: Path, folder: Path) -> None:
    """Write a page for each script, and the page that shows their pictures."""
    folder.mkdir(parents=True)
    names = [path.stem for path in sorted(scripts.glob("*.py"))]
    shown = []
    for name in names:
        title, text, code = read_script(scripts / f"{name}.py")
        page = f"# {title}\n\n{text}\n\n![{title}](../images/gallery-{name}.png)\n\n```python\n{code}\n```\n"
        (folder / f"{name}.md").write_text(page, encoding="utf-8")
        shown.append(f"## {title}\n\n[![{title}](../images/gallery-{name}.png)]({name}.md)\n")
    tree = "```{toctree}\n:hidden:\n\n" + "\n".join(names) + "\n```\n"
    head = "# Gallery\n\nEach picture is made by the script on its page, from a phantom: no scan is needed.\n\n"
    (folder / "index.md").write_text(head + "\n".join(shown) + "\n" + tree, encoding="utf-8")
