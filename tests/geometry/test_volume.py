"""`Volume`: axis order, types, and the way to millimetres and back."""

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.grid import DEVICE_DTYPES
from clrecon.system import memory

OBLIQUE = np.array([[0.7, 0.1, 0.05, -250.0], [-0.1, 0.5, 0.2, -300.0], [0.0, 0.05, 2.5, -846.0], [0, 0, 0, 1.0]])


def test_shape_is_reversed_between_subscripts_and_ijk():
    volume = Volume(np.zeros((5, 6, 7), np.int16), OBLIQUE)
    assert volume.voxels.shape == (5, 6, 7)
    assert volume.shape_ijk == (7, 6, 5)


def test_spacing_is_the_length_of_the_columns_of_the_affine():
    volume = Volume(np.zeros((5, 6, 7), np.int16), OBLIQUE)
    assert volume.spacing == pytest.approx(tuple(np.linalg.norm(OBLIQUE[:3, :3], axis=0)))


def test_indices_are_mapped_by_the_affine_in_float64_and_back():
    volume = Volume(np.zeros((5, 6, 7), np.int16), OBLIQUE)
    ijk = np.random.default_rng(3).uniform(-10, 500, (50, 3))
    lps = volume.ijk_to_lps(ijk)
    assert lps.dtype == np.float64
    assert np.allclose(lps, ijk @ OBLIQUE[:3, :3].T + OBLIQUE[:3, 3])
    assert np.abs(volume.lps_to_ijk(lps) - ijk).max() < tolerances.FLOAT64_PLACE_MM


def test_slice_origins_with_a_border_are_the_first_voxels_of_all_slices_and_one_beyond_either_end():
    volume = Volume(np.zeros((3, 6, 7), np.int16), OBLIQUE)
    origins = volume.slice_origins(border=1)
    assert np.allclose(origins, volume.ijk_to_lps([(0, 0, k) for k in (-1, 0, 1, 2, 3)]))


@pytest.mark.parametrize("dtype", DEVICE_DTYPES)
def test_device_types_are_kept_without_a_copy(dtype):
    voxels = np.ones((2, 3, 4), dtype)
    volume = Volume(voxels, np.eye(4))
    assert volume.voxels.dtype == dtype
    assert np.shares_memory(volume.voxels, voxels)


@pytest.mark.parametrize(
    ("given", "kept"),
    [("bool", "uint8"), ("float64", "float32"), ("int64", "int32"), (">i2", "int16"), ("uint32", "int32")],
)
def test_voxels_of_other_types_are_converted_with_their_values(given, kept):
    voxels = np.arange(24).reshape(2, 3, 4).astype(given)
    volume = Volume(voxels, np.eye(4))
    assert volume.voxels.dtype == np.dtype(kept)
    assert np.array_equal(volume.voxels, voxels)


def make_dask_array(voxels):
    return pytest.importorskip("dask.array").from_array(voxels, chunks=(2, 3, 3))


def make_zarr_array(voxels):
    return pytest.importorskip("zarr").array(voxels, chunks=(2, 3, 3))


class ArrayOfHdf5:
    """An array in chunks that gives its slices alone, and as which h5py's are read."""

    def __init__(self, voxels):
        self._voxels, self.chunks = voxels, (2, 3, 3)
        self.shape, self.dtype, self.ndim = voxels.shape, voxels.dtype, voxels.ndim

    def __getitem__(self, slices):
        return self._voxels[slices]


@pytest.mark.parametrize("make_array", [make_dask_array, make_zarr_array, ArrayOfHdf5])
@pytest.mark.parametrize("is_larger_than_memory", [False, True], ids=["in memory", "in a file"])
@pytest.mark.parametrize(("given", "kept"), [("int16", "int16"), ("float64", "float32"), ("bool", "uint8")])
def test_array_in_chunks_becomes_the_volume_of_its_values(make_array, is_larger_than_memory, given, kept, monkeypatch):
    voxels = np.random.default_rng(5).integers(0, 2, (7, 5, 4)).astype(given)
    if is_larger_than_memory:
        monkeypatch.setattr(memory, "available_memory_bytes", lambda: 1)
    volume = Volume(make_array(voxels), np.eye(4))
    assert volume.dtype == kept
    assert np.array_equal(volume.voxels, voxels)
    assert (memory.find_mapping(volume.voxels) is not None) == is_larger_than_memory


def test_volume_in_a_file_without_a_name_is_sent_with_its_values(monkeypatch):
    voxels = np.random.default_rng(5).integers(-1024, 3000, (7, 5, 4)).astype(np.int16)
    monkeypatch.setattr(memory, "available_memory_bytes", lambda: 1)
    volume = Volume(make_dask_array(voxels), np.eye(4))
    assert np.array_equal(pickle.loads(pickle.dumps(volume)).voxels, voxels)


def test_integers_are_kept_up_to_the_ends_of_32_bits():
    ends = np.array([[[-(2**31), 2**31 - 1]]], np.int64)
    assert Volume(ends, np.eye(4)).voxels.tolist() == ends.tolist()


@pytest.mark.parametrize("value", [-(2**31) - 1, 2**31])
def test_integers_beyond_32_bits_are_refused(value):
    with refused(UsageError, 32, "bits"):
        Volume(np.array([[[0, value]]], np.int64), np.eye(4))


def test_strided_voxels_are_made_contiguous():
    voxels = np.arange(120, dtype=np.int16).reshape(4, 5, 6)[::-1, :, ::2]
    volume = Volume(voxels, np.eye(4))
    assert volume.voxels.flags.c_contiguous
    assert np.array_equal(volume.voxels, voxels)


@pytest.mark.parametrize(
    ("voxels", "words"),
    [
        (np.zeros((3, 4)), "three axes"),
        (np.zeros((0, 3, 4)), "empty"),
        (np.zeros((2, 2, 2), complex), "complex"),
        (np.full((2, 2, 2), 2**40), "32 bits"),
        (np.ma.masked_equal(np.arange(24).reshape(2, 3, 4), 5), "masked"),
        ([[[1, 2], [3]]], "array"),
        (np.full((2, 2, 2), 1e300), "float32"),
    ],
    ids=["two axes", "no slice", "complex", "beyond 32 bits", "masked", "ragged", "beyond float32"],
)
def test_arrays_that_are_no_voxels_are_refused(voxels, words):
    with pytest.raises(UsageError, match=words):
        Volume(voxels, np.eye(4))


def test_a_volume_is_made_while_another_thread_loads_masked_arrays():
    code = """
import builtins, sys, threading, time
import numpy as np
from clrecon.geometry import Volume
load = builtins.__import__
def slow(name, *rest):
    if threading.current_thread().name == "other" and sys.modules.get("numpy.ma") is not None:
        time.sleep(0.02)
    return load(name, *rest)
builtins.__import__ = slow
thread = threading.Thread(target=lambda: __import__("numpy.ma"), name="other")
thread.start()
while "numpy.ma" not in sys.modules:
    time.sleep(0.001)
print(Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)).shape_ijk)
thread.join()
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (run.stderr, run.stdout) == ("", "(2, 2, 2)\n")


@pytest.mark.parametrize(
    "affine", ["x", [[1, 2], [3]], np.eye(4) * 1j, None], ids=["text", "ragged", "complex", "None"]
)
def test_an_affine_that_is_no_matrix_of_real_numbers_is_refused(affine):
    with refused(UsageError, "affine"):
        Volume(np.zeros((2, 2, 2), np.int16), affine)


def test_the_affine_of_a_volume_cannot_be_changed_in_place():
    volume = Volume(np.zeros((2, 3, 4), np.int16), np.eye(4))
    with refused(ValueError, "read-only"):
        volume.affine[0, 0] = 2.0
    assert volume.affine[0, 0] == 1.0


def test_the_range_of_values_is_that_of_the_voxels_whatever_the_report_says():
    voxels = np.arange(24, dtype=np.int16).reshape(2, 3, 4) - 5
    volume = Volume(voxels, np.eye(4), {"warnings": [], "hu_range": [0.0, 1.0]})
    assert volume.hu_range == (-5.0, 18.0)


def test_a_volume_with_other_voxels_has_their_range_also_in_its_report():
    voxels = np.arange(24, dtype=np.int16).reshape(2, 3, 4) - 5
    doubled = Volume(voxels, np.eye(4), {"warnings": [], "hu_range": [0.0, 1.0]}).with_voxels(voxels * 2)
    assert doubled.hu_range == (-10.0, 36.0)
    assert doubled.report["hu_range"] == [-10.0, 36.0]


def test_a_given_range_of_voxels_that_cannot_change_is_taken_without_a_search():
    voxels = np.zeros((2, 3, 4), np.int16)
    voxels.flags.writeable = False
    assert Volume(voxels, np.eye(4), hu_range=(-7.0, 99.0)).hu_range == (-7.0, 99.0)


def test_the_range_of_values_leaves_out_nan_and_infinity():
    voxels = np.full((2, 3, 4), np.nan, np.float32)
    voxels[1, 2, 3] = 7.5
    voxels[1, 0, 0] = np.inf
    assert Volume(voxels, np.eye(4)).hu_range == (7.5, 7.5)


def test_voxels_of_nan_alone_have_no_range():
    assert Volume(np.full((2, 3, 4), np.nan, np.float32), np.eye(4)).hu_range is None


@pytest.mark.parametrize("shown", ["itself", "read-only view"])
def test_the_range_of_values_follows_an_array_that_changes(shown):
    voxels = np.zeros((2, 3, 4), np.int16)
    given = voxels.view()
    given.flags.writeable = shown == "itself"
    volume = Volume(given, OBLIQUE)
    assert volume.hu_range == (0.0, 0.0)
    voxels[1, 2, 3] = 700
    assert volume.hu_range == (0.0, 700.0)
