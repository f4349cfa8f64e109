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
    """A job of one pair of times on a series."""
    given = inputs.parse_input(f"small={folder}", tmp_path)
    return registry.Job(given, hu=226.0, pairs=1, device=SimpleNamespace(index=0), peer_threads=1, limit_s=60.0)


def test_written_tree_has_three_different_series_of_four_slices(tmp_path: Path) -> None:
    assert trees.write_tree(tmp_path / "tree", series=3, slices=4) == 3 * 4  # files
    series = list_series(tmp_path / "tree").series
    assert [entry.slices for entry in series] == [4, 4, 4]
    assert len({entry.uid_hash for entry in series}) == 3
    assert len({entry.description for entry in series}) == 3


def test_slices_of_a_written_tree_are_a_gap_apart(tmp_path: Path) -> None:
    trees.write_tree(tmp_path / "tree", series=1, slices=4)
    [entry] = list_series(tmp_path / "tree").series
    assert entry.gap_mm["max"] == trees.GAP_MM


@pytest.fixture
def series_folder(tmp_path: Path) -> Path:
    """A series of 12 slices of 32 x 40 pixels."""
    write_series(tmp_path / "ct", PLAN)
    return tmp_path / "ct"


@pytest.mark.release
@pytest.mark.parametrize("name", ["clrecon", "pydicom", "simpleitk"])
def test_reader_of_the_bench_reads_the_voxels_of_the_library(name: str, series_folder: Path) -> None:
    pytest.importorskip("SimpleITK")
    from peers.read_series import READERS

    assert np.array_equal(READERS[name](str(series_folder)), read_volume(series_folder).voxels)


@pytest.mark.release
def test_reading_of_a_series_is_timed_against_pydicom_and_simpleitk_warm_and_in_a_process(
    series_folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("SimpleITK")
    figures = reading.measure_reading(make_job(series_folder, tmp_path))
    assert {"pydicom_warm", "simpleitk_warm", "pydicom_process", "simpleitk_process"} <= set(figures["ratios"])
    assert figures["equal_shapes"]
    assert figures["shapes"]["clrecon"] == list(PLAN.shape)
    assert figures["files"] == PLAN.shape[0]
    assert 0 < figures["scan_seconds_a_file"]["median"] < 1  # of small files


@pytest.mark.release
def test_scan_of_trees_is_timed_against_pydicom_for_each_size(series_folder: Path, tmp_path: Path) -> None:
    sizes = ((2, 3), (4, 5))  # series, slices of each
    figures = reading.measure_scan_tree(make_job(series_folder, tmp_path), sizes, runs=1)
    assert [(tree["series"], tree["files"]) for tree in figures["trees"]] == [(2, 2 * 3), (4, 4 * 5)]
    assert set(figures["ratios"]) == {"pydicom_headers"}
    assert figures["processor_seconds_a_file_growth"] > 0


def test_modules_of_the_bench_are_those_of_this_project() -> None:
    assert Path(reading.__file__).parent == FOLDER
