"""The spine phantom: tissues, left and right, levels, and independence from how it is sampled."""

from __future__ import annotations

import numpy as np
import pytest
from variants import daily

from clrecon.geometry import apply_affine
from clrecon.proof.phantom import PhantomSettings, make_phantom
from clrecon.proof.phantom.spine_plan import plan_anatomy
from clrecon.proof.phantom.vertebra import canal_distance, vertebra_distance

CLEAN = {"noise": 0.0, "point_spread_mm": 0.0}


@pytest.fixture(scope="module")
def spine() -> tuple:
    return make_phantom(PhantomSettings(size=(176, 160), slices=68, spacing=(1.6, 1.5, 2.2)))


def values_at(made: tuple, points_mm: np.ndarray) -> np.ndarray:
    """HU of the nearest voxels."""
    voxels, affine, _ = made
    i, j, k = np.rint(apply_affine(np.linalg.inv(affine), points_mm)).astype(int).T
    return voxels[k, j, i]


@pytest.mark.release
def test_histogram_has_air_soft_tissue_and_bone(spine: tuple) -> None:
    voxels = spine[0]
    count, edges = np.histogram(voxels, bins=np.arange(-1105, 1500, 10))
    middles = (edges[:-1] + edges[1:]) / 2.0
    assert abs(middles[np.argmax(count)] + 1000.0) <= 10.0
    soft = np.where((middles > -20.0) & (middles < 150.0), count, 0)
    assert 35.0 <= middles[np.argmax(soft)] <= 70.0
    fat = np.where((middles > -150.0) & (middles < -60.0), count, 0)
    assert -115.0 <= middles[np.argmax(fat)] <= -80.0
    share_of_bone = (voxels > 226).mean()
    assert 0.01 < share_of_bone < 0.06
    assert (voxels > 500).sum() > 5000 and voxels.max() > 1000
    assert voxels[0, :3, :3].std() < 40.0 and voxels.min() > -1100


@pytest.mark.parametrize("dk", daily(1, [3.0, 8.0]))
def test_most_frequent_values_are_those_of_the_tissues_in_thin_and_thick_slices(dk: float) -> None:
    voxels, _, _ = make_phantom(PhantomSettings(size=(96, 80), slices=12, spacing=(3.0, 3.0, dk), **CLEAN))
    values, counts = np.unique(voxels, return_counts=True)
    assert {-1000, -930, -860, -105, 54} == set(values[np.argsort(-counts)[:5]].tolist())


def test_bodies_are_trabecular_inside_and_discs_lie_between(spine: tuple) -> None:
    levels = [level for level in spine[2]["spine"]["vertebrae"] if level["inside"]]
    assert [level["name"] for level in levels] == ["T10", "T11", "T12", "L1", "L2"]
    centres = np.array([level["center_lps_mm"] for level in levels])
    assert np.all(np.diff(centres[:, 2]) < -24.0)
    front = centres - (0.0, 6.0, 0.0)
    around = np.vstack([front + offset for offset in np.random.default_rng(1).uniform(-4.0, 4.0, (60, 3))])
    assert 150.0 < values_at(spine, around).mean() < 240.0
    discs = (centres[1:] + centres[:-1]) / 2.0
    assert 70.0 < values_at(spine, discs - (0.0, 4.0, 0.0)).mean() < 130.0


def test_left_marker_and_missing_left_rib_show_which_side_is_left(spine: tuple) -> None:
    truth = spine[2]["spine"]
    marker = np.array(truth["left_marker_lps_mm"])
    assert truth["absent"] == ["left rib 12"] and truth["left_marker_inside"]
    lumbar = np.array(next(v["center_lps_mm"] for v in truth["vertebrae"] if v["name"] == "T12"))
    assert marker[0] > lumbar[0] + 50.0
    mirrored = marker.copy()
    mirrored[0] = 2.0 * -3.5 - marker[0]
    assert values_at(spine, marker[None])[0] > 1200
    assert values_at(spine, mirrored[None])[0] < 200
    voxels, affine, _ = spine
    k, j, i = np.nonzero(voxels > 400)
    points = apply_affine(affine, np.stack((i, j, k), axis=1))
    beside = points[(np.abs(points[:, 2] - lumbar[2]) < 22.0) & (np.abs(points[:, 1] - lumbar[1] - 40.0) < 30.0)]
    right = ((beside[:, 0] < lumbar[0] - 35.0) & (beside[:, 0] > lumbar[0] - 60.0)).sum()
    left = ((beside[:, 0] > lumbar[0] + 35.0) & (beside[:, 0] < lumbar[0] + 60.0)).sum()
    assert right > 60 and left < right / 3


@pytest.mark.release
def test_spine_has_the_same_anatomy_in_tilted_and_oblique_slices() -> None:
    size = {"size": (150, 140), "slices": 60, "spacing": (1.7, 1.6, 2.0)}
    straight = make_phantom(PhantomSettings(**size, **CLEAN))
    turned = make_phantom(PhantomSettings(**size, **CLEAN, tilt=14.0, oblique=(6.0, -9.0, 12.0)))
    points = np.random.default_rng(2).uniform((-70.0, -70.0, -35.0), (70.0, 70.0, 35.0), (4000, 3))
    points += (-3.5, -142.25, -418.75)
    pair = np.stack([values_at(made, points) for made in (straight, turned)]).astype(float)
    assert np.corrcoef(pair)[0, 1] > 0.85
    assert np.median(np.abs(pair[0] - pair[1])) < 25.0


def test_voxels_between_muscle_and_cortex_have_many_values_of_partial_volume() -> None:
    made = make_phantom(PhantomSettings(size=(120, 120), slices=20, spacing=(1.0, 1.0, 1.0), **CLEAN))
    levels = [v for v in made[2]["spine"]["vertebrae"] if v["name"] == "T12"]
    i, j, k = np.rint(apply_affine(np.linalg.inv(made[1]), [levels[0]["center_lps_mm"]])[0]).astype(int)
    shell = made[0][k, j - 25 : j + 10, i - 30 : i + 30]
    # a thresholded drawing has few values at the rims; partial volume has all between muscle and cortex
    between = np.unique(shell[(shell > 240) & (shell < 840)])
    assert len(between) > 60


def test_bone_of_a_vertebra_surrounds_its_canal_and_leaves_it_free() -> None:
    anatomy = plan_anatomy((250.0, 250.0, 150.0), np.eye(3), seed=1)
    for vertebra in (anatomy.vertebrae[5], anatomy.vertebrae[14]):
        middle = vertebra.depth / 2.0 + vertebra.canal_half_depth - 0.8
        angles = np.linspace(0.0, 2.0 * np.pi, 73)[None, :]
        reach = np.linspace(0.0, 30.0, 301)[:, None]
        x = (reach * np.sin(angles)).astype(np.float32)
        y = (middle + reach * np.cos(angles)).astype(np.float32)
        # at the height of the pedicles in front and at the sides, lower at the laminae behind
        bone = np.stack([
            vertebra_distance(vertebra, x, y, np.full_like(x, height * vertebra.height))
            for height in (0.2, 0.1, 0.0, -0.1, -0.2)
        ])  # fmt: skip
        assert (bone.max(axis=(0, 1)) > 0.5).all()
        assert (bone[:, canal_distance(vertebra, x, y) > 0.0] < 0.0).all()


def test_thoracic_levels_curve_backwards_and_lumbar_levels_forwards() -> None:
    anatomy = plan_anatomy((300.0, 300.0, 450.0), np.eye(3), seed=0)
    at = {vertebra.name: vertebra.center for vertebra in anatomy.vertebrae}

    def off_chord(top: str, apex: str, bottom: str) -> float:
        share = (at[apex][2] - at[bottom][2]) / (at[top][2] - at[bottom][2])
        return float(at[apex][1] - (at[bottom][1] + share * (at[top][1] - at[bottom][1])))

    assert off_chord("T1", "T6", "T12") > 5.0  # backwards
    assert off_chord("L1", "L3", "L5") < -2.0  # forwards
    assert len(anatomy.ribs) == 23 and "left rib 12" not in {rib.name for rib in anatomy.ribs}
    assert all(abs(centre[0] - 1.7) < 25.0 for centre in at.values())
