"""`Volume`: axis order, types, and the way to millimetres and back."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.grid import DEVICE_DTYPES

OBLIQUE = np.array([[0.7, 0.1, 0.05, -250.0], [-0.1, 0.5, 0.2, -300.0], [0.0, 0.05, 2.5, -846.0], [0, 0, 0, 1.0]])


def test_shape_is_reversed_between_subscripts_and_ijk():
    volume = Volume(np.zeros((5, 6, 7), np.int16), OBLIQUE)
    assert volume.voxels.shape == (5, 6, 7)
    assert volume.shape_ijk == (7, 6, 5)
    assert volume.spacing == pytest.approx(tuple(np.linalg.norm(OBLIQUE[:3, :3], axis=0)))


def test_ijk_to_lps_is_float64_and_inverted_by_lps_to_ijk():
    volume = Volume(np.zeros((5, 6, 7), np.int16), OBLIQUE)
    points = np.random.default_rng(3).uniform(-10, 500, (50, 3))
    mapped = volume.ijk_to_lps(points)
    assert mapped.dtype == np.float64
    assert np.allclose(mapped[0], OBLIQUE[:3, :3] @ points[0] + OBLIQUE[:3, 3])
    assert np.abs(volume.lps_to_ijk(mapped) - points).max() < 1e-9


def test_slice_origins_follow_the_slice_step():
    volume = Volume(np.zeros((3, 6, 7), np.int16), OBLIQUE)
    origins = volume.slice_origins(border=1)
    assert origins.shape == (5, 3)
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
def test_voxels_of_other_types_are_converted_once(given, kept):
    voxels = np.arange(24).reshape(2, 3, 4).astype(given)
    volume = Volume(voxels, np.eye(4))
    assert volume.voxels.dtype == np.dtype(kept)
    assert np.array_equal(volume.voxels, voxels)


def test_integers_are_kept_up_to_the_ends_of_32_bits():
    ends = np.array([[[-(2**31), 2**31 - 1]]], np.int64)
    assert Volume(ends, np.eye(4)).voxels.tolist() == ends.tolist()
    for further in (ends - 1, ends + 1):
        with refused(UsageError, 32, "bits"):
            Volume(further, np.eye(4))


def test_strided_voxels_are_made_contiguous():
    voxels = np.arange(120, dtype=np.int16).reshape(4, 5, 6)[::-1, :, ::2]
    volume = Volume(voxels, np.eye(4))
    assert volume.voxels.flags.c_contiguous
    assert np.array_equal(volume.voxels, voxels)


@pytest.mark.parametrize(
    ("voxels", "says"),
    [
        (np.zeros((3, 4)), "three axes"),
        (np.zeros((0, 3, 4)), "empty"),
        (np.zeros((2, 2, 2), complex), "complex"),
        (np.full((2, 2, 2), 2**40), "32 bits"),
    ],
)
def test_what_is_no_volume_is_refused(voxels, says):
    with pytest.raises(UsageError, match=says):
        Volume(voxels, np.eye(4))


def test_masked_and_ragged_voxels_are_refused():
    with refused(UsageError, "masked"):
        Volume(np.ma.masked_equal(np.arange(24).reshape(2, 3, 4), 5), np.eye(4))
    with refused(UsageError, "array", 2):
        Volume([[[1, 2], [3]]], np.eye(4))
    with refused(UsageError, "float32"):
        Volume(np.full((2, 2, 2), 1e300), np.eye(4))


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
thread = threading.Thread(target=lambda: np.unique([1, 2]), name="other")
thread.start()
while "numpy.ma" not in sys.modules:
    time.sleep(0.001)
print(Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)).shape_ijk)
thread.join()
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (run.stderr, run.stdout) == ("", "(2, 2, 2)\n")


@pytest.mark.parametrize("affine", ["x", [[1, 2], [3]], np.eye(4) * 1j, None])
def test_an_affine_is_numbers(affine):
    with refused(UsageError, "affine"):
        Volume(np.zeros((2, 2, 2), np.int16), affine)


def test_the_affine_cannot_be_changed_behind_the_inverse():
    volume = Volume(np.zeros((2, 3, 4), np.int16), np.eye(4))
    with refused(ValueError, "read-only"):
        volume.affine[0, 0] = 2.0
    assert volume.affine[0, 0] == 1.0


def test_the_range_of_values_is_found_when_it_is_asked_for():
    voxels = np.arange(24, dtype=np.int16).reshape(2, 3, 4) - 5
    volume = Volume(voxels, np.eye(4), {"warnings": [], "hu_range": [0.0, 1.0]})
    assert volume.hu_range == (-5.0, 18.0)
    assert volume.with_voxels(voxels * 2).hu_range == (-10.0, 36.0)
    assert volume.with_voxels(voxels * 2).report["hu_range"] == [-10.0, 36.0]
    voxels.flags.writeable = False  # what cannot change is believed
    assert Volume(voxels, np.eye(4), hu_range=(-7.0, 99.0)).hu_range == (-7.0, 99.0)


def test_the_range_of_values_leaves_out_what_is_no_number():
    voxels = np.full((2, 3, 4), np.nan, np.float32)
    assert Volume(voxels, np.eye(4)).hu_range is None
    voxels[1, 2, 3], voxels[1, 0, 0] = 7.5, np.inf
    assert Volume(voxels, np.eye(4)).hu_range == (7.5, 7.5)


@pytest.mark.parametrize("shown", ["itself", "read-only view"])
def test_the_range_of_values_follows_an_array_that_changes(shown):
    voxels = np.zeros((2, 3, 4), np.int16)
    given = voxels.view()
    given.flags.writeable = shown == "itself"
    volume = Volume(given, OBLIQUE)
    assert volume.hu_range == (0.0, 0.0)
    voxels[1, 2, 3] = 700
    assert volume.hu_range == (0.0, 700.0)
