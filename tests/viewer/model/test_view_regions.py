"""Circles and boxes on slices: the voxels in them, by hand and by brute force, and what is none."""

from __future__ import annotations

import numpy as np
import pytest
import view_scenes as scenes
from refusals import refused
from view_models import make_model

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.viewer.model.planes import turn_cross
from clrecon.viewer.model.regions import measure_region, place_region
from clrecon.viewer.model.state import Pick

pytestmark = pytest.mark.unit

X, Y, Z = np.eye(3)


def make_noise(affine: np.ndarray, **given: object) -> Volume:
    """HU without any order, so that one voxel more or less is seen."""
    hu = np.random.default_rng(5).integers(-900, 1500, (14, 16, 18)).astype(np.int16)
    return Volume(hu, affine, **given)


def voxel_places(volume: Volume) -> np.ndarray:
    """Places of the centres of all voxels, (n, 3) LPS mm, in the order of the voxels."""
    k, j, i = np.indices(volume.voxels.shape)
    return volume.ijk_to_lps(np.stack([i, j, k], axis=-1).reshape(-1, 3))


def check_values(measure, values: np.ndarray) -> None:
    """Assert that a measure is of these HU, by their number, mean and deviation."""
    assert measure.voxels == len(values) > 20  # or the test would see little
    assert measure.value == pytest.approx(values.mean(), abs=1e-3)  # as it is rounded
    assert measure.sd == pytest.approx(values.std(ddof=1), abs=1e-3)


def test_circle_takes_the_voxels_of_its_layer_whose_centres_lie_within_its_radius() -> None:
    volume = make_noise(np.diag([0.7, 0.9, 2.0, 1.0]))
    centre, rim = (6.1, 7.2, 8.9), (10.0, 7.2, 8.9)  # 8.9 mm: nearest to layer 4
    points = place_region("circle", centre, rim, right=X, up=-Y)

    measure = measure_region(volume, "circle", points)

    j, i = np.indices((16, 18))
    within = np.hypot(0.7 * i - 6.1, 0.9 * j - 7.2) <= 3.9
    check_values(measure, volume.voxels[4][within].astype(float))
    assert measure.area_mm2 == pytest.approx(np.pi * 3.9**2, abs=1e-3)


def test_box_takes_the_voxels_of_its_layer_within_its_corners() -> None:
    volume = make_noise(np.diag([0.7, 0.9, 2.0, 1.0]))
    points = place_region("box", first=(2.0, 3.0, 8.0), second=(9.0, 10.0, 8.0), right=X, up=-Y)

    measure = measure_region(volume, "box", points)

    check_values(measure, volume.voxels[4, 4:12, 3:13].ravel().astype(float))  # y 3.6 to 9.9 mm, x 2.1 to 8.4 mm
    assert measure.area_mm2 == pytest.approx((9.0 - 2.0) * (10.0 - 3.0))


@pytest.mark.parametrize("z", [8.999999, 9.0, 9.000001])
def test_region_between_two_layers_takes_one_of_them(z: float) -> None:
    volume = make_noise(np.diag([1.0, 1.0, 2.0, 1.0]))
    points = place_region("box", first=(2.0, 3.0, z), second=(9.0, 10.0, z), right=X, up=-Y)

    assert measure_region(volume, "box", points).voxels == 8 * 8  # 1 mm apart, 2 to 9 and 3 to 10 mm


@pytest.mark.parametrize("thickness", [3.0, 7.5])
def test_region_on_an_oblique_thick_slice_takes_all_voxels_within_its_thickness(thickness: float) -> None:
    volume = make_noise(scenes.AFFINE)
    middle = volume.ijk_to_lps([8.3, 7.1, 6.4])
    turns = (turn_cross(turn=None, plane="axial", degrees=25.0), turn_cross(turn=None, plane="sagittal", degrees=35.0))
    right, up = (np.array(turns[0]) @ np.array(turns[1]) @ axis for axis in (X, Y))
    points = place_region("circle", tuple(middle), tuple(middle + 4.5 * right), right=right, up=up)

    measure = measure_region(volume, "circle", points, thickness_mm=thickness)

    away = voxel_places(volume) - middle
    within = np.abs(away @ np.cross(right, up)) <= 0.5 * thickness
    within &= np.hypot(away @ right, away @ up) <= 4.5
    check_values(measure, volume.voxels.ravel()[within].astype(float))


def test_thin_region_on_an_oblique_slice_takes_one_voxel_of_each_column_through_it() -> None:
    volume = make_noise(np.diag([1.0, 1.0, 1.0, 1.0]))
    middle = np.array([8.0, 8.0, 7.0])
    right, up = (np.array(turn_cross(turn=None, plane="sagittal", degrees=20.0)) @ axis for axis in (X, Y))
    half = 5.2 * (right + up)
    points = place_region("box", tuple(middle - half), tuple(middle + half), right=right, up=up)

    measure = measure_region(volume, "box", points)

    # The plane meets each column along k at a height: the voxel nearest to it counts where its centre is inside.
    normal = np.cross(right, up)
    j, i = np.indices((16, 18))
    height = 7.0 - ((i - 8.0) * normal[0] + (j - 8.0) * normal[1]) / normal[2]
    k = np.floor(height + 0.5)
    away = np.stack([i, j, k], axis=-1) - middle
    within = (np.abs(away @ right) <= 5.2) & (np.abs(away @ up) <= 5.2)
    check_values(measure, volume.voxels[k[within].astype(int), j[within], i[within]].astype(float))


def test_region_in_an_uneven_stack_takes_the_layer_that_lies_nearest() -> None:
    heights = np.cumsum([0.0, 1, 1, 1, 1, 4, 4, 1, 1, 1, 1, 1, 1, 1])
    positions = np.stack([np.zeros(14), np.zeros(14), heights], axis=1)
    volume = make_noise(np.eye(4), slice_positions=positions)
    z = 9.5  # mm, between layers at 8 and 12 mm
    points = place_region("box", first=(2.0, 3.0, z), second=(9.0, 10.0, z), right=X, up=-Y)

    measure = measure_region(volume, "box", points)

    check_values(measure, volume.voxels[5, 3:11, 2:10].ravel().astype(float))  # at 8 mm


def draw(model, tool: str, first, second, axes=(X, -Y)):
    """Click at two points of a slice, `axes` to its right and up; return the measure."""
    model.start_tool(tool)
    model.add_point(Pick(point=tuple(first)), axes)
    return model.add_point(Pick(point=tuple(second)), axes)


def test_circle_of_a_view_is_listed_with_mean_and_deviation() -> None:
    model = make_model()

    draw(model, "circle", scenes.middle(0), scenes.middle(0) + (5.0, 0.0, 0.0))  # in a ball of 9 mm

    (shown,) = model.facts()["measures"]
    assert (shown["name"], shown["text"], shown["unit"]) == ("circle 1", "1000 ± 0 HU", "HU")


def test_first_point_of_a_circle_on_another_slice_is_moved_into_that_of_the_second() -> None:
    model = make_model()

    circle = draw(model, "circle", scenes.middle(0) + (0.0, 0.0, 4.0), scenes.middle(0) + (5.0, 0.0, 0.0))

    assert circle.points[0] == pytest.approx(tuple(scenes.middle(0)))


REFUSED = {
    "in the picture": ("circle", (0.0, 0.0, 0.0), (5.0, 0.0, 0.0), None, "slice"),
    "no radius": ("circle", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (X, -Y), "area"),
    "a line": ("box", (0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (X, -Y), "area"),
    "beside the scan": ("circle", (900.0, 0.0, 0.0), (905.0, 0.0, 0.0), (X, -Y), "voxel"),
    "between voxels": ("circle", (0.3, 0.3, 0.0), (0.31, 0.3, 0.0), (X, -Y), "voxel"),
}


@pytest.mark.parametrize(("tool", "first", "second", "axes", "fact"), REFUSED.values(), ids=REFUSED)
def test_region_that_measures_nothing_is_refused_and_leaves_the_measures(tool, first, second, axes, fact) -> None:
    model = make_model(make_noise(np.eye(4)))

    with refused(UsageError, tool, fact):
        draw(model, tool, first, second, axes)

    assert model.state.measures == ()


def test_region_without_a_scan_is_refused() -> None:
    with refused(UsageError, "scan", "box"):
        draw(make_model(scenes.make_mesh()), "box", (0.0, 0.0, 0.0), (5.0, 5.0, 0.0))
