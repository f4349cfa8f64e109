"""Contact sheets: which slices, where they lie and what they show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from dicom_series import rotation
from refusals import refused

import clrecon
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.rendering.pictures.styles import PlaneCut

SIZE = (420, 330)
AFFINE = np.diag([2.0, 2.0, 3.0, 1.0])
AFFINE[:3, 3] = (-40.0, -50.0, 100.0)


def steps(axis: int = 0) -> Volume:
    """A volume whose HU are ten times the index along an axis of its array."""
    voxels = 10 * np.indices((20, 40, 36))[axis]
    return Volume(voxels.astype(np.int16), AFFINE)


def take(volume: Volume, device: Any, view: str = "axial", **style: Any) -> clrecon.Rendering:
    return clrecon.render(volume, PlaneCut(**style), view=view, size=SIZE, device=device)


def tiles_of(picture: clrecon.Rendering) -> list[np.ndarray]:
    width, height = picture.report["tile_size"]
    return [
        picture.values[tile["top"] : tile["top"] + height, tile["left"] : tile["left"] + width]
        for tile in picture.report["tiles"]
    ]


@pytest.mark.every_device
@pytest.mark.parametrize(("view", "axis", "first"), [("axial", 0, 19), ("coronal", 1, 0), ("sagittal", 2, 0)])
def test_every_n_th_plane_of_voxels_has_its_values(device: Any, view: str, axis: int, first: int) -> None:
    """From the head down, from the front, from the right."""
    picture = take(steps(axis), device, view, slices=3)
    count = (20, 40, 36)[axis]
    numbers = [tile["slice"] for tile in picture.report["tiles"]]
    assert sorted(numbers) == list(range(0, count, 3)) and numbers[0] == (18 if first else 0)
    for number, values in zip(numbers, tiles_of(picture), strict=True):
        assert np.nanmin(values) == np.nanmax(values) == 10 * number
        assert np.isfinite(values).mean() > 0.9
    places = np.array([tile["middle_lps_mm"][2 - axis] for tile in picture.report["tiles"]])
    truth = AFFINE[2 - axis, 3] + AFFINE[2 - axis, 2 - axis] * np.array(numbers)
    assert np.allclose(places, truth, atol=1e-3)
    assert picture.camera is None and np.isnan(picture.depth).all() and picture.mode == "slice"


def test_a_number_of_slices_is_spread_over_the_scan_on_planes_of_voxels(device: Any) -> None:
    picture = take(steps(), device, sheet=5)
    assert [tile["slice"] for tile in picture.report["tiles"]] == [17, 13, 9, 5, 1]


def test_slices_lie_at_multiples_of_a_distance(device: Any) -> None:
    picture = take(steps(), device, sheet="10mm")
    assert [tile["middle_lps_mm"][2] for tile in picture.report["tiles"]] == [150.0, 140.0, 130.0, 120.0, 110.0, 100.0]
    assert {tile["slice"] for tile in picture.report["tiles"]} == {None}
    assert np.allclose(tiles_of(picture)[1][20, 20], 10 * 40.0 / 3.0, atol=1e-3)


def test_uneven_slices_are_where_they_are(device: Any) -> None:
    volume = steps()
    kept = [0, 1, 4, 5, 11, 19]
    uneven = Volume(volume.voxels[kept], AFFINE, slice_positions=volume.slice_origins()[kept])
    picture = take(uneven, device, slices=1)
    assert [tile["middle_lps_mm"][2] for tile in picture.report["tiles"]] == [157.0, 133.0, 115.0, 112.0, 103.0, 100.0]
    assert [float(np.nanmax(values)) for values in tiles_of(picture)] == [190, 110, 50, 40, 10, 0]


def test_oblique_slices_have_a_distance_and_no_number(device: Any) -> None:
    turned = np.eye(4)
    turned[:3, :3] = rotation((20.0, 0.0, 0.0))
    oblique = Volume(steps().voxels, turned @ AFFINE)
    picture = take(oblique, device, sheet=4)
    assert {tile["slice"] for tile in picture.report["tiles"]} == {None} and len(picture.report["tiles"]) == 4
    with refused(UsageError, "planes", "voxels"):
        take(oblique, device, (45, 45), slices=2)


def test_slices_of_a_tilted_gantry_are_shown_as_they_were_taken(device: Any) -> None:
    tilted = AFFINE.copy()
    tilted[:3, 1] = 2.0 * np.array([0.0, np.cos(np.radians(18.5)), np.sin(np.radians(18.5))])
    picture = take(Volume(steps().voxels, tilted), device, slices=[3, 12])
    assert [tile["slice"] for tile in picture.report["tiles"]] == [12, 3]
    for number, values in zip((12, 3), tiles_of(picture), strict=True):
        there = values[np.isfinite(values)]
        assert np.allclose(there, 10 * number, atol=0.05) and np.isfinite(values).mean() > 0.5
    assert [text for text in picture.report["warnings"] if "tilted by 18.5 degrees from the plane asked for" in text]
    assert picture.report["edges"]["right"] == "L" and picture.report["edges"]["top"][0] == "A"


def test_sides_scale_and_zoom_are_those_of_a_single_slice(device: Any) -> None:
    """The patient's left is at the right; a block at the left of the patient lies there in every tile."""
    voxels = np.zeros((20, 40, 36), np.int16)
    voxels[:, :, 30:] = 900
    volume = Volume(voxels, AFFINE)
    picture = take(volume, device, sheet=4)
    assert picture.report["edges"]["right"] == "L" and picture.report["edges"]["top"] == "A"
    for values in tiles_of(picture):
        assert np.nanmean(values[:, -20:]) > 700 and np.nanmean(values[:, :20]) == 0
    width = picture.report["tile_size"][0]
    assert width * picture.report["pixel_mm"] == pytest.approx(72.0, rel=0.03)
    near = clrecon.render(volume, PlaneCut(sheet=4), view="axial", zoom=2.0, size=SIZE, device=device)
    assert near.report["pixel_mm"] == pytest.approx(0.5 * picture.report["pixel_mm"], rel=1e-6)


def test_labels_are_drawn_on_their_slices_alone(device: Any) -> None:
    numbers = np.zeros((20, 40, 36), np.uint8)
    numbers[8:12, 10:20, 10:20] = 3
    labels = LabelMap(numbers, AFFINE, {3: "vertebrae_L3"})
    picture = take(steps(), device, slices=4, labels=labels, label_colors={3: "#00ff00"})
    single = clrecon.render(
        steps(), PlaneCut(labels=labels, label_colors={3: "#00ff00"}), view="axial", size=(80, 80), device=device,
        center=(-10.0, -10.0, 127.0),
    )  # fmt: skip
    assert picture.report["labels"][0] | {"pixels": 0} == {
        "label_number": 3, "label": "vertebrae_L3", "color": "#00ff00", "pixels": 0,
    }  # fmt: skip
    width, height = picture.report["tile_size"]
    for tile in picture.report["tiles"]:
        part = picture.image[tile["top"] : tile["top"] + height, tile["left"] : tile["left"] + width].astype(int)
        assert (part[..., 1] > part[..., 0] + 30).any() == (tile["slice"] == 8)
    green = single.image[..., 1].astype(int) > single.image[..., 0].astype(int) + 30
    assert green.sum() * single.pixel_mm**2 == pytest.approx(20.0 * 20.0, rel=0.1)
    assert single.report["labels"][0]["pixels"] == pytest.approx(green.sum(), rel=0.02)


@pytest.mark.parametrize(
    ("style", "words"),
    [
        ({"sheet": "0.001mm"}, r"slices 0.001 mm apart are .* in the 60 mm of this view: 1 to 1,000"),
        ({"slices": [3, 20]}, "slice 20 is not there: in this direction the volume has 0 to 19"),
        ({"sheet": "900 mm"}, "slices 900 mm apart are 0 in the 60 mm"),
    ],
)
def test_slices_that_are_not_there_are_refused(device: Any, style: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        take(steps(), device, **style)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"sheet": 0}, (0,)),
        ({"sheet": "five"}, ("five",)),
        ({"sheet": "-3mm"}, ("-3mm",)),
        ({"sheet": 4, "offset_mm": 3.0}, ("offset_mm",)),
        ({"sheet": 4, "pixel_mm": 1.0}, ("pixel_mm",)),
    ],
)
def test_sheets_that_cannot_be_are_refused(wrong: dict[str, Any], words: str) -> None:
    with refused(UsageError, *words):
        PlaneCut(**wrong)


def test_numbers_and_distances_are_read_from_text() -> None:
    sheets = [PlaneCut(sheet=given).sheet for given in (True, 7, "7", "5mm", " 2.50 MM")]
    assert sheets == [20, 7, 7, "5 mm", "2.5 mm"]
    assert PlaneCut(slices=4).sheet == 20 and PlaneCut().sheet is None
