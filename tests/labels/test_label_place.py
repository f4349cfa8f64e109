"""A label map of the scan's own shape and another affine: said with both, and with the share in bone either way."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.labels import LabelMap, resample_labels
from clrecon.labels.resample import warn_of_place

AFFINE = np.array([[0.8, 0, 0, -30.0], [0, 0.9, 0, 20.0], [0, 0, 1.5, 200.0], [0, 0, 0, 1.0]])
SHAPE = (10, 14, 14)
BONE = np.zeros(SHAPE, np.uint8)
BONE[1:4, 2:8, 3:6] = 1
HU = np.where(BONE > 0, 480, 30).astype(np.int16)


def scan(hu=HU) -> Volume:
    return Volume(hu, AFFINE)


def turned(*axes: int) -> np.ndarray:
    """Return an affine with the same places of voxels, counted from the other end of some axes."""
    affine = AFFINE.copy()
    for axis in axes:
        affine[:3, 3] += (SHAPE[2 - axis] - 1) * affine[:3, axis]
        affine[:3, axis] *= -1.0
    return affine


def shifted() -> np.ndarray:
    affine = AFFINE.copy()
    affine[0, 3] += 2.4
    return affine


@pytest.mark.parametrize(
    ("affine", "by_affine", "words"),
    [
        (turned(2), 0, "step along k (0, 0, -1.5) and (0, 0, 1.5), first voxel (-30, 20, 213.5) and (-30, 20, 200) mm"),
        (turned(0, 1), 0, "step along i (-0.8, 0, 0) and (0.8, 0, 0), step along j (0, -0.9, 0) and (0, 0.9, 0)"),
        (AFFINE[:, [1, 0, 2, 3]], 50, "step along i (0, 0.9, 0) and (0.8, 0, 0)"),
        (shifted(), 0, "first voxel (-27.6, 20, 200) and (-30, 20, 200) mm"),
    ],
)
def test_an_array_of_the_scan_with_another_affine_is_said(caplog, affine, by_affine, words):
    labels = LabelMap(BONE, affine, warnings=("from its file",))
    with caplog.at_level("WARNING"):
        taken = resample_labels(labels, scan())
    first, warning = taken.warnings
    assert first == "from its file"
    assert words in warning
    assert (
        "of its voxels in the scan have 200 HU or more where its affine puts them, 100 % at the same indices" in warning
    )
    assert int(warning.split(" mm): ")[1].split(" %")[0]) == by_affine
    assert warn_of_place(labels, scan()) == [warning]
    assert [record.message for record in caplog.records] == [warning]


def test_a_map_that_lies_right_on_other_voxels_is_said_too():
    (warning,) = warn_of_place(LabelMap(np.roll(BONE, -3, axis=2), shifted()), scan())
    assert "100 % at the" not in warning and " mm): 100 % of its" in warning


@pytest.mark.parametrize("axes", [(2,), (0,), (0, 1), (0, 1, 2)])
def test_a_map_turned_with_its_affine_is_not_alarmed_about(axes):
    labels = LabelMap(np.flip(BONE, tuple(2 - axis for axis in axes)), turned(*axes))
    assert resample_labels(labels, scan()).warnings == ()


def test_rounded_affines_and_other_shapes_are_not_alarmed_about():
    assert warn_of_place(LabelMap(BONE, AFFINE.astype(np.float32)), scan()) == []
    assert warn_of_place(LabelMap(BONE[1:], turned(2)), scan()) == []
