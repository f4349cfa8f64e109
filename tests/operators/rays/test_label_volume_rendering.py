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

GREY = TransferFunction([(0, 0.5, 0.5, 0.5, 0.1), (200, 0.5, 0.5, 0.5, 0.1)], unit_distance=2.0)
LABEL_TINT = 0.8
"""Share of a label's colour, as in cl/rays/label_color.h."""


def block() -> tuple[Volume, LabelMap]:
    """All of one HU; label 1 on the left half along i, label 3 on a quarter, none elsewhere."""
    affine = np.diag([*SPACING, 1.0])
    numbers = np.zeros(SHAPE, np.uint8)
    numbers[:, :, :10] = 1
    numbers[:, :, 10:15] = 3
    return Volume(np.full(SHAPE, 100, np.int16), affine), LabelMap(numbers, affine)


def ahead(volume: Volume) -> Camera:
    """Along j, one pixel a voxel of i."""
    middle = volume.ijk_to_lps([(9.5, 4.5, 20.5)])[0]
    return Camera(middle - (0, 50, 0), middle, (0, 0, 1), parallel_scale=2 * SPACING[0])


@pytest.mark.seconds
@pytest.mark.oclgrind
@pytest.mark.parametrize("memory", daily(1, [None, 12_000]))
def test_labels_change_opacity_and_colour_as_they_say(device, memory):
    volume, labels = block()
    options = {"label_colors": {3: "red"}, "label_opacity": {1: 0.25, 3: 0.5}}
    made = render(
        volume, transfer_function=GREY, camera=ahead(volume), size=(20, 4), ray_step=0.3, device=device, memory=memory,
        lighting=UNSHADED, background="transparent", labels=labels, **options,
    )  # fmt: skip
    assert (made.report["slabs"] > 1) == (memory is not None)
    row = made.image[2].astype(float)
    through = SHAPE[1] * SPACING[1] / GREY.unit_distance
    for columns, factor in ((slice(1, 9), 0.25), (slice(11, 15 + GROWN), 0.5), (slice(15 + GROWN, 19), 1.0)):
        expected = 255.0 * (1.0 - (1.0 - factor * 0.1) ** through)
        assert np.abs(row[columns, 3] - expected).max() <= tolerances.RAY_SAME_255, factor
    grey, red = row[1:9, :3], row[11:14, :3]
    assert np.abs(grey - 127.5).max() <= tolerances.LABEL_COLOR_255
    mixed = 255.0 * ((1.0 - LABEL_TINT) * 0.5 + LABEL_TINT * np.array([1.0, 0.0, 0.0]))
    assert np.abs(red - mixed).max() <= tolerances.LABEL_COLOR_255


def test_a_label_without_opacity_shows_what_is_behind(device):
    volume, labels = block()
    settings = {"camera": ahead(volume), "size": (20, 4), "device": device, "background": "transparent"}
    hidden = render(volume, transfer_function=GREY, labels=labels, label_colors={}, label_opacity={1: 0.0}, **settings)
    plain = render(volume, transfer_function=GREY, **settings)
    assert (hidden.image[:, 1:9, 3] == 0).all()
    assert np.isnan(hidden.depth[:, 1:9]).all()
    assert np.array_equal(hidden.image[:, 11:19], plain.image[:, 11:19])


def test_colours_of_labels_without_labels_are_refused(device):
    volume, _ = block()
    with refused(UsageError, "label_opacity", "labels"):
        render(volume, device=device, size=(8, 8), label_opacity={1: 0.5})
