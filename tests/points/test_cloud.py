"""`PointCloud`: shapes, types, selections and frames."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.points import PointCloud, PointStep
from clrecon.points.cloud import VoxelNumbers


def a_cloud(n: int = 5) -> PointCloud:
    return PointCloud(
        np.arange(3 * n, dtype=np.float32).reshape(n, 3),
        normals=np.tile([0.0, 0.6, 0.8], (n, 1)),
        hu=np.arange(n) * 100,
        labels=np.arange(n) - 1,
        ijk=np.arange(3 * n).reshape(n, 3),
        report={"iso_value_hu": 200.0},
    )


def test_arrays_have_the_promised_types() -> None:
    cloud = a_cloud()
    assert [cloud.points.dtype, cloud.normals.dtype, cloud.hu.dtype] == [np.float32] * 3
    assert cloud.labels.dtype == cloud.ijk.dtype == np.int32
    assert len(cloud) == 5 and repr(cloud) == "PointCloud(5 points, with normals, hu, labels, ijk, LPS mm)"
    assert np.asarray(cloud) is cloud.points
    assert PointCloud([[5000.0, 0.0, 0.0]]).points.dtype == np.float64


def test_points_are_rows_of_three() -> None:
    assert PointCloud([]).points.shape == PointCloud(np.empty((0, 3))).points.shape == (0, 3)
    for shape in ((4,), (2, 2), (0, 2), (1, 3, 1)):
        with refused(UsageError, 3, *shape):
            PointCloud(np.zeros(shape))


def test_a_selection_takes_every_array_along() -> None:
    cloud = a_cloud()
    kept = cloud.select(np.array([False, True, False, True, True]))
    by_number = cloud.select([1, 3, 4])
    for one in (kept, by_number):
        assert one.hu.tolist() == [100.0, 300.0, 400.0] and one.labels.tolist() == [0, 2, 3]
        assert one.points[:, 0].tolist() == [3.0, 9.0, 12.0] and one.ijk[:, 2].tolist() == [5, 11, 14]
    assert cloud.select([4, 0]).hu.tolist() == [400.0, 0.0]
    assert kept.report == cloud.report and kept.report is not cloud.report


def test_voxels_by_number_stay_numbers_until_their_indices_are_asked_for() -> None:
    shape = (5, 4, 3)
    numbers = VoxelNumbers(np.array([0, 19, 20, 41, 59], np.uint32), shape)
    cloud = PointCloud.of_known(np.zeros((5, 3), np.float32), ijk=numbers).changed(labels=np.arange(5))
    chosen = cloud.select([True, False, True, False, True])
    assert chosen.voxel_numbers is not None and chosen.labels.tolist() == [0, 2, 4]
    assert chosen.voxel_slices().tolist() == [0, 1, 2]
    assert cloud.describe("lps", with_ijk=False).ijk is None and cloud.voxel_numbers is not None
    expected = [[0, 0, 0], [4, 3, 0], [0, 0, 1], [1, 0, 2], [4, 3, 2]]
    assert cloud.ijk.tolist() == expected and cloud.voxel_numbers is None
    assert cloud.voxel_slices().tolist() == [0, 0, 1, 2, 2]
    assert chosen.describe("lps").ijk.tolist() == expected[::2]
    assert PointCloud(np.zeros((2, 3))).voxel_slices() is None


def test_changed_arrays_of_a_cloud_are_checked() -> None:
    cloud = PointCloud(np.zeros((3, 3)), hu=[1, 2, 3], report={"a": 1})
    changed = cloud.changed(hu=None, normals=np.eye(3))
    assert changed.hu is None and changed.normals.dtype == np.float32 and cloud.normals is None
    changed.report["b"] = 2
    assert cloud.report == {"a": 1} and cloud.changed(report={}).report == {}
    with refused(UsageError, 1, 3):
        cloud.changed(normals=np.where(np.eye(3) > 0, [1.0, 1.0, np.nan], 0.0))
    with refused(UsageError, 3, "finite"):
        cloud.changed(points=np.full((3, 3), np.inf))
    with refused(UsageError, "labels", "shape", 3, 2):
        cloud.changed(labels=[1, 2])
    with refused(UsageError, "cloud", "colour"):
        cloud.changed(colour=[1, 2, 3])


def test_a_selection_of_far_points_is_stored_as_others_are() -> None:
    cloud = PointCloud(np.array([[0.1, 0.2, 0.3], [1e5, 0.0, 0.1]]))
    assert cloud.points.dtype == np.float64
    assert cloud.select([1]).points.dtype == np.float64 and cloud.select([0]).points.dtype == np.float32


def test_ras_negates_x_and_y() -> None:
    points, normals = a_cloud().in_space("ras")
    assert points[1].tolist() == [-3.0, -4.0, 5.0]
    assert np.allclose(normals[0], [0.0, -0.6, 0.8]) and not np.signbit(normals[0, 0])


def test_a_cloud_survives_pickle() -> None:
    again = pickle.loads(pickle.dumps(a_cloud()))
    assert np.array_equal(again.points, a_cloud().points) and again.labels.tolist() == [-1, 0, 1, 2, 3]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"points": [[1.0, 2.0]]}, r"points have shape \(n, 3\), these have \(1, 2\)"),
        ({"points": [["a", "b", "c"]]}, "points are numbers"),
        ({"points": [[0.0, np.nan, 0.0], [np.inf, 0.0, 0.0]]}, "2 of 2 points are not finite, the first is number 0"),
        ({"points": [[0.0, 0.0, 0.0]], "hu": [1.0, 2.0]}, "hu have shape"),
        ({"points": [[0.0, 0.0, 0.0]], "labels": [0.5]}, "labels are whole numbers"),
        ({"points": [[0.0, 0.0, 0.0]], "normals": [[0, 0, 1], [0, 0, 1]]}, "2 normals for 1 points"),
        ({"points": [[0.0, 0.0, 0.0]], "normals": [[0, 0, np.nan]]}, "1 of 1 normals are not finite"),
    ],
)
def test_bad_arrays_are_refused(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        PointCloud(**arguments)


@pytest.mark.parametrize("mask", [[True], [5], [-1], [0.5], [[0, 1]]])
def test_bad_selections_are_refused(mask: list[Any]) -> None:
    with refused(UsageError, 5, "selection"):
        a_cloud().select(mask)


def test_a_step_counts_by_reason() -> None:
    step = PointStep(a_cloud(2), np.array([0, 2, 1, 2, 0], np.uint8), ("noise", "sheet", "ghost"), {"eps_mm": 1.2})
    assert step.counts == {"noise": 1, "sheet": 2, "ghost": 0}
    assert step.as_dict() == {"points_before": 5, "points_after": 2, "removed": step.counts, "eps_mm": 1.2}


RAGGED = [[1.0, 2.0, 3.0], [4.0, 5.0]]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"points": RAGGED}, "points are rows of unequal length"),
        ({"normals": RAGGED}, "normals are rows of unequal length"),
        ({"hu": [1.0, [2.0]]}, "hu are rows of unequal length"),
        ({"labels": [1, 2**40]}, "labels are whole numbers of 32 bits"),
        ({"ijk": [[0, 0, 0], [0, 0, 2.0**40]]}, "ijk are whole numbers of 32 bits"),
        ({"ijk": [[0, 0, 0], [0, 0, np.nan]]}, "ijk are whole numbers of 32 bits"),
        ({"ijk": [[0, 0, 0], [0, 0, 1.5]]}, "ijk are whole numbers of 32 bits"),
    ],
)
def test_values_that_no_cloud_can_have_are_refused_by_name(values: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        PointCloud(**{"points": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], **values})
