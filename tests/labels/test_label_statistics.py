"""Volume and HU of labels: known answers on even, uneven, tilted and odd grids, and numpy as a second opinion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused
from uneven_volume import HEIGHTS, uneven

import clrecon
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.labels.resample import ResampledLabels
from clrecon.labels.statistics import LabelFigures, measure_labels, measure_resampled

AFFINE = np.array([[0.7, 0.1, 0.05, -25.0], [-0.1, 0.5, 0.2, -30.0], [0.0, 0.05, 2.5, -84.0], [0, 0, 0, 1.0]])


VOXEL_ML = abs(np.linalg.det(AFFINE[:3, :3])) / 1000.0


def random_scan_and_labels(dtype: str = "int16") -> tuple[Volume, LabelMap]:
    """Return random HU, and a map of the labels 2, "liver", and 9, without a name, on the same voxels."""
    random = np.random.default_rng(3)
    values = random.integers(-900, 1500, (5, 7, 9)).astype(dtype)
    if dtype == "int32":  # more levels than are counted one by one
        values[0, 0, :] = 2_000_000
    labels = random.choice(np.array([0, 0, 2, 9], np.uint8), values.shape)
    return Volume(values, AFFINE), LabelMap(labels, AFFINE, {2: "liver"})


@pytest.mark.parametrize("dtype", ["int16", "float32", "int32"])
def test_hu_figures_of_each_label_are_those_of_numpy(dtype: str) -> None:
    volume, labels = random_scan_and_labels(dtype)
    percentiles = [0, 2.5, 50, 95, 100]

    liver, unnamed = clrecon.measure_labels(volume, labels, percentiles=percentiles)

    for figures, number in ((liver, 2), (unnamed, 9)):
        values = volume.voxels[labels.voxels == number].astype(np.float64)
        expected = np.percentile(values, percentiles, method="inverted_cdf")
        assert (figures.min_hu, figures.max_hu) == (values.min(), values.max())
        assert figures.mean_hu == pytest.approx(values.mean(), rel=tolerances.LABEL_FLOAT64)
        assert figures.sd_hu == pytest.approx(values.std(), rel=tolerances.LABEL_SD_FLOAT64)
        assert list(figures.percentiles_hu.values()) == expected.tolist()


def test_volume_of_each_label_is_its_voxels_times_that_of_one() -> None:
    volume, labels = random_scan_and_labels()

    liver, unnamed = clrecon.measure_labels(volume, labels)

    for figures, number in ((liver, 2), (unnamed, 9)):
        voxels = np.count_nonzero(labels.voxels == number)
        assert figures.voxels == voxels
        assert figures.ml == pytest.approx(voxels * VOXEL_ML, rel=tolerances.LABEL_FLOAT64)


def test_figures_carry_number_and_name_of_their_label() -> None:
    volume, labels = random_scan_and_labels()
    figures = clrecon.measure_labels(volume, labels)
    assert [(label.number, label.name) for label in figures] == [(2, "liver"), (9, "label_9")]


def test_labels_on_the_grid_of_the_scan_lie_inside_of_it_without_a_warning() -> None:
    volume, labels = random_scan_and_labels()
    for figures, number in zip(clrecon.measure_labels(volume, labels), (2, 9), strict=True):
        label_ml = np.count_nonzero(labels.voxels == number) * VOXEL_ML
        assert figures.label_ml == pytest.approx(label_ml, rel=tolerances.LABEL_FLOAT64)
        assert (figures.inside_share, figures.unmeasured, figures.warnings) == (1.0, 0, [])


UNEVEN_SLICES = slice(2, 5)
"""Slices 2, 3 and 4 of the uneven stack carry label 3, in 3 rows and 2 columns; their HU are 200, 300 and 400."""
UNEVEN_HU = np.array([200.0, 300.0, 400.0])
UNEVEN_MM = (HEIGHTS[3:6] - HEIGHTS[1:4]) / 2.0  # half way to the slices on either side


def measure_on_uneven_slices(percentiles: tuple[float, ...] = (50,)) -> tuple[LabelFigures, Volume]:
    """The figures of label 3, and the scan."""
    voxels = np.repeat(np.array([0, 100, 200, 300, 400, 500], np.int16), 20).reshape(6, 5, 4)
    volume = uneven(voxels)
    labels = np.zeros(voxels.shape, np.uint8)
    labels[UNEVEN_SLICES, 1:4, 1:3] = 3
    evenly_placed = LabelMap(labels, volume.affine)
    # On the scan's own slices, which no file of labels can say.
    on_scan = ResampledLabels(labels, exact=True, inside={3: 1.0}, warnings=())
    (figures,) = measure_resampled(volume, evenly_placed, on_scan, percentiles=percentiles)
    return figures, volume


def test_voxels_of_uneven_slices_count_with_their_own_volume() -> None:
    figures, volume = measure_on_uneven_slices()
    pixel_mm2 = np.linalg.norm(np.cross(volume.affine[:3, 0], volume.affine[:3, 1]))
    assert figures.voxels == 3 * 3 * 2
    assert figures.ml == pytest.approx(3 * 2 * pixel_mm2 * UNEVEN_MM.sum() / 1000.0, rel=tolerances.LABEL_FLOAT64)


def test_mean_and_deviation_on_uneven_slices_are_weighted_by_thickness() -> None:
    figures, _ = measure_on_uneven_slices()
    mean = np.average(UNEVEN_HU, weights=UNEVEN_MM)
    variance = np.average((UNEVEN_HU - mean) ** 2, weights=UNEVEN_MM)
    assert figures.mean_hu == pytest.approx(mean, rel=tolerances.LABEL_FLOAT64)
    assert figures.sd_hu == pytest.approx(np.sqrt(variance), rel=tolerances.LABEL_SD_FLOAT64)


def test_percentiles_on_uneven_slices_are_weighted_by_thickness() -> None:
    figures, _ = measure_on_uneven_slices(percentiles=(10, 50, 90))
    shares_up_to_slice = np.cumsum(UNEVEN_MM) / UNEVEN_MM.sum()
    expected = [UNEVEN_HU[np.searchsorted(shares_up_to_slice, share)] for share in (0.1, 0.5, 0.9)]
    assert list(figures.percentiles_hu.values()) == expected


def test_labels_measured_on_slices_of_other_places_than_their_own_are_warned_of() -> None:
    figures, _ = measure_on_uneven_slices()  # the map's own slices are evenly placed
    (warning,) = figures.warnings
    assert "on its own" in warning


def test_map_of_half_the_voxel_size_is_measured_on_the_voxels_of_the_scan() -> None:
    volume = Volume(np.arange(8 * 8 * 8, dtype=np.int16).reshape(8, 8, 8), np.eye(4))
    half_as_large = np.diag([0.5, 0.5, 0.5, 1.0])
    half_as_large[:3, 3] = -0.25  # both grids begin at the same corner
    voxels = np.zeros((16, 16, 16), np.uint8)
    voxels[4:8, 4:8, 4:8] = 1  # voxels 2 and 3 of the scan along each axis, 1 mm3 each

    (figures,) = measure_labels(volume, LabelMap(voxels, half_as_large))

    assert figures.voxels == 2**3
    assert figures.ml == pytest.approx(0.008)
    assert figures.label_ml == pytest.approx(0.008)
    assert figures.mean_hu == volume.voxels[2:4, 2:4, 2:4].mean()


def measure_beside_scan() -> tuple[LabelFigures, LabelFigures]:
    """Measure a rib with 4 of its 6 slices in a scan of zeros, whose first voxel is NaN, and a label beyond it."""
    volume = Volume(np.zeros((4, 4, 4), np.float32), np.eye(4))
    volume.voxels[0, 0, 0] = np.nan
    voxels = np.zeros((9, 4, 4), np.uint8)
    voxels[:6, :2] = 1
    voxels[7:] = 2
    rib, beyond = measure_labels(volume, LabelMap(voxels, np.eye(4), {1: "rib"}))
    return rib, beyond


def test_label_that_leaves_the_scan_is_measured_inside_of_it_with_a_warning() -> None:
    rib, _ = measure_beside_scan()
    assert rib.voxels == 4 * 2 * 4
    assert rib.inside_share == pytest.approx(4 / 6)
    of_place, _ = rib.warnings
    assert of_place.startswith("66.7 % of rib lie inside")


def test_voxels_without_a_value_are_counted_and_left_out_of_the_mean() -> None:
    rib, _ = measure_beside_scan()
    assert (rib.unmeasured, rib.mean_hu) == (1, 0.0)
    _, of_voxels = rib.warnings
    assert "1 of 32 voxels" in of_voxels


def test_label_outside_of_the_scan_has_no_figures_and_a_warning() -> None:
    _, beyond = measure_beside_scan()
    assert (beyond.voxels, beyond.ml, beyond.mean_hu, beyond.percentiles_hu["50"]) == (0, 0.0, None, None)
    (warning,) = beyond.warnings
    assert "has no voxel in the scan" in warning
    assert "outside" in warning


def test_label_asked_for_by_name_and_number_is_measured_once_and_alone() -> None:
    volume, labels = random_scan_and_labels()
    assert [figures.number for figures in measure_labels(volume, labels, ["Liver", 2])] == [2]


def test_label_that_the_map_lacks_is_not_measured_but_refused() -> None:
    volume, labels = random_scan_and_labels()
    with refused(UsageError, "spleen"):
        measure_labels(volume, labels, ["spleen"])


@pytest.mark.parametrize("percentiles", [(-1,), (101,), (float("nan"),), "a"])
def test_percentiles_outside_of_0_to_100_are_refused(percentiles: Any) -> None:
    volume, labels = random_scan_and_labels()
    with refused(UsageError, 0, 100):
        measure_labels(volume, labels, percentiles=percentiles)


def test_map_that_misses_the_scan_is_not_measured_but_refused() -> None:
    volume, labels = random_scan_and_labels()
    beside = AFFINE.copy()
    beside[0, 3] += 500.0
    with refused(RefusedInputError, "scan"):
        measure_labels(volume, LabelMap(labels.voxels, beside))


def test_label_of_one_voxel_has_its_hu_in_all_figures() -> None:
    volume = Volume(np.full((1, 1, 1), -3, np.int8), np.diag([2.0, 3.0, 4.0, 1.0]))
    (figures,) = measure_labels(volume, LabelMap(np.ones((1, 1, 1), np.uint8), volume.affine))
    assert figures.ml == 2 * 3 * 4 / 1000
    assert (figures.mean_hu, figures.sd_hu) == (-3.0, 0.0)
    assert figures.percentiles_hu == dict.fromkeys(("5", "25", "50", "75", "95"), -3.0)  # the default ones


def test_progress_of_measuring_counts_the_labels() -> None:
    calls: list[tuple[str, int, int]] = []
    volume, two_labels = random_scan_and_labels()
    measure_labels(volume, two_labels, progress=lambda *call: calls.append(call))
    assert calls == [("measure labels", 0, 2), ("measure labels", 1, 2), ("measure labels", 2, 2)]
