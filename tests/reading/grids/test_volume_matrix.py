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
    text = (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
    lines = find_table(text, "volumes that were written").splitlines()
    head, _, *cells = [[cell.strip().replace("`", "") for cell in line.strip("|").split("|")] for line in lines]
    return {row[0]: dict(zip(head[1:], row[1:], strict=True)) for row in cells}


def test_cases_of_grid_files_are_those_of_the_page(rows: dict[str, dict[str, str]]) -> None:
    assert list(rows) == NAMES and len(NAMES) >= 60


@pytest.mark.parametrize(("one", "extension"), EXPORTS, ids=NAMES)
def test_a_volume_comes_back_as_it_was(
    tmp_path: Path, rows: dict[str, dict[str, str]], one: Export, extension: str
) -> None:
    row = rows[f"{one.name}, {extension}"]
    path, said = write_export(one, extension, tmp_path)
    words = one.refused(extension)
    if words:
        assert words in said and not path.exists() and row["clrecon"] == "R"
        return
    truth = one.truth()
    assert describe(read_with_clrecon(path), truth) == row["clrecon"]
    assert row["clrecon"].removesuffix(" W") == "0"
    for peer in OTHERS:
        if row[peer] == "R":
            with pytest.raises(RuntimeError):
                PEERS[peer][1](path)
        elif row[peer] != "-":
            assert describe((*PEERS[peer][1](path), False), truth) == row[peer] == "0", peer
