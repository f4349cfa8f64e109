"""Volume and HU of labels: known answers on even, uneven, tilted and odd grids, and numpy as a second opinion."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from uneven_volume import HEIGHTS, uneven

import clrecon
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.labels.resample import ResampledLabels
from clrecon.labels.statistics import LabelFigures, measure_labels, measure_resampled

AFFINE = np.array([[0.7, 0.1, 0.05, -25.0], [-0.1, 0.5, 0.2, -30.0], [0.0, 0.05, 2.5, -84.0], [0, 0, 0, 1.0]])


def random_pair(dtype: str = "int16") -> tuple[Volume, LabelMap]:
    random = np.random.default_rng(3)
    values = random.integers(-900, 1500, (5, 7, 9)).astype(dtype)
    labels = random.choice(np.array([0, 0, 2, 9], np.uint8), values.shape)
    return Volume(values, AFFINE), LabelMap(labels, AFFINE, {2: "liver"})


@pytest.mark.parametrize("dtype", ["int16", "float32", "int32"])
def test_figures_are_those_of_numpy(dtype: str) -> None:
    volume, labels = random_pair(dtype)
    if dtype == "int32":  # more levels than are counted one by one
        wide = volume.voxels.copy()
        wide[0, 0, :] = 2_000_000
        volume = Volume(wide, AFFINE)
    figures = clrecon.measure_labels(volume, labels, percentiles=(0, 2.5, 50, 95, 100))
    assert [(one.number, one.name) for one in figures] == [(2, "liver"), (9, "label_9")]
    for one in figures:
        values = volume.voxels[labels.voxels == one.number].astype(np.float64)
        assert one.voxels == len(values)
        assert one.ml == pytest.approx(len(values) * abs(np.linalg.det(AFFINE[:3, :3])) / 1000.0, rel=1e-12)
        assert one.ml == pytest.approx(one.label_ml, rel=1e-12)
        assert (one.mean_hu, one.sd_hu) == pytest.approx((values.mean(), values.std()), rel=1e-9)
        assert (one.min_hu, one.max_hu) == (values.min(), values.max())
        expected = np.percentile(values, [0, 2.5, 50, 95, 100], method="inverted_cdf")
        assert list(one.percentiles_hu) == ["0", "2.5", "50", "95", "100"]
        assert list(one.percentiles_hu.values()) == expected.tolist()
        assert one.inside_share == 1.0 and one.unmeasured == 0 and one.warnings == []


def test_voxels_of_uneven_slices_count_with_their_own_volume() -> None:
    voxels = np.repeat(np.array([0, 100, 200, 300, 400, 500], np.int16), 20).reshape(6, 5, 4)
    volume = uneven(voxels)
    labels = np.zeros(voxels.shape, np.uint8)
    labels[2:5, 1:4, 1:3] = 3
    positions = volume.slice_origins()
    nominal = LabelMap(labels, volume.affine)
    on_scan = ResampledLabels(labels, True, {3: 1.0}, ())  # on the scan's own slices, which no file of labels can say
    (one,) = measure_resampled(volume, nominal, on_scan, percentiles=(10, 50, 90))
    thick = (HEIGHTS[3:6] - HEIGHTS[1:4]) / 2.0
    area = np.linalg.norm(np.cross(volume.affine[:3, 0], volume.affine[:3, 1]))
    assert len(positions) == 6 and one.voxels == 18
    assert one.ml == pytest.approx(6 * area * thick.sum() / 1000.0, rel=1e-12)
    mean = (thick * (200, 300, 400)).sum() / thick.sum()
    assert one.mean_hu == pytest.approx(mean, rel=1e-12)
    assert one.sd_hu == pytest.approx(np.sqrt((thick * (np.array([200, 300, 400]) - mean) ** 2).sum() / thick.sum()))
    shares = np.cumsum(thick) / thick.sum()
    expected = [200.0 + 100.0 * np.searchsorted(shares, p) for p in (0.1, 0.5, 0.9)]
    assert list(one.percentiles_hu.values()) == expected
    assert "on its own" in one.warnings[0]  # the nominal even step of the map is not that of these slices


def test_a_map_on_another_grid_is_brought_to_the_scan() -> None:
    volume = Volume(np.arange(8 * 8 * 8, dtype=np.int16).reshape(8, 8, 8), np.eye(4))
    fine = np.diag([0.5, 0.5, 0.5, 1.0])
    fine[:3, 3] = -0.25
    voxels = np.zeros((16, 16, 16), np.uint8)
    voxels[4:8, 4:8, 4:8] = 1  # voxels 2 and 3 of the scan, each way
    (one,) = measure_labels(volume, LabelMap(voxels, fine))
    assert one.voxels == 8 and one.ml == pytest.approx(0.008) and one.label_ml == pytest.approx(0.008)
    assert one.mean_hu == volume.voxels[2:4, 2:4, 2:4].mean()


def test_labels_outside_the_scan_are_told() -> None:
    volume = Volume(np.zeros((4, 4, 4), np.float32), np.eye(4))
    volume.voxels[0, 0, 0] = np.nan
    voxels = np.zeros((9, 4, 4), np.uint8)
    voxels[:6, :2] = 1
    voxels[7:] = 2
    gone, lost = measure_labels(volume, LabelMap(voxels, np.eye(4), {1: "rib"}))
    assert (gone.voxels, gone.unmeasured, gone.mean_hu) == (32, 1, 0.0)
    assert gone.inside_share == pytest.approx(4 / 6)
    assert gone.warnings[0].startswith("66.7 % of rib lie inside") and "1 of 32 voxels" in gone.warnings[1]
    assert (lost.voxels, lost.ml, lost.mean_hu, lost.percentiles_hu["50"]) == (0, 0.0, None, None)
    assert "has no voxel in the scan" in lost.warnings[0] and "outside" in lost.warnings[0]


def test_labels_are_chosen_and_wrong_ones_refused() -> None:
    volume, labels = random_pair()
    assert [one.number for one in measure_labels(volume, labels, ["Liver", 2])] == [2]
    with refused(UsageError, "spleen"):
        measure_labels(volume, labels, ["spleen"])
    for wrong in ((-1,), (101,), (float("nan"),), "a"):
        with refused(UsageError, 0, 100):
            measure_labels(volume, labels, percentiles=wrong)  # type: ignore[arg-type]
    away = AFFINE.copy()
    away[0, 3] += 500.0
    with refused(RefusedInputError, "scan"):
        measure_labels(volume, LabelMap(labels.voxels, away))


def test_one_voxel_is_measured_and_progress_told() -> None:
    told: list[tuple[str, int, int]] = []
    volume = Volume(np.full((1, 1, 1), -3, np.int8), np.diag([2.0, 3.0, 4.0, 1.0]))
    (one,) = measure_labels(
        volume, LabelMap(np.ones((1, 1, 1), np.uint8), volume.affine), progress=lambda *given: told.append(given)
    )
    assert isinstance(one, LabelFigures) and list(one.percentiles_hu) == ["5", "25", "50", "75", "95"]
    assert (one.ml, one.mean_hu, one.sd_hu, one.percentiles_hu["5"]) == (0.024, -3.0, 0.0, -3.0)
    assert told == [("measure labels", 0, 1), ("measure labels", 1, 1)]
