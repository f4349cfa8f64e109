"""scripts/proof/check_package.py: what a source distribution lacks is found."""

from __future__ import annotations

import tarfile
from pathlib import Path

import check_package


def test_file_that_a_source_distribution_lacks_is_named(tmp_path: Path) -> None:
    kept = tmp_path / "kept.md"
    kept.write_text("kept")
    with tarfile.open(tmp_path / "a-1.tar.gz", "w:gz") as archive:
        archive.add(kept, "a-1/docs/kept.md")
    names = ["docs/kept.md", "tests/lost.py"]
    assert check_package.missing_files(names, tmp_path / "a-1.tar.gz") == ["tests/lost.py"]
