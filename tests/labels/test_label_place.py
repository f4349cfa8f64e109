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


def scan() -> Volume:
    """HU of 480 in a block of bone, 30 around it."""
    return Volume(HU, AFFINE)


def affine_counted_from_the_other_end(*axes: int) -> np.ndarray:
    """Return an affine with the same places of voxels, counted from the other end of some axes (0 is i)."""
    affine = AFFINE.copy()
    for axis in axes:
        affine[:3, 3] += (SHAPE[2 - axis] - 1) * affine[:3, axis]
        affine[:3, axis] *= -1.0
    return affine


def affine_three_voxels_aside() -> np.ndarray:
    affine = AFFINE.copy()
    affine[0, 3] += 3 * 0.8
    return affine


OTHER_AFFINES = {
    "slices from the other end": affine_counted_from_the_other_end(2),
    "rows and columns from the other end": affine_counted_from_the_other_end(0, 1),
    "rows and columns exchanged": AFFINE[:, [1, 0, 2, 3]],
    "three voxels aside": affine_three_voxels_aside(),
}
"""Of maps whose array fits the scan: the labels of BONE are bone at the same indices, and not where these put them."""


@pytest.mark.parametrize(
    ("affine", "percent_in_bone", "words"),
    [
        (
            "slices from the other end",
            0,
            "step along k (0, 0, -1.5) and (0, 0, 1.5), first voxel (-30, 20, 213.5) and (-30, 20, 200) mm",
        ),
        (
            "rows and columns from the other end",
            0,
            "step along i (-0.8, 0, 0) and (0.8, 0, 0), step along j (0, -0.9, 0) and (0, 0.9, 0)",
        ),
        # Rows 2 to 7 and columns 3 to 5 exchanged have 9 of 18 in common.
        ("rows and columns exchanged", 50, "step along i (0, 0.9, 0) and (0.8, 0, 0)"),
        ("three voxels aside", 0, "first voxel (-27.6, 20, 200) and (-30, 20, 200) mm"),
    ],
    ids=OTHER_AFFINES,
)
def test_map_whose_array_fits_the_scan_better_than_its_affine_is_warned_of(affine, percent_in_bone, words):
    (warning,) = warn_of_place(LabelMap(BONE, OTHER_AFFINES[affine]), scan())
    assert words in warning
    assert (
        f"{percent_in_bone} % of its voxels in the scan have 200 HU or more where its affine puts them, 100 % at the"
        " same indices" in warning
    )


def test_warning_about_an_affine_follows_those_of_the_file_and_is_logged(caplog):
    labels = LabelMap(BONE, affine_three_voxels_aside(), warnings=("from its file",))
    (about_affine,) = warn_of_place(labels, scan())
    with caplog.at_level("WARNING"):
        resampled = resample_labels(labels, scan())
    assert resampled.warnings == ("from its file", about_affine)
    assert [record.message for record in caplog.records] == [about_affine]


def test_map_with_another_affine_that_puts_it_in_bone_is_warned_of():
    on_bone = LabelMap(np.roll(BONE, -3, axis=2), affine_three_voxels_aside())
    (warning,) = warn_of_place(on_bone, scan())
    assert " mm): 100 % of its voxels in the scan" in warning
    assert "100 % at the same indices" not in warning


@pytest.mark.parametrize("axes", [(2,), (0,), (0, 1), (0, 1, 2)], ids=["k", "i", "i and j", "all"])
def test_map_flipped_together_with_its_affine_is_not_warned_of(axes):
    labels = LabelMap(np.flip(BONE, tuple(2 - axis for axis in axes)), affine_counted_from_the_other_end(*axes))
    assert resample_labels(labels, scan()).warnings == ()


def test_map_whose_affine_is_rounded_to_float32_is_not_warned_of():
    assert warn_of_place(LabelMap(BONE, AFFINE.astype(np.float32)), scan()) == []


def test_map_of_another_shape_than_the_scan_is_not_warned_of():
    assert warn_of_place(LabelMap(BONE[1:], affine_counted_from_the_other_end(2)), scan()) == []
