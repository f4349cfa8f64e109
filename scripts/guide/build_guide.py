#!/usr/bin/env python3
"""Build the Guide: the pages of docs/, one page a command, the Python names by subject, as a site.

    python3 scripts/guide/build_guide.py [FOLDER]

FOLDER (default: build/guide) gets index.html and what it needs; nothing is fetched when it is opened.  Needs the extra
`docs`.  A warning of Sphinx, a link without a target for one, fails the build.
"""

from __future__ import annotations

import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

from guide_sources import gather_sources

ROOT = Path(__file__).resolve().parents[2]
NEEDED = ("sphinx", "pydata_sphinx_theme", "numpydoc", "myst_parser", "sphinx_copybutton")


def find_missing() -> list[str]:
    """Return the packages of the extra `docs` that are not installed."""
    return [name for name in NEEDED if find_spec(name) is None]


def build_guide(folder: Path) -> int:
    """Build the site.

    folder: Where it goes; what is there from an earlier build is written over.
    Returns 0, or what Sphinx gave: a warning is an error.
    """
    from sphinx.cmd.build import main as sphinx_build

    with tempfile.TemporaryDirectory(prefix="clrecon-guide-") as work:
        sources = Path(work, "sources")
        gather_sources(ROOT, sources)
        options = ["-W", "--keep-going", "-n", "-q", "-b", "html", "-d", str(Path(work, "doctrees"))]
        return int(sphinx_build([*options, str(sources), str(folder)]))


def main() -> int:
    """Build the Guide into the folder of the command line."""
    arguments = sys.argv[1:]
    if len(arguments) > 1 or any(argument.startswith("-") for argument in arguments):
        print(__doc__.strip())
        return 0 if arguments in (["-h"], ["--help"]) else 3
    if missing := find_missing():
        print(f"not installed: {', '.join(missing)}; pip install -e '.[docs]' brings them", file=sys.stderr)
        return 1
    folder = Path(arguments[0]) if arguments else ROOT / "build" / "guide"
    started = time.monotonic()
    code = build_guide(folder)
    if code == 0:
        print(f"{folder / 'index.html'}: {time.monotonic() - started:.0f} s")
    return code


if __name__ == "__main__":
    sys.exit(main())
