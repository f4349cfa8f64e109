"""Labels in volume rendering: factors on the opacity and colours, against analysis, in slabs and on every device."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from variants import daily

from clrecon import Camera, LabelMap, TransferFunction, UsageError, Volume, render
from clrecon.operators.rays.ray_slabs import GROWN
from clrecon.rendering.looks.lighting import UNSHADED

SPACING = (0.7, 0.5, 1.1)
SHAPE = (40, 10, 20)
"""Voxels along k, j, i."""

GREY_LEVEL, GREY_OPACITY = 0.5, 0.1
GREY = TransferFunction([(hu, *[GREY_LEVEL] * 3, GREY_OPACITY) for hu in (0, 200)], unit_distance=2.0)
LABEL_TINT = 0.8
"""Share of a label's colour, as in cl/rays/label_color.h."""


def labelled_block() -> tuple[Volume, LabelMap]:
    """All of one HU; label 1 on the left half along i, label 3 on a quarter, none elsewhere."""
    affine = np.diag([*SPACING, 1.0])
    numbers = np.zeros(SHAPE, np.uint8)
    numbers[:, :, :10] = 1
    numbers[:, :, 10:15] = 3
    return Volume(np.full(SHAPE, 100, np.int16), affine), LabelMap(numbers, affine)


def camera_along_j(volume: Volume) -> Camera:
    """One pixel a voxel of i, in pictures of 20 x 4."""
    (middle,) = volume.ijk_to_lps([(9.5, 4.5, 20.5)])
    return Camera(middle - (0, 50, 0), middle, (0, 0, 1), parallel_scale=2 * SPACING[0])


@pytest.fixture(params=daily(1, [None, 12_000]), ids=["whole", "slabs"])
def row_of_labels(request, device):
    """A row of the picture of the block: label 1 with a quarter of its opacity, label 3 red with a half."""
    volume, labels = labelled_block()
    picture = render(
        volume, transfer_function=GREY, camera=camera_along_j(volume), size=(20, 4), ray_step=0.3, device=device,
        memory=request.param, lighting=UNSHADED, background="transparent", labels=labels,
        label_colors={3: "red"}, label_opacity={1: 0.25, 3: 0.5},
    )  # fmt: skip
    assert (picture.report["slabs"] > 1) == (request.param is not None)
    return picture.image[2].astype(float)  # of four rows, all alike


@pytest.mark.seconds
@pytest.mark.oclgrind
@pytest.mark.parametrize(
    ("columns", "factor"),
    [(slice(1, 9), 0.25), (slice(11, 15 + GROWN), 0.5), (slice(15 + GROWN, 19), 1.0)],
    ids=["label 1", "label 3", "no label"],
)
def test_opacity_of_a_label_is_a_factor_on_that_of_each_unit_of_way(row_of_labels, columns, factor):
    units = SHAPE[1] * SPACING[1] / GREY.unit_distance
    expected = 255.0 * (1.0 - (1.0 - factor * GREY_OPACITY) ** units)
    assert np.abs(row_of_labels[columns, 3] - expected).max() <= tolerances.RAY_SAME_255


@pytest.mark.seconds
@pytest.mark.oclgrind
def test_colour_of_a_label_is_mixed_with_that_of_the_transfer_function(row_of_labels):
    without_colour, red = row_of_labels[1:9, :3], row_of_labels[11:14, :3]
    assert np.abs(without_colour - 255.0 * GREY_LEVEL).max() <= tolerances.LABEL_COLOR_255
    mixed = 255.0 * ((1.0 - LABEL_TINT) * GREY_LEVEL + LABEL_TINT * np.array([1.0, 0.0, 0.0]))
    assert np.abs(red - mixed).max() <= tolerances.LABEL_COLOR_255


def test_a_label_with_an_opacity_of_0_is_not_seen_and_others_look_as_without_labels(device):
    volume, labels = labelled_block()
    settings = {"camera": camera_along_j(volume), "size": (20, 4), "device": device, "background": "transparent"}
    hidden = render(volume, transfer_function=GREY, labels=labels, label_colors={}, label_opacity={1: 0.0}, **settings)
    plain = render(volume, transfer_function=GREY, **settings)
    assert (hidden.image[:, 1:9, 3] == 0).all()
    assert np.isnan(hidden.depth[:, 1:9]).all()
    assert np.array_equal(hidden.image[:, 11:19], plain.image[:, 11:19])


def test_colours_of_labels_without_labels_are_refused(device):
    volume, _ = labelled_block()
    with refused(UsageError, "label_opacity", "labels"):
        render(volume, device=device, size=(8, 8), label_opacity={1: 0.5})
