"""The solid bone of one vertebra against the phantom's truth, on any order of axes, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from surface_volumes import MIDDLE, hollow_ball
from variants import daily_rows

import clrecon
from clrecon.errors import NoSurfaceError, RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.operators.vertebrae.solid import vertebra_solid
from clrecon.proof.phantom import PhantomSettings, make_phantom

pytestmark = pytest.mark.first_device

SPINE = PhantomSettings(levels="L1-L2", size=(160, 160), spacing=(0.9, 0.9, 1.0))


@pytest.fixture(scope="module")
def spine():
    """A phantom of L1 and L2, and the labels of its truth."""
    voxels, affine, _ = make_phantom(SPINE)
    truth = clrecon.phantom_truth(SPINE)
    return Volume(voxels, affine), LabelMap(truth.label_map(), affine, names=truth.names)


def ring_in_slices():
    """A ring of 1000 HU from 5 to 11 voxels in 12 axial slices, all but the first and last, and its voxels."""
    nk, nj, ni = 12, 30, 30
    j, i = np.mgrid[:nj, :ni] - (nj - 1) / 2.0
    radius = np.hypot(j, i)
    ring = np.repeat(((radius >= 5) & (radius <= 11))[None], nk, axis=0)
    ring[[0, -1]] = False
    return np.where(ring, 1000, 0).astype(np.int16), ring


def test_solid_bone_of_a_label_has_its_pore_and_cavity_filled_and_its_canal_open(device):
    voxels, ring = ring_in_slices()
    holed = ring.copy()
    holed[5, 15, 21:24] = False  # a pore within the wall
    holed[4:8, 6:8, 14:17] = False  # a cavity that no ball of 1.5 mm closes
    labels = LabelMap(holed, np.eye(4), names={1: "ring"})

    solid = vertebra_solid(Volume(voxels, np.eye(4)), labels, "ring", device=device)

    k, j, i = np.rint(solid.scan.affine[:3, 3]).astype(int)[::-1]  # the solid has a part of the scan
    nk, nj, ni = solid.scan.voxels.shape
    assert np.array_equal(solid.to_numpy(), ring[k : k + nk, j : j + nj, i : i + ni])
    assert solid.count == np.count_nonzero(ring)  # nothing of it lies beyond
    assert solid.name == "solid bone of label ring, closed by 1.5 mm"


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(
    ("level", "share_added", "dice"),
    daily_rows(
        1,
        [
            (None, (-0.005, 0.005), 0.995),
            (226, (0.10, 0.16), 0.93),
            (300, (0.06, 0.12), 0.95),
            (400, (0.0, 0.05), 0.975),
            ("cortex", (-0.02, 0.02), 0.985),
        ],
    ),
)
def test_solid_bone_of_a_phantom_is_its_truth_and_the_share_that_the_level_adds(
    spine, device, level, share_added, dice
):
    """Half of 850 HU of the cortex and 50 HU around is 450 HU: lower levels lie farther out."""
    volume, labels = spine
    of = {"surface": level, "iso_value": 200} if level == "cortex" else {"iso_value": level}
    solid = vertebra_solid(volume, labels, "L1", **of, device=device)
    truth = clrecon.Mask.from_labels(solid.scan, labels, ["L1"], device=device)
    assert truth.count == labels.counts[20]  # L1's number: nothing of the label is cut off
    lowest, highest = share_added
    assert lowest <= solid.count / truth.count - 1.0 <= highest
    assert 2 * (solid & truth).count / (solid.count + truth.count) >= dice  # measured 0.004 to 0.012 above


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("level", [None, 226])
def test_solid_bone_of_a_phantom_has_no_voxel_of_the_next_vertebra(spine, device, level):
    volume, labels = spine
    solid = vertebra_solid(volume, labels, "L1", iso_value=level, device=device)
    next_vertebra = clrecon.Mask.from_labels(solid.scan, labels, ["L2"], device=device)
    assert next_vertebra.count > 0
    assert not (solid & next_vertebra).count


@pytest.fixture(scope="module")
def ball_with_a_small_label():
    """A shell of bone of 13 mm, and a label that ends at 12.5 mm, before the bone does."""
    volume = hollow_ball(radius=13.0, thickness=3.0)
    k, j, i = np.indices(volume.voxels.shape)
    far = np.sqrt((i - MIDDLE[0]) ** 2 + (j - MIDDLE[1]) ** 2 + (k - MIDDLE[2]) ** 2)
    return volume, LabelMap((far < 12.5).astype(np.uint8), volume.affine, names={1: "ball"})


def test_solid_bone_of_the_cortex_has_the_volume_of_the_bone_and_that_of_a_level_more(ball_with_a_small_label, device):
    volume, labels = ball_with_a_small_label
    true_mm3 = 4.0 / 3.0 * np.pi * 13.0**3  # as many voxels of 1 mm
    level, cortex = (
        vertebra_solid(volume, labels, 1, iso_value=200, surface=kind, device=device) for kind in ("hu", "cortex")
    )
    assert level.count > 1.09 * true_mm3  # measured 1.17
    assert cortex.count == pytest.approx(true_mm3, rel=0.015)  # measured 0.991


def test_solid_bone_of_the_cortex_without_a_level_is_refused(ball_with_a_small_label, device):
    volume, labels = ball_with_a_small_label
    with refused(UsageError, "level", 200):
        vertebra_solid(volume, labels, 1, surface="cortex", device=device)


def test_solid_bone_in_sagittal_slices_with_a_flipped_map_has_the_same_places(spine, device):
    volume, labels = spine
    plain = vertebra_solid(volume, labels, "L1", iso_value=300, device=device)
    sagittal = Volume(volume.voxels.transpose(2, 0, 1), volume.affine[:, [1, 2, 0, 3]])
    flipped = labels.affine @ np.diag([-1.0, 1.0, 1.0, 1.0])
    flipped[:3, 3] += labels.affine[:3, 0] * (labels.shape_ijk[0] - 1)
    flipped_map = LabelMap(labels.voxels[:, :, ::-1], flipped, names=labels.names)

    found = vertebra_solid(sagittal, flipped_map, 20, iso_value=300, device=device)

    assert found.count == plain.count
    places = plain.scan.ijk_to_lps(np.argwhere(plain.to_numpy())[:, ::-1])
    ijk = np.rint(found.scan.lps_to_ijk(places)).astype(int)
    assert found.to_numpy()[tuple(ijk.T[::-1])].all()


def test_solid_bone_of_sagittal_slices_is_given_in_axial_ones(spine, device):
    volume, labels = spine
    sagittal = Volume(volume.voxels.transpose(2, 0, 1), volume.affine[:, [1, 2, 0, 3]])
    normal = np.cross(*vertebra_solid(sagittal, labels, 20, iso_value=300, device=device).scan.affine[:3, :2].T)
    assert abs(normal[2]) > 0.99 * np.linalg.norm(normal)  # along the axis of the body


def test_solid_bone_of_an_uneven_stack_has_the_voxels_and_places_of_its_label(device):
    voxels, ring = ring_in_slices()
    heights = np.cumsum([0, *[1.0, 1.5] * 5, 1.0])
    positions = np.stack([np.zeros(12), np.zeros(12), heights], axis=1)
    volume = Volume(voxels, np.eye(4), slice_positions=positions)
    labels = LabelMap(np.repeat(ring, 2, axis=0), np.diag([1.0, 1.0, 0.7, 1.0]), names={1: "ring"})

    solid = vertebra_solid(volume, labels, 1, device=device)

    of_label = clrecon.Mask.from_labels(volume, labels, [1], device=device)
    assert solid.scan.uneven
    assert solid.count == of_label.count > 0
    places = solid.scan.ijk_to_lps(np.argwhere(solid.to_numpy())[:, ::-1])
    expected = heights[of_label.to_numpy().any(axis=(1, 2))]
    assert np.allclose(np.unique(places[:, 2]), expected)


VOXELS, RING = ring_in_slices()
RING_VOLUME, RING_LABELS = Volume(VOXELS, np.eye(4)), LabelMap(RING, np.eye(4), names={1: "ring"})


@pytest.mark.parametrize(
    ("volume", "labels", "label", "options", "facts"),
    [
        (VOXELS, RING_LABELS, 1, {}, ("Volume", "volume")),
        (RING_VOLUME, RING, 1, {}, ("LabelMap", "labels")),
        (RING_VOLUME, RING_LABELS, "L9", {}, ("ring",)),
        (RING_VOLUME, RING_LABELS, 1, {"close_mm": 0}, (0, "radius")),
        (RING_VOLUME, RING_LABELS, 1, {"grow_mm": 2.0}, ("voxels", "grow")),
    ],
    ids=["array for a volume", "array for labels", "unknown label", "no radius", "growth without a level"],
)
def test_solid_bone_of_wrong_arguments_is_refused(device, volume, labels, label, options, facts):
    with refused(UsageError, *facts):
        vertebra_solid(volume, labels, label, **options, device=device)


def test_solid_bone_above_all_hu_of_its_label_is_refused(device):
    dense_around = Volume(np.where(RING, VOXELS, 3000), np.eye(4))
    with refused(NoSurfaceError, 1, 2000, 1000):  # the label, the level, and its highest HU
        vertebra_solid(dense_around, RING_LABELS, 1, iso_value=2000, device=device)


def test_solid_bone_below_all_hu_is_refused(device):
    with refused(NoSurfaceError, 1, -2000, 0):
        vertebra_solid(RING_VOLUME, RING_LABELS, 1, iso_value=-2000, device=device)


def test_solid_bone_of_a_label_beyond_the_scan_is_refused(device):
    numbers = np.concatenate([RING.astype(np.uint8), 2 * RING.astype(np.uint8)])
    with refused(RefusedInputError, "CT", 2):
        vertebra_solid(RING_VOLUME, LabelMap(numbers, np.eye(4), names={1: "ring", 2: "away"}), "away", device=device)


def test_solid_bone_of_a_map_beside_the_scan_is_refused(device):
    beside = np.eye(4)
    beside[:3, 3] = 500.0
    with refused(RefusedInputError, "scan", "CT"):
        vertebra_solid(RING_VOLUME, LabelMap(RING, beside), 1, device=device)
