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
    """A volume and its canal, 400 points from T9 to L3."""
    voxels, affine, truth = make_phantom(SETTINGS)
    field = tuple(float(n) for n in np.multiply(voxels.shape[::-1], (1.9, 1.8, 2.5)))
    planned = plan_anatomy(field, affine[:3, :3], SETTINGS.seed).vertebrae
    centres = np.array([level["center_lps_mm"] for level in truth["spine"]["vertebrae"]])
    shift = centres - [level.center for level in planned]
    assert np.abs(shift - shift[0]).max() < 1e-9  # the plan is that of the phantom
    middles = [level.to_patient((0.0, level.depth / 2.0 + level.canal_half_depth - 0.8, 0.0)) for level in planned]
    canal = Curve(np.array(middles) + shift[0])
    return Volume(voxels, affine), canal.at(np.linspace(0.0, canal.length, 1500))


def distances(points, line) -> np.ndarray:
    """Of the points at heights of the line."""
    curve = Curve(line.points)
    places = curve.at(np.linspace(0.0, curve.length, 2000))
    beside = points[(points[:, 2] <= places[0, 2]) & (points[:, 2] >= places[-1, 2])]
    assert len(beside) >= 10
    return np.linalg.norm(beside[:, None] - places, axis=2).min(axis=1)


def check_canal(line, canal) -> None:
    away = distances(canal, line)
    assert away.mean() <= tolerances.CANAL_MEAN_MM and away.max() <= tolerances.CANAL_MAX_MM
    upper, lower = line.sure_mm
    assert line.points[0, 2] >= upper > lower + 0.3 * line.height_mm and lower >= line.points[-1, 2]
    assert len(line.points) == round((line.height_mm + CELL_MM[2]) / 15.0) + 1


@pytest.mark.release
@pytest.mark.seconds
def test_the_canal_of_the_phantom_is_found_over_its_whole_height(phantom):
    volume, canal = phantom
    line = find_spine_line(volume)
    assert line.searched_mm == pytest.approx(60 * 2.5, abs=5.0) and line.height_mm >= 0.9 * line.searched_mm
    assert line.sure_share > 0.9 and np.all(np.diff(line.points[:, 2]) < 0.0)
    check_canal(line, canal)


@pytest.mark.parametrize(
    ("cell", "more", "bends"),
    # Straight on is free, a step aside costs 0.05, and one across the corner that times the root of 2: 0.0707.
    [((1, 2), 0.049, False), ((1, 2), 0.051, True), ((0, 0), 0.070, False), ((0, 0), 0.0715, True)],
)
def test_a_bend_costs_its_length(cell, more, bends):
    gain = np.full((2, 3, 3), -1.0, np.float32)
    gain[:, 1, 1] = 0.5
    gain[1][cell] = 0.5 + more
    assert _best_path(gain).tolist() == [[0, 1, 1], [1, *(cell if bends else (1, 1))]]


@pytest.mark.release
def test_how_the_voxels_are_ordered_and_how_the_patient_lies_does_not_matter(phantom):
    volume, canal = phantom
    flip = np.eye(4)
    flip[:3, :3] = np.diag((-1.0, 1.0, -1.0))
    flip[:3, 3] = (volume.shape_ijk[0] - 1, 0.0, volume.shape_ijk[2] - 1)
    check_canal(find_spine_line(Volume(volume.voxels[::-1, :, ::-1], volume.affine @ flip)), canal)
    turned = np.eye(4)
    turned[:3, :3] = rotation((8.0, 6.0, 4.0))
    line = find_spine_line(Volume(volume.voxels, turned @ volume.affine))
    check_canal(line, canal @ turned[:3, :3].T)
    sagittal = Volume(volume.voxels.transpose(2, 0, 1), volume.affine[:, [1, 2, 0, 3]])
    check_canal(find_spine_line(sagittal), canal)


def test_a_canal_with_more_of_the_body_behind_it_than_in_front_is_found(phantom):
    """As in a neck: 55 mm in front of the middle of the canal, and soft tissue as far back as the scan goes."""
    volume, canal = phantom
    row = round(float(volume.lps_to_ijk([canal.mean(axis=0)])[0, 1]))
    voxels = np.array(volume.voxels)
    voxels[:, : row - 30] = -1000
    voxels[:, row:-8][voxels[:, row:-8] < -200] = 40
    check_canal(find_spine_line(Volume(voxels, volume.affine)), canal)


def test_uneven_slices_are_where_they_are(phantom):
    volume, canal = phantom
    kept = np.flatnonzero(np.arange(60) % 4 != 1)
    uneven = Volume(volume.voxels[kept], volume.affine, slice_positions=volume.slice_origins()[kept])
    check_canal(find_spine_line(uneven), canal)


def made_up(name: str, phantom) -> Volume:
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
def test_scan_without_a_sure_spine_is_refused_and_points_are_asked_for(phantom, name):
    with refused(RefusedInputError, "points"):
        find_spine_line(made_up(name, phantom))


@pytest.mark.release
@pytest.mark.slow
def test_spine_line_lies_in_the_labelled_canal_of_real_scans(real_data):
    """The cord, as a network drew it at 2 mm; and the holes that vertebrae enclose at 3 mm."""
    folder = real_data / "thoracolumbar_labels"
    labels = read_labels(folder / "ct_2mm_labels.nii.gz")
    cord = [
        (*np.argwhere(plane)[:, ::-1].mean(axis=0), k) for k, plane in enumerate(labels.voxels == 79) if plane.any()
    ]
    away = distances(labels.ijk_to_lps(cord), find_spine_line(read_volume(folder / "ct_2mm_jpeg2000")))
    assert away.mean() <= tolerances.REAL_CANAL_MEAN_MM and away.max() <= tolerances.REAL_CANAL_MAX_MM

    from scipy.ndimage import binary_fill_holes, label

    labels = read_labels(folder / "spine_report" / "totalseg.nii.gz")
    holes = []
    for k, plane in enumerate(labels.voxels > 26):  # without the sacrum
        inside, count = label(binary_fill_holes(plane) & ~plane)
        sizes = np.bincount(inside.ravel())[1:]
        if count and sizes.max() >= 9:
            holes.append((*np.argwhere(inside == sizes.argmax() + 1)[:, ::-1].mean(axis=0), k))
    away = distances(labels.ijk_to_lps(holes), find_spine_line(read_volume(folder / "example_ct.nii.gz")))
    assert away.mean() <= tolerances.REAL_CANAL_MEAN_MM and away.max() <= tolerances.REAL_CANAL_MAX_MM


def test_real_scans_are_found_or_refused(real_data):
    line = find_spine_line(read_volume(real_data / "thoracic_0p8mm"))
    assert line.height_mm >= 0.9 * line.searched_mm and line.sure_share > 0.9
    with pytest.raises(RefusedInputError, match="no spine was found"):
        find_spine_line(read_volume(real_data / "head_tilt_gaps"))


@pytest.mark.release
@pytest.mark.slow
def test_a_long_real_spine_is_found(real_data):
    line = find_spine_line(read_volume(real_data / "lumbar_4p25mm"))
    assert line.height_mm >= 290.0 and line.sure_share > 0.9


def test_spine_of_a_scan_cropped_at_one_side_is_followed(phantom):
    """Beside the canal 14 mm of the left are there: left and right are not alike, but where a half of it is whole."""
    volume, canal = phantom
    middle = volume.lps_to_ijk([canal.mean(axis=0)])[0, 0]
    voxels = np.array(volume.voxels)
    voxels[:32, :, round(middle + 26.0 / 1.9) :] = -1000
    cropped = Volume(voxels, volume.affine)
    sure, whole = find_spine_line(cropped, sure_only=True), find_spine_line(cropped)
    assert sure.height_mm < 0.75 * whole.height_mm and sure.ends == {"upper": None, "lower": None}
    assert whole.height_mm >= 0.85 * whole.searched_mm and whole.sure_share < 0.8
    assert whole.upper.lost_mm is None and whole.lower.lost_mm is None
    check_canal(whole, canal)


def lost_below(phantom, value):
    """Return the line of the phantom with one value in all of its lower slices, and the height where these begin."""
    volume, _ = phantom
    voxels = np.array(volume.voxels)
    voxels[:25] = value
    return find_spine_line(Volume(voxels, volume.affine)), float(volume.slice_origins()[24, 2])


@pytest.mark.parametrize(
    ("value", "words"), [(600, r"bone in its place \(\d+ HU\)"), (-1000, "air or fat in its place|no vertebral body")]
)
def test_end_of_a_lost_spine_is_said_in_mm_with_what_was_found_instead(phantom, value, words):
    line, z_mm = lost_below(phantom, value)
    assert line.upper.lost_mm is None and line.upper.because == ""
    assert re.search(words, line.lower.because), line.lower.because
    assert line.lower.lost_mm == pytest.approx(z_mm, abs=10.0) and line.lower.lost_mm < line.lower.z_mm
    assert line.points[-1, 2] == pytest.approx(line.lower.z_mm, abs=0.1)


def test_a_scan_with_too_little_of_a_spine_says_where_that_is(phantom):
    volume, canal = phantom
    with refused(RefusedInputError, 20, 35):
        find_spine_line(Volume(volume.voxels[:8], volume.affine))
    with refused(RefusedInputError, "look", "points"):
        find_spine_line(made_up("air", phantom))
    askew = np.eye(4)
    askew[:3, :3] = rotation((0.0, 0.0, 20.0))
    with refused(RefusedInputError, "canal", 4, 35):
        find_spine_line(Volume(volume.voxels, askew @ volume.affine))
