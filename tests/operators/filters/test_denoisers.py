"""Filters of other packages: what they do to a ball in noise, their reports, and refusals in one line."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from refusals import refused
from surface_volumes import OBLIQUE
from uneven_volume import uneven

import clrecon
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.operators.filters.denoisers import DENOISERS, ITK_TIME_STEP

SPACING = np.diag((0.7, 0.7, 1.0, 1.0))


def noisy(noise: float = 20.0) -> tuple[Volume, np.ndarray]:
    """A ball of 120 HU in 20 HU, and the same without noise."""
    k, j, i = np.indices((14, 50, 60))
    clean = np.where((k - 6.5) ** 2 + (j - 24.5) ** 2 + (i - 29.5) ** 2 < 30.0, 120.0, 20.0)
    voxels = clean + np.random.default_rng(4).normal(0.0, noise, clean.shape)
    return Volume(np.rint(voxels).astype(np.int16), SPACING), clean


@pytest.mark.parametrize("name", DENOISERS)
def test_noise_goes_and_the_report_says_how(name):
    volume, clean = noisy()
    told = []
    made = clrecon.filter_volume(volume, name, progress=lambda *step: told.append(step))
    assert made.voxels.dtype == np.int16 and np.array_equal(made.affine, volume.affine)
    even = (slice(2, -2), slice(2, 12), slice(2, -2))
    assert (made.voxels - clean)[even].std() < 0.7 * (volume.voxels - clean)[even].std()
    (step,) = made.report["filtered"]["steps"]
    assert step["filter"] == name and step["package"].split()[0] in ("SimpleITK", "skimage")
    assert told[0] == ("filter", 0, 14) and told[-1] == ("filter", 14, 14)


def test_lengths_of_filters_are_in_mm():
    """An impulse spreads as far in mm along each axis."""
    voxels = np.zeros((31, 41, 41), np.float32)
    voxels[15, 20, 20] = 1.0
    made = clrecon.filter_volume(Volume(voxels, SPACING), "gaussian", sigma_mm=2.0).voxels.astype(np.float64)
    for axis, step in ((0, 1.0), (1, 0.7), (2, 0.7)):
        places = (np.arange(made.shape[axis]) - (made.shape[axis] - 1) / 2) * step
        along = made.sum(axis=tuple({0, 1, 2} - {axis}))
        assert np.sqrt((along * places**2).sum() / along.sum()) == pytest.approx(2.0, rel=0.01)
    wide = clrecon.filter_volume(noisy()[0], "median", radius_mm=1.4)
    assert wide.report["filtered"]["steps"][0]["window"] == [5, 5, 3]


def test_filter_of_a_device_volume_gives_a_device_volume(device):
    volume, _ = noisy()
    with clrecon.DeviceVolume(volume, device=device) as resident:
        made = clrecon.filter_volume(resident, "median")
        assert isinstance(made, clrecon.DeviceVolume) and made.device is resident.device
        np.testing.assert_array_equal(made.volume.voxels, clrecon.filter_volume(volume, "median").voxels)


@pytest.mark.parametrize(
    "volume", [uneven(), Volume(np.zeros((4, 5, 6), np.int16), OBLIQUE)], ids=["uneven", "sheared"]
)
@pytest.mark.parametrize("name", ["median", "gaussian", "curvature-flow"])
def test_odd_stacks_are_refused(volume, name):
    with pytest.raises(UsageError, match=f"unevenly spaced|sheared by .* degrees, and {name} takes them"):
        clrecon.filter_volume(volume, name)
    made = clrecon.filter_volume(volume, "non-local-means", sigma_hu=10.0)
    assert made.uneven is volume.uneven


@pytest.mark.parametrize(
    ("name", "parameters", "words"),
    [
        ("bilateral", {}, "there is no filter 'bilateral': it is one of median, gaussian"),
        ("median", {"sigma_mm": 1.0}, "median has no parameter sigma_mm: it has radius_mm"),
        ("median", {"radius_mm": 0.1}, "radius_mm=0.1 is less than half a voxel"),
        ("median", {"radius_mm": 500}, "radius_mm is 500 mm, larger than the volume"),
        ("gaussian", {"sigma_mm": 0}, "sigma_mm is a length in mm above 0, not 0"),
        ("gaussian", {"sigma_mm": float("nan")}, "sigma_mm is a length in mm above 0, not nan"),
        ("curvature-flow", {"iterations": 0}, "iterations is a whole number from 1 to 1000, not 0"),
        ("curvature-flow", {"time_step": -1}, "time_step is a number above 0"),
        ("non-local-means", {"patch": 2.5}, "patch is a whole number from 3 to 31, not 2.5"),
        ("non-local-means", {"sigma_hu": -1.0}, "sigma_hu is a number above 0"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(name, parameters, words):
    with pytest.raises(UsageError, match=words) as refused:
        clrecon.filter_volume(noisy()[0], name, **parameters)
    assert "\n" not in str(refused.value)


def test_nan_and_missing_packages_are_told(monkeypatch):
    voxels = np.zeros((3, 4, 5), np.float32)
    voxels[1, 2, 3] = np.nan
    with refused(UsageError, "NaN", "voxels"):
        clrecon.filter_volume(Volume(voxels, SPACING), "median")
    with refused(UsageError, "Volume"):
        clrecon.filter_volume(voxels, "median")  # type: ignore[type-var]
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with refused(UsageError, "SimpleITK", "median"):
        clrecon.filter_volume(noisy()[0], "median")


@pytest.mark.parametrize(("radius_mm", "window"), [(0.35, [3, 3, 1]), (0.5, [3, 3, 3]), (1.05, [5, 5, 3])])
def test_a_median_takes_the_voxels_nearest_to_its_radius(radius_mm, window):
    made = clrecon.filter_volume(noisy()[0], "median", radius_mm=radius_mm)
    (step,) = made.report["filtered"]["steps"]
    assert step["window"] == window and step["radius_mm"] == radius_mm


@pytest.mark.parametrize(("spacing", "share"), [((0.7, 0.7, 1.0), 0.49), ((2.0, 3.0, 2.5), 1.0)])
def test_curvature_flow_takes_the_longest_stable_step(spacing, share):
    volume = Volume(noisy()[0].voxels, np.diag((*spacing, 1.0)))
    (step,) = clrecon.filter_volume(volume, "curvature-flow", iterations=1).report["filtered"]["steps"]
    assert step["time_step"] == pytest.approx(share * ITK_TIME_STEP, rel=1e-12)


def test_a_volume_of_one_column_is_filtered_as_one_of_one_row():
    pytest.importorskip("skimage")
    plane = np.random.default_rng(0).normal(0.0, 20.0, (5, 30)).astype(np.int16)
    column, row = (
        clrecon.filter_volume(Volume(np.expand_dims(plane, axis), np.eye(4)), "non-local-means", sigma_hu=20.0).voxels
        for axis in (2, 1)
    )
    np.testing.assert_array_equal(column[:, :, 0], row[:, 0, :])
    assert column.std() < 0.5 * plane.std()
