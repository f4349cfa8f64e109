"""`clrecon.Mask`: made of bands, labels, boxes, tubes and arrays, joined, and given back."""

from __future__ import annotations

import copy
import math
import pickle
import re
from typing import Any

import numpy as np
import pytest
from refusals import refused
from scipy import ndimage
from surface_volumes import MIRRORED, OBLIQUE, random_volume
from uneven_volume import uneven

import clrecon
from clrecon import LabelMap, Mask
from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.proof.volumes import volume_twins as twin

TILTED = np.array([[0.6, 0.0, 0.0, -20.0], [0.0, 0.6, 0.7, 5.0], [0.0, 0.0, 2.0, 100.0], [0, 0, 0, 1.0]])
ROWS = [1, 31, 32, 33, 512, 513, 2049]


def volumes() -> list[Volume]:
    noise = np.random.default_rng(8).integers(0, 100, (6, 13, 40)).astype(np.int16)
    frames = [Volume(noise, frame) for frame in (np.eye(4), OBLIQUE, MIRRORED, TILTED)]
    return [*frames, uneven(noise), uneven(noise, -1.0), Volume(noise[:1], OBLIQUE)]


@pytest.mark.parametrize("ni", ROWS)
def test_arrays_come_back_from_rows_of_any_length(device, ni):
    volume = random_volume((3, 4, ni), high=100)
    chosen = volume.voxels > 60
    made = clrecon.Mask.from_array(volume, chosen, device=device)
    np.testing.assert_array_equal(made.to_numpy(), chosen)
    np.testing.assert_array_equal((~made).to_numpy(), ~chosen)
    assert (made.count, made.share) == (chosen.sum(), chosen.mean())
    assert (~made).count == (~chosen).sum()  # bits beyond the row stay 0
    np.testing.assert_array_equal(clrecon.Mask.from_band(volume, (61, math.inf), device=device).to_numpy(), chosen)


def test_logic_equals_that_of_numpy(device):
    volume = random_volume((5, 6, 70), high=100)
    a, b = volume.voxels > 40, volume.voxels % 3 == 0
    one, other = (clrecon.Mask.from_array(volume, chosen, device=device) for chosen in (a, b))
    for made, expected in ((one & other, a & b), (one | other, a | b), (one ^ other, a ^ b), (one - other, a & ~b)):
        np.testing.assert_array_equal(made.to_numpy(), expected)
    assert (one - other).name == "(an array) and not (an array)"
    np.testing.assert_array_equal(one.to_numpy(), a)  # nothing is changed
    with pytest.raises(TypeError):
        one & a  # type: ignore[operator]


@pytest.mark.parametrize("which", range(7))
def test_boxes_equal_the_twin(device, which):
    volume = volumes()[which]
    places = twin.find_places(volume).reshape(-1, 3)
    low, high = places.min(axis=0), places.max(axis=0)
    rng = np.random.default_rng(which)
    for _ in range(6):
        sides = np.sort(rng.uniform(low, high, (2, 3)), axis=0).T
        sides[rng.random((3, 2)) < 0.4] = np.nan
        expected = twin.find_in_box(volume, np.where(np.isnan(sides), [-np.inf, np.inf], sides))
        if expected.any():
            made = clrecon.Mask.from_box(volume, sides.ravel().tolist(), device=device)
            np.testing.assert_array_equal(made.to_numpy(), expected)
    whole = clrecon.Mask.from_box(volume, np.stack([low, high], axis=1).ravel().tolist(), device=device)
    assert whole.share == 1.0  # a box that ends at voxels holds them


@pytest.mark.parametrize("which", range(7))
def test_tubes_equal_the_twin(device, which):
    volume = volumes()[which]
    places = twin.find_places(volume)
    rng = np.random.default_rng(which)
    for radius, count in ((0.4, 1), (1.7, 2), (3.1, 4), (2.0, 9)):
        line = places.reshape(-1, 3)[rng.integers(0, volume.voxels.size, count)] + rng.normal(0.0, 0.2, (count, 3))
        line = np.concatenate([line, line[-1:]])  # a piece without length
        expected = twin.find_in_tube(volume, line, radius)
        if expected.any():
            made = clrecon.Mask.from_tube(volume, line, radius, device=device)
            np.testing.assert_array_equal(made.to_numpy(), expected)
    ball = clrecon.Mask.from_tube(volume, places[0, 3, 4][None], 1e4, device=device)
    assert ball.share == 1.0


def test_labels_are_chosen_by_number_and_name(device):
    volume = random_volume((4, 5, 40))
    numbers = volume.voxels.astype(np.uint8)
    labels = clrecon.LabelMap(numbers, volume.affine, {2: "L1", 3: "L2"})
    made = clrecon.Mask.from_labels(volume, labels, ["L1", 3], device=device)
    np.testing.assert_array_equal(made.to_numpy(), (numbers == 2) | (numbers == 3))
    assert made.name == "labels L1, L2"
    assert clrecon.Mask.from_labels(volume, labels, device=device).count == np.count_nonzero(numbers)
    again = clrecon.Mask.from_labels(volume, made.to_label_map("two"), ["two"], device=device)
    assert again.count == made.count
    with refused(UsageError, "L9"):
        clrecon.Mask.from_labels(volume, labels, ["L9"], device=device)
    with refused(UsageError, "LabelMap", "labels"):
        clrecon.Mask.from_labels(volume, numbers, device=device)


@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32"])
def test_mask_keeps_the_chosen_voxels_of_a_volume(device, dtype):
    volume = random_volume((4, 5, 40), dtype=dtype, high=100)
    made = clrecon.Mask.from_band(volume, (30, 60), device=device)
    outside = 0 if dtype == "uint8" else -1024
    expected = np.where((volume.voxels >= 30) & (volume.voxels <= 60), volume.voxels, outside)
    found = made.apply(volume, outside)
    np.testing.assert_array_equal(found.voxels, expected)
    assert found.voxels.dtype == dtype
    assert found.report["region"]["voxels"] == made.count
    with clrecon.DeviceVolume(volume, device=device) as resident, made.apply(resident, outside) as kept:
        assert isinstance(kept, clrecon.DeviceVolume)
        np.testing.assert_array_equal(kept.volume.voxels, expected)
        assert kept.is_held
        found, same = (clrecon.extract_isosurface(each, 45) for each in (kept, kept.volume))
        np.testing.assert_array_equal(found.vertices, same.vertices)
    with pytest.raises(UsageError, match="hold no such HU"):
        made.apply(volume, math.nan)


def test_a_surface_of_what_is_chosen_is_that_of_the_part(device):
    volume = random_volume((8, 9, 40), high=100)
    made = clrecon.Mask.from_box(volume, [volume.affine[0, 3] + 9.0, None, None, None, None, None], device=device)
    part = volume.with_voxels(np.where(made.to_numpy(), volume.voxels, -1024))
    one, other = (clrecon.extract_isosurface(each, 50, device=device) for each in (made.apply(volume), part))
    np.testing.assert_array_equal(one.vertices, other.vertices)
    assert 0 < one.triangles.shape[0] < clrecon.extract_isosurface(volume, 50, device=device).triangles.shape[0]


def test_bad_input_is_refused(device):
    volume = random_volume((3, 4, 40))
    make = clrecon.Mask
    places = volume.ijk_to_lps(np.argwhere(volume.voxels.T > -1))
    low, high = places.min(axis=0), places.max(axis=0)
    ends = "the volume runs from ({:.1f}, {:.1f}, {:.1f}) to ({:.1f}, {:.1f}, {:.1f}) mm".format(*low, *high)
    with pytest.raises(UsageError, match="a band is two numbers"):
        make.from_band(volume, (3, 1), device=device)
    with pytest.raises(NoSurfaceError, match="no voxel can have"):
        make.from_band(volume, (0.2, 0.8), device=device)
    with pytest.raises(UsageError, match="has shape \\(3, 4, 39\\), the volume \\(3, 4, 40\\)"):
        make.from_array(volume, np.zeros((3, 4, 39), bool), device=device)
    with pytest.raises(UsageError, match="not of float64"):
        make.from_array(volume, np.zeros((3, 4, 40)), device=device)
    for box, words in (
        ((1, 2, 3), "a box is six numbers of mm"),
        (7, "a box is six numbers of mm"),
        ((5, 1, None, None, None, None), "runs from 5 to 1 mm in x"),
        ((900, 950, 0, 1, 0, 1), "no voxel lies in the box x 900 to 950 mm.*the volume runs from"),
    ):
        with pytest.raises(UsageError, match=words):
            make.from_box(volume, box, device=device)
    for points, radius, words in (
        (np.zeros((0, 3)), 3.0, "needs points that are numbers"),
        ([[0, 0, np.nan]], 3.0, "needs points that are numbers"),
        ([[0, 0]], 3.0, "points have shape"),
        ([[0, 0, 0]], 0.0, "the radius of the tube is 0.0"),
        ([[0, 0, 0]], math.nan, "the radius of the tube is nan"),
        ([[9e3, 0, 0]], 3.0, f"no voxel lies in the tube of 3 mm.*: {re.escape(ends)}"),
    ):
        with pytest.raises(UsageError, match=words):
            make.from_tube(volume, points, radius, device=device)
    one = make.from_band(volume, (1, 3), device=device)
    with pytest.raises(UsageError, match="the mask has"):
        one.apply(random_volume((3, 4, 41)))
    with pytest.raises(UsageError, match="lie up to .* mm apart"):
        one & make.from_band(Volume(volume.voxels, np.eye(4)), (1, 3), device=device)
    with pytest.raises(UsageError, match="even ones"):
        make.from_band(uneven(), (0, 3), device=device).to_label_map()
    for refuse in (pickle.dumps, copy.copy):
        with pytest.raises(TypeError, match="belongs to its process"):
            refuse(one)


def test_memory_is_summed_before_it_is_taken(device):
    volume = random_volume((40, 50, 600))
    few = clrecon.Mask.from_band(volume, (1, 3), device=device, memory=400_000)  # slab by slab
    assert few.count == ((volume.voxels >= 1) & (volume.voxels <= 3)).sum()
    with refused(DeviceError, "masks", "voxels", 3, 400000):
        few & few
    with refused(DeviceError, 100000):
        clrecon.Mask.from_band(volume, (1, 3), device=device, memory=100_000)
    with refused(DeviceError, 100000):
        clrecon.Mask.from_array(volume, volume.voxels > 1, device=device, memory=100_000)


@pytest.mark.oclgrind
def test_masks_are_computed_cleanly_under_a_simulator(device):
    volume = Volume(np.zeros((5, 6, 41), np.int16), OBLIQUE)
    chosen = np.random.default_rng(3).random((5, 6, 41)) < 0.4
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    opened = mask.close(2.0).open(1.0).fill_holes() | mask.fill_holes(by_slice=True)
    grown = opened.grow(volume.ijk_to_lps(np.argwhere(opened.to_numpy())[:1, ::-1]))
    assert 0 < grown.count <= opened.count
    assert mask.apply(volume, -5.0).voxels.min() == -5
    assert not (clrecon.Mask.from_band(volume, (0, 1), device=device) & ~mask & mask).count


def test_numpy_takes_a_mask_as_its_voxels(device):
    mask = clrecon.Mask.from_band(
        Volume(np.arange(24, dtype=np.int16).reshape(2, 3, 4), np.eye(4)), (5, 9), device=device
    )
    assert np.asarray(mask).dtype == np.bool_ and np.array_equal(np.asarray(mask), mask.to_numpy())
    assert np.asarray(mask, dtype=np.uint8).sum() == 5


@pytest.mark.parametrize("which", range(7))
def test_a_mask_knows_its_volume_and_its_box(device, which):
    volume = volumes()[which]
    chosen = volume.voxels > 95
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    places = twin.find_places(volume)[chosen]
    np.testing.assert_allclose(mask.bounds, [places.min(axis=0), places.max(axis=0)], atol=1e-9)
    each = slice_voxel_ml(volume)
    assert mask.ml == pytest.approx(sum(layer.sum() * ml for layer, ml in zip(chosen, each, strict=True)), rel=1e-12)
    if not volume.uneven:
        assert mask.ml == pytest.approx(chosen.sum() * abs(np.linalg.det(volume.affine[:3, :3])) / 1000.0, rel=1e-9)


def test_an_empty_mask_has_no_box_no_component_and_no_surface(device):
    mask = clrecon.Mask.from_array(volumes()[0], np.zeros((6, 13, 40), bool), device=device)
    assert np.isnan(mask.bounds).all() and mask.ml == 0.0 and mask.components() == [] and mask.keep_largest().count == 0
    with pytest.raises(NoSurfaceError, match="no voxel is chosen"):
        mask.to_mesh()


@pytest.mark.parametrize("which", [0, 3, 4])
def test_components_are_those_of_scipy_the_largest_first(device, which):
    volume = volumes()[which]
    chosen = volume.voxels > 70
    labels, count = ndimage.label(chosen)
    ml = np.bincount(labels.ravel(), np.broadcast_to(slice_voxel_ml(volume)[:, None, None], chosen.shape).ravel())[1:]
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    found = mask.components(most=5)
    assert [part.ml for part in found] == pytest.approx(sorted(ml, reverse=True)[:5])
    assert len(mask.components(most=10_000)) == count
    for part in found:
        (number,) = np.unique(labels[part.to_numpy()])
        assert part.count == (labels == number).sum()
    both = mask.keep_largest(2)
    np.testing.assert_array_equal(both.to_numpy(), (found[0] | found[1]).to_numpy())
    assert both.name == "the 2 largest components of (an array)" and found[0].name == "component 1 of (an array)"


@pytest.mark.parametrize("wanted", [0, -1, 1.5, True, "2"])
def test_a_number_of_components_is_a_whole_one(device, wanted):
    mask = clrecon.Mask.from_box(volumes()[0], (0, 3, 0, 3, 0, 3), device=device)
    with refused(UsageError, 1, "components"):
        mask.keep_largest(wanted)


def test_the_surface_of_a_mask_is_that_of_its_label(device):
    volume = Volume(np.zeros((20, 24, 40), np.int16), TILTED)
    chosen = np.zeros(volume.shape, bool)
    chosen[4:15, 5:20, 6:33] = True
    mask = clrecon.Mask.from_array(volume, chosen, device=device)
    mesh = mask.to_mesh()
    assert mesh.volume / 1000.0 == pytest.approx(mask.ml, rel=1e-3)
    expected = clrecon.extract_label_masks(mask.to_label_map(), device=device)[1]
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)


def test_labels_and_masks_of_one_grid_make_label_maps(device: Any) -> None:
    voxels = np.zeros((3, 4, 37), np.uint8)
    voxels[0], voxels[1, :, 30:] = 2, 9
    labels = LabelMap(voxels, np.diag([1.0, 1.0, 2.0, 1.0]), {2: "two", 9: "nine"}, warnings=["doubtful"])
    assert np.array_equal(labels.label(["two", 9], device=device).to_numpy(), voxels > 0)
    volume = Volume(np.where(np.arange(37) < 33, -5, 50) * np.ones((3, 4, 1), np.int16), labels.affine)
    bone = Mask.from_band(volume, (0, None), device=device)
    chosen = bone.to_numpy()
    within, outside, more = labels & bone, labels - bone, labels | bone
    assert np.array_equal(within.voxels, np.where(chosen, voxels, 0)) and within.warnings == ("doubtful",)
    assert np.array_equal(outside.voxels, np.where(chosen, 0, voxels)) and outside.names == labels.names
    assert np.array_equal(more.voxels, np.where(chosen & (voxels == 0), 10, voxels))
    assert more.names == {**labels.names, 10: bone.name}
    assert np.array_equal(labels.label("nine", volume, device=device).to_numpy(), voxels == 9)


def test_labels_and_masks_of_other_grids_are_refused(device: Any) -> None:
    labels = LabelMap(np.ones((3, 4, 5), np.uint8), np.eye(4))
    away = Volume(np.ones((3, 4, 5), np.int16), np.diag([1.0, 1.0, 2.0, 1.0]))
    with refused(UsageError, "mm", 2):
        labels & Mask.from_band(away, (0, None), device=device)
    with refused(UsageError, 5, 4, 2):
        labels - Mask.from_band(away[:2], (0, None), device=device)
    for other in (3, labels):
        with refused(TypeError, "LabelMap"):
            labels & other  # type: ignore[operator]
