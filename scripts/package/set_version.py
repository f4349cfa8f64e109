#!/usr/bin/env python3
"""Write the version of a release into all files that state it, and the date into the changelog.

    python scripts/package/set_version.py 0.2.0

setup.cfg, CITATION.cff and scripts/package/recipe.yaml get the version, CITATION.cff the date of today too; in
CHANGELOG.md the title "Unreleased" becomes the version with that date, and a new empty "Unreleased" stands above it.  A
version that is not higher, a file without a version and a changelog without entries are refused, and nothing is written
then.
"""

from __future__ import annotations

import argparse
import datetime
import re
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLACES = {
    "setup.cfg": r"(?m)^version = (\d+\.\d+\.\d+)$",
    "CITATION.cff": r"(?m)^version: (\d+\.\d+\.\d+)$",
    "scripts/package/recipe.yaml": r'(?m)^  version: "(\d+\.\d+\.\d+)"$',
}
TITLE = "## Unreleased\n"


def set_version(root: Path, version: str, date: str) -> None:
    """Write `version` into the files of the project at `root`."""
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise ValueError(f"{version} is no version: three numbers, such as 0.2.0")
    texts = {}
    for name, pattern in PLACES.items():
        text = (root / name).read_text(encoding="utf-8")
        stated = re.findall(pattern, text)
        if len(stated) != 1:
            raise ValueError(f"{name} states {len(stated)} versions, not one")
        if _numbers(version) <= _numbers(stated[0]):
            raise ValueError(f"{name} has version {stated[0]}: {version} is not higher")
        texts[name] = re.sub(pattern, lambda found: found[0].replace(found[1], version), text)
    undated = re.sub(r"(?m)^date-released: .*\n", "", texts["CITATION.cff"])
    texts["CITATION.cff"] = undated.replace(f"\nversion: {version}\n", f"\nversion: {version}\ndate-released: {date}\n")
    changes = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    if changes.count(TITLE) != 1 or changes.partition(TITLE)[2].lstrip().startswith("## "):
        raise ValueError('CHANGELOG.md has no entries below one title "Unreleased"')
    texts["CHANGELOG.md"] = changes.replace(TITLE, f"{TITLE}\n## {version} ({date})\n")
    for name, text in texts.items():
        (root / name).write_text(text, encoding="utf-8")


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))


def main(argv: Sequence[str] | None = None, root: Path = ROOT) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("version", help="such as 0.2.0")
    options = parser.parse_args(argv)
    try:
        set_version(root, options.version, datetime.date.today().isoformat())
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
