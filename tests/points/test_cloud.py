"""`PointCloud`: shapes, types, selections and frames."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.points.cloud import PointCloud, PointStep, VoxelNumbers


def numbered_cloud(n: int = 5) -> PointCloud:
    """Point k lies at (3 k, 3 k + 1, 3 k + 2); it has 100 k HU, the label k - 1, and its voxel has the same indices."""
    return PointCloud(
        np.arange(3 * n, dtype=np.float32).reshape(n, 3),
        normals=np.tile([0.0, 0.6, 0.8], (n, 1)),
        hu=np.arange(n) * 100,
        labels=np.arange(n) - 1,
        ijk=np.arange(3 * n).reshape(n, 3),
        report={"iso_value_hu": 200.0},
    )


def test_points_normals_and_hu_are_float32_and_labels_and_voxels_int32() -> None:
    cloud = numbered_cloud()
    assert [cloud.points.dtype, cloud.normals.dtype, cloud.hu.dtype] == [np.float32] * 3
    assert [cloud.labels.dtype, cloud.ijk.dtype] == [np.int32] * 2


def test_points_beyond_4096_mm_are_float64() -> None:
    assert PointCloud([[5000.0, 0.0, 0.0]]).points.dtype == np.float64


def test_repr_of_a_cloud_has_its_number_of_points_arrays_and_frame() -> None:
    assert repr(numbered_cloud()) == "PointCloud(5 points, with normals, hu, labels, ijk, LPS mm)"
    assert len(numbered_cloud()) == 5


def test_numpy_takes_a_cloud_as_its_points_without_a_copy() -> None:
    cloud = numbered_cloud()
    assert np.asarray(cloud) is cloud.points


@pytest.mark.parametrize("points", [[], np.empty((0, 3))], ids=["list", "array"])
def test_no_points_are_an_array_of_three_columns(points: Any) -> None:
    assert PointCloud(points).points.shape == (0, 3)


@pytest.mark.parametrize("shape", [(4,), (2, 2), (0, 2), (1, 3, 1)])
def test_points_that_are_no_rows_of_three_are_refused_with_their_shape(shape: tuple[int, ...]) -> None:
    with refused(UsageError, 3, *shape):
        PointCloud(np.zeros(shape))


@pytest.mark.parametrize("key", [np.array([False, True, False, True, True]), [1, 3, 4]], ids=["mask", "numbers"])
def test_a_selection_takes_points_hu_labels_and_voxels_along(key: Any) -> None:
    """Point k has x = 3 k, 100 k HU, the label k - 1, and a voxel in slice 3 k + 2."""
    chosen = numbered_cloud().select(key)
    assert chosen.points[:, 0].tolist() == [3.0, 9.0, 12.0]
    assert chosen.hu.tolist() == [100.0, 300.0, 400.0]
    assert chosen.labels.tolist() == [0, 2, 3]
    assert chosen.ijk[:, 2].tolist() == [5, 11, 14]


def test_a_selection_by_numbers_has_their_order() -> None:
    assert numbered_cloud().select([4, 0]).hu.tolist() == [400.0, 0.0]


def test_a_selection_has_a_copy_of_the_report() -> None:
    cloud = numbered_cloud()
    chosen = cloud.select([1, 3])
    assert chosen.report == cloud.report
    assert chosen.report is not cloud.report


NUMBERS = np.array([0, 19, 20, 41, 59], np.uint32)
INDICES = [[0, 0, 0], [4, 3, 0], [0, 0, 1], [1, 0, 2], [4, 3, 2]]
"""i, j, k of these numbers of voxels in a volume of 5 x 4 x 3."""


def cloud_by_numbers() -> PointCloud:
    numbers = VoxelNumbers(NUMBERS, (5, 4, 3))
    return PointCloud.of_known(np.zeros((5, 3), np.float32), ijk=numbers).changed(labels=np.arange(5))


def test_voxels_by_number_become_indices_once_these_are_asked_for() -> None:
    cloud = cloud_by_numbers()
    assert cloud.voxel_numbers is not None
    assert cloud.ijk.tolist() == INDICES
    assert cloud.voxel_numbers is None


def test_a_selection_of_voxels_by_number_stays_by_number() -> None:
    chosen = cloud_by_numbers().select([True, False, True, False, True])
    assert chosen.voxel_numbers is not None
    assert chosen.labels.tolist() == [0, 2, 4]
    assert chosen.describe("lps").ijk.tolist() == INDICES[::2]


def test_slices_of_voxels_are_known_by_number_and_by_index() -> None:
    by_number, by_index = cloud_by_numbers(), cloud_by_numbers()
    assert by_index.ijk is not None  # asked for: the numbers are gone
    assert by_number.voxel_slices().tolist() == [0, 0, 1, 2, 2]
    assert by_index.voxel_slices().tolist() == [0, 0, 1, 2, 2]


def test_points_without_voxels_have_no_slices() -> None:
    assert PointCloud(np.zeros((2, 3))).voxel_slices() is None


def test_a_description_without_voxels_leaves_them_numbers() -> None:
    cloud = cloud_by_numbers()
    assert cloud.describe("lps", with_ijk=False).ijk is None
    assert cloud.voxel_numbers is not None


@pytest.fixture
def three_points() -> PointCloud:
    """Three points at one place with 1, 2 and 3 HU."""
    return PointCloud(np.zeros((3, 3)), hu=[1, 2, 3], report={"a": 1})


def test_a_changed_cloud_has_the_new_arrays_and_the_given_one_stays(three_points: PointCloud) -> None:
    changed = three_points.changed(hu=None, normals=np.eye(3))
    assert changed.hu is None
    assert changed.normals.dtype == np.float32
    assert three_points.normals is None


def test_a_changed_cloud_has_a_report_of_its_own(three_points: PointCloud) -> None:
    changed = three_points.changed(hu=None)
    changed.report["b"] = 2
    assert three_points.report == {"a": 1}
    assert three_points.changed(report={}).report == {}


@pytest.mark.parametrize(
    ("arrays", "facts"),
    [
        ({"normals": np.where(np.eye(3) > 0, [1.0, 1.0, np.nan], 0.0)}, (1, 3)),
        ({"points": np.full((3, 3), np.inf)}, (3, "finite")),
        ({"labels": [1, 2]}, ("labels", "shape", 3, 2)),
        ({"colour": [1, 2, 3]}, ("cloud", "colour")),
    ],
    ids=["a normal of NaN", "points of infinity", "too few labels", "unknown array"],
)
def test_arrays_that_a_cloud_cannot_have_are_refused_when_it_is_changed(
    three_points: PointCloud, arrays: dict[str, Any], facts: tuple[Any, ...]
) -> None:
    with refused(UsageError, *facts):
        three_points.changed(**arrays)


@pytest.mark.parametrize(("number", "dtype"), [(0, np.float32), (1, np.float64)], ids=["near point", "far point"])
def test_a_selection_is_float64_only_where_a_point_of_its_own_lies_far(number: int, dtype: type) -> None:
    cloud = PointCloud(np.array([[0.1, 0.2, 0.3], [1e5, 0.0, 0.1]]))
    assert cloud.select([number]).points.dtype == dtype


def test_points_and_normals_in_ras_have_x_and_y_negated_without_a_negative_zero() -> None:
    points, normals = numbered_cloud().in_space("ras")
    assert points[1].tolist() == [-3.0, -4.0, 5.0]
    assert normals[0] == pytest.approx([0.0, -0.6, 0.8])
    assert not np.signbit(normals[0, 0])


def test_points_and_labels_of_a_cloud_survive_pickling() -> None:
    again = pickle.loads(pickle.dumps(numbered_cloud()))
    assert np.array_equal(again.points, numbered_cloud().points)
    assert again.labels.tolist() == [-1, 0, 1, 2, 3]


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
    ids=["pairs", "text", "not finite", "HU too many", "labels of halves", "normals too many", "normal of NaN"],
)
def test_arrays_that_fit_no_cloud_are_refused_when_it_is_made(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        PointCloud(**arguments)


@pytest.mark.parametrize(
    "key",
    [[True], [5], [-1], [0.5], [[0, 1]]],
    ids=["short mask", "number too high", "negative number", "half", "table"],
)
def test_selections_that_name_no_points_are_refused(key: list[Any]) -> None:
    with refused(UsageError, 5, "selection"):
        numbered_cloud().select(key)


def test_a_step_counts_the_points_that_it_removed_by_reason() -> None:
    kept, noise, sheet = 0, 1, 2
    removed = np.array([kept, sheet, noise, sheet, kept], np.uint8)
    step = PointStep(numbered_cloud(2), removed, reasons=("noise", "sheet", "ghost"), facts={"eps_mm": 1.2})
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
    ids=[
        "ragged points",
        "ragged normals",
        "ragged HU",
        "label beyond 32 bits",
        "voxel beyond 32 bits",
        "voxel of NaN",
        "voxel of a half",
    ],
)
def test_values_that_no_cloud_can_have_are_refused_by_name(values: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        PointCloud(**{"points": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], **values})
