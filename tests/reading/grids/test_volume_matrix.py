"""Volumes that `clrecon export` writes, with known places: read back exactly, by others too, or refused with words."""

from __future__ import annotations

from pathlib import Path

import pytest
from house import ROOT
from marked_tables import find_table
from volume_matrix import EXPORTS, PEERS, Export, describe, read_with_clrecon, write_export

for library in ("nibabel", "nrrd", "SimpleITK"):
    pytest.importorskip(library)

NAMES = [f"{one.name}, {extension}" for one, extension in EXPORTS]
OTHERS = ("SimpleITK", "nibabel", "pynrrd")


@pytest.fixture(scope="module")
def rows() -> dict[str, dict[str, str]]:
    """The rows of the table on the page, by the name of the volume; the cells of each by the name of the reader."""
    text = (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
    lines = find_table(text, "volumes that were written").splitlines()
    head, _, *cells = [[cell.strip().replace("`", "") for cell in line.strip("|").split("|")] for line in lines]
    return {row[0]: dict(zip(head[1:], row[1:], strict=True)) for row in cells}


def test_table_of_the_page_has_a_row_for_every_exported_volume(rows: dict[str, dict[str, str]]) -> None:
    assert list(rows) == NAMES
    assert len(NAMES) >= 60  # 16 scans in four kinds of files


WRITTEN = [(export, extension) for export, extension in EXPORTS if not export.refused(extension)]
REFUSED = [(export, extension) for export, extension in EXPORTS if export.refused(extension)]


def names_of(exports: list[tuple[Export, str]]) -> list[str]:
    return [f"{export.name}, {extension}" for export, extension in exports]


@pytest.mark.parametrize(("export", "extension"), WRITTEN, ids=names_of(WRITTEN))
def test_exported_volume_is_read_back_exactly(
    tmp_path: Path, rows: dict[str, dict[str, str]], export: Export, extension: str
) -> None:
    path, _ = write_export(export, extension, tmp_path)
    error = describe(read_with_clrecon(path), export.truth())  # mm, and W where something was warned of
    assert error.removesuffix(" W") == "0"
    assert error == rows[f"{export.name}, {extension}"]["clrecon"]


@pytest.mark.parametrize(("export", "extension"), WRITTEN, ids=names_of(WRITTEN))
def test_other_readers_get_an_exported_volume_exactly_or_refuse_it_as_the_page_says(
    tmp_path: Path, rows: dict[str, dict[str, str]], export: Export, extension: str
) -> None:
    path, _ = write_export(export, extension, tmp_path)
    for reader in OTHERS:
        cell = rows[f"{export.name}, {extension}"][reader]
        _, read, _ = PEERS[reader]
        if cell == "R":
            with pytest.raises(RuntimeError):
                read(path)
        elif cell != "-":  # it reads files of this extension
            assert describe((*read(path), False), export.truth()) == cell == "0", reader


@pytest.mark.parametrize(("export", "extension"), REFUSED, ids=names_of(REFUSED))
def test_volume_that_a_format_cannot_hold_is_refused_and_nothing_is_written(
    tmp_path: Path, rows: dict[str, dict[str, str]], export: Export, extension: str
) -> None:
    path, printed_errors = write_export(export, extension, tmp_path)
    assert export.refused(extension) in printed_errors
    assert not path.exists()
    assert rows[f"{export.name}, {extension}"]["clrecon"] == "R"
