"""RT structure sets: contours in mm become labels on the slices of their scan, by the even-odd rule of centres."""

from __future__ import annotations

import json

import dicom_series
import numpy as np
import pytest
import tolerances
from refusals import assert_one_line, refused
from structure_sets import write_structures
from uneven_volume import uneven

from clrecon import Volume, read_labels
from clrecon.cli.main import main
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import slice_voxel_ml
from clrecon.labels.contours import fill_contours, unite_contours
from clrecon.labels.label_levels import label_ml
from clrecon.labels.reader import read_all_labels
from clrecon.labels.resample import resample_labels
from clrecon.labels.structures import label_slices
from clrecon.reading import read_volume

pytestmark = pytest.mark.unit

CLOSED = "CLOSED_PLANAR"
PLANS = {
    "straight": dicom_series.Plan(shape=(7, 20, 24), gap=1.25),
    "oblique": dicom_series.Plan(shape=(7, 20, 24), angles=(10, -20, 35), gap=1.25),
    "tilted": dicom_series.Plan(shape=(7, 20, 24), tilt_deg=12.0, gap=1.25),
}


@pytest.fixture(params=PLANS)
def volume(request, tmp_path):
    """A CT of 7 slices of 20 rows and 24 columns, 1.25 mm apart: one after the other of PLANS."""
    dicom_series.write_series(tmp_path / "ct", PLANS[request.param])
    return read_volume(tmp_path / "ct")


def rectangle(volume, k, low, high):
    """A contour around the pixels from `low` to `high` (i, j), both included."""
    (i0, j0), (i1, j1) = np.subtract(low, 0.5), np.add(high, 0.5)
    return CLOSED, volume.ijk_to_lps([(i0, j0, k), (i1, j0, k), (i1, j1, k), (i0, j1, k)])


@pytest.mark.parametrize("counts", [True, False], ids=["NumberOfContourPoints", "without it"])
def test_rois_of_rectangles_become_labels_of_the_pixels_inside(volume, tmp_path, counts):
    rois = {
        "L3": [rectangle(volume, k, (3, 4), (9, 12)) for k in (2, 3, 4)],
        "Leber & Milz ä": [rectangle(volume, 3, (15, 2), (15, 2))],
    }
    expected = np.zeros(volume.voxels.shape, int)
    expected[2:5, 4:13, 3:10] = 1
    expected[3, 2, 15] = 2

    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois, counts=counts), volume=volume)

    assert np.array_equal(labels.voxels, expected)
    assert labels.names == {1: "L3", 2: "Leber & Milz ä"}
    assert labels.warnings == ()


def test_labels_of_contours_lie_on_the_grid_of_their_scan(volume, tmp_path):
    rois = {"L3": [rectangle(volume, 2, (3, 4), (9, 12))]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert np.array_equal(labels.affine, volume.affine)
    assert resample_labels(labels, volume).exact


def test_contour_within_another_is_a_hole_and_one_within_that_is_filled(volume, tmp_path):
    nested = [rectangle(volume, 1, (2, 2), (16, 16)), rectangle(volume, 1, (5, 5), (13, 13)),
              rectangle(volume, 1, (8, 8), (10, 10))]  # fmt: skip
    labels = read_labels(write_structures(tmp_path / "rt.dcm", {"x": nested}), volume=volume)
    assert labels.counts == {1: 15 * 15 - 9 * 9 + 3 * 3}


def test_contour_that_enters_its_hole_along_a_line_leaves_the_hole_out(volume, tmp_path):
    outer = [(1.5, 1.5), (10.5, 1.5), (10.5, 10.5), (1.5, 10.5), (1.5, 1.5)]
    inner = [(4.5, 4.5), (4.5, 7.5), (7.5, 7.5), (7.5, 4.5), (4.5, 4.5)]
    keyhole = volume.ijk_to_lps([(i, j, 2) for i, j in (*outer, *inner)])
    labels = read_labels(write_structures(tmp_path / "rt.dcm", {"x": [(CLOSED, keyhole)]}), volume=volume)
    assert labels.counts == {1: 9 * 9 - 3 * 3}


@pytest.mark.parametrize(("radius", "centre"), [(20.3, (30.2, 31.7)), (3.7, (30.5, 30.5))], ids=["large", "small"])
def test_pixels_of_a_circle_are_those_whose_centres_lie_within_its_radius(radius, centre):
    shape = (64, 60)
    filled = fill_contours([circle(radius, corners=3600, centre=centre)], shape)
    j, i = np.indices(shape)
    assert np.array_equal(filled, np.hypot(i - centre[0], j - centre[1]) < radius)


def test_pixel_whose_centre_is_on_the_common_side_of_two_contours_belongs_to_one_of_them():
    top, bottom = (5.0, -1.0), (5.0, 20.0)  # through the centres of column 5
    left = np.array([(-1.0, -1.0), top, bottom, (-1.0, 20.0)])
    right = np.array([top, (30.0, -1.0), (30.0, 20.0), bottom])
    expected_right = np.zeros((10, 12), bool)
    expected_right[:, 5:] = True
    assert np.array_equal(fill_contours([right], (10, 12)), expected_right)
    assert np.array_equal(fill_contours([left], (10, 12)), ~expected_right)


def test_contour_beyond_the_pixels_of_its_slice_is_cut_off(volume, tmp_path):
    rois = {"x": [rectangle(volume, 1, (-30, -30), (5, 90))]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 20 * 6}  # all rows, columns 0 to 5
    assert labels.warnings == ()


def test_contours_beyond_the_slices_of_the_scan_are_left_out_with_a_warning(volume, tmp_path):
    rois = {"x": [rectangle(volume, k, (2, 2), (4, 4)) for k in (1, -3, 9)]}  # the scan has slices 0 to 6
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 3 * 3}
    assert labels.warnings == ("ROI x: 2 contours beyond the slices of the scan left out",)


def test_points_slices_without_contours_and_rois_without_any_are_warned_of(volume, tmp_path):
    point = ("POINT", volume.ijk_to_lps([(4, 4, 4)]))
    rois = {"x": [rectangle(volume, 1, (2, 2), (4, 4)), rectangle(volume, 5, (2, 2), (4, 4)), point], "iso": [point]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 2 * 3 * 3}
    assert labels.warnings == (
        "ROI x: 1 POINT left out, only closed planar contours enclose voxels",
        "ROI x: 3 of 5 slices from its first to its last have no contour and stay empty",
        "ROI iso: 1 POINT left out, only closed planar contours enclose voxels",
        "ROI iso has no closed contour and no voxel",
    )


def test_contour_written_three_times_counts_once_with_a_warning(volume, tmp_path):
    kind, points = rectangle(volume, 2, (3, 3), (12, 12))
    reversed_and_rounded = np.roll(points[::-1], 1, axis=0) + 0.002  # mm, and another corner first
    closed_by_its_first_point = [*points, points[0]]
    rois = {"x": [(kind, points), (kind, reversed_and_rounded), (kind, closed_by_its_first_point)]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 10 * 10}
    assert labels.warnings == ("ROI x: 2 contours written twice, each counts once",)


def test_contours_that_cross_are_united_with_a_warning(volume, tmp_path):
    plus = [rectangle(volume, 2, (5, 1), (7, 15)), rectangle(volume, 2, (1, 5), (18, 8))]
    labels = read_labels(write_structures(tmp_path / "rt.dcm", {"x": plus}), volume=volume)
    assert labels.counts == {1: 3 * 15 + 18 * 4 - 3 * 4}
    assert labels.warnings == ("ROI x: contours cross on 1 slice and were united",)


def test_contour_within_two_that_cross_is_a_hole_of_both(volume, tmp_path):
    """A hole within what both share lies within one region, not two."""
    two_that_cross = [((1, 1), (12, 12)), ((4, 4), (18, 18))]
    hole, filled_within_it = ((6, 6), (9, 9)), ((7, 7), (8, 8))
    rois = {"x": [rectangle(volume, 2, *corners) for corners in (*two_that_cross, hole, filled_within_it)]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    shared = 9 * 9
    assert labels.counts == {1: 12 * 12 + 15 * 15 - shared - 4 * 4 + 2 * 2}


def test_pixels_that_two_xor_contours_share_are_left_out(volume, tmp_path):
    xor = "CLOSEDPLANAR_XOR"
    (_, upright), (_, across) = rectangle(volume, 2, (5, 1), (7, 15)), rectangle(volume, 2, (1, 5), (18, 8))
    plus = [(xor, upright), (xor, across)]
    labels = read_labels(write_structures(tmp_path / "rt.dcm", {"x": plus}), volume=volume)
    assert labels.counts == {1: 3 * 15 + 18 * 4 - 2 * 3 * 4}
    assert labels.warnings == ()


def test_xor_contour_written_twice_leaves_nothing(volume, tmp_path):
    _, points = rectangle(volume, 2, (5, 1), (7, 15))
    twice = ("CLOSEDPLANAR_XOR", points)
    rois = {"y": [twice, twice, rectangle(volume, 4, (1, 1), (2, 2))]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 2 * 2}


@pytest.mark.parametrize(("beyond_mm", "is_hole"), [(0.04, True), (0.06, False)], ids=["rounding", "crossing"])
def test_hole_that_passes_the_outline_by_less_than_a_tenth_of_a_mm_is_still_a_hole(beyond_mm, is_hole):
    """The hole has the centres of column 2 and the outline has not: their sides lie twice `beyond_mm` apart."""
    beyond = beyond_mm / 0.5  # pixels
    outer = np.array([(2 + beyond, 1.6), (11.4, 1.6), (11.4, 11.4), (2 + beyond, 11.4)])
    hole = np.array([(2 - beyond, 4.6), (5.4, 4.6), (5.4, 7.4), (2 - beyond, 7.4)])
    united = unite_contours([outer, hole], (16, 16), (0.5, 0.5))
    assert united.crossing == (0 if is_hole else 1)
    assert united.inside[:, 3:].sum() == 9 * 10 - (3 * 3 if is_hole else 0)


def test_contours_of_fewer_than_3_points_are_left_out_with_a_warning(volume, tmp_path):
    kind, points = rectangle(volume, 2, (2, 2), (4, 4))
    rois = {"x": [(kind, points), (kind, points[:2]), (kind, points[:1])], "y": [(kind, points[:2])]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 3 * 3}
    assert labels.warnings == (
        "ROI x: 2 contours of fewer than 3 points left out",
        "ROI y: 1 contour of fewer than 3 points left out",
    )


def test_roi_whose_contours_have_fewer_than_3_points_is_refused_where_it_is_asked_for(volume, tmp_path):
    kind, points = rectangle(volume, 2, (2, 2), (4, 4))
    path = write_structures(tmp_path / "rt.dcm", {"x": [(kind, points)], "y": [(kind, points[:2])]})
    assert read_labels(path, ["x"], volume=volume).counts == {1: 3 * 3}
    with refused(RefusedInputError, "rt.dcm", "ROI", 1, 3):
        read_labels(path, ["y"], volume=volume)


@pytest.mark.parametrize("only", [None, ["iso"]], ids=["all", "by name"])
def test_roi_of_a_point_alone_is_refused(volume, tmp_path, only):
    path = write_structures(tmp_path / "rt.dcm", {"iso": [("POINT", volume.ijk_to_lps([(4, 4, 4)]))]})
    with refused(RefusedInputError, "ROI", "POINT", 1):
        read_labels(path, only, volume=volume)


def write_square_off_its_slice(path, off_mm):
    """A scan of slices 3 mm apart, and a square of 9 pixels `off_mm` above its third slice."""
    volume = Volume(np.zeros((4, 20, 24), np.int16), np.diag((1.0, 1.0, 3.0, 1.0)))
    kind, points = rectangle(volume, 2, (2, 2), (4, 4))
    return write_structures(path, {"x": [(kind, points + (0.0, 0.0, off_mm))]}), volume


def test_contour_within_a_tenth_of_a_mm_of_its_slice_is_read_without_a_warning(tmp_path):
    path, volume = write_square_off_its_slice(tmp_path / "rt.dcm", off_mm=0.09)
    labels = read_labels(path, volume=volume)
    assert labels.counts == {1: 9}
    assert labels.warnings == ()


def test_contour_within_a_tenth_of_the_step_of_its_slice_is_read_with_a_warning(tmp_path):
    path, volume = write_square_off_its_slice(tmp_path / "rt.dcm", off_mm=0.29)
    labels = read_labels(path, volume=volume)
    assert labels.counts == {1: 9}
    (warning,) = labels.warnings
    assert "up to 0.29 mm off their slices" in warning


def test_contour_further_than_a_tenth_of_the_step_off_its_slice_is_refused(tmp_path):
    path, volume = write_square_off_its_slice(tmp_path / "rt.dcm", off_mm=0.31)
    with refused(RefusedInputError, 0.31, 0.1):
        read_labels(path, volume=volume)


def test_contour_through_voxel_centres_is_warned_of(volume, tmp_path):
    """As rt_utils writes them, which takes the outermost pixels of a mask as corners."""
    ijk = [(3, 4, 2), (9, 4, 2), (9, 12, 2), (3, 12, 2)]
    path = write_structures(tmp_path / "rt.dcm", {"x": [(CLOSED, volume.ijk_to_lps(ijk))]})
    (warning,) = read_labels(path, volume=volume).warnings
    assert warning.startswith("ROI x: the contours run through voxel centres, as rt_utils writes them")


@pytest.mark.parametrize("steps", [0.4, 0.2], ids=["0.4 steps", "0.2 steps"])
def test_contour_between_two_slices_is_refused_and_another_roi_can_be_read(volume, tmp_path, steps):
    between = [rectangle(volume, 2, (2, 2), (4, 4)), rectangle(volume, 3 + steps, (2, 2), (4, 4))]
    path = write_structures(tmp_path / "rt.dcm", {"x": between, "fine": [rectangle(volume, 1, (2, 2), (4, 4))]})
    with refused(RefusedInputError, "ROI", 1, 2, 1.25 * steps):  # one of two contours, and how many mm
        read_labels(path, volume=volume)
    assert read_labels(path, ["fine"], volume=volume).counts == {2: 3 * 3}


def test_contour_that_is_not_parallel_to_the_slices_is_refused(volume, tmp_path):
    rois = {"x": [(CLOSED, volume.ijk_to_lps([(2, 2, 1), (6, 2, 1), (6, 6, 3), (2, 6, 3)]))]}
    with refused(RefusedInputError, "rt.dcm", "parallel"):
        read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)


def test_contour_rounded_to_a_hundredth_of_a_mm_has_its_pixels(volume, tmp_path):
    kind, points = rectangle(volume, 2, (2, 2), (4, 4))
    path = write_structures(tmp_path / "rt.dcm", {"x": [(kind, np.round(points, 2))]})
    assert read_labels(path, volume=volume).counts == {1: 3 * 3}


def test_rois_of_another_frame_of_reference_than_the_scan_are_refused(volume, tmp_path):
    rois = {"x": [rectangle(volume, 2, (2, 2), (4, 4))]}
    path = write_structures(tmp_path / "rt.dcm", rois, frame="1.2.3.4.5.6")
    assert volume.report["frame_of_reference_hash"] is not None
    with refused(RefusedInputError, "ROIs", "rt.dcm", 1):
        read_labels(path, volume=volume)


def write_body_around_l3(path, volume):
    """BODY is all 7 x 20 x 24 voxels, L3 are 9 of them."""
    body = [rectangle(volume, k, (0, 0), (23, 19)) for k in range(7)]
    return write_structures(path, {"BODY": body, "L3": [rectangle(volume, 3, (2, 2), (4, 4))]})


def test_rois_that_overlap_are_refused_with_their_names_and_voxels(volume, tmp_path):
    with refused(RefusedInputError, "BODY", "L3", 1, 2, 9):
        read_labels(write_body_around_l3(tmp_path / "rt.dcm", volume), volume=volume)


def test_roi_chosen_by_name_or_number_is_read_alone_beside_one_that_overlaps(volume, tmp_path):
    path = write_body_around_l3(tmp_path / "rt.dcm", volume)
    l3 = read_labels(path, ["L3"], volume=volume)
    assert l3.counts == {2: 9}
    assert l3.names == {2: "L3"}
    assert read_labels(path, [1], volume=volume).counts == {1: 7 * 20 * 24}


def test_roi_chosen_by_name_keeps_its_voxels_where_all_are_read(volume, tmp_path):
    path = write_body_around_l3(tmp_path / "rt.dcm", volume)
    assert read_all_labels(path, ["L3"], volume=volume).counts == {1: 7 * 20 * 24 - 9, 2: 9}


def test_rois_numbered_from_0_are_numbered_from_1(volume, tmp_path):
    rois = {name: [rectangle(volume, k, (2, 2), (4, 4))] for name, k in (("a", 1), ("b", 2))}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois, numbers=[0, 1]), volume=volume)
    assert labels.names == {1: "a", 2: "b"}
    assert labels.counts == {1: 9, 2: 9}


def test_contours_without_a_scan_are_refused(tmp_path):
    path = write_structures(tmp_path / "rt.dcm", {"x": [rectangle(uneven(), 2, (1, 1), (2, 2))]})
    with refused(UsageError, "contours", "scan", "rt.dcm"):
        read_labels(path)


def test_contours_on_slices_whose_pixels_are_sheared_unevenly_are_refused(tmp_path):
    stack = uneven()  # its slices shift sideways, no two alike
    path = write_structures(tmp_path / "rt.dcm", {"x": [rectangle(stack, 2, (1, 1), (2, 2))]})
    with refused(UsageError, "contours", "pixels"):
        read_labels(path, volume=stack)


def label_slices_of_gap(gap, sign):
    """Slices of a map for a scan of six slices, `gap` and then 5 mm apart, up or down."""
    positions = np.zeros((6, 3))
    positions[:, 2] = sign * np.array([0.0, gap, 5.0, 10.0, 15.0, 20.0])
    affine = np.diag((1.0, 1.0, sign, 1.0))
    return label_slices(Volume(np.zeros((6, 4, 4), np.int16), affine, slice_positions=positions))


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["up", "down"])
@pytest.mark.parametrize(("gap", "slices"), [(0.05, 4), (0.02, 2)], ids=["four", "two"])
def test_map_for_uneven_slices_has_four_or_two_slices_to_their_smallest_gap(sign, gap, slices):
    affine = label_slices_of_gap(gap, sign).affine
    step, first = affine[2, 2:]
    assert step == pytest.approx(sign * gap / slices)
    assert first == pytest.approx(sign * (gap / slices - gap) / 2.0)  # its slices lie evenly around each of the scan


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["up", "down"])
def test_map_for_slices_5_micrometres_apart_is_refused(sign):
    with refused(UsageError, 5, "contours"):
        label_slices_of_gap(gap=0.005, sign=sign)


def uneven_scan(tilt, sign):
    """Six slices up to 7.7 mm apart, of pixels of 0.5 mm, from a gantry tilted by `tilt` degrees."""
    heights = np.array([0.0, 4.0, 8.0, 9.08, 16.0, 23.0])
    affine = np.diag((0.5, 0.5, sign, 1.0))
    positions = np.column_stack([0 * heights, heights * np.tan(np.radians(tilt)), sign * heights])
    return Volume(np.zeros((6, 20, 24), np.int16), affine, slice_positions=positions)


@pytest.fixture(
    params=[(0.0, 1.0), (0.0, -1.0), (18.0, 1.0), (18.0, -1.0)], ids=["up", "down", "tilted", "tilted down"]
)
def labels_of_uneven_scan(request, tmp_path):
    """Labels read from contours on slices 1, 2, 3 and 5, their pixels by hand, and the scan."""
    volume = uneven_scan(*request.param)
    corners = {1: ((3, 4), (9, 12)), 2: ((2, 2), (2, 2)), 3: ((5, 5), (8, 8)), 5: ((0, 0), (23, 19))}
    expected = np.zeros(volume.voxels.shape, int)
    for k, ((i0, j0), (i1, j1)) in corners.items():
        expected[k, j0 : j1 + 1, i0 : i1 + 1] = 1
    rois = {"x": [rectangle(volume, k, *low_and_high) for k, low_and_high in corners.items()]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    return labels, expected, volume


def test_each_slice_of_an_uneven_stack_has_the_pixels_of_its_own_contours(labels_of_uneven_scan):
    labels, expected, volume = labels_of_uneven_scan
    assert np.array_equal(resample_labels(labels, volume).voxels, expected)


def test_label_of_an_uneven_stack_has_the_volume_of_its_slices(labels_of_uneven_scan):
    labels, expected, volume = labels_of_uneven_scan
    ml = float(np.count_nonzero(expected, axis=(1, 2)) @ slice_voxel_ml(volume))
    assert label_ml(labels, 1) == pytest.approx(ml, rel=tolerances.UNEVEN_LABEL_VOLUME)


@pytest.mark.parametrize("tilt", [0.0, 18.0])
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["up", "down"])
def test_contour_between_slices_of_an_uneven_stack_is_refused(tmp_path, tilt, sign):
    volume = uneven_scan(tilt, sign)
    kind, points = rectangle(volume, 4, (1, 1), (3, 3))
    rois = {"x": [(kind, points + (0, 0, 2 * sign))]}  # 2 mm off
    with refused(RefusedInputError, "ROI", 1, 2.0):
        read_labels(write_structures(tmp_path / "off.dcm", rois), volume=volume)


def test_rt_dose_is_refused_as_a_label_map(volume, tmp_path):
    rt_dose = "1.2.840.10008.5.1.4.1.1.481.2"
    path = write_structures(tmp_path / "dose.dcm", {}, sop_class=rt_dose)
    with refused(RefusedInputError, "dose.dcm", "RT"):
        read_labels(path, volume=volume)


@pytest.mark.parametrize("harm", ["half a point", "nan", "cut", "none", "words", "twice", "count"])
def test_corrupt_structure_set_is_refused_in_one_line(volume, tmp_path, harm):
    kind, points = rectangle(volume, 2, (2, 2), (4, 4))
    rois = {"x": [(kind, points.ravel()[:-1] if harm == "half a point" else points)]}
    path = write_structures(tmp_path / "rt.dcm", {} if harm == "none" else rois, counts=harm != "half a point")
    data = path.read_bytes()
    coordinate = f"{points[1, 0]:.6f}"[:16].encode()
    if harm == "nan":
        path.write_bytes(data.replace(coordinate, b"nan".ljust(len(coordinate))))
    elif harm == "words":
        path.write_bytes(data.replace(coordinate, b"x" * len(coordinate)))
    elif harm == "cut":
        path.write_bytes(data[:-20])
    elif harm == "count":
        number_of_points = data.index((0x3006).to_bytes(2, "little") + (0x0046).to_bytes(2, "little")) + 8
        path.write_bytes(data[:number_of_points] + b"5 " + data[number_of_points + 2 :])  # there are 4
    elif harm == "twice":
        write_structures(path, {"x": rois["x"], "y": rois["x"]}, numbers=[4, 4])
    with pytest.raises(RefusedInputError) as refusal:
        read_labels(path, volume=volume)
    assert_one_line(refusal.value, "rt.dcm")


@pytest.fixture
def scan_with_structure_set(tmp_path):
    """A straight CT series and a structure set with L3: 9 x 7 pixels on three slices."""
    dicom_series.write_series(tmp_path / "ct", PLANS["straight"])
    volume = read_volume(tmp_path / "ct")
    rois = {"L3": [rectangle(volume, k, (3, 4), (9, 12)) for k in (2, 3, 4)]}
    return str(tmp_path / "ct"), str(write_structures(tmp_path / "rt.dcm", rois, frame=""))


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.first_device
def test_commands_mesh_and_render_take_structure_sets_as_labels(scan_with_structure_set, tmp_path, printed):
    scan, path = scan_with_structure_set
    mesh = ["mesh", scan, "-o", str(tmp_path / "a.stl"), "--surface", "mask", "--labels", path, "--json"]
    assert main(mesh) == 0
    assert [mesh["label"] for mesh in printed().report()["meshes"]] == ["L3"]
    middle_slice = ["render", scan, "-o", str(tmp_path / "p.png"), "--mode", "slice", "--labels", path, "--json"]
    assert main(middle_slice) == 0
    (picture,) = printed().report()["pictures"]
    assert [label["label"] for label in picture["labels"]] == ["L3"]


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.first_device
def test_command_stats_measures_the_rois_of_a_structure_set(scan_with_structure_set, tmp_path):
    scan, path = scan_with_structure_set
    assert main(["stats", scan, "--report", str(tmp_path / "s.json"), "--labels", path, "-q"]) == 0
    (label,) = json.loads((tmp_path / "s.json").read_text())["labels"]
    assert label["name"] == "L3"
    plan = PLANS["straight"]
    voxel_mm3 = np.prod(plan.pixel_spacing) * plan.gap
    assert label["ml"] == pytest.approx(3 * 9 * 7 * voxel_mm3 / 1000)


def circle(radius, corners=40, centre=(20.0, 20.0)):
    """Corners (n, 2) of a polygon on a circle."""
    turns = np.arange(corners) * 2.0 * np.pi / corners
    return np.stack((np.cos(turns), np.sin(turns)), axis=1) * radius + centre


@pytest.mark.parametrize(
    "copy",
    [circle(15.0, centre=(20.1, 20.0)), circle(15.0, centre=(20.001, 20.0)), circle(15.0, corners=80), circle(14.9)],
    ids=["a tenth of a voxel aside", "a thousandth", "twice the corners", "a little smaller"],
)
@pytest.mark.parametrize("copy_is_first", [False, True])
def test_contour_drawn_nearly_twice_is_united_with_its_copy(copy, copy_is_first):
    drawn = circle(15.0)
    contours = [copy, drawn] if copy_is_first else [drawn, copy]
    united = unite_contours(contours, (41, 41), (1.0, 1.0))
    assert np.array_equal(united.inside, fill_contours([drawn], (41, 41)) | fill_contours([copy], (41, 41)))
    assert united.repeated + united.crossing == 1  # counted as one of both


def test_contours_one_voxel_apart_are_a_ring():
    ring = unite_contours([circle(15.0), circle(14.0)], (41, 41), (1.0, 1.0))
    assert (ring.repeated, ring.crossing) == (0, 0)
    assert not ring.inside[20, 20]
    assert ring.inside[20, 5:7].any()  # 14 to 15 voxels left of the centre
