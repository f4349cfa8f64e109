"""scripts/package/set_version.py: one command for the version of a release."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from house import ROOT
from refusals import refused

import set_version  # isort: skip


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A copy of the files that state the version, with a change that is not released."""
    (tmp_path / "scripts" / "package").mkdir(parents=True)
    for name in set_version.PLACES:
        shutil.copy(ROOT / name, tmp_path / name)
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    entry = f"{set_version.TITLE}\n### Fixed\n- A fault.\n"
    (tmp_path / "CHANGELOG.md").write_text(changes.replace(set_version.TITLE, entry), encoding="utf-8")
    return tmp_path


def read_all(folder: Path) -> dict[str, str]:
    return {name: (folder / name).read_text(encoding="utf-8") for name in (*set_version.PLACES, "CHANGELOG.md")}


def test_version_stands_in_all_files_and_the_changelog_has_its_date(project: Path) -> None:
    set_version.set_version(project, "98.7.6", "2031-01-02")

    texts = read_all(project)
    assert [name for name, text in texts.items() if "98.7.6" not in text] == []
    assert "## Unreleased\n\n## 98.7.6 (2031-01-02)\n\n### Fixed\n- A fault.\n" in texts["CHANGELOG.md"]
    assert "\nversion: 98.7.6\ndate-released: 2031-01-02\n" in texts["CITATION.cff"]


def test_second_release_replaces_the_date_of_the_first_in_the_citation(project: Path) -> None:
    set_version.set_version(project, "98.7.6", "2031-01-02")
    released = project / "CHANGELOG.md"
    released.write_text(released.read_text().replace("## Unreleased\n", "## Unreleased\n\n### Fixed\n- Another.\n"))

    set_version.set_version(project, "98.7.7", "2031-01-03")

    dates = [line for line in (project / "CITATION.cff").read_text().splitlines() if line.startswith("date-released")]
    assert dates == ["date-released: 2031-01-03"]


@pytest.mark.parametrize("version", ["0.0.9", "2", "0.2.0rc1"])
def test_version_that_is_lower_or_no_version_is_refused_and_nothing_is_written(project: Path, version: str) -> None:
    before = read_all(project)
    with refused(ValueError, version):
        set_version.set_version(project, version, "2031-01-02")
    assert read_all(project) == before


def test_second_release_without_an_entry_in_the_changelog_is_refused(project: Path) -> None:
    set_version.set_version(project, "98.7.6", "2031-01-02")
    with refused(ValueError, "Unreleased"):
        set_version.set_version(project, "98.7.7", "2031-01-03")
