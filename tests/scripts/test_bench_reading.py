"""The cases of reading, on series and trees of a few small files."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench_harness import FOLDER
from dicom_series import Plan, write_series

from clrecon.reading import list_series, read_volume

import inputs  # isort: skip
import reading  # isort: skip
import registry  # isort: skip
import trees  # isort: skip

PLAN = Plan(shape=(12, 32, 40), pixel_spacing=(0.7, 0.7))


def make_job(folder: Path, tmp_path: Path) -> Any:
    given = inputs.parse_input(f"small={folder}", tmp_path)
    return registry.Job(given, 226.0, 1, SimpleNamespace(index=0), 1, 60.0)


def test_a_tree_holds_series_that_can_be_read(tmp_path: Path) -> None:
    assert trees.write_tree(tmp_path / "tree", 3, 4) == 12
    listing = list_series(tmp_path / "tree")
    assert [entry.slices for entry in listing.series] == [4, 4, 4]
    assert {entry.gap_mm["max"] for entry in listing.series} == {trees.GAP_MM}
    assert (
        len({entry.uid_hash for entry in listing.series}) == len({entry.description for entry in listing.series}) == 3
    )


@pytest.mark.release
def test_all_readers_of_the_bench_read_the_same(tmp_path: Path) -> None:
    pytest.importorskip("SimpleITK")
    from peers.read_series import READERS

    write_series(tmp_path / "ct", PLAN)
    expected = read_volume(tmp_path / "ct").voxels
    assert set(READERS) == {"clrecon", "pydicom", "simpleitk"}
    for read in READERS.values():
        assert np.array_equal(read(str(tmp_path / "ct")), expected)


@pytest.mark.release
def test_reading_is_measured(tmp_path: Path) -> None:
    pytest.importorskip("SimpleITK")
    write_series(tmp_path / "ct", PLAN)
    figures = reading.measure_reading(make_job(tmp_path / "ct", tmp_path))
    assert {"pydicom_warm", "simpleitk_warm", "pydicom_process", "simpleitk_process"} <= set(figures["ratios"])
    assert figures["equal_shapes"] and figures["shapes"]["clrecon"] == [12, 32, 40] and figures["files"] == 12
    assert 0 < figures["scan_seconds_a_file"]["median"] < 1


@pytest.mark.release
def test_scans_of_trees_are_measured(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", PLAN)
    figures = reading.measure_scan_tree(make_job(tmp_path / "ct", tmp_path), ((2, 3), (4, 5)), 1)
    assert [(tree["files"], tree["series"]) for tree in figures["trees"]] == [(6, 2), (20, 4)]
    assert set(figures["ratios"]) == {"pydicom_headers"} and figures["processor_seconds_a_file_growth"] > 0


def test_the_folder_of_the_bench_is_the_one_tested() -> None:
    assert Path(reading.__file__).parent == FOLDER
