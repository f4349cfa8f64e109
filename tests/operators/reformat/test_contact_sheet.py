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
SHAPE = (20, 40, 36)
AFFINE = np.diag([2.0, 2.0, 3.0, 1.0])
AFFINE[:3, 3] = (-40.0, -50.0, 100.0)


def volume_of_steps(axis: int = 0) -> Volume:
    """HU are ten times the index along an axis of the array; voxels of 2 x 2 x 3 mm, the first slice at 100 mm."""
    voxels = 10 * np.indices(SHAPE)[axis]
    return Volume(voxels.astype(np.int16), AFFINE)


def take_sheet(volume: Volume, device: Any, view: str = "axial", **style: Any) -> clrecon.Rendering:
    return clrecon.render(volume, PlaneCut(**style), view=view, size=SIZE, device=device)


def tiles_of(picture: clrecon.Rendering) -> list[np.ndarray]:
    """HU of the pixels of each tile, in the order of the report."""
    width, height = picture.report["tile_size"]
    return [
        picture.values[tile["top"] : tile["top"] + height, tile["left"] : tile["left"] + width]
        for tile in picture.report["tiles"]
    ]


def heights_of(picture: clrecon.Rendering) -> list[float]:
    """z of the middle of each tile, mm."""
    middles = [tile["middle_lps_mm"] for tile in picture.report["tiles"]]
    return [z for _, _, z in middles]


@pytest.fixture(params=[("axial", 0, 18), ("coronal", 1, 0), ("sagittal", 2, 0)], ids=["axial", "coronal", "sagittal"])
def every_third_plane(request: pytest.FixtureRequest, device: Any) -> Any:
    """A sheet of every third plane, the axis of the array that it runs along, and the first that is shown."""
    view, axis, first = request.param
    return take_sheet(volume_of_steps(axis), device, view, slices=3), axis, first


@pytest.mark.every_device
def test_every_third_plane_of_voxels_is_shown_from_head_front_or_right(every_third_plane: Any) -> None:
    picture, axis, first = every_third_plane
    numbers = [tile["slice"] for tile in picture.report["tiles"]]
    assert sorted(numbers) == list(range(0, SHAPE[axis], 3))
    assert numbers[0] == first
    tiles = tiles_of(picture)
    assert len(tiles) == len(numbers)
    for number, values in zip(numbers, tiles, strict=True):
        assert np.nanmin(values) == np.nanmax(values) == 10 * number
        assert np.isfinite(values).mean() > 0.9  # measured 1


@pytest.mark.every_device
def test_tiles_tell_the_places_of_their_planes(every_third_plane: Any) -> None:
    picture, axis, _ = every_third_plane
    in_lps = 2 - axis  # axes of the array are z, y, x
    places = [tile["middle_lps_mm"][in_lps] for tile in picture.report["tiles"]]
    numbers = np.array([tile["slice"] for tile in picture.report["tiles"]])
    assert np.allclose(places, AFFINE[in_lps, 3] + AFFINE[in_lps, in_lps] * numbers, atol=1e-6)  # mm; measured 0


@pytest.mark.every_device
def test_a_sheet_has_no_camera_and_no_depths(every_third_plane: Any) -> None:
    picture, _, _ = every_third_plane
    assert picture.camera is None
    assert np.isnan(picture.depth).all()
    assert picture.mode == "slice"


def test_a_number_of_slices_is_spread_over_the_scan_on_planes_of_voxels(device: Any) -> None:
    """Of 20 slices each stands for four: the second of them is shown, from the head down."""
    picture = take_sheet(volume_of_steps(), device, sheet=5)
    assert [tile["slice"] for tile in picture.report["tiles"]] == [17, 13, 9, 5, 1]


def test_slices_at_a_distance_lie_at_its_multiples_and_have_no_number(device: Any) -> None:
    """Slices at 100, 103 ... 157 mm have 0, 10 ... 190 HU."""
    picture = take_sheet(volume_of_steps(), device, sheet="10mm")
    assert heights_of(picture) == [150.0, 140.0, 130.0, 120.0, 110.0, 100.0]
    assert {tile["slice"] for tile in picture.report["tiles"]} == {None}
    _, at_140_mm, *_ = tiles_of(picture)
    assert at_140_mm[20, 20] == pytest.approx(10 * (140.0 - 100.0) / 3.0, abs=1e-5)  # HU in float32; measured 5e-6


def test_uneven_slices_have_their_places_and_values(device: Any) -> None:
    volume = volume_of_steps()
    kept = [0, 1, 4, 5, 11, 19]
    uneven = Volume(volume.voxels[kept], AFFINE, slice_positions=volume.slice_origins()[kept])
    picture = take_sheet(uneven, device, slices=1)
    assert heights_of(picture) == [100.0 + 3.0 * slice_ for slice_ in kept[::-1]]  # from the head down
    assert [float(np.nanmax(values)) for values in tiles_of(picture)] == [10 * slice_ for slice_ in kept[::-1]]


@pytest.fixture
def turned_volume() -> Volume:
    """A volume turned by 20 degrees about x."""
    turned = np.eye(4)
    turned[:3, :3] = rotation((20.0, 0.0, 0.0))
    return Volume(volume_of_steps().voxels, turned @ AFFINE)


def test_slices_across_a_turned_volume_have_no_number(device: Any, turned_volume: Volume) -> None:
    picture = take_sheet(turned_volume, device, sheet=4)
    assert [tile["slice"] for tile in picture.report["tiles"]] == [None] * 4


def test_every_second_slice_of_an_oblique_view_is_refused(device: Any, turned_volume: Volume) -> None:
    with refused(UsageError, "planes", "voxels"):
        take_sheet(turned_volume, device, (45, 45), slices=2)


@pytest.fixture
def tilted_sheet(device: Any) -> clrecon.Rendering:
    """Slices 3 and 12 of a volume by a gantry tilted by 18.5 degrees."""
    tilted = AFFINE.copy()
    tilted[:3, 1] = 2.0 * np.array([0.0, np.cos(np.radians(18.5)), np.sin(np.radians(18.5))])
    return take_sheet(Volume(volume_of_steps().voxels, tilted), device, slices=[3, 12])


def test_slices_of_a_tilted_gantry_are_shown_as_they_were_taken(tilted_sheet: clrecon.Rendering) -> None:
    assert [tile["slice"] for tile in tilted_sheet.report["tiles"]] == [12, 3]
    for number, values in zip((12, 3), tiles_of(tilted_sheet), strict=True):
        assert np.isfinite(values).mean() > 0.5  # measured 0.95 on
        assert np.allclose(values[np.isfinite(values)], 10 * number, atol=1e-3)  # HU in float32; measured 0


def test_sheet_of_a_tilted_gantry_warns_of_the_tilt_and_names_its_sides(tilted_sheet: clrecon.Rendering) -> None:
    report = tilted_sheet.report
    assert any("tilted by 18.5 degrees from the plane asked for" in text for text in report["warnings"])
    assert report["edges"]["right"] == "L"
    assert report["edges"]["top"][0] == "A"


@pytest.fixture
def block_at_the_left() -> Volume:
    """900 HU from column 30 of 36 on, at the patient's left."""
    voxels = np.zeros((20, 40, 36), np.int16)
    voxels[:, :, 30:] = 900
    return Volume(voxels, AFFINE)


def test_the_left_of_the_patient_is_at_the_right_of_every_tile(device: Any, block_at_the_left: Volume) -> None:
    picture = take_sheet(block_at_the_left, device, sheet=4)
    assert (picture.report["edges"]["right"], picture.report["edges"]["top"]) == ("L", "A")
    tiles = tiles_of(picture)
    assert len(tiles) == 4
    for values in tiles:
        assert np.nanmean(values[:, -20:]) > 700  # but for the blurred edge of the block
        assert np.nanmean(values[:, :20]) == 0


def test_tiles_are_as_wide_as_the_volume(device: Any, block_at_the_left: Volume) -> None:
    report = take_sheet(block_at_the_left, device, sheet=4).report
    width, _ = report["tile_size"]
    assert width * report["pixel_mm"] == pytest.approx(36 * 2.0, rel=0.01)  # whole pixels; measured 0.003


def test_zoom_of_two_halves_the_pixels_of_a_sheet(device: Any, block_at_the_left: Volume) -> None:
    pixel, zoomed_pixel = (
        clrecon.render(
            block_at_the_left, PlaneCut(sheet=4), view="axial", zoom=zoom, size=SIZE, device=device
        ).report["pixel_mm"]
        for zoom in (1.0, 2.0)
    )  # fmt: skip
    assert zoomed_pixel == pytest.approx(0.5 * pixel, rel=1e-6)  # float64; measured 0


@pytest.fixture
def labels_in_four_slices() -> LabelMap:
    """A label of 10 x 10 voxels of 2 mm in slices 8 to 11."""
    numbers = np.zeros((20, 40, 36), np.uint8)
    numbers[8:12, 10:20, 10:20] = 3
    return LabelMap(numbers, AFFINE, {3: "vertebrae_L3"})


def is_green(image: np.ndarray) -> np.ndarray:
    return np.asarray(image[..., 1].astype(int) > image[..., 0].astype(int) + 30)


def test_labels_are_drawn_on_their_slices_alone(device: Any, labels_in_four_slices: LabelMap) -> None:
    colors = {3: "#00ff00"}
    picture = take_sheet(volume_of_steps(), device, slices=4, labels=labels_in_four_slices, label_colors=colors)
    width, height = picture.report["tile_size"]
    green_slices = [
        tile["slice"]
        for tile in picture.report["tiles"]
        if is_green(picture.image[tile["top"] : tile["top"] + height, tile["left"] : tile["left"] + width]).any()
    ]
    assert green_slices == [8]  # of 0, 4, 8, 12 and 16
    (entry,) = picture.report["labels"]
    assert (entry["label_number"], entry["label"], entry["color"]) == (3, "vertebrae_L3", "#00ff00")


def test_a_label_on_a_slice_has_its_area_and_the_report_its_pixels(
    device: Any, labels_in_four_slices: LabelMap
) -> None:
    style = PlaneCut(labels=labels_in_four_slices, label_colors={3: "#00ff00"})
    in_slice_9 = (-10.0, -10.0, 127.0)
    picture = clrecon.render(volume_of_steps(), style, view="axial", size=(80, 80), device=device, center=in_slice_9)
    pixels = np.count_nonzero(is_green(picture.image))
    assert pixels * picture.pixel_mm**2 == pytest.approx((10 * 2.0) ** 2, rel=0.1)  # its outline is a pixel wide
    (entry,) = picture.report["labels"]
    assert entry["pixels"] == pytest.approx(pixels, rel=0.02)  # measured 0


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
        take_sheet(volume_of_steps(), device, **style)


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
def test_wrong_numbers_and_distances_of_sheets_are_refused(wrong: dict[str, Any], words: str) -> None:
    with refused(UsageError, *words):
        PlaneCut(**wrong)


@pytest.mark.parametrize(
    ("given", "sheet"), [(True, 20), (7, 7), ("7", 7), ("5mm", "5 mm"), (" 2.50 MM", "2.5 mm"), (None, None)]
)
def test_number_or_distance_of_a_sheet_is_read_from_text_and_is_20_by_default(given: Any, sheet: Any) -> None:
    assert PlaneCut(sheet=given).sheet == sheet


def test_every_fourth_slice_makes_a_sheet_of_20() -> None:
    assert PlaneCut(slices=4).sheet == PlaneCut(sheet=True).sheet == 20
