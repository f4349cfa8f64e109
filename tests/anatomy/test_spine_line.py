"""The spinal canal found by itself: on phantoms with known canals, on real CT, and refused where there is none."""

from __future__ import annotations

import re

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import refused
from variants import daily

from clrecon import read_labels, read_volume
from clrecon.anatomy.spine_line import CELL_MM, _best_path, find_spine_line
from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.proof.phantom import PhantomSettings, make_phantom
from clrecon.proof.phantom.spine_plan import plan_anatomy
from clrecon.rendering.views.centre_line import Curve

SETTINGS = PhantomSettings(size=(160, 144), slices=60, spacing=(1.9, 1.8, 2.5))


@pytest.fixture(scope="module")
def phantom():
    """A volume and its canal, 1,500 points from T9 to L3."""
    voxels, affine, truth = make_phantom(SETTINGS)
    field = tuple(float(n) for n in np.multiply(voxels.shape[::-1], affine.diagonal()[:3]))
    planned = plan_anatomy(field, affine[:3, :3], SETTINGS.seed).vertebrae
    centres = np.array([level["center_lps_mm"] for level in truth["spine"]["vertebrae"]])
    shift = centres - [level.center for level in planned]
    assert np.abs(shift - shift[0]).max() < 1e-9  # the plan is that of the phantom
    middles = [level.to_patient((0.0, level.depth / 2.0 + level.canal_half_depth - 0.8, 0.0)) for level in planned]
    canal = Curve(np.array(middles) + shift[0])
    return Volume(voxels, affine), canal.at(np.linspace(0.0, canal.length, 1500))


def distances_from_line(points, line) -> np.ndarray:
    """Distances in mm of those of the points that lie at heights of the line."""
    curve = Curve(line.points)
    places = curve.at(np.linspace(0.0, curve.length, 2000))
    beside = points[(points[:, 2] <= places[0, 2]) & (points[:, 2] >= places[-1, 2])]
    assert len(beside) >= 10  # of 1,500 points of a phantom's canal, or a slice each of a real scan
    return np.linalg.norm(beside[:, None] - places, axis=2).min(axis=1)


def check_lies_in_canal(line, canal) -> None:
    away = distances_from_line(canal, line)
    assert away.mean() <= tolerances.CANAL_MEAN_MM
    assert away.max() <= tolerances.CANAL_MAX_MM


@pytest.fixture(scope="module")
def phantom_line(phantom):
    """The line that is found in the phantom."""
    return find_spine_line(phantom[0])


@pytest.mark.release
@pytest.mark.seconds
def test_the_line_of_a_phantom_lies_in_its_canal(phantom, phantom_line):
    check_lies_in_canal(phantom_line, phantom[1])


@pytest.mark.release
@pytest.mark.seconds
def test_the_line_of_a_phantom_is_found_over_its_whole_height_and_sure_over_most_of_it(phantom_line):
    assert phantom_line.searched_mm == pytest.approx(60 * 2.5, abs=2 * 2.5)  # 60 slices of 2.5 mm
    assert phantom_line.height_mm >= 0.9 * phantom_line.searched_mm
    assert phantom_line.sure_share > 0.9  # measured 1.0


@pytest.mark.release
@pytest.mark.seconds
def test_the_line_of_a_phantom_has_a_point_about_every_15_mm_from_top_to_bottom(phantom_line):
    heights = phantom_line.points[:, 2]
    assert np.abs(np.diff(heights) + 15.0).max() < CELL_MM[2]  # points lie in cells of 4 mm: 12 or 16 mm apart
    assert heights[[0, -1]] == pytest.approx([phantom_line.upper.z_mm, phantom_line.lower.z_mm])


@pytest.mark.release
@pytest.mark.seconds
def test_the_sure_part_of_a_line_lies_within_it(phantom_line):
    upper, lower = phantom_line.sure_mm
    first, last = phantom_line.points[[0, -1], 2]
    assert first >= upper > lower >= last


@pytest.mark.parametrize(
    ("cell", "gained", "bends"),
    [((1, 2), 0.049, False), ((1, 2), 0.051, True), ((0, 0), 0.070, False), ((0, 0), 0.0715, True)],
    ids=["aside for too little", "aside", "across the corner for too little", "across the corner"],
)
def test_a_path_bends_to_a_cell_that_gains_more_than_the_length_of_the_bend_costs(cell, gained, bends):
    """Straight on is free, a step aside costs 0.05, and one across the corner that times the root of 2: 0.0707."""
    middle = (1, 1)
    gain = np.full((2, 3, 3), -1.0, np.float32)
    gain[:, 1, 1] = 0.5
    gain[1][cell] = 0.5 + gained
    assert _best_path(gain).tolist() == [[0, *middle], [1, *(cell if bends else middle)]]


@pytest.mark.release
def test_the_canal_is_found_where_i_and_k_run_the_other_way(phantom):
    volume, canal = phantom
    flip = np.eye(4)
    flip[:3, :3] = np.diag((-1.0, 1.0, -1.0))
    flip[:3, 3] = (volume.shape_ijk[0] - 1, 0.0, volume.shape_ijk[2] - 1)
    flipped = Volume(volume.voxels[::-1, :, ::-1], volume.affine @ flip)
    check_lies_in_canal(find_spine_line(flipped), canal)


@pytest.mark.release
def test_the_canal_of_a_patient_who_lies_askew_is_found(phantom):
    volume, canal = phantom
    turn = np.eye(4)
    turn[:3, :3] = rotation((8.0, 6.0, 4.0))  # degrees
    turned = Volume(volume.voxels, turn @ volume.affine)
    check_lies_in_canal(find_spine_line(turned), canal @ turn[:3, :3].T)


@pytest.mark.release
def test_the_canal_is_found_in_sagittal_slices(phantom):
    volume, canal = phantom
    sagittal = Volume(volume.voxels.transpose(2, 0, 1), volume.affine[:, [1, 2, 0, 3]])
    check_lies_in_canal(find_spine_line(sagittal), canal)


def test_a_canal_with_more_of_the_body_behind_it_than_in_front_is_found(phantom):
    """As in a neck: 57 mm in front of the middle of the canal, and soft tissue up to 15 mm from the scan's last row."""
    volume, canal = phantom
    row = round(float(volume.lps_to_ijk([canal.mean(axis=0)])[0, 1]))
    voxels = np.array(volume.voxels)
    assert volume.spacing[1] == pytest.approx(1.9)  # mm from row to row: 30 are 57 mm, 8 are 15 mm
    voxels[:, : row - 30] = -1000
    voxels[:, row:-8][voxels[:, row:-8] < -200] = 40
    check_lies_in_canal(find_spine_line(Volume(voxels, volume.affine)), canal)


def test_the_canal_is_found_where_every_fourth_slice_is_missing(phantom):
    volume, canal = phantom
    kept = np.flatnonzero(np.arange(60) % 4 != 1)
    uneven = Volume(volume.voxels[kept], volume.affine, slice_positions=volume.slice_origins()[kept])
    check_lies_in_canal(find_spine_line(uneven), canal)


def make_scan_without_a_spine(name: str, phantom) -> Volume:
    k, j, i = np.indices((60, 80, 80))
    random = np.random.default_rng(1)
    grid = np.diag((2.5, 2.5, 2.5, 1.0))
    ball = np.sqrt((k - 30.0) ** 2 + (j - 40.0) ** 2 + (i - 40.0) ** 2)
    voxels = {
        "air": np.full(k.shape, -1000),
        "noise": random.normal(0.0, 400.0, k.shape),
        "ball": np.where(ball < 24, 1000, -1000),
        "skull": np.where((ball < 28) & (ball > 25), 1000, np.where(ball <= 25, 40, -1000)),
        "one voxel": np.zeros((1, 1, 1)),
    }
    if name in voxels:
        return Volume(voxels[name].astype(np.int16), grid)
    volume = phantom[0]
    if name == "mirrored":  # front and back exchanged
        return Volume(volume.voxels, np.diag((1.0, -1.0, 1.0, 1.0)) @ volume.affine)
    if name == "front":  # the half of the body without the spine
        middle = int(volume.lps_to_ijk([phantom[1].mean(axis=0)])[0, 1])
        return Volume(volume.voxels[:, : middle - 30], volume.affine)
    return Volume(volume.voxels[:8], volume.affine)  # "short": 20 mm


@pytest.mark.parametrize("name", daily(5, ["air", "noise", "ball", "skull", "one voxel", "mirrored", "front", "short"]))
def test_a_scan_without_a_sure_spine_is_refused_and_points_are_asked_for(phantom, name):
    with refused(RefusedInputError, "points"):
        find_spine_line(make_scan_without_a_spine(name, phantom))


def check_lies_in_real_canal(line, canal) -> None:
    away = distances_from_line(canal, line)
    assert away.mean() <= tolerances.REAL_CANAL_MEAN_MM
    assert away.max() <= tolerances.REAL_CANAL_MAX_MM


@pytest.mark.release
@pytest.mark.slow
def test_the_line_of_a_real_scan_lies_in_the_cord_that_a_network_drew(real_data):
    folder = real_data / "thoracolumbar_labels"
    labels = read_labels(folder / "ct_2mm_labels.nii.gz")
    cord_label = 79
    middles = [
        (*np.argwhere(plane == cord_label)[:, ::-1].mean(axis=0), k)
        for k, plane in enumerate(labels.voxels)
        if (plane == cord_label).any()
    ]
    line = find_spine_line(read_volume(folder / "ct_2mm_jpeg2000"))
    check_lies_in_real_canal(line, labels.ijk_to_lps(middles))


@pytest.mark.release
@pytest.mark.slow
def test_the_line_of_a_real_scan_lies_in_the_holes_that_labelled_vertebrae_enclose(real_data):
    from scipy.ndimage import binary_fill_holes, label

    folder = real_data / "thoracolumbar_labels"
    labels = read_labels(folder / "spine_report" / "totalseg.nii.gz")
    last_label_of_the_sacrum, fewest_pixels = 26, 9
    middles = []
    for k, plane in enumerate(labels.voxels > last_label_of_the_sacrum):
        holes, count = label(binary_fill_holes(plane) & ~plane)
        sizes = np.bincount(holes.ravel())[1:]
        if count and sizes.max() >= fewest_pixels:
            middles.append((*np.argwhere(holes == sizes.argmax() + 1)[:, ::-1].mean(axis=0), k))
    line = find_spine_line(read_volume(folder / "example_ct.nii.gz"))
    check_lies_in_real_canal(line, labels.ijk_to_lps(middles))


def test_the_line_of_a_real_chest_is_found_over_its_whole_height(real_data):
    line = find_spine_line(read_volume(real_data / "thoracic_0p8mm"))
    assert line.height_mm >= 0.9 * line.searched_mm  # measured 68 of 72 mm: from the first cell of 4 mm to the last
    assert line.sure_share > 0.9  # measured 1.0


def test_a_real_head_without_a_sure_spine_is_refused(real_data):
    with refused(RefusedInputError, "spine"):
        find_spine_line(read_volume(real_data / "head_tilt_gaps"))


@pytest.mark.release
@pytest.mark.slow
def test_the_line_of_a_real_trunk_is_found_over_290_mm(real_data):
    line = find_spine_line(read_volume(real_data / "lumbar_4p25mm"))
    assert line.height_mm >= 290.0  # of 306 mm: 72 slices
    assert line.sure_share > 0.9


@pytest.fixture(scope="module")
def cropped_scan(phantom):
    """In the lower 32 of 60 slices only 26 mm to the left of the canal are there: left and right are not alike."""
    volume, canal = phantom
    middle = volume.lps_to_ijk([canal.mean(axis=0)])[0, 0]
    voxels = np.array(volume.voxels)
    voxels[:32, :, round(middle + 26.0 / volume.spacing[0]) :] = -1000
    return Volume(voxels, volume.affine)


def test_the_line_follows_a_spine_through_slices_that_are_cropped_at_one_side(phantom, cropped_scan):
    line = find_spine_line(cropped_scan)
    assert line.height_mm >= 0.85 * line.searched_mm  # measured 144 of 148 mm, as without the crop
    assert line.sure_share < 0.8  # 28 of 60 slices are whole; measured 0.43
    assert (line.upper.lost_mm, line.lower.lost_mm) == (None, None)
    check_lies_in_canal(line, phantom[1])


def test_only_the_sure_part_of_a_line_is_returned_on_request(cropped_scan):
    sure, whole = find_spine_line(cropped_scan, sure_only=True), find_spine_line(cropped_scan)
    assert sure.height_mm < 0.75 * whole.height_mm  # 28 of 60 slices are whole; measured 60 of 144 mm
    assert sure.ends == {"upper": None, "lower": None}
    assert sure.sure_mm == pytest.approx(sure.points[[0, -1], 2], abs=CELL_MM[2])


def line_above_lost_slices(phantom, *, hu):
    """Return the line of the phantom with one value in all of its lower slices, and the height where these begin."""
    volume, _ = phantom
    voxels = np.array(volume.voxels)
    voxels[:25] = hu
    return find_spine_line(Volume(voxels, volume.affine)), float(volume.slice_origins()[24, 2])


@pytest.mark.parametrize(
    ("hu", "words"),
    [(600, r"bone in its place \(\d+ HU\)"), (-1000, "air or fat in its place|no vertebral body")],
    ids=["bone", "air"],
)
def test_the_end_of_a_lost_spine_names_its_height_and_what_was_found_instead(phantom, hu, words):
    line, z_mm = line_above_lost_slices(phantom, hu=hu)
    assert re.search(words, line.lower.because), line.lower.because
    assert line.lower.lost_mm == pytest.approx(z_mm, abs=5.0)  # cells are 4 mm high; measured 2.3
    assert line.lower.lost_mm < line.lower.z_mm
    assert line.points[-1, 2] == pytest.approx(line.lower.z_mm)


def test_the_end_of_a_spine_that_the_scan_cuts_is_not_lost(phantom):
    line, _ = line_above_lost_slices(phantom, hu=600)
    assert (line.upper.lost_mm, line.upper.because) == (None, "")


def test_a_scan_of_20_mm_of_a_spine_is_refused_with_the_35_mm_that_are_needed(phantom):
    volume, _ = phantom
    with refused(RefusedInputError, 20, 35):
        find_spine_line(Volume(volume.voxels[:8], volume.affine))


def test_a_scan_of_air_is_refused_with_what_to_look_at(phantom):
    with refused(RefusedInputError, "look", "points"):
        find_spine_line(make_scan_without_a_spine("air", phantom))


def test_a_patient_turned_by_20_degrees_is_refused_with_the_height_over_which_a_canal_was_found(phantom):
    volume, _ = phantom
    turn = np.eye(4)
    turn[:3, :3] = rotation((0.0, 0.0, 20.0))
    with refused(RefusedInputError, "canal", 4, 35):  # mm that were found, and that are needed
        find_spine_line(Volume(volume.voxels, turn @ volume.affine))
