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
    """Volume, exact label map, and ml of a voxel."""
    voxels, affine, _ = make_phantom(SPINE)
    truth = clrecon.phantom_truth(SPINE)
    return Volume(voxels, affine), LabelMap(truth.label_map(), affine, truth.names), 0.81e-3


def tube(hu=1000, shape=(12, 30, 30)):
    """A ring in axial slices whose hole is open at both ends, with a pore through its wall and a cavity within it."""
    nk, nj, ni = shape
    j, i = np.mgrid[:nj, :ni] - (nj - 1) / 2.0
    radius = np.hypot(j, i)
    ring = np.repeat(((radius >= 5) & (radius <= 11))[None], nk, axis=0)
    ring[[0, -1]] = False
    return np.where(ring, hu, 0).astype(np.int16), ring


def test_the_label_alone_is_closed_and_filled_and_its_canal_stays_open(device):
    voxels, ring = tube()
    holed = ring.copy()
    holed[5, 15, 21:24] = False  # a pore within the wall
    holed[4:8, 6:8, 14:17] = False  # a cavity that no ball of 1.5 mm closes
    affine = np.diag([1.0, 1.0, 1.0, 1.0])
    solid = vertebra_solid(Volume(voxels, affine), LabelMap(holed, affine, {1: "ring"}), "ring", device=device)
    at = np.rint(solid.scan.affine[:3, 3]).astype(int)[::-1]
    nk, nj, ni = solid.scan.voxels.shape
    expected = ring[at[0] : at[0] + nk, at[1] : at[1] + nj, at[2] : at[2] + ni]
    assert solid.count == np.count_nonzero(expected) == np.count_nonzero(ring)
    assert np.array_equal(solid.to_numpy(), expected)
    assert solid.name == "solid bone of label ring, closed by 1.5 mm"


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(
    ("level", "more_ml", "dice"),
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
def test_volumes_of_a_phantom_are_those_of_its_truth_and_what_the_level_adds(spine, device, level, more_ml, dice):
    # half of 850 HU of the cortex and 50 HU around is 450 HU: lower levels lie farther out
    volume, labels, ml = spine
    of = {"surface": level, "iso_value": 200} if level == "cortex" else {"iso_value": level}
    solid = vertebra_solid(volume, labels, "L1", **of, device=device)
    truth = clrecon.Mask.from_labels(solid.scan, labels, ["L1"], device=device)
    assert truth.count == labels.counts[20]  # nothing of the label is cut off
    more = solid.count / truth.count - 1.0
    assert more_ml[0] <= more <= more_ml[1]
    assert 2 * (solid & truth).count / (solid.count + truth.count) >= dice
    assert not (solid & clrecon.Mask.from_labels(solid.scan, labels, ["L2"], device=device)).count


def test_the_solid_bone_of_the_cortex_is_what_its_surface_encloses(device):
    volume = hollow_ball(thickness=3.0)
    k, j, i = np.indices(volume.voxels.shape)
    far = np.sqrt((i - MIDDLE[0]) ** 2 + (j - MIDDLE[1]) ** 2 + (k - MIDDLE[2]) ** 2)
    labels = LabelMap((far < 12.5).astype(np.uint8), volume.affine, {1: "ball"})  # ends before the bone does
    true = 4.0 / 3.0 * np.pi * 13.0**3
    level, cortex = (vertebra_solid(volume, labels, 1, 200, surface=kind, device=device) for kind in ("hu", "cortex"))
    assert level.count > 1.09 * true and cortex.count == pytest.approx(true, rel=0.015)
    with refused(UsageError, "level", 200):
        vertebra_solid(volume, labels, 1, surface="cortex", device=device)


def test_the_order_of_axes_and_the_grid_of_the_map_do_not_matter(spine, device):
    volume, labels, _ = spine
    plain = vertebra_solid(volume, labels, "L1", 300, device=device)
    turned = volume.affine[:, [1, 2, 0, 3]]  # sagittal slices
    sagittal = Volume(volume.voxels.transpose(2, 0, 1), turned)
    flipped = labels.affine @ np.diag([-1.0, 1.0, 1.0, 1.0])
    flipped[:3, 3] += labels.affine[:3, 0] * (labels.shape_ijk[0] - 1)
    other_map = LabelMap(labels.voxels[:, :, ::-1], flipped, labels.names)
    other = vertebra_solid(sagittal, other_map, 20, 300, device=device)
    normal = np.cross(*other.scan.affine[:3, :2].T)
    assert abs(normal[2]) > 0.99 * np.linalg.norm(normal)
    points = np.argwhere(plain.to_numpy())[:, ::-1]
    places = np.rint(other.scan.lps_to_ijk(plain.scan.ijk_to_lps(points))).astype(int)
    assert other.count == plain.count
    assert other.to_numpy()[tuple(places.T[::-1])].all()


def test_an_uneven_stack_keeps_its_places(device):
    voxels, ring = tube()
    affine = np.diag([1.0, 1.0, 1.0, 1.0])
    positions = np.stack([np.zeros(12), np.zeros(12), np.cumsum([0, *[1.0, 1.5] * 5, 1.0])], axis=1)
    volume = Volume(voxels, affine, slice_positions=positions)
    labels = LabelMap(np.repeat(ring, 2, axis=0), np.diag([1.0, 1.0, 0.7, 1.0]), {1: "ring"})
    solid = vertebra_solid(volume, labels, 1, device=device)
    assert solid.scan.uneven
    held = clrecon.Mask.from_labels(volume, labels, [1], device=device)
    assert solid.count == held.count > 0
    places = solid.scan.ijk_to_lps(np.argwhere(solid.to_numpy())[:, ::-1])
    assert np.allclose(np.sort(np.unique(places[:, 2])), np.unique(positions[held.to_numpy().any(axis=(1, 2)), 2]))


def test_solid_bone_refuses_arrays_and_unknown_labels(device):
    voxels, ring = tube()
    affine = np.eye(4)
    volume, labels = Volume(voxels, affine), LabelMap(ring, affine, {1: "ring"})
    with refused(UsageError, "Volume", "volume"):
        vertebra_solid(voxels, labels, 1, device=device)
    with refused(UsageError, "LabelMap", "labels"):
        vertebra_solid(volume, ring, 1, device=device)
    with refused(UsageError, "ring"):
        vertebra_solid(volume, labels, "L9", device=device)
    with refused(UsageError, 0, "radius"):
        vertebra_solid(volume, labels, 1, close_mm=0, device=device)
    with refused(UsageError, "voxels", "grow"):
        vertebra_solid(volume, labels, 1, grow_mm=2.0, device=device)
    with refused(NoSurfaceError, 1, 2000, 1000):
        vertebra_solid(Volume(np.where(ring, voxels, 3000), affine), labels, 1, 2000, device=device)
    with refused(NoSurfaceError, 1, -2000, 0):
        vertebra_solid(volume, labels, 1, -2000, device=device)
    two = LabelMap(np.concatenate([ring.astype(np.uint8), 2 * ring.astype(np.uint8)]), affine, {1: "ring", 2: "away"})
    with refused(RefusedInputError, "CT", 2):
        vertebra_solid(volume, two, "away", device=device)
    far = np.eye(4)
    far[:3, 3] = 500.0
    with refused(RefusedInputError, "scan", "CT"):
        vertebra_solid(volume, LabelMap(ring, far), 1, device=device)
