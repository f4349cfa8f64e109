"""Memory-mapped voxels: found through views, and let go without losing anything."""

from __future__ import annotations

import mmap

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.system.memory import find_mapping

VOXELS = np.arange(6 * 64 * 64, dtype=np.int16).reshape(6, 64, 64)


@pytest.fixture
def file(tmp_path):
    np.save(tmp_path / "voxels.npy", VOXELS)
    return tmp_path / "voxels.npy"


@pytest.mark.parametrize("mode", ["r", "r+"])
def test_a_mapping_is_found_through_views(file, mode):
    mapped = np.load(file, mmap_mode=mode)
    for view in (mapped, np.asarray(mapped), mapped[2:5], np.ascontiguousarray(mapped)[1:]):
        mapping = find_mapping(view)
        assert mapping is not None
        assert mapping.address < view.ctypes.data < mapping.address + len(mapping.file)


def test_ordinary_memory_and_private_mappings_are_left_alone(file):
    private = np.load(file, mmap_mode="c")
    private[0, 0, 0] = -5
    assert find_mapping(private) is None
    assert find_mapping(VOXELS) is None
    anonymous = np.frombuffer(mmap.mmap(-1, VOXELS.nbytes), np.int16).reshape(VOXELS.shape)
    assert find_mapping(anonymous) is None
    Volume(private, np.eye(4)).release_slices(0, 6)
    assert private[0, 0, 0] == -5


def test_released_slices_are_read_again(file):
    mapped = np.load(file, mmap_mode="r+")
    mapped[3, 2, 1] = -77
    volume = Volume(mapped, np.eye(4))
    for first, end in [(0, 6), (1, 2), (5, 6), (3, 3)]:
        volume.release_slices(first, end)
    assert volume.voxels[3, 2, 1] == -77
    assert np.array_equal(volume.voxels[4:], VOXELS[4:])


def test_releasing_takes_whole_pages_within_the_part(file, monkeypatch):
    mapped = np.load(file, mmap_mode="r")
    mapping = find_mapping(mapped)
    calls = []

    class File:
        def madvise(self, option, start, length):
            calls.append((start, length))

    object.__setattr__(mapping, "file", File())
    mapping.release(mapped[1:5])
    ((start, length),) = calls
    begin = mapped[1].ctypes.data - mapping.address
    assert start % mmap.PAGESIZE == length % mmap.PAGESIZE == 0
    assert begin <= start and start + length <= begin + 4 * mapped[1].nbytes
