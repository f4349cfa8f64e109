"""Parts of a volume by indices: the voxels that numpy takes, each at its own place; and its boxes in mm."""

from __future__ import annotations

import pickle

import dicom_series
import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import refused
from uneven_volume import positions, uneven

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


def placed(steps: np.ndarray, origin: tuple[float, float, float] = ORIGIN) -> np.ndarray:
    """Return the affine with the columns of `steps`, (3, 3)."""
    i, j, k = steps.T
    return compose_affine(i, j, k, origin)


def numbered(affine: np.ndarray) -> Volume:
    return Volume(np.arange(np.prod(SHAPE), dtype=np.int32).reshape(SHAPE), affine)


VOLUMES = {
    "oblique": numbered(placed(STEPS)),
    "left-handed": numbered(placed(STEPS * (1, 1, -1))),
    "flipped": numbered(placed(np.diag((-0.7, -0.5, 1.25)))),
    "sheared": numbered(placed(STEPS @ SHEAR)),
    "uneven": uneven(np.arange(np.prod(SHAPE), dtype=np.int32).reshape(SHAPE)),
    "uneven, left-handed": uneven(np.arange(np.prod(SHAPE), dtype=np.int32).reshape(SHAPE), -1.0),
}
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
    np.s_[5:6:-1, 4:5:7, 3:2:-1],
    np.s_[...],
    (),
]


def places(volume: Volume) -> np.ndarray:
    """Place of each voxel, by its number."""
    k, j, i = np.indices(volume.shape).reshape(3, -1)
    return volume.ijk_to_lps(np.column_stack([i, j, k]))


@pytest.mark.parametrize("name", VOLUMES)
@pytest.mark.parametrize("key", [key for key in KEYS if key != np.s_[5:6:-1, 4:5:7, 3:2:-1]], ids=str)
def test_the_voxels_are_those_of_numpy_at_their_own_places(name, key):
    volume = VOLUMES[name]
    part = volume[key]
    assert type(part) is Volume and part.shape == volume.voxels[key].shape
    assert np.array_equal(part.voxels, volume.voxels[key])
    # Uneven slices of which the rest is even get an affine, within the tolerance of reading.
    off = tolerances.FLOAT64_PLACE_MM if part.uneven == volume.uneven or part.shape[0] == 1 else 0.0125
    assert np.abs(places(part) - places(volume)[part.voxels.ravel()]).max() <= off
    assert part.hu_range == (part.voxels.min(), part.voxels.max())


def test_random_ranges_are_those_of_nibabel():
    """Ranges that begin at a number from 0: with others nibabel 5.4 takes the right voxels and places them wrongly."""
    pytest.importorskip("nibabel")
    random = np.random.default_rng(5)
    tried = 0
    while tried < 60:
        volume = VOLUMES[["oblique", "left-handed", "flipped", "sheared"][tried % 4]]
        starts = [int(random.integers(n)) for n in SHAPE]
        stops = random.choice([None, -3, -1, 0, 1, 3, 9], 3)
        key = tuple(map(slice, starts, stops, random.choice([None, 1, 2, -1, -2], 3)))
        if 0 in volume.voxels[key].shape:
            with refused(UsageError, "indices"):
                volume[key]
            continue
        if any(n == 1 and own.step is not None for n, own in zip(volume.voxels[key].shape, key, strict=True)):
            continue  # there nibabel stretches the one voxel
        theirs = volume.to_nibabel().slicer[key[::-1]]
        part = volume[key]
        assert np.array_equal(np.asanyarray(theirs.dataobj).T, part.voxels)
        assert np.abs(theirs.affine - part.to_nibabel().affine).max() <= tolerances.FLOAT64_PLACE_MM
        tried += 1


def test_parts_have_the_spacing_handedness_and_place_of_their_steps():
    volume = VOLUMES["oblique"]
    assert volume[::2, ::3].spacing == pytest.approx((0.7, 1.5, 2.5))
    assert is_left_handed(volume[::-1].affine) and not is_left_handed(volume[::-1, ::-1].affine)
    backward = VOLUMES["flipped"][::-1, ::-1, ::-1].affine
    assert not np.signbit(backward[backward == 0.0]).any()
    single = volume[3:4:2, 4:5, 1:0:-1]
    assert single.shape == (1, 1, 1) and single.spacing == pytest.approx(volume.spacing)
    assert single.voxels.item() == volume.voxels[3, 4, 1] and is_left_handed(single.affine)
    assert np.array_equal(single.affine[:3, 3], volume.ijk_to_lps([(1, 4, 3)])[0])
    slab = VOLUMES["uneven"][4:5]
    assert not slab.uneven and np.allclose(slab.affine[:3, 3], positions()[4])


def test_uneven_slices_that_become_even_have_an_affine():
    table = np.zeros((7, 3))
    table[:, 2] = (0.0, 1.0, 2.0, 3.0, 9.0, 10.0, 11.0)
    whole = Volume(np.zeros((7, 2, 2), np.int16), np.diag((0.5, 0.5, 11.0 / 6.0, 1.0)), slice_positions=table)
    assert not whole[4:].uneven and np.allclose(whole[4:].affine[:3, 2:4].T, [(0, 0, 1), (0, 0, 9)])
    assert not whole[::3].uneven or whole[::3].slice_origins()[:, 2].tolist() == [0.0, 3.0, 11.0]
    turned = whole[5:1:-1]
    assert turned.uneven and turned.slice_origins()[:, 2].tolist() == [10.0, 9.0, 3.0, 2.0]
    assert turned.affine[2, 2] < 0 and turned.lps_to_ijk([(0.5, 0.0, 6.0)])[0] == pytest.approx((1.0, 0.0, 1.5))


def test_a_part_shares_the_memory_where_numpy_can():
    volume = VOLUMES["oblique"]
    assert np.shares_memory(volume[2:].voxels, volume.voxels)
    assert volume[:, :, ::2].voxels.flags.c_contiguous
    assert np.array_equal(pickle.loads(pickle.dumps(volume[2:])).voxels, volume.voxels[2:])


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
)
def test_index_that_leaves_no_volume_is_refused_in_one_line(key, words):
    with pytest.raises(UsageError, match=words) as refused:
        VOLUMES["oblique"][key]
    assert "\n" not in str(refused.value)


def test_a_volume_is_no_sequence_of_parts():
    with refused(TypeError, "Volume"):
        iter(VOLUMES["oblique"])
    with pytest.raises(TypeError):
        3 in VOLUMES["oblique"]  # type: ignore[operator]  # noqa: B015


@pytest.fixture(scope="module", params=[0.0, 12.0, -12.0])
def tilted(request, tmp_path_factory):
    """The tilt, a series of 7 slices of 9 x 6, and of its slices 5 and 3 the rows 1 to 3."""
    folder = tmp_path_factory.mktemp("tilted")
    dicom_series.write_series(folder, dicom_series.Plan(shape=(7, 6, 9), gap=1.25, tilt_deg=request.param))
    volume = read_volume(folder)
    return request.param, volume, volume[5:1:-2, 1:4]


def test_the_certificate_is_that_of_the_part(tilted):
    _, volume, part = tilted
    own = part.certificate
    assert own.shape_ijk == list(part.shape_ijk) and own.slices == 2
    assert np.allclose(own.affine_ijk_to_lps_mm, part.affine) and own.hu_range == list(part.hu_range)
    assert own.gap_mm["median"] == pytest.approx(2 * volume.certificate.gap_mm["median"])
    assert own.orientation == facts_of_orientation(part.affine) and not own.orientation["right_handed"]
    assert own.frame_of_reference_hash == volume.certificate.frame_of_reference_hash is not None


def test_the_certificate_of_a_part_keeps_the_tilt(tilted):
    tilt, volume, part = tilted
    assert part.certificate.tilt_deg == pytest.approx(volume.certificate.tilt_deg, abs=1e-6)
    assert abs(part.certificate.tilt_deg) == pytest.approx(abs(tilt), abs=1e-3)
    assert part.certificate.tilt_deg * tilt <= 0.0  # the plan's 12 degrees are -12 of a certificate


def test_the_certificate_of_a_part_says_what_was_taken(tilted):
    _, volume, part = tilted
    assert part.certificate["sliced"] == {
        "first_ijk": [0, 1, 5], "step_ijk": [1, 1, -2], "shape_ijk_before": [9, 6, 7],
    }  # fmt: skip
    assert part.certificate.warnings[-1].startswith(
        "sliced to 5:1:-2, 1:4, : of k, j, i: 54 of 378 voxels stay"  # 9 x 3 x 2 of 9 x 6 x 7
    )
    assert "sliced" not in volume.report
    assert part[:, :1].report["sliced"]["shape_ijk_before"] == [9, 3, 2]


def test_labels_of_the_whole_body_go_with_a_thin_part():
    labels = LabelMap(np.ones((200, 5, 4), np.uint8), np.diag((0.7, 0.5, 1.25, 1.0)), {1: "bone"})
    volume = Volume(np.zeros((200, 5, 4), np.int16), labels.affine)
    taken = resample_labels(labels, volume[120:119:-1, :, 1:2])
    assert taken.exact and taken.voxels.shape == (1, 5, 1) and (taken.voxels == 1).all()
    told = []
    oblique = Volume(np.zeros(SHAPE, np.int16), placed(STEPS, (1.0, 1.0, 3.0)))
    resample_labels(labels, oblique, progress=lambda *call: told.append(call))
    assert told == [("resample", k, 6) for k in range(6)]
    with refused(UsageError, "Volume", "LabelMap"):
        resample_labels(labels, labels)


def test_crop_takes_the_boxes_of_the_command_line():
    volume = Volume(np.arange(120, dtype=np.int32).reshape(SHAPE), np.diag((2.0, 3.0, 4.0, 1.0)))
    nan, inf = float("nan"), float("inf")
    by_box = volume.crop(clip_box=(2, 4, 3, None, None, 16))
    same = crop_volume(volume, (2, 3, -inf), (4, inf, 16))
    assert np.array_equal(by_box.voxels, same.voxels) and by_box.report == same.report
    assert by_box.shape_ijk == (2, 4, 5)
    assert np.array_equal(volume.crop(between=(8, None)).voxels, volume.voxels[2:])
    assert volume.crop(around=(2, 3, 8, 1), margin=1).shape == (3, 3, 3)
    assert volume.crop(clip_box=[2, 4, 3, 9, -inf, inf], between=(8, 16)).shape_ijk == (2, 3, 3)
    turned = volume.crop(clip_box=(-4, -2, -9, -3, None, None), space="ras")
    assert turned.shape_ijk == (2, 3, 6) and turned.report["crop"]["space"] == "ras"
    for words, wrong in (
        ("needs a box: clip_box, between or around", {}),
        ("clip_box takes six numbers", {"clip_box": (1, 2)}),
        ("between takes two numbers, z0,z1, not", {"between": "high"}),
        ("one of them is NaN", {"between": (nan, 2)}),
        ("one of them is None", {"around": (0, 0, None, 3)}),
        ("margin of a crop is a number of voxels from 0, not -1", {"between": (0, 9), "margin": -1}),
        ("margin of a crop .* not 1.5", {"between": (0, 9), "margin": 1.5}),
        ("unknown space 'xyz'", {"between": (0, 9), "space": "xyz"}),
        ("no voxel lies in the box z from 90", {"between": (90, None)}),
    ):
        with pytest.raises(UsageError, match=words):
            volume.crop(**wrong)


def test_resampled_volume_covers_the_bounds_of_an_uneven_one():
    volume = VOLUMES["uneven"]
    low, high = volume.bounds
    assert np.allclose(low, places(volume).min(axis=0)) and np.allclose(high, places(volume).max(axis=0))
    made = volume.resample(0.5)
    assert not made.uneven and made.spacing == pytest.approx((0.5, 0.5, 0.5))
    assert (made.bounds[0] <= low + 1e-9).all() and (made.bounds[1] >= high - 1e-9).all()
    for step in (0.0, float("nan"), "1", None, (1, 1, 0)):
        with refused(UsageError, 0.01):
            volume.resample(step)
