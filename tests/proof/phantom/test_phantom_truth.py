"""The truth of a phantom as functions of mm: distances, signs and labels."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest
import tolerances
from refusals import refused
from variants import daily

import clrecon
from clrecon.errors import UsageError
from clrecon.geometry import apply_affine
from clrecon.proof.phantom import PhantomSettings, PhantomTruth, make_phantom, write_phantom
from clrecon.proof.phantom import truth as cover
from clrecon.proof.phantom.settings import CENTRE_LPS_MM
from clrecon.proof.phantom.spine_parts import Vertebra
from clrecon.proof.phantom.vertebra import local_bounds

SMALL = {"size": (60, 60), "spacing": (3.0, 3.0, 3.0), "noise": 0.0, "point_spread_mm": 0.0}
CASES = {
    "straight": {"levels": "C2"},
    "tilted and oblique": {"levels": "T6", "tilt": 14.0, "oblique": (8.0, -12.0, 25.0)},
    "scoliotic, with facets": {"levels": "L2-L3", "scoliosis_deg": 40.0, "kyphosis_deg": 20.0, "facet_gap_mm": 0.3},
}


@functools.cache
def truth_of(case: str) -> PhantomTruth:
    """The truth of a case of `CASES`."""
    return clrecon.phantom_truth(PhantomSettings(**SMALL, **CASES[case]))


def points_near(truth: PhantomTruth, count: int, spread_mm: float) -> np.ndarray:
    """Points about the surface, LPS mm."""
    rng = np.random.default_rng(5)
    surface = truth._bone._tree.data
    points = surface[rng.integers(0, len(surface), count)] + rng.normal(0.0, spread_mm, (count, 3))
    return points + CENTRE_LPS_MM


def points_around(truth: PhantomTruth, count: int, margin_mm: float) -> np.ndarray:
    """Points evenly spread over the box of the surface with a margin, LPS mm."""
    tree = truth._bone._tree
    low, high = tree.mins - margin_mm, tree.maxes + margin_mm
    return np.random.default_rng(6).uniform(low, high, (count, 3)) + CENTRE_LPS_MM


def assert_close_in_99_percent(values: np.ndarray, expected: np.ndarray) -> None:
    off = np.abs(values - expected)
    assert np.quantile(off, 0.99) < tolerances.PHANTOM_TRUTH_NEAR_MM
    assert off.max() < tolerances.PHANTOM_TRUTH_MM


@pytest.mark.parametrize("case", daily(1, CASES))
@pytest.mark.parametrize("near", [True, False], ids=["near", "away"])
def test_distances_are_those_of_a_dense_cover_of_the_surface(
    case: str, near: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = truth_of(case)
    points = points_near(truth, 1500, spread_mm=0.6) if near else points_around(truth, 1500, margin_mm=30.0)

    found = np.abs(truth.signed_distance(points))

    monkeypatch.setattr(cover, "_STEP_MM", 0.6)
    dense = cover.BoneSurface(truth._bone.vertebrae)
    nearest_of_cover, _ = dense._tree.query(points - CENTRE_LPS_MM)
    assert (found - nearest_of_cover).max() < tolerances.PHANTOM_TRUTH_MM  # points of the surface are no nearer
    assert_close_in_99_percent(found, dense.distance(points - CENTRE_LPS_MM))


@pytest.mark.parametrize("case", daily(1, CASES))
def test_distances_change_by_no_more_than_the_way_between_two_points(case: str) -> None:
    truth = truth_of(case)
    points = points_near(truth, 800, spread_mm=0.3)
    steps = np.random.default_rng(8).normal(0.0, 2.0, points.shape)
    change = np.abs(truth.signed_distance(points + steps) - truth.signed_distance(points))
    assert (change - np.linalg.norm(steps, axis=1)).max() < tolerances.PHANTOM_TRUTH_MM


@pytest.mark.parametrize("case", daily(1, CASES))
def test_gradient_of_the_distance_has_length_1_at_nearly_all_of_the_surface(case: str) -> None:
    truth = truth_of(case)
    points = points_near(truth, 800, spread_mm=0.3)
    points = points[np.abs(truth.signed_distance(points)) < 0.3]
    step = 0.02  # mm

    differences = [truth.signed_distance(points + d) - truth.signed_distance(points - d) for d in step * np.eye(3)]

    length = np.linalg.norm(np.stack(differences, axis=1) / (2.0 * step), axis=1)
    assert np.median(length) == pytest.approx(1.0, abs=1e-5)  # measured 1.5e-6
    # less on the medial axis, over rims and in the joints, where the nearest points are several
    assert (np.abs(length - 1.0) < 0.05).mean() > 0.98  # measured 0.993


def sample_label_map(truth: PhantomTruth) -> tuple[np.ndarray, np.ndarray]:
    """Centres of all labelled voxels and of some 3000 others, LPS mm, and their labels in the label map."""
    labels = truth.label_map()
    outside = np.argwhere(labels == 0)[:: labels.size // 3000]
    kji = np.concatenate((np.argwhere(labels), outside))
    return apply_affine(truth.affine, kji[:, ::-1].astype(np.float64)), labels[tuple(kji.T)]


@pytest.mark.parametrize("case", CASES)
def test_labels_of_points_are_those_of_the_label_map_but_for_rounding(case: str) -> None:
    truth = truth_of(case)
    points, drawn = sample_label_map(truth)

    different = truth.label(points) != drawn

    assert set(np.unique(drawn)) == {0, *truth.names}
    assert different.mean() < 0.001  # of 3,000 to 6,000 points; measured 0
    assert (np.abs(truth.signed_distance(points[different])) < 1e-3).all()  # mm: the drawing has float32


@pytest.mark.parametrize("case", CASES)
def test_distance_is_negative_exactly_where_a_point_has_a_label(case: str) -> None:
    truth = truth_of(case)
    points, _ = sample_label_map(truth)
    assert np.array_equal(truth.signed_distance(points) <= 0.0, truth.label(points) > 0)


def test_levels_and_names_of_the_truth_are_those_of_the_settings() -> None:
    truth = truth_of("scoliotic, with facets")
    assert truth.levels == ("L2", "L3")
    assert truth.names == {21: "L2", 22: "L3"}


def test_centres_of_vertebrae_have_the_labels_that_the_made_phantom_tells() -> None:
    truth = truth_of("scoliotic, with facets")
    _, _, told = make_phantom(truth.settings)
    vertebrae = told["spine"]["vertebrae"]
    assert [vertebra["label"] for vertebra in vertebrae] == [21, 22]
    assert truth.label([vertebra["center_lps_mm"] for vertebra in vertebrae]).tolist() == [21, 22]


def test_truth_of_the_default_spine_has_17_levels_from_t1_to_l5() -> None:
    truth = clrecon.phantom_truth(PhantomSettings(**SMALL))
    assert (truth.levels[0], truth.levels[-1]) == ("T1", "L5")
    assert len(truth.names) == len(truth.levels) == 12 + 5


def test_label_map_of_the_default_spine_has_the_levels_in_view() -> None:
    labels = clrecon.phantom_truth(PhantomSettings(**SMALL)).label_map()
    assert {18, 19, 20} <= set(np.unique(labels))  # T11 to L1, in the middle


@functools.cache
def shape_of(kind: str) -> tuple[PhantomTruth, tuple]:
    """Truth and made phantom of a tilted sphere or torus."""
    settings = PhantomSettings(kind=kind, size=(40, 36), slices=30, tilt=10.0)
    return clrecon.phantom_truth(settings), make_phantom(settings)


@pytest.mark.parametrize("kind", ["sphere", "torus"])
def test_truth_of_a_shape_has_no_levels_and_its_name_at_label_1(kind: str) -> None:
    truth, _ = shape_of(kind)
    assert truth.levels == ()
    assert truth.names == {1: kind}


@pytest.mark.parametrize("kind", ["sphere", "torus"])
def test_label_map_of_a_shape_is_1_where_its_voxels_are_at_least_half_inside(kind: str) -> None:
    truth, (voxels, _, _) = shape_of(kind)
    labels = truth.label_map()
    half_way_hu = 0  # between 1000 inside and -1000 outside
    # but for single voxels with curved surfaces
    assert (voxels[labels == 1] >= half_way_hu).mean() > 0.99
    assert (voxels[labels == 0] <= half_way_hu).mean() > 0.99  # measured 1.0


def test_distance_at_the_centre_of_a_sphere_is_its_negative_radius() -> None:
    truth, (_, _, facts) = shape_of("sphere")
    surface = facts["surface"]
    assert truth.signed_distance([surface["center_lps_mm"]]) == pytest.approx([-surface["radius_mm"]])


@pytest.mark.parametrize(("kind", "label"), [("sphere", 1), ("torus", 0)])
def test_centre_lies_in_a_sphere_and_in_the_hole_of_a_torus(kind: str, label: int) -> None:
    truth, (_, _, facts) = shape_of(kind)
    assert truth.label([facts["surface"]["center_lps_mm"]]).tolist() == [label]


@pytest.fixture
def phantom_of_l5(tmp_path: Path) -> Path:
    """A folder with a written phantom of one vertebra."""
    write_phantom(tmp_path / "ct", PhantomSettings(kind="spine", **SMALL, levels="L5"))
    return tmp_path / "ct"


def test_truth_of_a_folder_has_the_settings_with_which_it_was_written(phantom_of_l5: Path) -> None:
    truth = clrecon.phantom_truth(phantom_of_l5)
    assert truth.settings == PhantomSettings(kind="spine", **SMALL, levels="L5")
    assert truth.levels == ("L5",)


def test_truth_of_a_folder_that_is_made_in_another_way_today_is_refused(phantom_of_l5: Path) -> None:
    written = json.loads((phantom_of_l5 / "truth.json").read_text())
    written["spine"]["vertebrae"][0]["center_lps_mm"][2] += 1.0
    (phantom_of_l5 / "truth.json").write_text(json.dumps(written))
    with pytest.raises(UsageError, match="makes it in another way: write it again"):
        clrecon.phantom_truth(phantom_of_l5)


@pytest.mark.parametrize(
    "text",
    ["[]", "{", '{"generator": "clrecon phantom", "settings": {"colour": 1}}'],
    ids=["no object", "no JSON", "unknown setting"],
)
def test_truth_file_that_is_not_of_a_phantom_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "truth.json").write_text(text)
    with pytest.raises(UsageError, match="not of a phantom"):
        clrecon.phantom_truth(tmp_path)


def test_truth_of_a_folder_without_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"there is no truth of a phantom {tmp_path}/truth.json"):
        clrecon.phantom_truth(tmp_path)


@pytest.mark.parametrize(
    ("points", "says"),
    [
        pytest.param([1.0, 2.0, 3.0], r"points have shape \(n, 3\)", id="one point without a list"),
        pytest.param([[1.0, 2.0]], r"points have shape \(n, 3\)", id="two coordinates"),
        pytest.param([[np.nan, 0.0, 0.0]], "1 of 1 points are not finite", id="not a number"),
    ],
)
def test_distance_at_what_are_no_points_is_refused_with_the_reason(points: list, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        truth_of("straight").signed_distance(points)


def test_truth_of_a_scene_is_refused_with_the_name_of_its_label_map() -> None:
    with refused(UsageError, "materials.nrrd"):
        clrecon.phantom_truth(PhantomSettings(kind="skull"))


def surface_of_vertebra(vertebra: Vertebra) -> np.ndarray:
    """Points of the surface from random ones within 0.5 mm of it by steps of Newton, mm from the middle of the body."""
    low, high = (np.array(corner) for corner in local_bounds(vertebra))
    points = np.random.default_rng(9).uniform(low, high, (40_000, 3))
    depth_of = cover._Shape(vertebra)
    points = points[np.abs(depth_of(points)) < 0.5]
    for _ in range(6):
        depth, gradient = cover.gradient_of(depth_of, points)
        points = points - (depth / np.maximum((gradient**2).sum(axis=1), 1e-3))[:, None] * gradient
    return points[np.abs(depth_of(points)) < 1e-6]


def test_every_point_of_a_vertebra_has_one_of_the_cover_within_a_cell() -> None:
    truth = truth_of("scoliotic, with facets")
    vertebra = truth._bone.vertebrae[0]
    surface = surface_of_vertebra(vertebra)

    apart, _ = truth._bone._tree.query(vertebra.center + surface @ vertebra.axes)

    assert len(surface) > 500  # measured 777 of 40,000 random points that lie near it
    assert apart.max() < cover._STEP_MM
