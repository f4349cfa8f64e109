"""Filters of other packages: what they do to a ball in noise, their reports, and refusals in one line."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from refusals import refused
from surface_volumes import OBLIQUE
from uneven_volume import uneven

import clrecon
from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.operators.filters.denoisers import DENOISERS, ITK_TIME_STEP

SPACING = np.diag((0.7, 0.7, 1.0, 1.0))


SLICES, NOISE_HU = 14, 20.0


def clean_ball() -> np.ndarray:
    """A ball of 120 HU in 20 HU."""
    k, j, i = np.indices((SLICES, 50, 60))
    return np.where((k - 6.5) ** 2 + (j - 24.5) ** 2 + (i - 29.5) ** 2 < 30.0, 120.0, 20.0)


def noisy_ball() -> Volume:
    clean = clean_ball()
    voxels = clean + np.random.default_rng(4).normal(0.0, NOISE_HU, clean.shape)
    return Volume(np.rint(voxels).astype(np.int16), SPACING)


NAMES = pytest.mark.parametrize("name", DENOISERS)


@NAMES
def test_a_filter_takes_three_tenths_off_the_noise_and_keeps_type_and_place(name):
    volume = noisy_ball()
    filtered = clrecon.filter_volume(volume, name)
    beside_the_ball = (slice(2, -2), slice(2, 12), slice(2, -2))
    before, after = ((each.voxels - clean_ball())[beside_the_ball].std() for each in (volume, filtered))
    assert after < 0.7 * before  # measured 0.11 to 0.43 of it
    assert filtered.voxels.dtype == np.int16
    assert np.array_equal(filtered.affine, volume.affine)


@pytest.mark.parametrize("name", [name for name, denoiser in DENOISERS.items() if denoiser.package])
def test_report_of_a_filter_names_it_and_its_package(name):
    (step,) = clrecon.filter_volume(noisy_ball(), name).report["filtered"]["steps"]
    assert step["filter"] == name
    assert step["package"].split()[0] in ("SimpleITK", "scipy")


@NAMES
def test_progress_of_a_filter_is_told_from_no_slice_to_all(name):
    told = []
    clrecon.filter_volume(noisy_ball(), name, progress=lambda *step: told.append(step))
    assert told[0] == ("filter", 0, SLICES)
    assert told[-1] == ("filter", SLICES, SLICES)


@pytest.mark.parametrize(("axis", "step_mm"), [(0, 1.0), (1, 0.7), (2, 0.7)], ids="kji")
def test_a_gaussian_spreads_an_impulse_by_its_sigma_in_mm_along_each_axis(axis, step_mm):
    voxels = np.zeros((31, 41, 41), np.float32)
    voxels[15, 20, 20] = 1.0
    sigma_mm = 2.0
    spread = clrecon.filter_volume(Volume(voxels, SPACING), "gaussian", sigma_mm=sigma_mm).voxels.astype(np.float64)
    places = (np.arange(spread.shape[axis]) - (spread.shape[axis] - 1) / 2) * step_mm
    along = spread.sum(axis=tuple({0, 1, 2} - {axis}))
    assert np.sqrt((along * places**2).sum() / along.sum()) == pytest.approx(sigma_mm, rel=0.001)  # measured 0.0005


def test_filter_of_a_device_volume_gives_a_device_volume(device):
    volume = noisy_ball()
    with clrecon.DeviceVolume(volume, device=device) as resident:
        made = clrecon.filter_volume(resident, "median")
        assert isinstance(made, clrecon.DeviceVolume) and made.device is resident.device
        np.testing.assert_array_equal(made.volume.voxels, clrecon.filter_volume(volume, "median").voxels)


FAST_EXP = 0.06
"""Relative error of the weights of scikit-image, whose exponential is that of N. Schraudolph, 1999."""


def test_non_local_means_are_those_of_scikit_image(device):
    restoration = pytest.importorskip("skimage.restoration")
    volume = noisy_ball()
    floats = Volume(volume.voxels.astype(np.float32), SPACING)
    means = clrecon.filter_volume(floats, "non-local-means", sigma_hu=NOISE_HU, patch=5, reach=6, device=device)
    recommended = {"patch_size": 5, "patch_distance": 6, "h": 0.8 * NOISE_HU, "sigma": NOISE_HU}  # h as by A. Buades
    expected = [
        restoration.denoise_nl_means(layer, **recommended, preserve_range=True)
        for layer in floats.voxels.astype(np.float64)
    ]
    # Means of voxels that differ from each other by the noise.
    np.testing.assert_allclose(means.voxels, np.stack(expected), rtol=0.0, atol=FAST_EXP * NOISE_HU)  # measured 0.87


def test_one_lane_and_eight_find_the_same_means(device, monkeypatch):
    floats = Volume(noisy_ball().voxels.astype(np.float32), SPACING)
    means = clrecon.filter_volume(floats, "non-local-means", sigma_hu=20.0, device=device)
    lanes = "1" if device.kernel_variants["LANES"] == "8" else "8"
    monkeypatch.setattr(device, "kernel_variants", {**device.kernel_variants, "LANES": lanes})
    others = clrecon.filter_volume(floats, "non-local-means", sigma_hu=20.0, device=device)
    np.testing.assert_array_equal(means.voxels, others.voxels)


def test_non_local_means_are_the_same_in_slabs(device):
    volume = noisy_ball()
    whole = clrecon.filter_volume(volume, "non-local-means", device=device)
    filtered_slices = []
    in_slabs = clrecon.filter_volume(
        volume, "non-local-means", device=device, memory=500_000, progress=lambda *step: filtered_slices.append(step[1])
    )
    assert set(filtered_slices) > {0, SLICES}, "the memory holds all slices at once"
    np.testing.assert_array_equal(whole.voxels, in_slabs.voxels)


def test_non_local_means_without_room_for_a_slice_are_refused(device):
    with refused(DeviceError, "slice", "memory"):
        clrecon.filter_volume(noisy_ball(), "non-local-means", device=device, memory=100_000)


def test_median_on_a_device_is_refused(device):
    with refused(UsageError, "median", "device"):
        clrecon.filter_volume(noisy_ball(), "median", device=device)


ODD_STACKS = pytest.mark.parametrize(
    "volume", [uneven(), Volume(np.zeros((4, 5, 6), np.int16), OBLIQUE)], ids=["uneven", "sheared"]
)


@ODD_STACKS
@pytest.mark.parametrize("name", ["median", "gaussian", "curvature-flow"])
def test_uneven_and_sheared_stacks_are_refused_by_filters_of_itk(volume, name):
    with pytest.raises(UsageError, match=f"unevenly spaced|sheared by .* degrees, and {name} takes them"):
        clrecon.filter_volume(volume, name)


@ODD_STACKS
def test_uneven_and_sheared_stacks_stay_so_through_non_local_means(volume):
    assert clrecon.filter_volume(volume, "non-local-means", sigma_hu=10.0).uneven is volume.uneven


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
def test_wrong_parameters_of_filters_of_other_packages_are_refused_in_one_line(name, parameters, words):
    with pytest.raises(UsageError, match=words) as refused:
        clrecon.filter_volume(noisy_ball(), name, **parameters)
    assert "\n" not in str(refused.value)


def test_filter_of_voxels_of_nan_is_refused():
    voxels = np.zeros((3, 4, 5), np.float32)
    voxels[1, 2, 3] = np.nan
    with refused(UsageError, "NaN", "voxels"):
        clrecon.filter_volume(Volume(voxels, SPACING), "median")


def test_filter_of_an_array_is_refused():
    with refused(UsageError, "Volume"):
        clrecon.filter_volume(np.zeros((3, 4, 5), np.float32), "median")  # type: ignore[type-var]


def test_filter_without_its_package_is_refused_with_its_name(monkeypatch):
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with refused(UsageError, "SimpleITK", "median"):
        clrecon.filter_volume(noisy_ball(), "median")


@pytest.mark.parametrize(
    ("radius_mm", "window"), [(0.35, [3, 3, 1]), (0.5, [3, 3, 3]), (1.05, [5, 5, 3]), (1.4, [5, 5, 3])]
)
def test_a_median_takes_the_voxels_nearest_to_its_radius(radius_mm, window):
    """In steps of 0.7, 0.7 and 1 mm: 0.35 mm is half a step, 1.05 mm one and a half, and halves are rounded up."""
    filtered = clrecon.filter_volume(noisy_ball(), "median", radius_mm=radius_mm)
    (step,) = filtered.report["filtered"]["steps"]
    assert step["window"] == window and step["radius_mm"] == radius_mm


@pytest.mark.parametrize(
    ("spacing", "share"),
    [((0.7, 0.7, 1.0), 0.7**2), ((2.0, 3.0, 2.5), 1.0)],
    ids=["smaller than 1 mm: by its square", "larger: that of 1 mm"],
)
def test_curvature_flow_takes_the_longest_step_that_is_stable_for_its_smallest_spacing(spacing, share):
    volume = Volume(noisy_ball().voxels, np.diag((*spacing, 1.0)))
    (step,) = clrecon.filter_volume(volume, "curvature-flow", iterations=1).report["filtered"]["steps"]
    assert step["time_step"] == pytest.approx(share * ITK_TIME_STEP, rel=1e-12)  # float64


def test_a_volume_of_one_column_is_filtered_as_one_of_one_row():
    plane = np.random.default_rng(0).normal(0.0, 20.0, (5, 30)).astype(np.int16)
    column, row = (
        clrecon.filter_volume(Volume(np.expand_dims(plane, axis), np.eye(4)), "non-local-means", sigma_hu=20.0).voxels
        for axis in (2, 1)
    )
    np.testing.assert_array_equal(column[:, :, 0], row[:, 0, :])
    assert column.std() < 0.5 * plane.std()  # measured 0.37 of it
