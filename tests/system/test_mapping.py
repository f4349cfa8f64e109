"""Memory-mapped voxels: their mapping is found through views, and released pages are read again from the file."""

from __future__ import annotations

import mmap

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.system.memory import find_mapping

VOXELS = np.arange(6 * 64 * 64, dtype=np.int16).reshape(6, 64, 64)


@pytest.fixture
def voxel_file(tmp_path):
    """A file of `VOXELS`, to be mapped."""
    np.save(tmp_path / "voxels.npy", VOXELS)
    return tmp_path / "voxels.npy"


@pytest.mark.parametrize("mode", ["r", "r+"])
@pytest.mark.parametrize(
    "make_view",
    [
        pytest.param(lambda mapped: mapped, id="the mapped array"),
        pytest.param(np.asarray, id="a plain array"),
        pytest.param(lambda mapped: mapped[2:5], id="some slices"),
        pytest.param(lambda mapped: np.ascontiguousarray(mapped)[1:], id="slices of a contiguous array"),
    ],
)
def test_mapping_of_a_file_is_found_through_a_view_of_it(voxel_file, mode, make_view):
    view = make_view(np.load(voxel_file, mmap_mode=mode))
    mapping = find_mapping(view)
    assert mapping is not None
    assert mapping.address < view.ctypes.data < mapping.address + len(mapping.file)


def test_array_in_ordinary_memory_has_no_mapping():
    assert find_mapping(VOXELS) is None


def test_array_in_an_anonymous_mapping_has_no_mapping_of_a_file():
    anonymous = np.frombuffer(mmap.mmap(-1, VOXELS.nbytes), np.int16).reshape(VOXELS.shape)
    assert find_mapping(anonymous) is None


def test_value_written_to_a_private_mapping_is_kept_when_its_slices_are_released(voxel_file):
    """It stands in memory alone: a released page would be read from the file."""
    private = np.load(voxel_file, mmap_mode="c")
    private[0, 0, 0] = -5
    assert find_mapping(private) is None
    Volume(private, np.eye(4)).release_slices(first=0, end=6)
    assert private[0, 0, 0] == -5


@pytest.mark.parametrize(("first", "end"), [(0, 6), (1, 2), (5, 6), (3, 3)])
def test_released_slices_of_a_shared_mapping_keep_their_values(voxel_file, first, end):
    mapped = np.load(voxel_file, mmap_mode="r+")
    mapped[3, 2, 1] = -77
    expected = mapped.copy()
    volume = Volume(mapped, np.eye(4))
    volume.release_slices(first, end)
    assert np.array_equal(volume.voxels, expected)


def test_only_whole_pages_within_the_released_slices_are_released(voxel_file):
    mapped = np.load(voxel_file, mmap_mode="r")
    mapping = find_mapping(mapped)
    released = []

    class File:
        def madvise(self, option, start, length):
            released.append((start, length))

    object.__setattr__(mapping, "file", File())
    mapping.release(mapped[1:5])

    [(start, length)] = released
    begin = mapped[1].ctypes.data - mapping.address
    end = begin + mapped[1:5].nbytes
    assert start % mmap.PAGESIZE == 0
    assert length % mmap.PAGESIZE == 0
    assert begin <= start
    assert end - 2 * mmap.PAGESIZE < start + length <= end
