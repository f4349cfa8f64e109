"""The pages of the Guide on Python: the public names by subject, each name on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import clrecon

SUBJECTS = {
    "volumes": ("Volumes: read, cut, write", "clrecon.reading clrecon.geometry clrecon.operators.resident"),
    "surfaces": ("Surfaces", "clrecon.operators.surface clrecon.anatomy.iso_choice"),
    "meshes": ("Meshes: files, smoothing, decimation", "clrecon.mesh clrecon.proof.compare"),
    "measures": ("Measures of meshes", "clrecon.mesh.compare clrecon.proof.phantom"),
    "anatomy": ("Body, table, noise, spine", "clrecon.anatomy"),
    "labels": ("Label maps", "clrecon.labels"),
    "vertebrae": ("Vertebrae", "clrecon.spine clrecon.operators.vertebrae clrecon.spine"),
    "filters": ("Filters and masks", "clrecon.operators.filters clrecon.operators.masks"),
    "clouds": ("Point clouds", "clrecon.points clrecon.operators.points"),
    "pictures": (
        "Pictures and notebooks",
        "clrecon.rendering clrecon.operators.rays clrecon.operators.reformat clrecon.viewer",
    ),
    "devices": ("Devices and time", "clrecon.opencl clrecon.operators clrecon.system"),
    "errors": ("Errors", "clrecon.errors"),
}
"""Page: its title, and the modules whose public names it has; a name goes to the longest match."""

_HEAD = """\
{title}
{line}

.. currentmodule:: clrecon

.. autosummary::
   :nosignatures:

{summary}

"""


def _subject_of(module: str) -> str | None:
    """Page of what is public of a module; None: there is none."""
    found = [
        (len(room), page)
        for page, (_, rooms) in SUBJECTS.items()
        for room in rooms.split()
        if module == room or module.startswith(room + ".")
    ]
    return max(found)[1] if found else None


def names_by_subject() -> dict[str, list[str]]:
    """Return the public names of each page, in the order of the alphabet."""
    pages: dict[str, list[str]] = {page: [] for page in SUBJECTS}
    package: Any = clrecon  # whose stub says the public names alone
    for name, (module, _) in package._homes.items():
        page = _subject_of(module)
        if page is None:
            raise ValueError(f"clrecon.{name} comes from {module}: say in SUBJECTS of {__file__} which page has it")
        pages[page].append(name)
    return {page: sorted(names, key=str.lower) for page, names in pages.items()}


def _write_name(name: str) -> str:
    public = getattr(clrecon, name)
    if not isinstance(public, type):
        return f".. autofunction:: {name}\n"
    if issubclass(public, Exception):
        return f".. autoexception:: {name}\n   :show-inheritance:\n"
    return f".. autoclass:: {name}\n   :members:\n"


def write_api(folder: Path) -> None:
    """Write a page for each subject, and the page that lists them."""
    folder.mkdir(parents=True)
    for page, names in names_by_subject().items():
        title = SUBJECTS[page][0]
        head = _HEAD.format(title=title, line="=" * len(title), summary="\n".join(f"   {name}" for name in names))
        (folder / f"{page}.rst").write_text(head + "\n".join(map(_write_name, names)), encoding="utf-8")
    entries = "\n".join(f"   {page}" for page in SUBJECTS)
    text = (
        "Python\n======\n\n"
        "``import clrecon`` gives every name here, and loads nothing heavy before a name is used.\n"
        "``device``, ``memory`` and ``progress`` are given by name in all functions.\n\n"
        f".. toctree::\n   :maxdepth: 1\n\n{entries}\n"
    )
    (folder / "index.rst").write_text(text, encoding="utf-8")
