"""Curved reformations of bent tubes with known radius and length, in sheared and uneven volumes."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.operators.reformat.cut import reformat_curve
from clrecon.proof.volumes.volume_twins import reformat_sheet
from clrecon.rendering.views.centre_line import Curve
from clrecon.rendering.views.reformation import slab_samples, straightened_sheet

BEND, TUBE = 40.0, 7.0
"""Radius of the torus and of its tube, mm."""
TURN = np.radians(110.0)
CENTRE = np.array([4.0, -60.0, 200.0])


def volume_around_tube(grid):
    """Zeros on a grid, "sheared" or "uneven", about 60 mm aside, 80 along y and z."""
    affine = np.eye(4)
    affine[:3, :3] = [[0.9, 0.0, 0.1], [0.0, 0.8, -0.3], [0.0, 0.0, 1.2]]
    affine[:3, 3] = CENTRE + (-16.0, -10.0, -46.0)
    shape = (78, 104, 36)
    if grid == "sheared":
        return Volume(np.zeros(shape, np.float32), affine)
    heights = np.cumsum(np.tile([0.7, 1.2, 0.9], 34)[:102])
    positions = affine[:3, 3] + np.stack([0.0 * heights, 0.02 * heights, heights], axis=1) + (0.0, 0.0, -2.0)
    affine[:3, 2] = (0.0, 0.0, 0.93)
    return Volume(np.zeros((102, *shape[1:]), np.float32), affine, slice_positions=positions)


def coordinates(volume):
    """For each voxel: distance from the middle of the tube, and way along it, from the upper end down."""
    nk, nj, ni = volume.voxels.shape
    k, j, i = np.indices((nk, nj, ni)).reshape(3, -1)
    x, y, z = (volume.ijk_to_lps(np.stack([i, j, k], axis=1)) - CENTRE).T
    distance = np.hypot(x, np.hypot(y, z) - BEND)
    way = BEND * (0.5 * TURN - np.arctan2(z, y))
    return distance.reshape(nk, nj, ni), way.reshape(nk, nj, ni)


def centre_line():
    """Twelve points on the middle of the tube, from its lower end up, mm."""
    angle = np.linspace(-0.5 * TURN, 0.5 * TURN, 12)
    return CENTRE + BEND * np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], axis=1)


def edges(values, pixel):
    """The two crossings of 0 in each row, mm from the middle of the picture; linear between pixels."""
    crossings = []
    for row in values:
        at = np.flatnonzero(np.diff(row > 0.0))
        assert len(at) == 2
        crossings.append((at + row[at] / (row[at] - row[at + 1]) - 0.5 * (len(row) - 1)) * pixel)
    return np.array(crossings)


GRIDS = pytest.mark.parametrize("grid", ["sheared", "uneven"])
KINDS = pytest.mark.parametrize("kind", ["straightened", "stretched"])
TUBE_SIZE = (60, 150)
"""Columns and rows of a picture of the whole tube."""


@GRIDS
@KINDS
def test_picture_of_a_bent_tube_is_as_long_as_its_arc_and_each_row_at_its_way_along_it(device, grid, kind):
    volume = volume_around_tube(grid)
    _, way = coordinates(volume)
    marked = volume.with_voxels(way.astype(np.float32))
    seen = reformat_curve(marked, centre_line(), kind, TUBE_SIZE, device=device, view="anterior")
    pixel, arc = seen.report["pixel_mm"], BEND * TURN
    columns, rows = TUBE_SIZE
    assert rows * pixel == pytest.approx(arc, rel=tolerances.TUBE_ARC)
    assert seen.report["curve"]["length_mm"] == pytest.approx(arc, rel=tolerances.TUBE_ARC)
    middle = seen.values[:, columns // 2]
    assert np.abs(middle - (np.arange(rows) + 0.5) * pixel).max() <= tolerances.TUBE_ARC * arc


def test_curved_reformation_runs_from_the_upper_end_and_has_no_camera_and_no_depths(device):
    """The points of the centre line run upward."""
    volume = volume_around_tube("sheared")
    seen = reformat_curve(volume, centre_line(), "straightened", TUBE_SIZE, device=device, view="anterior")
    assert seen.report["curve"]["reversed"]
    assert seen.camera is None
    assert np.isnan(seen.depth).all()


@GRIDS
@KINDS
def test_a_bent_tube_is_straight_and_has_its_width(device, grid, kind):
    volume = volume_around_tube(grid)
    distance, _ = coordinates(volume)
    tube = volume.with_voxels((100.0 * (TUBE - distance)).astype(np.float32))
    seen = reformat_curve(tube, centre_line(), kind, TUBE_SIZE, device=device, view="anterior")
    assert np.abs(edges(seen.values, seen.report["pixel_mm"]) - (-TUBE, TUBE)).max() <= tolerances.TUBE_EDGE_MM


@pytest.mark.parametrize("angle", [90.0, 30.0])
def test_a_round_tube_is_as_wide_from_every_side(device, angle):
    volume, pixel_mm, width_mm = volume_around_tube("sheared"), 0.5, 20.0
    distance, _ = coordinates(volume)
    tube = volume.with_voxels((100.0 * (TUBE - distance)).astype(np.float32))
    seen = reformat_curve(tube, centre_line(), "straightened", device=device, view="anterior", angle=angle,
                          pixel_mm=pixel_mm, width_mm=width_mm)  # fmt: skip
    assert seen.values.shape == (round(BEND * TURN / pixel_mm), width_mm / pixel_mm)
    assert np.abs(edges(seen.values, pixel_mm) - (-TUBE, TUBE)).max() <= tolerances.TUBE_EDGE_MM


@KINDS
@pytest.mark.parametrize("upward", [True, False])
@pytest.mark.parametrize(
    ("view", "axis", "sign"),
    [("left", 1, 1), ("anterior", 0, 1), ("right", 1, -1), ("posterior", 0, -1)],
    ids=["left: back at the right", "anterior: left at the right", "right: front at the right",
         "posterior: right at the right"],
)  # fmt: skip
def test_sides_of_a_curved_reformation_are_those_of_its_view_and_the_head_is_at_its_top(
    device, kind, upward, view, axis, sign
):
    """However the points run: the volume shows its own coordinates."""
    volume = volume_around_tube("sheared")
    nk, nj, ni = volume.voxels.shape
    k, j, i = np.indices((nk, nj, ni)).reshape(3, -1)
    places = volume.ijk_to_lps(np.stack([i, j, k], axis=1)).reshape(nk, nj, ni, 3).astype(np.float32)
    line = CENTRE + np.array([(0.0, 30.0, z) for z in (-20.0, 5.0, 20.0)])
    points = line if upward else line[::-1]
    size = columns, rows = 8, 12

    across, heights = (
        reformat_curve(volume.with_voxels(places[..., shown]), points, kind, size, device=device, view=view).values
        for shown in (axis, 2)
    )

    middle_row, middle_column = rows // 2, columns // 2
    assert np.sign(across[middle_row, -1] - across[middle_row, 0]) == sign
    assert heights[0, middle_column] > heights[-1, middle_column]


@pytest.fixture(scope="module")
def two_wires():
    """Wires of 500 and 900 HU beside the column at i = 20, j = 20: 2 and 5 mm into the picture."""
    voxels = np.zeros((40, 40, 40), np.int16)
    voxels[:, 20, 18], voxels[:, 24, 15] = 500, 900
    return Volume(voxels, np.eye(4)), [(20.0, 20.0, 2.0), (20.0, 20.0, 38.0)]


@KINDS
def test_a_slab_of_6_mm_shows_the_wire_within_3_mm_of_the_picture_alone(device, two_wires, kind):
    volume, line = two_wires
    slab = reformat_curve(volume, line, kind, (21, 36), device=device, thickness=6.0, combine="max", pixel_mm=1.0)
    middle_column = slab.values[:, 10]
    assert (middle_column == 500).all()
    assert slab.values.max() == 500


@KINDS
def test_a_picture_without_thickness_shows_no_wire_beside_it(device, two_wires, kind):
    volume, line = two_wires
    assert reformat_curve(volume, line, kind, (21, 36), device=device, pixel_mm=1.0).values.max() == 0


def test_curved_reformation_equals_its_twin(device):
    volume = volume_around_tube("uneven")
    values = np.random.default_rng(4).integers(0, 100, volume.voxels.shape).astype(np.int16)
    volume = volume.with_voxels(values)
    size = columns, rows = 30, 50
    seen = reformat_curve(volume, centre_line(), "straightened", size, device=device, view="left", thickness=2.0)
    curve, to_the_back = Curve(centre_line()[::-1]), np.array([0.0, 1.0, 0.0])
    straightened = straightened_sheet(curve, to_the_back, size, curve.length / rows)
    expected = reformat_sheet(volume, straightened.sheet, slab_samples(volume, 2.0))
    assert np.array_equal(np.isnan(seen.values), np.isnan(expected))
    assert np.nanmax(np.abs(seen.values - expected)) <= tolerances.TWIN_SLICE_HU


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"kind": "projected"}, "straightened or stretched"),
        ({"view": "front"}, "anterior, posterior"),
        ({"kind": "stretched", "angle": 5.0}, "angle"),
        ({"size": (3, 3), "width_mm": 10.0}, "not by both"),
        ({"width_mm": -1.0}, "width"),
        ({"pixel_mm": 1e-6}, "size of a picture"),
        ({"curve": [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)]}, "point 0 at"),
        ({"curve": CENTRE[None]}, "at least two"),
        ({"kind": "stretched", "curve": CENTRE + [(0, 20, 0), (0, 40, 0.1)], "view": "left"}, "another view"),
    ],
)
def test_wrong_arguments_of_a_curved_reformation_are_refused(device, arguments, says):
    with pytest.raises(UsageError, match=says):
        reformat_curve(
            **{"volume": volume_around_tube("sheared"), "curve": centre_line(), "device": device, **arguments}
        )
