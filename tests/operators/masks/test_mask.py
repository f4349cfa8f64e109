"""`clrecon.Mask`: made of bands, labels, boxes, tubes and arrays, joined, and given back."""

from __future__ import annotations

import copy
import math
import operator
import pickle
from typing import Any

import numpy as np
import pytest
from refusals import refused
from scipy import ndimage
from surface_volumes import MIRRORED, OBLIQUE, random_volume
from tolerances import FLOAT64_PLACE_MM, MASK_VOLUME
from uneven_volume import uneven

import clrecon
from clrecon import LabelMap, Mask
from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.proof.volumes import volume_twins as twin

TILTED = np.array([[0.6, 0.0, 0.0, -20.0], [0.0, 0.6, 0.7, 5.0], [0.0, 0.0, 2.0, 100.0], [0, 0, 0, 1.0]])
ROWS = [1, 31, 32, 33, 512, 513, 2049]


GRIDS = ["straight", "oblique", "mirrored", "tilted", "uneven", "uneven, mirrored", "one slice"]


def volume_of_grid(grid: str) -> Volume:
    """Random HU from 0 to 99."""
    noise = np.random.default_rng(8).integers(0, 100, (6, 13, 40)).astype(np.int16)
    match grid:
        case "uneven":
            return uneven(noise)
        case "uneven, mirrored":
            return uneven(noise, sign=-1.0)
        case "one slice":
            return Volume(noise[:1], OBLIQUE)
    return Volume(noise, {"straight": np.eye(4), "oblique": OBLIQUE, "mirrored": MIRRORED, "tilted": TILTED}[grid])


@pytest.mark.parametrize("columns", ROWS)
def test_mask_of_an_array_of_rows_around_whole_words_gives_it_back(device, columns):
    chosen = random_volume((3, 4, columns), high=100).voxels > 60
    made = clrecon.Mask.from_array(random_volume((3, 4, columns)), chosen, device=device)
    np.testing.assert_array_equal(made.to_numpy(), chosen)
    assert (made.count, made.share) == (chosen.sum(), chosen.mean())


@pytest.mark.parametrize("columns", ROWS)
def test_inverted_mask_holds_the_other_voxels(device, columns):
    chosen = random_volume((3, 4, columns), high=100).voxels > 60
    inverted = ~clrecon.Mask.from_array(random_volume((3, 4, columns)), chosen, device=device)
    np.testing.assert_array_equal(inverted.to_numpy(), ~chosen)
    assert inverted.count == (~chosen).sum()  # bits beyond the row stay 0


@pytest.mark.parametrize("columns", ROWS)
def test_mask_of_a_band_without_an_end_holds_the_voxels_from_its_lower_value_on(device, columns):
    volume = random_volume((3, 4, columns), high=100)
    made = clrecon.Mask.from_band(volume, (61, math.inf), device=device)
    np.testing.assert_array_equal(made.to_numpy(), volume.voxels >= 61)


@pytest.fixture
def two_masks(device):
    """Masks of the voxels above 40 of random HU from 0 to 99, and of those that are multiples of three."""
    volume = random_volume((5, 6, 70), high=100)
    chosen = volume.voxels > 40, volume.voxels % 3 == 0
    return [clrecon.Mask.from_array(volume, bits, device=device) for bits in chosen]


@pytest.mark.parametrize(
    ("join", "join_arrays"),
    [
        (operator.and_, np.logical_and),
        (operator.or_, np.logical_or),
        (operator.xor, np.logical_xor),
        (operator.sub, lambda a, b: a & ~b),
    ],
    ids=["and", "or", "xor", "without"],
)
def test_joined_masks_equal_joined_arrays_and_the_masks_stay(two_masks, join, join_arrays):
    one, other = two_masks
    a, b = one.to_numpy(), other.to_numpy()
    np.testing.assert_array_equal(join(one, other).to_numpy(), join_arrays(a, b))
    np.testing.assert_array_equal(one.to_numpy(), a)
    np.testing.assert_array_equal(other.to_numpy(), b)


def test_difference_of_masks_is_named_by_both(two_masks):
    one, other = two_masks
    assert (one - other).name == "(an array) and not (an array)"


def test_mask_and_an_array_are_not_joined(two_masks):
    with refused(TypeError, "Mask"):
        one, other = two_masks
        one & other.to_numpy()


@pytest.mark.parametrize("grid", GRIDS)
def test_boxes_with_and_without_ends_equal_the_twin(device, grid):
    volume = volume_of_grid(grid)
    places = twin.find_places(volume).reshape(-1, 3)
    rng = np.random.default_rng(GRIDS.index(grid))
    compared = 0
    for _ in range(6):
        sides = np.sort(rng.uniform(places.min(axis=0), places.max(axis=0), (2, 3)), axis=0).T
        sides[rng.random((3, 2)) < 0.4] = np.nan  # no end
        expected = twin.find_in_box(volume, np.where(np.isnan(sides), [-np.inf, np.inf], sides))
        if expected.any():
            made = clrecon.Mask.from_box(volume, sides.ravel().tolist(), device=device)
            np.testing.assert_array_equal(made.to_numpy(), expected)
            compared += 1
    assert compared > 1


@pytest.mark.parametrize("grid", GRIDS)
def test_a_box_that_ends_at_the_outermost_voxels_holds_all(device, grid):
    volume = volume_of_grid(grid)
    places = twin.find_places(volume).reshape(-1, 3)
    sides = np.stack([places.min(axis=0), places.max(axis=0)], axis=1)
    assert clrecon.Mask.from_box(volume, sides.ravel().tolist(), device=device).share == 1.0


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize(("radius", "points"), [(0.4, 1), (1.7, 2), (3.1, 4), (2.0, 9)])
def test_tubes_around_lines_equal_the_twin(device, grid, radius, points):
    volume = volume_of_grid(grid)
    places = twin.find_places(volume).reshape(-1, 3)
    rng = np.random.default_rng(points)
    line = places[rng.integers(0, len(places), points)] + rng.normal(0.0, 0.1, (points, 3))
    line = np.concatenate([line, line[-1:]])  # a piece without length
    expected = twin.find_in_tube(volume, line, radius)
    assert expected.any()
    made = clrecon.Mask.from_tube(volume, line, radius, device=device)
    np.testing.assert_array_equal(made.to_numpy(), expected)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_tube_of_ten_metres_around_a_voxel_holds_all(device, grid):
    volume = volume_of_grid(grid)
    assert clrecon.Mask.from_tube(volume, volume.ijk_to_lps([[4, 3, 0]]), 1e4, device=device).share == 1.0


@pytest.fixture
def labelled():
    """A volume, and a label map of the numbers 0 to 5 in which 2 is named L1 and 3 L2."""
    volume = random_volume((4, 5, 40), high=6)
    return volume, LabelMap(volume.voxels.astype(np.uint8), volume.affine, {2: "L1", 3: "L2"})


def test_mask_of_labels_by_number_and_name_holds_their_voxels(device, labelled):
    volume, labels = labelled
    made = clrecon.Mask.from_labels(volume, labels, ["L1", 3], device=device)
    np.testing.assert_array_equal(made.to_numpy(), np.isin(labels.voxels, [2, 3]))
    assert made.name == "labels L1, L2"


def test_mask_of_all_labels_holds_every_voxel_that_has_one(device, labelled):
    volume, labels = labelled
    made = clrecon.Mask.from_labels(volume, labels, device=device)
    np.testing.assert_array_equal(made.to_numpy(), labels.voxels != 0)


def test_label_map_of_a_mask_gives_the_mask_back(device, labelled):
    volume, labels = labelled
    made = clrecon.Mask.from_labels(volume, labels, ["L1", 3], device=device)
    again = clrecon.Mask.from_labels(volume, made.to_label_map("two"), ["two"], device=device)
    np.testing.assert_array_equal(again.to_numpy(), made.to_numpy())


def test_mask_of_an_unknown_label_is_refused_with_its_name(device, labelled):
    volume, labels = labelled
    with refused(UsageError, "L9"):
        clrecon.Mask.from_labels(volume, labels, ["L9"], device=device)


def test_mask_of_an_array_in_place_of_a_label_map_is_refused(device, labelled):
    volume, labels = labelled
    with refused(UsageError, "LabelMap", "labels"):
        clrecon.Mask.from_labels(volume, labels.voxels, device=device)


@pytest.mark.parametrize(("dtype", "outside"), [("int16", -1024), ("uint8", 0), ("float32", -1024)])
def test_mask_keeps_the_chosen_voxels_of_a_volume(device, dtype, outside):
    volume = random_volume((4, 5, 40), dtype=dtype, high=100)
    made = clrecon.Mask.from_band(volume, (30, 60), device=device)
    kept = made.apply(volume, outside)
    expected = np.where((volume.voxels >= 30) & (volume.voxels <= 60), volume.voxels, outside)
    np.testing.assert_array_equal(kept.voxels, expected)
    assert kept.voxels.dtype == dtype
    assert kept.report["region"]["voxels"] == made.count


@pytest.mark.parametrize(("dtype", "outside"), [("int16", -1024), ("uint8", 0), ("float32", -1024)])
def test_mask_keeps_the_chosen_voxels_of_a_resident_volume_on_the_device(device, dtype, outside):
    volume = random_volume((4, 5, 40), dtype=dtype, high=100)
    made = clrecon.Mask.from_band(volume, (30, 60), device=device)
    expected = made.apply(volume, outside)
    with clrecon.DeviceVolume(volume, device=device) as resident, made.apply(resident, outside) as kept:
        assert kept.is_held
        np.testing.assert_array_equal(kept.volume.voxels, expected.voxels)
        on_device = clrecon.extract_isosurface(kept, 45)
    on_host = clrecon.extract_isosurface(expected, 45, device=device)
    np.testing.assert_array_equal(on_device.vertices, on_host.vertices)


@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32"])
def test_nan_for_the_voxels_outside_of_a_mask_is_refused(device, dtype):
    volume = random_volume((4, 5, 40), dtype=dtype, high=100)
    with refused(UsageError, "nan", dtype):
        clrecon.Mask.from_band(volume, (30, 60), device=device).apply(volume, math.nan)


def test_surface_of_the_voxels_in_a_box_is_that_of_the_volume_with_air_elsewhere(device):
    volume = random_volume((8, 9, 40), high=100)
    from_x = [volume.affine[0, 3] + 9.0, None, None, None, None, None]  # mm: 9 from the first voxel on
    mask = clrecon.Mask.from_box(volume, from_x, device=device)
    with_air = volume.with_voxels(np.where(mask.to_numpy(), volume.voxels, -1024))
    found, expected, whole = (
        clrecon.extract_isosurface(each, 50, device=device) for each in (mask.apply(volume), with_air, volume)
    )
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    assert 0 < len(found.triangles) < len(whole.triangles)


SMALL = random_volume((3, 4, 40), high=6)
"""Random HU from 0 to 5."""


def test_mask_of_a_band_whose_ends_are_exchanged_is_refused(device):
    with refused(UsageError, "band", 3, 1):
        Mask.from_band(SMALL, (3, 1), device=device)


def test_mask_of_a_band_between_whole_numbers_is_refused(device):
    with refused(NoSurfaceError, "voxel", 0.2, 0.8):
        Mask.from_band(SMALL, (0.2, 0.8), device=device)


def test_mask_of_an_array_of_another_shape_is_refused(device):
    with refused(UsageError, "shape", 39, 40):
        Mask.from_array(SMALL, np.zeros((3, 4, 39), bool), device=device)


def test_mask_of_an_array_of_floats_is_refused(device):
    with refused(UsageError, "float64"):
        Mask.from_array(SMALL, np.zeros((3, 4, 40)), device=device)


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ((1, 2, 3), "a box is six numbers of mm"),
        (7, "a box is six numbers of mm"),
        ((5, 1, None, None, None, None), "runs from 5 to 1 mm in x"),
        ((900, 950, 0, 1, 0, 1), "no voxel lies in the box x 900 to 950 mm.*the volume runs from"),
    ],
    ids=["three numbers", "one number", "ends exchanged", "beside the volume"],
)
def test_mask_of_a_wrong_box_is_refused(device, box, words):
    with pytest.raises(UsageError, match=words):
        Mask.from_box(SMALL, box, device=device)


@pytest.mark.parametrize(
    ("points", "radius", "words"),
    [
        (np.zeros((0, 3)), 3.0, "needs points that are numbers"),
        ([[0, 0, np.nan]], 3.0, "needs points that are numbers"),
        ([[0, 0]], 3.0, "points have shape"),
        ([[0, 0, 0]], 0.0, "the radius of the tube is 0.0"),
        ([[0, 0, 0]], math.nan, "the radius of the tube is nan"),
    ],
    ids=["no point", "nan", "two numbers", "no radius", "radius of nan"],
)
def test_mask_of_a_wrong_tube_is_refused(device, points, radius, words):
    with pytest.raises(UsageError, match=words):
        Mask.from_tube(SMALL, points, radius, device=device)


def test_mask_of_a_tube_beside_the_volume_is_refused_with_the_corners_of_the_volume(device):
    places = twin.find_places(SMALL).reshape(-1, 3)
    corners = [round(float(value), 1) for value in (*places.min(axis=0), *places.max(axis=0))]
    with refused(UsageError, "tube", 3, *corners):
        Mask.from_tube(SMALL, [[9e3, 0, 0]], 3.0, device=device)


@pytest.fixture
def small_mask(device):
    """The voxels of `SMALL` from 1 to 3 HU."""
    return Mask.from_band(SMALL, (1, 3), device=device)


def test_mask_is_not_applied_to_a_volume_of_another_shape(small_mask):
    with refused(UsageError, "mask", 40, 41):
        small_mask.apply(random_volume((3, 4, 41)))


def test_masks_whose_voxels_lie_elsewhere_are_not_joined(device, small_mask):
    elsewhere = Mask.from_band(Volume(SMALL.voxels, np.eye(4)), (1, 3), device=device)
    with refused(UsageError, "mm", "apart"):
        small_mask & elsewhere


def test_mask_of_uneven_slices_makes_no_label_map(device):
    with refused(UsageError, "even"):
        Mask.from_band(uneven(), (0, 3), device=device).to_label_map()


@pytest.mark.parametrize("duplicate", [pickle.dumps, copy.copy])
def test_mask_is_neither_pickled_nor_copied(small_mask, duplicate):
    with refused(TypeError, "process"):
        duplicate(small_mask)


WIDE = random_volume((40, 50, 600), high=6)
ONE_MASK = 40 * 50 * 19 * 4  # bytes of 19 words a row: 152,000
ROOM_FOR_TWO_MASKS = 400_000  # bytes; the voxels alone take 2,400,000


def test_mask_of_a_volume_beyond_the_memory_is_made_slab_by_slab(device):
    low, high = 1, 3
    few = clrecon.Mask.from_band(WIDE, (low, high), device=device, memory=ROOM_FOR_TWO_MASKS)
    assert WIDE.voxels.nbytes > ROOM_FOR_TWO_MASKS > 2 * ONE_MASK
    assert few.count == np.count_nonzero((WIDE.voxels >= low) & (WIDE.voxels <= high))


def test_masks_without_room_for_three_are_not_joined(device):
    few = clrecon.Mask.from_band(WIDE, (1, 3), device=device, memory=ROOM_FOR_TWO_MASKS)
    with refused(DeviceError, "masks", "voxels", 3, ROOM_FOR_TWO_MASKS):
        few & few


def test_mask_of_a_band_without_room_is_refused(device):
    with refused(DeviceError, "mask", "slice", 100_000):
        clrecon.Mask.from_band(WIDE, (1, 3), device=device, memory=100_000)


def test_mask_of_an_array_without_room_is_refused(device):
    with refused(DeviceError, "mask", "extents", 100_000):
        clrecon.Mask.from_array(WIDE, WIDE.voxels > 1, device=device, memory=100_000)


@pytest.fixture
def small_random_mask(device):
    """Two fifths of the voxels of an oblique volume of 0 HU."""
    chosen = np.random.default_rng(3).random((5, 6, 41)) < 0.4
    return clrecon.Mask.from_array(Volume(np.zeros((5, 6, 41), np.int16), OBLIQUE), chosen, device=device)


@pytest.mark.oclgrind
def test_a_component_of_a_closed_opened_and_filled_mask_is_a_part_of_it(small_random_mask):
    mask = small_random_mask
    opened = mask.close(2.0).open(1.0).fill_holes() | mask.fill_holes(by_slice=True)
    first_voxel = np.argwhere(opened.to_numpy())[:1, ::-1]  # k, j, i to i, j, k
    grown = opened.grow(mask.scan.ijk_to_lps(first_voxel))
    assert grown.count > 0
    assert (grown - opened).count == 0


@pytest.mark.oclgrind
def test_a_mask_of_a_small_volume_is_applied_to_it(small_random_mask):
    assert small_random_mask.apply(small_random_mask.scan, -5.0).voxels.min() == -5


@pytest.mark.oclgrind
def test_a_mask_and_its_inverse_have_no_voxel_in_common(device, small_random_mask):
    everything = clrecon.Mask.from_band(small_random_mask.scan, (0, 1), device=device)
    others = everything & ~small_random_mask
    assert others.count == everything.count - small_random_mask.count > 0
    assert (others & small_random_mask).count == 0


def test_numpy_takes_a_mask_as_its_voxels(device):
    numbers = Volume(np.arange(24, dtype=np.int16).reshape(2, 3, 4), np.eye(4))
    mask = clrecon.Mask.from_band(numbers, (5, 9), device=device)
    assert np.asarray(mask).dtype == np.bool_
    assert np.array_equal(np.asarray(mask), mask.to_numpy())
    assert np.asarray(mask, dtype=np.uint8).sum() == 5  # the voxels 5, 6, 7, 8 and 9


@pytest.mark.parametrize("grid", GRIDS)
def test_bounds_of_a_mask_are_the_extremes_of_its_voxels(device, grid):
    volume = volume_of_grid(grid)
    chosen = volume.voxels > 95
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    places = twin.find_places(volume)[chosen]
    np.testing.assert_allclose(mask.bounds, [places.min(axis=0), places.max(axis=0)], atol=FLOAT64_PLACE_MM)


@pytest.mark.parametrize("grid", GRIDS)
def test_volume_of_a_mask_is_the_sum_of_its_voxels(device, grid):
    volume = volume_of_grid(grid)
    chosen = volume.voxels > 95
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    voxels_of_slices = np.count_nonzero(chosen, axis=(1, 2))
    if volume.uneven:
        expected = voxels_of_slices @ slice_voxel_ml(volume)
    else:
        expected = voxels_of_slices.sum() * abs(np.linalg.det(volume.affine[:3, :3])) / 1000.0
    assert mask.ml == pytest.approx(expected, rel=1e-9)  # float64


def test_an_empty_mask_has_no_bounds_no_volume_no_component_and_no_surface(device):
    mask = clrecon.Mask.from_array(volume_of_grid("straight"), np.zeros((6, 13, 40), bool), device=device)
    assert np.isnan(mask.bounds).all()
    assert mask.ml == 0.0
    assert mask.components() == []
    assert mask.keep_largest().count == 0
    with refused(NoSurfaceError, "voxel"):
        mask.to_mesh()


@pytest.fixture(params=["straight", "tilted", "uneven"])
def high_voxels(request, device):
    """A mask of the voxels above 70 HU, and their components by scipy: their numbers, and the volume of each in ml."""
    volume = volume_of_grid(request.param)
    chosen = volume.voxels > 70
    labels, _ = ndimage.label(chosen)
    voxel_ml = np.broadcast_to(slice_voxel_ml(volume)[:, None, None], chosen.shape)
    return clrecon.Mask.from_array(volume, chosen, device=device), labels, np.bincount(labels.flat, voxel_ml.flat)[1:]


def test_components_of_a_mask_are_those_of_scipy_the_largest_first(high_voxels):
    mask, labels, ml = high_voxels
    found = mask.components(most=5)
    assert [component.ml for component in found] == pytest.approx(sorted(ml, reverse=True)[:5])
    for component in found:
        (number,) = np.unique(labels[component.to_numpy()])
        assert component.count == np.count_nonzero(labels == number)


def test_all_components_of_a_mask_are_listed_where_as_many_are_asked_for(high_voxels):
    mask, _, ml = high_voxels
    assert len(mask.components(most=10_000)) == len(ml)


def test_the_largest_two_are_the_first_two_components(high_voxels):
    mask, _, _ = high_voxels
    first, second = mask.components(most=2)
    largest = mask.keep_largest(2)
    np.testing.assert_array_equal(largest.to_numpy(), (first | second).to_numpy())
    assert largest.name == "the 2 largest components of (an array)"
    assert first.name == "component 1 of (an array)"


@pytest.mark.parametrize("wanted", [0, -1, 1.5, True, "2"])
def test_a_number_of_components_that_is_no_whole_one_is_refused(device, wanted):
    mask = clrecon.Mask.from_box(volume_of_grid("straight"), (0, 3, 0, 3, 0, 3), device=device)
    with refused(UsageError, 1, "components"):
        mask.keep_largest(wanted)


def test_the_surface_of_a_mask_is_that_of_its_label_and_has_its_volume(device):
    volume = Volume(np.zeros((20, 24, 40), np.int16), TILTED)
    chosen = np.zeros(volume.shape, bool)
    chosen[4:15, 5:20, 6:33] = True
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    mesh = mask.to_mesh()
    mesh_of_label = clrecon.extract_label_masks(mask.to_label_map(), device=device)
    expected = mesh_of_label[1]
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    assert mesh.volume / 1000.0 == pytest.approx(mask.ml, rel=MASK_VOLUME)


@pytest.fixture
def labels_and_bone(device: Any) -> tuple[LabelMap, Mask]:
    """Label 2 in the first of three slices and 9 in the last columns of the second; bone in columns from 33 on."""
    voxels = np.zeros((3, 4, 37), np.uint8)
    voxels[0], voxels[1, :, 30:] = 2, 9
    labels = LabelMap(voxels, np.diag([1.0, 1.0, 2.0, 1.0]), {2: "two", 9: "nine"}, warnings=["doubtful"])
    hu = np.where(np.arange(37) < 33, -5, 50) * np.ones((3, 4, 1), np.int16)
    return labels, Mask.from_band(Volume(hu, labels.affine), (0, None), device=device)


def test_labels_within_a_mask_keep_their_numbers_and_warnings(labels_and_bone: tuple[LabelMap, Mask]) -> None:
    labels, bone = labels_and_bone
    within = labels & bone
    assert np.array_equal(within.voxels, np.where(bone.to_numpy(), labels.voxels, 0))
    assert within.warnings == ("doubtful",)


def test_labels_without_a_mask_keep_their_numbers_and_names(labels_and_bone: tuple[LabelMap, Mask]) -> None:
    labels, bone = labels_and_bone
    outside = labels - bone
    assert np.array_equal(outside.voxels, np.where(bone.to_numpy(), 0, labels.voxels))
    assert outside.names == labels.names


def test_mask_joined_to_labels_is_a_label_of_the_next_number_and_its_name(
    labels_and_bone: tuple[LabelMap, Mask],
) -> None:
    labels, bone = labels_and_bone
    joined = labels | bone
    is_new = bone.to_numpy() & (labels.voxels == 0)
    assert np.array_equal(joined.voxels, np.where(is_new, 10, labels.voxels))
    assert joined.names == {2: "two", 9: "nine", 10: bone.name}


def test_mask_of_labels_of_a_map_holds_their_voxels(device: Any, labels_and_bone: tuple[LabelMap, Mask]) -> None:
    labels, bone = labels_and_bone
    assert np.array_equal(labels.label(["two", 9], device=device).to_numpy(), labels.voxels > 0)
    assert np.array_equal(labels.label("nine", bone.scan, device=device).to_numpy(), labels.voxels == 9)


ONES_OF_1_MM = LabelMap(np.ones((3, 4, 5), np.uint8), np.eye(4))
ONES_OF_2_MM = Volume(np.ones((3, 4, 5), np.int16), np.diag([1.0, 1.0, 2.0, 1.0]))


def test_labels_and_a_mask_of_other_slice_gaps_are_refused(device: Any) -> None:
    with refused(UsageError, "mm", 2):
        ONES_OF_1_MM & Mask.from_band(ONES_OF_2_MM, (0, None), device=device)


def test_labels_and_a_mask_of_fewer_slices_are_refused(device: Any) -> None:
    with refused(UsageError, 5, 4, 2):  # columns, rows and slices of the volume
        ONES_OF_1_MM - Mask.from_band(ONES_OF_2_MM[:2], (0, None), device=device)


@pytest.mark.parametrize("other", [3, ONES_OF_1_MM], ids=["a number", "labels"])
def test_labels_and_what_is_no_mask_are_refused(other: Any) -> None:
    with refused(TypeError, "LabelMap"):
        ONES_OF_1_MM & other
