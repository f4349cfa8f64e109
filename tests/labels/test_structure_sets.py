"""RT structure sets: contours in mm become labels on the slices of their scan, by the even-odd rule of centres."""

from __future__ import annotations

import json

import dicom_series
import numpy as np
import pytest
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
    dicom_series.write_series(tmp_path / "ct", PLANS[request.param])
    return read_volume(tmp_path / "ct")


def rectangle(volume, k, low, high):
    """A contour around the pixels from `low` to `high` (i, j), both included."""
    (i0, j0), (i1, j1) = np.subtract(low, 0.5), np.add(high, 0.5)
    return CLOSED, volume.ijk_to_lps([(i0, j0, k), (i1, j0, k), (i1, j1, k), (i0, j1, k)])


def ring(volume, k, centre, radius, count=720):
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ijk = np.column_stack([centre[0] + radius * np.cos(turn), centre[1] + radius * np.sin(turn), np.full(count, k)])
    return CLOSED, volume.ijk_to_lps(ijk)


def test_rectangles_have_their_pixels(volume, tmp_path):
    rois = {"L3": [rectangle(volume, k, (3, 4), (9, 12)) for k in (2, 3, 4)], "Leber & Milz ä": [
        rectangle(volume, 3, (15, 2), (15, 2))]}  # fmt: skip
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    expected = np.zeros(volume.voxels.shape, int)
    expected[2:5, 4:13, 3:10] = 1
    expected[3, 2, 15] = 2
    assert np.array_equal(labels.voxels, expected)
    assert labels.names == {1: "L3", 2: "Leber & Milz ä"} and labels.warnings == ()
    assert np.array_equal(labels.affine, volume.affine)
    assert resample_labels(labels, volume).exact
    unsaid = read_labels(write_structures(tmp_path / "unsaid.dcm", rois, counts=False), volume=volume)
    assert np.array_equal(unsaid.voxels, expected)


def test_a_contour_within_another_is_a_hole(volume, tmp_path):
    nested = [rectangle(volume, 1, (2, 2), (16, 16)), rectangle(volume, 1, (5, 5), (13, 13)),
              rectangle(volume, 1, (8, 8), (10, 10))]  # fmt: skip
    labels = read_labels(write_structures(tmp_path / "rt.dcm", {"x": nested}), volume=volume)
    assert labels.counts == {1: 15 * 15 - 9 * 9 + 3 * 3}


def test_a_keyhole_is_a_ring(volume, tmp_path):
    outer = [(1.5, 1.5), (10.5, 1.5), (10.5, 10.5), (1.5, 10.5), (1.5, 1.5)]
    inner = [(4.5, 4.5), (4.5, 7.5), (7.5, 7.5), (7.5, 4.5), (4.5, 4.5)]
    ijk = [(i, j, 2) for i, j in (*outer, *inner)]
    rois = {"x": [(CLOSED, volume.ijk_to_lps(ijk))]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 9 * 9 - 3 * 3}


def test_circles_have_their_area():
    turn = np.linspace(0, 2 * np.pi, 3600, endpoint=False)
    for radius, centre in ((20.3, (30.2, 31.7)), (3.7, (30.5, 30.5))):
        circle = np.column_stack([centre[0] + radius * np.cos(turn), centre[1] + radius * np.sin(turn)])
        found = fill_contours([circle], (64, 60))
        j, i = np.indices((64, 60))
        assert np.array_equal(found, np.hypot(i - centre[0], j - centre[1]) < radius)


def test_neighbours_share_no_pixel_and_leave_none_out():
    middle = [(5.0, -1.0), (5.0, 20.0)]
    left = np.array([(-1.0, -1.0), *middle, (-1.0, 20.0)])
    right = np.array([middle[0], (30.0, -1.0), (30.0, 20.0), middle[1]])
    one, other = fill_contours([left], (10, 12)), fill_contours([right], (10, 12))
    assert not (one & other).any() and (one | other).all()
    assert one[:, :5].all() and other[:, 5:].all()  # centres on the common side belong to the right one


def test_contours_beyond_the_slices_are_cut_off(volume, tmp_path):
    rois = {"x": [rectangle(volume, 1, (-30, -30), (5, 90)), *(rectangle(volume, k, (2, 2), (4, 4)) for k in (-3, 9))]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 20 * 6}
    assert labels.warnings == ("ROI x: 2 contours beyond the slices of the scan left out",)


def test_points_and_gaps_of_an_roi_are_warned_of(volume, tmp_path):
    point = ("POINT", volume.ijk_to_lps([(4, 4, 4)]))
    rois = {"x": [rectangle(volume, 1, (2, 2), (4, 4)), rectangle(volume, 5, (2, 2), (4, 4)), point], "iso": [point]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 18}
    assert labels.warnings == (
        "ROI x: 1 POINT left out, only closed planar contours enclose voxels",
        "ROI x: 3 of 5 slices from its first to its last have no contour and stay empty",
        "ROI iso: 1 POINT left out, only closed planar contours enclose voxels",
        "ROI iso has no closed contour and no voxel",
    )


def test_equal_contours_count_once(volume, tmp_path):
    kind, points = rectangle(volume, 2, (3, 3), (12, 12))
    again = np.roll(points[::-1], 1, axis=0) + 0.002  # another corner first, the other way round, and rounded
    rois = {"x": [(kind, points), (kind, again), (kind, [*points, points[0]]), rectangle(volume, 3, (3, 3), (5, 5))]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 100 + 9}
    assert labels.warnings == ("ROI x: 2 contours written twice, each counts once",)


def test_contours_that_cross_are_united(volume, tmp_path):
    plus = [rectangle(volume, 2, (5, 1), (7, 15)), rectangle(volume, 2, (1, 5), (18, 8))]
    labels = read_labels(write_structures(tmp_path / "rt.dcm", {"x": plus}), volume=volume)
    assert labels.counts == {1: 3 * 15 + 18 * 4 - 3 * 4}
    assert labels.warnings == ("ROI x: contours cross on 1 slice and were united",)


def test_a_hole_of_contours_that_cross_is_a_hole(volume, tmp_path):
    """A hole within what both share lies within one region, not two."""
    parts = [((1, 1), (12, 12)), ((4, 4), (18, 18)), ((6, 6), (9, 9)), ((7, 7), (8, 8))]
    rois = {"x": [rectangle(volume, 2, *part) for part in parts]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    assert labels.counts == {1: 12 * 12 + 15 * 15 - 9 * 9 - 4 * 4 + 2 * 2}


def test_xor_contours_leave_out_what_two_share(volume, tmp_path):
    kind = "CLOSEDPLANAR_XOR"
    plus = [(kind, rectangle(volume, 2, *part)[1]) for part in (((5, 1), (7, 15)), ((1, 5), (18, 8)))]
    path = write_structures(
        tmp_path / "rt.dcm", {"x": plus, "y": [plus[0], plus[0], rectangle(volume, 4, (1, 1), (2, 2))]}
    )
    labels = read_labels(path, ["x"], volume=volume)
    assert labels.counts == {1: 3 * 15 + 18 * 4 - 2 * 3 * 4} and labels.warnings == ()
    assert read_labels(path, ["y"], volume=volume).counts == {2: 4}


@pytest.mark.parametrize(("off_mm", "crossing"), [(0.04, 0), (0.06, 1)])
def test_a_hole_may_touch_the_outline_within_rounding(off_mm, crossing):
    """The hole has the centres of column 2 and the outline has not: by rounding alone, or by more."""
    off = off_mm / 0.5
    outer = np.array([(2 + off, 1.6), (11.4, 1.6), (11.4, 11.4), (2 + off, 11.4)])
    hole = np.array([(2 - off, 4.6), (5.4, 4.6), (5.4, 7.4), (2 - off, 7.4)])
    united = unite_contours([outer, hole], (16, 16), (0.5, 0.5))
    assert united.crossing == crossing
    assert united.inside[:, 3:].sum() == 9 * 10 - (0 if crossing else 3 * 3)


def test_contours_of_one_and_two_points_are_left_out(volume, tmp_path):
    kind, points = rectangle(volume, 2, (2, 2), (4, 4))
    rois = {"x": [(kind, points), (kind, points[:2]), (kind, points[:1])], "y": [(kind, points[:2])]}
    path = write_structures(tmp_path / "rt.dcm", rois)
    labels = read_labels(path, volume=volume)
    assert labels.counts == {1: 9}
    assert labels.warnings == (
        "ROI x: 2 contours of fewer than 3 points left out",
        "ROI y: 1 contour of fewer than 3 points left out",
    )
    assert read_labels(path, ["x"], volume=volume).counts == {1: 9}
    with refused(RefusedInputError, "rt.dcm", "ROI", 1, 3):
        read_labels(path, ["y"], volume=volume)


def test_an_roi_of_points_is_said_to_be_one(volume, tmp_path):
    rois = {"iso": [("POINT", volume.ijk_to_lps([(4, 4, 4)]))]}
    path = write_structures(tmp_path / "rt.dcm", rois)
    for only in (None, ["iso"]):
        with refused(RefusedInputError, "ROI", "POINT", 1):
            read_labels(path, only, volume=volume)


def test_contours_may_be_a_tenth_of_the_step_off(tmp_path):
    volume = Volume(np.zeros((4, 20, 24), np.int16), np.diag((1.0, 1.0, 3.0, 1.0)))
    for off, words in ((0.09, None), (0.29, "up to 0.29 mm off their slices"), (0.31, None)):
        kind, points = rectangle(volume, 2, (2, 2), (4, 4))
        path = write_structures(tmp_path / "rt.dcm", {"x": [(kind, points + (0.0, 0.0, off))]})
        if off > 0.3:
            with refused(RefusedInputError, 0.31, 0.1):
                read_labels(path, volume=volume)
            continue
        labels = read_labels(path, volume=volume)
        assert labels.counts == {1: 9} and [words in warning for warning in labels.warnings] == [True] * bool(words)


def test_contours_through_voxel_centres_are_said(volume, tmp_path):
    """As rt_utils writes them, which takes the outermost pixels of a mask as corners."""
    ijk = [(3, 4, 2), (9, 4, 2), (9, 12, 2), (3, 12, 2)]
    path = write_structures(tmp_path / "rt.dcm", {"x": [(CLOSED, volume.ijk_to_lps(ijk))]})
    (said,) = read_labels(path, volume=volume).warnings
    assert said.startswith("ROI x: the contours run through voxel centres, as rt_utils writes them")


@pytest.mark.parametrize("off", [0.4, 0.2])
def test_contours_between_slices_are_refused(volume, tmp_path, off):
    rois = {"x": [rectangle(volume, 2, (2, 2), (4, 4)), rectangle(volume, 3 + off, (2, 2), (4, 4))]}
    path = write_structures(tmp_path / "rt.dcm", {**rois, "fine": [rectangle(volume, 1, (2, 2), (4, 4))]})
    with refused(RefusedInputError, "ROI", 1, 2, 1.25 * off):
        read_labels(path, volume=volume)
    assert read_labels(path, ["fine"], volume=volume).counts[3 - 1] == 9


def test_contours_across_slices_are_refused(volume, tmp_path):
    rois = {"x": [(CLOSED, volume.ijk_to_lps([(2, 2, 1), (6, 2, 1), (6, 6, 3), (2, 6, 3)]))]}
    with refused(RefusedInputError, "rt.dcm", "parallel"):
        read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)


def test_points_are_rounded_by_writers(volume, tmp_path):
    kind, points = rectangle(volume, 2, (2, 2), (4, 4))
    rois = {"x": [(kind, np.round(points, 2))]}
    assert read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume).counts == {1: 9}


def test_another_frame_of_reference_is_refused(volume, tmp_path):
    rois = {"x": [rectangle(volume, 2, (2, 2), (4, 4))]}
    path = write_structures(tmp_path / "rt.dcm", rois, frame="1.2.3.4.5.6")
    assert volume.report["frame_of_reference_hash"] is not None
    with refused(RefusedInputError, "ROIs", "rt.dcm", 1):
        read_labels(path, volume=volume)


def test_overlapping_structures_are_chosen_by_name(volume, tmp_path):
    rois = {
        "BODY": [rectangle(volume, k, (0, 0), (23, 19)) for k in range(7)],
        "L3": [rectangle(volume, 3, (2, 2), (4, 4))],
    }
    path = write_structures(tmp_path / "rt.dcm", rois)
    with refused(RefusedInputError, "BODY", "L3", 1, 2, 9):
        read_labels(path, volume=volume)
    alone = read_labels(path, ["L3"], volume=volume)
    assert alone.counts == {2: 9} and alone.names == {2: "L3"}
    assert read_labels(path, [1], volume=volume).counts == {1: 7 * 480}
    assert read_all_labels(path, ["L3"], volume=volume).counts == {1: 7 * 480 - 9, 2: 9}


def test_numbers_from_0_are_moved(volume, tmp_path):
    rois = {name: [rectangle(volume, k, (2, 2), (4, 4))] for name, k in (("a", 1), ("b", 2))}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois, numbers=[0, 1]), volume=volume)
    assert labels.names == {1: "a", 2: "b"} and labels.counts == {1: 9, 2: 9}


def test_contours_without_a_scan_or_beside_it_are_refused(tmp_path):
    stack = uneven()
    path = write_structures(tmp_path / "rt.dcm", {"x": [rectangle(stack, 2, (1, 1), (2, 2))]})
    with refused(UsageError, "contours", "scan", "rt.dcm"):
        read_labels(path)
    with refused(UsageError, "contours", "pixels"):
        read_labels(path, volume=stack)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_map_has_four_or_two_slices_to_the_smallest_gap(sign):
    def slices(gap):
        table = np.zeros((6, 3))
        table[:, 2] = sign * np.array([0.0, gap, 5.0, 10.0, 15.0, 20.0])
        affine = np.diag((1.0, 1.0, sign, 1.0))
        return label_slices(Volume(np.zeros((6, 4, 4), np.int16), affine, slice_positions=table)).affine

    for gap, parts in ((0.05, 4), (0.02, 2)):
        assert slices(gap)[2, 2:] == pytest.approx([sign * gap / parts, sign * (gap / parts - gap) / 2.0])
    with refused(UsageError, 5, "contours"):
        slices(0.005)


@pytest.mark.parametrize("tilt", [0.0, 18.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_slice_of_an_uneven_stack_has_its_own_contours(tmp_path, tilt, sign):
    heights = np.array([0.0, 4.0, 8.0, 9.08, 16.0, 23.0])
    affine = np.diag((0.5, 0.5, sign, 1.0))
    table = np.column_stack([0 * heights, heights * np.tan(np.radians(tilt)), sign * heights])
    volume = Volume(np.zeros((6, 20, 24), np.int16), affine, slice_positions=table)
    areas = {1: ((3, 4), (9, 12)), 2: ((2, 2), (2, 2)), 3: ((5, 5), (8, 8)), 5: ((0, 0), (23, 19))}
    rois = {"x": [rectangle(volume, k, *corners) for k, corners in areas.items()]}
    labels = read_labels(write_structures(tmp_path / "rt.dcm", rois), volume=volume)
    expected = np.zeros(volume.voxels.shape, int)
    for k, ((i0, j0), (i1, j1)) in areas.items():
        expected[k, j0 : j1 + 1, i0 : i1 + 1] = 1
    assert np.array_equal(resample_labels(labels, volume).voxels, expected)
    ml = float(np.count_nonzero(expected, axis=(1, 2)) @ slice_voxel_ml(volume))
    assert label_ml(labels, 1) == pytest.approx(ml, rel=0.03)
    between = {"x": [(CLOSED, rectangle(volume, 4, (1, 1), (3, 3))[1] + (0, 0, 2 * sign))]}
    with refused(RefusedInputError, "ROI", 1, 2.0):
        read_labels(write_structures(tmp_path / "off.dcm", between), volume=volume)


def test_other_objects_are_no_label_maps(volume, tmp_path):
    path = write_structures(tmp_path / "dose.dcm", {}, sop_class="1.2.840.10008.5.1.4.1.1.481.2")
    with refused(RefusedInputError, "dose.dcm", "RT"):
        read_labels(path, volume=volume)


@pytest.mark.parametrize("harm", ["half a point", "nan", "cut", "none", "words", "twice", "count"])
def test_corrupt_files_are_one_line(volume, tmp_path, harm):
    kind, points = rectangle(volume, 2, (2, 2), (4, 4))
    rois = {"x": [(kind, points.ravel()[:-1] if harm == "half a point" else points)]}
    path = write_structures(tmp_path / "rt.dcm", {} if harm == "none" else rois, counts=harm != "half a point")
    data = path.read_bytes()
    number = f"{points[1, 0]:.6f}"[:16].encode()
    if harm == "nan":
        path.write_bytes(data.replace(number, b"nan".ljust(len(number))))
    elif harm == "words":
        path.write_bytes(data.replace(number, b"x" * len(number)))
    elif harm == "cut":
        path.write_bytes(data[:-20])
    elif harm == "count":
        at = data.index((0x3006).to_bytes(2, "little") + (0x0046).to_bytes(2, "little"))
        path.write_bytes(data[: at + 8] + b"5 " + data[at + 10 :])  # of 4 points
    elif harm == "twice":
        write_structures(path, {"x": rois["x"], "y": rois["x"]}, numbers=[4, 4])
    with pytest.raises(RefusedInputError) as found:
        read_labels(path, volume=volume)
    assert_one_line(found.value, "rt.dcm")


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.first_device
def test_commands_take_structure_sets_as_labels(tmp_path, printed):
    dicom_series.write_series(tmp_path / "ct", PLANS["straight"])
    volume = read_volume(tmp_path / "ct")
    rois = {"L3": [rectangle(volume, k, (3, 4), (9, 12)) for k in (2, 3, 4)]}
    path = write_structures(tmp_path / "rt.dcm", rois, frame="")
    words = ["--labels", str(path), "-q"]
    mesh = ["mesh", str(tmp_path / "ct"), "-o", str(tmp_path / "a.stl"), "--surface", "mask", *words]
    assert main(mesh) == 0, printed()
    assert main(["stats", str(tmp_path / "ct"), "--report", str(tmp_path / "s.json"), *words]) == 0
    (one,) = json.loads((tmp_path / "s.json").read_text())["labels"]
    assert one["name"] == "L3" and one["ml"] == pytest.approx(3 * 9 * 7 * 0.7 * 0.5 * 1.25 / 1000)
    picture = ["render", str(tmp_path / "ct"), "-o", str(tmp_path / "p.png"), "--size", "64", *words]
    assert main(picture) == 0, printed()


def circle(radius, corners=40, centre=(20.0, 20.0)):
    turns = np.arange(corners) * 2.0 * np.pi / corners
    return np.stack((np.cos(turns), np.sin(turns)), axis=1) * radius + centre


@pytest.mark.parametrize(
    "copy",
    [circle(15.0, centre=(20.1, 20.0)), circle(15.0, centre=(20.001, 20.0)), circle(15.0, 80), circle(14.9)],
    ids=["a tenth of a voxel aside", "a thousandth", "twice the corners", "a little smaller"],
)
def test_a_contour_drawn_again_is_no_hole_in_itself(copy):
    drawn = circle(15.0)
    once = fill_contours([drawn], (41, 41))
    for contours in ([drawn, copy], [copy, drawn]):
        united = unite_contours(contours, (41, 41), (1.0, 1.0))
        assert np.array_equal(united.inside, once | fill_contours([copy], (41, 41)))
        assert united.repeated + united.crossing == 1


def test_a_ring_of_one_voxel_is_a_ring():
    ring = unite_contours([circle(15.0), circle(14.0)], (41, 41), (1.0, 1.0))
    assert (ring.repeated, ring.crossing) == (0, 0) and not ring.inside[20, 20] and ring.inside[20, 5:7].any()
