"""The spine phantom: tissues, left and right, levels, and independence from how it is sampled."""

from __future__ import annotations

import numpy as np
import pytest
from variants import daily

from clrecon.geometry import apply_affine
from clrecon.proof.phantom import PhantomSettings, make_phantom
from clrecon.proof.phantom.settings import CENTRE_LPS_MM
from clrecon.proof.phantom.spine_parts import Anatomy
from clrecon.proof.phantom.spine_plan import plan_anatomy
from clrecon.proof.phantom.vertebra import canal_distance, vertebra_distance

CLEAN = {"noise": 0.0, "point_spread_mm": 0.0}


@pytest.fixture(scope="module")
def spine() -> tuple:
    """Voxels, affine and truth of a spine in 68 slices of 2.2 mm."""
    return make_phantom(PhantomSettings(size=(176, 160), slices=68, spacing=(1.6, 1.5, 2.2)))


def values_at(made: tuple, points_mm: np.ndarray) -> np.ndarray:
    """HU of the nearest voxels."""
    voxels, affine, _ = made
    i, j, k = np.rint(apply_affine(np.linalg.inv(affine), points_mm)).astype(int).T
    return voxels[k, j, i]


def most_frequent(voxels: np.ndarray, low: float, high: float) -> float:
    """The middle of the fullest bin of 10 HU between two values."""
    count, edges = np.histogram(voxels, bins=np.arange(low - 5.0, high + 6.0, 10.0))
    return float(edges[np.argmax(count)] + 5.0)


@pytest.mark.release
@pytest.mark.parametrize(
    ("between_hu", "peak_hu"),
    [
        pytest.param((-1100, -200), (-1010, -990), id="air"),
        pytest.param((-150, -60), (-115, -80), id="fat"),
        pytest.param((-20, 150), (35, 70), id="soft tissue"),
    ],
)
def test_histogram_of_a_spine_peaks_at_the_value_of_a_tissue(
    spine: tuple, between_hu: tuple[float, float], peak_hu: tuple[float, float]
) -> None:
    voxels, _, _ = spine
    lowest, highest = peak_hu
    assert lowest <= most_frequent(voxels, *between_hu) <= highest


@pytest.mark.release
def test_one_to_six_percent_of_the_voxels_of_a_spine_are_bone_some_above_1000_hu(spine: tuple) -> None:
    voxels, _, _ = spine
    assert 0.01 < (voxels > 226).mean() < 0.06  # HU of the default preset of bone; measured 0.018
    assert (voxels > 500).sum() > 5000  # of 1.9 million: cortex; measured 14,369
    assert voxels.max() > 1000  # measured 2213: the marker


@pytest.mark.release
def test_air_of_a_spine_has_noise_of_less_than_40_hu(spine: tuple) -> None:
    voxels, _, _ = spine
    air = voxels[0, :3, :3]  # the corner of a slice
    assert air.std() < 40.0  # measured 16
    assert voxels.min() > -1100  # air has -1000; measured -1056


@pytest.mark.parametrize("dk", daily(1, [3.0, 8.0]), ids=["thin slices", "thick slices"])
def test_most_frequent_values_are_those_of_air_couch_lung_fat_and_muscle(dk: float) -> None:
    voxels, _, _ = make_phantom(PhantomSettings(size=(96, 80), slices=12, spacing=(3.0, 3.0, dk), **CLEAN))
    values, counts = np.unique(voxels, return_counts=True)
    five_most_frequent = set(values[np.argsort(-counts)[:5]].tolist())
    assert five_most_frequent == {-1000, -930, -860, -105, 54}


def centres_in_view(spine: tuple) -> np.ndarray:
    """Centres of the vertebral bodies within the slices from above, LPS mm."""
    _, _, truth = spine
    return np.array([level["center_lps_mm"] for level in truth["spine"]["vertebrae"] if level["inside"]])


def test_spine_of_150_mm_shows_five_levels_from_above_more_than_24_mm_apart(spine: tuple) -> None:
    _, _, truth = spine
    names = [level["name"] for level in truth["spine"]["vertebrae"] if level["inside"]]
    assert names == ["T10", "T11", "T12", "L1", "L2"]
    assert np.all(np.diff(centres_in_view(spine)[:, 2]) < -24.0)  # z grows upwards


def test_vertebral_bodies_have_the_values_of_trabecular_bone_inside(spine: tuple) -> None:
    front = centres_in_view(spine) - (0.0, 6.0, 0.0)  # away from the canal
    offsets = np.random.default_rng(1).uniform(-4.0, 4.0, (60, 3))
    points = (front + offsets[:, None]).reshape(-1, 3)
    assert 150.0 < values_at(spine, points).mean() < 240.0  # HU; measured 188


def test_half_way_between_vertebral_bodies_is_a_disc(spine: tuple) -> None:
    centres = centres_in_view(spine)
    half_way = (centres[1:] + centres[:-1]) / 2.0 - (0.0, 4.0, 0.0)
    assert 70.0 < values_at(spine, half_way).mean() < 130.0  # HU; measured 91


def centre_of_t12(spine: tuple) -> np.ndarray:
    _, _, truth = spine
    return np.array(next(v["center_lps_mm"] for v in truth["spine"]["vertebrae"] if v["name"] == "T12"))


def test_left_marker_lies_on_the_left_alone(spine: tuple) -> None:
    _, _, truth = spine
    marker = np.array(truth["spine"]["left_marker_lps_mm"])
    middle_x, _, _ = CENTRE_LPS_MM
    mirrored = marker * (-1, 1, 1) + (2.0 * middle_x, 0, 0)

    assert truth["spine"]["left_marker_inside"]
    assert marker[0] > centre_of_t12(spine)[0] + 50.0  # x grows to the left; measured 109 mm away
    assert values_at(spine, marker[None])[0] > 1200  # measured 2181
    assert values_at(spine, mirrored[None])[0] < 200  # neither metal nor bone; measured -112, as fat has


def test_twelfth_rib_is_on_the_right_alone(spine: tuple) -> None:
    voxels, affine, truth = spine
    x, y, z = centre_of_t12(spine)
    k, j, i = np.nonzero(voxels > 400)
    bone = apply_affine(affine, np.stack((i, j, k), axis=1))

    near_the_rib = bone[(np.abs(bone[:, 2] - z) < 22.0) & (np.abs(bone[:, 1] - y - 40.0) < 30.0)]
    to_the_left = near_the_rib[:, 0] - x
    on_the_left = ((to_the_left > 35.0) & (to_the_left < 60.0)).sum()
    on_the_right = ((to_the_left < -35.0) & (to_the_left > -60.0)).sum()

    assert truth["spine"]["absent"] == ["left rib 12"]
    assert on_the_right > 200  # voxels; measured 393
    assert on_the_left < on_the_right / 3  # a little of the 11th rib; measured 38


@pytest.mark.release
def test_spine_has_the_same_anatomy_in_tilted_and_oblique_slices() -> None:
    size = {"size": (150, 140), "slices": 60, "spacing": (1.7, 1.6, 2.0)}
    straight = make_phantom(PhantomSettings(**size, **CLEAN))
    turned = make_phantom(PhantomSettings(**size, **CLEAN, tilt=14.0, oblique=(6.0, -9.0, 12.0)))
    offsets = np.random.default_rng(2).uniform((-70.0, -70.0, -35.0), (70.0, 70.0, 35.0), (4000, 3))

    pair = np.stack([values_at(made, CENTRE_LPS_MM + offsets) for made in (straight, turned)]).astype(float)

    # the nearest voxels of two grids differ at edges
    assert np.corrcoef(pair)[0, 1] > 0.93  # measured 0.965
    assert np.median(np.abs(pair[0] - pair[1])) < 25.0  # HU; measured 0


def test_voxels_between_muscle_and_cortex_have_many_values_of_partial_volume() -> None:
    voxels, affine, truth = make_phantom(PhantomSettings(size=(120, 120), slices=20, spacing=(1.0, 1.0, 1.0), **CLEAN))
    i, j, k = np.rint(apply_affine(np.linalg.inv(affine), [centre_of_t12((voxels, affine, truth))])[0]).astype(int)
    around_the_body = voxels[k, j - 25 : j + 10, i - 30 : i + 30]

    between = np.unique(around_the_body[(around_the_body > 240) & (around_the_body < 840)])

    # a thresholded drawing has few values at the rims; partial volume has all between muscle and cortex
    assert len(between) > 60  # measured 120


@pytest.mark.parametrize("name", ["T6", "L3"])
def test_bone_of_a_vertebra_surrounds_its_canal_and_leaves_it_free(name: str) -> None:
    anatomy = plan_anatomy(field_of_view_mm=(250.0, 250.0, 150.0), steps_mm=np.eye(3), seed=1)
    [vertebra] = [each for each in anatomy.vertebrae if each.name == name]
    # 0.8 mm of the canal lie in the hollow at the back of the body.
    middle_of_canal = vertebra.depth / 2.0 + vertebra.canal_half_depth - 0.8
    angles = np.linspace(0.0, 2.0 * np.pi, 73)[None, :]
    reach_mm = np.linspace(0.0, 30.0, 301)[:, None]
    x = (reach_mm * np.sin(angles)).astype(np.float32)
    y = (middle_of_canal + reach_mm * np.cos(angles)).astype(np.float32)

    # at the height of the pedicles in front and at the sides, lower at the laminae behind
    heights = vertebra.height * np.array((0.2, 0.1, 0.0, -0.1, -0.2))
    depth_mm = np.stack([vertebra_distance(vertebra, x, y, np.full_like(x, height)) for height in heights])

    in_every_direction = depth_mm.max(axis=(0, 1)) > 0.5
    assert in_every_direction.all()
    in_the_canal = canal_distance(vertebra, x, y) > 0.0
    assert in_the_canal.any()
    assert (depth_mm[:, in_the_canal] < 0.0).all()


@pytest.fixture(scope="module")
def whole_spine() -> Anatomy:
    """The plan of a spine from C1 to L5 with its ribs."""
    return plan_anatomy(field_of_view_mm=(300.0, 300.0, 450.0), steps_mm=np.eye(3), seed=0)


def behind_the_chord(spine: Anatomy, top: str, apex: str, bottom: str) -> float:
    """How far behind the line between two levels a third one lies, mm."""
    centres = {vertebra.name: vertebra.center for vertebra in spine.vertebrae}
    (_, y_top, z_top), (_, y, z), (_, y_bottom, z_bottom) = (centres[name] for name in (top, apex, bottom))
    return float(y - np.interp(z, (z_bottom, z_top), (y_bottom, y_top)))


def test_thoracic_levels_curve_backwards(whole_spine: Anatomy) -> None:
    assert behind_the_chord(whole_spine, "T1", "T6", "T12") > 5.0  # mm; measured 17


def test_lumbar_levels_curve_forwards(whole_spine: Anatomy) -> None:
    assert behind_the_chord(whole_spine, "L1", "L3", "L5") < -2.0  # mm; measured -9


def test_spine_has_all_ribs_but_the_left_twelfth(whole_spine: Anatomy) -> None:
    names = {rib.name for rib in whole_spine.ribs}
    assert names == {f"{side} rib {n}" for side in ("left", "right") for n in range(1, 13)} - {"left rib 12"}


def test_levels_of_a_straight_spine_lie_near_the_middle_plane(whole_spine: Anatomy) -> None:
    x = np.array([vertebra.center[0] for vertebra in whole_spine.vertebrae])
    middle_x = 1.7  # mm: where spine_parts.py places the spine
    assert np.abs(x - middle_x).max() < 3.0  # mm; measured 1.4
