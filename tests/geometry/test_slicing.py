"""Parts of a volume by indices: the voxels that numpy takes, each at its own place; and its boxes in mm."""

from __future__ import annotations

import pickle

import dicom_series
import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import assert_one_line, refused
from uneven_volume import uneven

from clrecon import LabelMap, Volume, resample_labels
from clrecon.errors import UsageError
from clrecon.geometry import compose_affine, is_left_handed
from clrecon.geometry.affine import facts_of_orientation
from clrecon.geometry.blocks import crop_volume
from clrecon.reading import read_volume

pytestmark = pytest.mark.unit

SHAPE = (6, 5, 4)
STEPS = rotation((25.0, -40.0, 70.0)) * (0.7, 0.5, 1.25)
SHEAR = np.array([[1.0, 0.1, 0.2], [0.0, 1.0, -0.4], [0.0, 0.0, 1.0]])
ORIGIN = (-120.0, 83.0, -210.5)


def affine_of_steps(steps: np.ndarray, origin: tuple[float, float, float] = ORIGIN) -> np.ndarray:
    """Return the affine with the columns of `steps`, (3, 3)."""
    i, j, k = steps.T
    return compose_affine(i, j, k, origin)


def numbered_volume(affine: np.ndarray) -> Volume:
    return Volume(np.arange(np.prod(SHAPE), dtype=np.int32).reshape(SHAPE), affine)


VOLUMES = {
    "oblique": numbered_volume(affine_of_steps(STEPS)),
    "left-handed": numbered_volume(affine_of_steps(STEPS * (1, 1, -1))),
    "flipped": numbered_volume(affine_of_steps(np.diag((-0.7, -0.5, 1.25)))),
    "sheared": numbered_volume(affine_of_steps(STEPS @ SHEAR)),
    "uneven": uneven(np.arange(np.prod(SHAPE), dtype=np.int32).reshape(SHAPE)),
    "uneven, left-handed": uneven(np.arange(np.prod(SHAPE), dtype=np.int32).reshape(SHAPE), sign=-1.0),
}
EVEN_WITHIN_MM = 0.0125
"""Uneven slices of which those left are even within the tolerance of reading get an affine."""

KEYS = [
    np.s_[1:4],
    np.s_[:, 2:],
    np.s_[..., 1:3],
    np.s_[2:, ..., :-1],
    np.s_[::2, ::3, ::2],
    np.s_[::-1],
    np.s_[4:0:-2, ::-1, 3::-3],
    np.s_[-3:, -2:-1, -99:99],
    np.s_[1:2],
    np.s_[...],
    (),
]


def voxel_centres(volume: Volume) -> np.ndarray:
    """Place of each voxel, by its number."""
    k, j, i = np.indices(volume.shape).reshape(3, -1)
    return volume.ijk_to_lps(np.column_stack([i, j, k]))


of_every_volume = pytest.mark.parametrize("name", VOLUMES)
by_every_key = pytest.mark.parametrize("key", KEYS, ids=str)


@of_every_volume
@by_every_key
def test_a_part_has_the_voxels_that_numpy_takes_and_their_range(name, key):
    volume = VOLUMES[name]
    part = volume[key]
    assert type(part) is Volume
    assert np.array_equal(part.voxels, volume.voxels[key])
    assert part.hu_range == (part.voxels.min(), part.voxels.max())


@of_every_volume
@by_every_key
def test_each_voxel_of_a_part_lies_where_it_did(name, key):
    volume = VOLUMES[name]
    part = volume[key]
    became_even = volume.uneven and not part.uneven and part.shape[0] > 1
    tolerance = EVEN_WITHIN_MM if became_even else tolerances.FLOAT64_PLACE_MM
    before = voxel_centres(volume)[part.voxels.ravel()]  # each voxel is its number
    assert np.abs(voxel_centres(part) - before).max() <= tolerance


def random_key(random: np.random.Generator) -> tuple[slice, ...]:
    """Ranges that begin at a number from 0: with others nibabel 5.4 takes the right voxels and places them wrongly."""
    starts = [int(random.integers(count)) for count in SHAPE]
    stops = random.choice([None, -3, -1, 0, 1, 3, 9], 3)
    return tuple(map(slice, starts, stops, random.choice([None, 1, 2, -1, -2], 3)))


def stretches_in_nibabel(shape: tuple[int, ...], key: tuple[slice, ...]) -> bool:
    """nibabel stretches the one voxel that a range with a step leaves."""
    return any(count == 1 and part.step is not None for count, part in zip(shape, key, strict=True))


def keys_that_leave(voxels: bool) -> list[tuple[slice, ...]]:
    random = np.random.default_rng(5)
    keys = [random_key(random) for _ in range(600)]
    shapes = [VOLUMES["oblique"].voxels[key].shape for key in keys]
    return [
        key
        for key, shape in zip(keys, shapes, strict=True)
        if (0 not in shape) == voxels and not stretches_in_nibabel(shape, key)
    ]


@pytest.mark.parametrize("name", ["oblique", "left-handed", "flipped", "sheared"])
def test_random_parts_have_the_voxels_and_the_affine_that_nibabel_gives_them(name):
    pytest.importorskip("nibabel")
    volume = VOLUMES[name]
    image = volume.to_nibabel()
    keys = keys_that_leave(voxels=True)
    assert len(keys) > 15  # of 600 drawn; measured 27
    for key in keys:
        theirs, part = image.slicer[key[::-1]], volume[key]
        assert np.array_equal(np.asanyarray(theirs.dataobj).T, part.voxels), key
        assert np.abs(theirs.affine - part.to_nibabel().affine).max() <= tolerances.FLOAT64_PLACE_MM, key


def test_random_ranges_without_a_voxel_are_refused():
    keys = keys_that_leave(voxels=False)
    assert len(keys) > 150  # of 600 drawn; measured 298
    for key in keys:
        with refused(UsageError, "indices"):
            VOLUMES["oblique"][key]


def test_every_second_slice_and_third_row_lie_two_and_three_steps_apart():
    assert VOLUMES["oblique"][::2, ::3].spacing == pytest.approx((0.7, 3 * 0.5, 2 * 1.25))


def test_a_part_is_left_handed_once_one_axis_is_reversed_and_not_once_two_are():
    volume = VOLUMES["oblique"]
    assert is_left_handed(volume[::-1].affine)
    assert not is_left_handed(volume[::-1, ::-1].affine)


def test_the_affine_of_a_reversed_volume_holds_no_negative_zero():
    affine = VOLUMES["flipped"][::-1, ::-1, ::-1].affine
    assert not np.signbit(affine[affine == 0.0]).any()


def test_a_single_voxel_keeps_value_place_spacing_and_the_direction_of_its_ranges():
    volume = VOLUMES["oblique"]
    single = volume[3:4:2, 4:5, 1:0:-1]
    assert single.voxels.tolist() == [[[volume.voxels[3, 4, 1]]]]
    assert single.spacing == pytest.approx(volume.spacing)
    assert is_left_handed(single.affine)
    assert np.array_equal(single.affine[:3, 3], volume.ijk_to_lps([(1, 4, 3)])[0])


def test_one_slice_of_an_uneven_volume_is_even_and_lies_where_it_did():
    volume = VOLUMES["uneven"]
    slab = volume[4:5]
    assert not slab.uneven
    assert np.allclose(slab.affine[:3, 3], volume.slice_origins()[4])


@pytest.fixture
def two_even_runs():
    """Slices at z = 0, 1, 2, 3 and 9, 10, 11 mm."""
    table = np.zeros((7, 3))
    table[:, 2] = (0.0, 1.0, 2.0, 3.0, 9.0, 10.0, 11.0)
    return Volume(np.zeros((7, 2, 2), np.int16), np.diag((0.5, 0.5, 11.0 / 6.0, 1.0)), slice_positions=table)


def test_even_slices_of_an_uneven_volume_have_an_affine(two_even_runs):
    last_three = two_even_runs[4:]
    assert not last_three.uneven
    assert last_three.affine[:3, 2].tolist() == pytest.approx([0, 0, 1])
    assert last_three.affine[:3, 3].tolist() == pytest.approx([0, 0, 9])


def test_slices_of_an_uneven_volume_that_stay_uneven_keep_their_positions(two_even_runs):
    every_third = two_even_runs[::3]
    assert every_third.uneven
    assert every_third.slice_origins()[:, 2].tolist() == [0.0, 3.0, 11.0]


def test_reversed_uneven_slices_run_downwards_and_map_points_between_them(two_even_runs):
    downwards = two_even_runs[5:1:-1]
    assert downwards.uneven
    assert downwards.slice_origins()[:, 2].tolist() == [10.0, 9.0, 3.0, 2.0]
    assert downwards.affine[2, 2] < 0
    assert downwards.lps_to_ijk([(0.5, 0.0, 6.0)])[0] == pytest.approx((1.0, 0.0, 1.5))  # half way from 9 to 3 mm


def test_a_range_of_slices_shares_the_memory_of_its_volume():
    volume = VOLUMES["oblique"]
    assert np.shares_memory(volume[2:].voxels, volume.voxels)


def test_voxels_of_a_part_are_contiguous():
    assert VOLUMES["oblique"][:, :, ::2].voxels.flags.c_contiguous


def test_a_part_survives_pickling():
    part = VOLUMES["oblique"][2:]
    again = pickle.loads(pickle.dumps(part))
    assert np.array_equal(again.voxels, part.voxels)
    assert np.array_equal(again.affine, part.affine)


@pytest.mark.parametrize(
    ("key", "words"),
    [
        (7, r"index 7 along k leaves no volume: take 7:8 .* volume\.voxels"),
        (np.s_[:, np.int16(-1)], "index -1 along j leaves no volume: take -1: for"),
        (np.s_[0:2, 0:2, 0:2, 0:2], "three axes, k, j, i, .* not by 4"),
        (np.s_[..., ...], "not by ellipsis along k"),
        (np.s_[None], "not by NoneType along k"),
        (np.s_[:, [1, 2]], "not by list along j"),
        (np.zeros(SHAPE, bool), r"not by ndarray along k: .* clrecon\.Mask"),
        (np.s_[4:2], "nothing is left: 4:2 holds none of the 6 indices along k"),
        (np.s_[:, :, 9:], "9: holds none of the 4 indices along i"),
        (np.s_[::0], "::0 along k is no range of indices: slice step cannot be zero"),
        (np.s_[1.0:2.0], r"1\.0:2\.0 along k is no range"),
        ("k", "not by str along k"),
    ],
    ids=[
        "number",
        "negative number",
        "four axes",
        "two ellipses",
        "None",
        "list",
        "mask",
        "empty range",
        "beyond the end",
        "step of 0",
        "range of floats",
        "text",
    ],
)
def test_an_index_that_leaves_no_volume_is_refused_in_one_line(key, words):
    with pytest.raises(UsageError, match=words) as caught:
        VOLUMES["oblique"][key]
    assert_one_line(caught.value)


def test_going_through_a_volume_as_a_sequence_is_refused():
    with refused(TypeError, "Volume"):
        iter(VOLUMES["oblique"])


def test_looking_for_a_value_in_a_volume_is_refused():
    with refused(TypeError, "Volume"):
        3 in VOLUMES["oblique"]  # type: ignore[operator]  # noqa: B015


@pytest.fixture(scope="module", params=[0.0, 12.0, -12.0])
def tilted(request, tmp_path_factory):
    """The tilt, a series of 7 slices of 9 x 6, and of its slices 5 and 3 the rows 1 to 3."""
    folder = tmp_path_factory.mktemp("tilted")
    dicom_series.write_series(folder, dicom_series.Plan(shape=(7, 6, 9), gap=1.25, tilt_deg=request.param))
    volume = read_volume(folder)
    return request.param, volume, volume[5:1:-2, 1:4]


def test_the_certificate_of_a_part_has_its_shape_affine_range_gap_and_orientation(tilted):
    _, volume, part = tilted
    certificate = part.certificate
    assert (certificate.shape_ijk, certificate.slices) == (list(part.shape_ijk), 2)
    assert np.allclose(certificate.affine_ijk_to_lps_mm, part.affine)
    assert certificate.hu_range == list(part.hu_range)
    assert certificate.gap_mm["median"] == pytest.approx(2 * volume.certificate.gap_mm["median"])
    assert certificate.orientation == facts_of_orientation(part.affine)


def test_the_certificate_of_a_part_has_the_frame_of_reference_of_the_whole(tilted):
    _, volume, part = tilted
    assert part.certificate.frame_of_reference_hash == volume.certificate.frame_of_reference_hash is not None


def test_the_certificate_of_a_part_keeps_the_tilt(tilted):
    plan_deg, volume, part = tilted  # 12 degrees of the plan are -12 of a certificate
    assert part.certificate.tilt_deg == pytest.approx(volume.certificate.tilt_deg, abs=1e-6)
    assert part.certificate.tilt_deg == pytest.approx(-plan_deg, abs=1e-6)  # places have 9 decimals


def test_the_certificate_of_a_part_says_what_was_taken_and_how_many_voxels_stay(tilted):
    _, _, part = tilted
    assert part.certificate["sliced"] == {
        "first_ijk": [0, 1, 5], "step_ijk": [1, 1, -2], "shape_ijk_before": [9, 6, 7],
    }  # fmt: skip
    assert part.certificate.warnings[-1].startswith(
        "sliced to 5:1:-2, 1:4, : of k, j, i: 54 of 378 voxels stay"  # 9 x 3 x 2 of 9 x 6 x 7
    )


def test_a_part_of_a_part_is_reported_as_taken_from_the_first_part_and_the_whole_is_not_changed(tilted):
    _, volume, part = tilted
    assert part[:, :1].report["sliced"]["shape_ijk_before"] == [9, 3, 2]
    assert "sliced" not in volume.report


LABELS = LabelMap(np.ones((200, 5, 4), np.uint8), np.diag((0.7, 0.5, 1.25, 1.0)), {1: "bone"})


def test_labels_of_a_thin_part_of_their_grid_are_taken_exactly():
    volume = Volume(np.zeros((200, 5, 4), np.int16), LABELS.affine)
    labels = resample_labels(LABELS, volume[120:119:-1, :, 1:2])
    assert labels.exact
    assert labels.voxels.tolist() == np.ones((1, 5, 1)).tolist()


def test_resampling_labels_to_an_oblique_grid_tells_each_slice():
    steps = []
    oblique = Volume(np.zeros(SHAPE, np.int16), affine_of_steps(STEPS, (1.0, 1.0, 3.0)))
    resample_labels(LABELS, oblique, progress=lambda *step: steps.append(step))
    assert steps == [("resample", k, 6) for k in range(6)]


def test_resampling_labels_to_labels_is_refused():
    with refused(UsageError, "Volume", "LabelMap"):
        resample_labels(LABELS, LABELS)  # type: ignore[arg-type]


STRAIGHT = Volume(np.arange(120, dtype=np.int32).reshape(SHAPE), np.diag((2.0, 3.0, 4.0, 1.0)))
"""4 x 5 x 6 voxels of 2 x 3 x 4 mm from the origin on."""
INF = float("inf")


def test_a_crop_by_a_box_with_open_sides_is_that_of_a_box_to_infinity():
    cropped = STRAIGHT.crop(clip_box=(2, 4, 3, None, None, 16))
    expected = crop_volume(STRAIGHT, (2, 3, -INF), (4, INF, 16))
    assert np.array_equal(cropped.voxels, expected.voxels)
    assert cropped.report == expected.report


@pytest.mark.parametrize(
    ("box", "shape_ijk"),
    [
        ({"clip_box": (2, 4, 3, None, None, 16)}, (2, 4, 5)),
        ({"between": (8, None)}, (4, 5, 4)),
        ({"around": (2, 3, 8, 1), "margin": 1}, (3, 3, 3)),
        ({"clip_box": [2, 4, 3, 9, -INF, INF], "between": (8, 16)}, (2, 3, 3)),
        ({"clip_box": (-4, -2, -9, -3, None, None), "space": "ras"}, (2, 3, 6)),
    ],
    ids=["box", "between heights", "around a point with a margin", "box and heights", "box in RAS"],
)
def test_a_crop_keeps_the_voxels_whose_centres_lie_in_the_box(box, shape_ijk):
    assert STRAIGHT.crop(**box).shape_ijk == shape_ijk


def test_a_crop_above_a_height_keeps_the_slices_from_there_on():
    assert np.array_equal(STRAIGHT.crop(between=(8, None)).voxels, STRAIGHT.voxels[2:])


def test_report_of_a_crop_names_the_frame_of_its_box():
    cropped = STRAIGHT.crop(clip_box=(-4, -2, -9, -3, None, None), space="ras")
    assert cropped.report["crop"]["space"] == "ras"


WRONG_CROPS = {
    "no box": ({}, "needs a box: clip_box, between or around"),
    "box of two numbers": ({"clip_box": (1, 2)}, "clip_box takes six numbers"),
    "heights as text": ({"between": "high"}, "between takes two numbers, z0,z1, not"),
    "height of NaN": ({"between": (float("nan"), 2)}, "one of them is NaN"),
    "point with None": ({"around": (0, 0, None, 3)}, "one of them is None"),
    "negative margin": ({"between": (0, 9), "margin": -1}, "margin of a crop is a number of voxels from 0, not -1"),
    "margin of 1.5": ({"between": (0, 9), "margin": 1.5}, "margin of a crop .* not 1.5"),
    "unknown frame": ({"between": (0, 9), "space": "xyz"}, "unknown space 'xyz'"),
    "box beside the volume": ({"between": (90, None)}, "no voxel lies in the box z from 90"),
}


@pytest.mark.parametrize(("box", "words"), WRONG_CROPS.values(), ids=WRONG_CROPS)
def test_a_crop_without_a_box_of_numbers_that_holds_a_voxel_is_refused(box, words):
    with pytest.raises(UsageError, match=words):
        STRAIGHT.crop(**box)


def test_bounds_of_an_uneven_volume_are_those_of_its_voxel_centres():
    volume = VOLUMES["uneven"]
    low, high = volume.bounds
    assert np.allclose(low, voxel_centres(volume).min(axis=0))
    assert np.allclose(high, voxel_centres(volume).max(axis=0))


def test_an_uneven_volume_resampled_to_one_step_covers_its_bounds():
    volume = VOLUMES["uneven"]
    resampled = volume.resample(0.5)
    assert not resampled.uneven
    assert resampled.spacing == pytest.approx((0.5, 0.5, 0.5))
    assert (resampled.bounds[0] <= volume.bounds[0] + tolerances.FLOAT64_PLACE_MM).all()
    assert (resampled.bounds[1] >= volume.bounds[1] - tolerances.FLOAT64_PLACE_MM).all()


@pytest.mark.parametrize("step", [0.0, float("nan"), "1", None, (1, 1, 0)])
def test_resampling_with_a_step_that_is_no_length_is_refused(step):
    with refused(UsageError, 0.01):
        VOLUMES["uneven"].resample(step)
