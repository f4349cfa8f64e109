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
from clrecon.proof.phantom import PhantomSettings, PhantomTruth, make_phantom, write_phantom
from clrecon.proof.phantom import truth as cover
from clrecon.proof.phantom.vertebra import local_bounds

SMALL = {"size": (60, 60), "spacing": (3.0, 3.0, 3.0), "noise": 0.0, "point_spread_mm": 0.0}
CASES = {
    "straight": {"levels": "C2"},
    "tilted and oblique": {"levels": "T6", "tilt": 14.0, "oblique": (8.0, -12.0, 25.0)},
    "scoliotic, with facets": {"levels": "L2-L3", "scoliosis_deg": 40.0, "kyphosis_deg": 20.0, "facet_gap_mm": 0.3},
}


@functools.cache
def truth_of(case: str) -> PhantomTruth:
    return clrecon.phantom_truth(PhantomSettings(**SMALL, **CASES[case]))


def points_near(truth: PhantomTruth, count: int, spread_mm: float) -> np.ndarray:
    """Points about the surface, LPS mm."""
    rng = np.random.default_rng(5)
    surface = truth._bone._tree.data
    points = surface[rng.integers(0, len(surface), count)] + rng.normal(0.0, spread_mm, (count, 3))
    return points + cover_centre()


def cover_centre() -> tuple[float, float, float]:
    from clrecon.proof.phantom.settings import CENTRE_LPS_MM

    return CENTRE_LPS_MM


@pytest.mark.parametrize("case", daily(1, CASES))
def test_distances_are_those_of_a_dense_cover_of_the_surface(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = truth_of(case)
    near = points_near(truth, 1500, 0.6)
    low, high = truth._bone._tree.mins - 30.0, truth._bone._tree.maxes + 30.0
    far = np.random.default_rng(6).uniform(low, high, (1500, 3)) + cover_centre()
    points = np.concatenate((near, far))
    found = np.abs(truth.signed_distance(points))
    monkeypatch.setattr(cover, "_STEP_MM", 0.6)
    dense = cover.BoneSurface(truth._bone.vertebrae)
    nearest = dense._tree.query(points - cover_centre())[0]
    # no point of the surface is nearer than said, and one is nearly as near
    assert (found - nearest).max() < tolerances.PHANTOM_TRUTH_MM
    true = dense.distance(points - cover_centre())
    off = found - true
    assert off.min() > -tolerances.PHANTOM_TRUTH_MM
    close = true < 0.5
    assert np.quantile(np.abs(off[close]), 0.99) < tolerances.PHANTOM_TRUTH_NEAR_MM
    assert np.quantile(np.abs(off), 0.99) < tolerances.PHANTOM_TRUTH_NEAR_MM
    assert np.abs(off).max() < tolerances.PHANTOM_TRUTH_MM


@pytest.mark.parametrize("case", daily(1, CASES))
def test_distances_change_by_no_more_than_the_way_and_point_along_the_normal(case: str) -> None:
    truth = truth_of(case)
    points = points_near(truth, 800, 0.3)
    here = truth.signed_distance(points)
    steps = np.random.default_rng(8).normal(0.0, 2.0, points.shape)
    there = truth.signed_distance(points + steps)
    way = np.linalg.norm(steps, axis=1)
    assert (np.abs(there - here) - way).max() < tolerances.PHANTOM_TRUTH_MM
    delta = 0.02
    shifted = [(truth.signed_distance(points + d) - truth.signed_distance(points - d)) for d in delta * np.eye(3)]
    slope = np.linalg.norm(np.stack(shifted, axis=1) / (2.0 * delta), axis=1)
    at_the_surface = np.abs(here) < 0.3
    assert np.median(slope[at_the_surface]) == pytest.approx(1.0, abs=2e-3)
    # but on the medial axis, over rims and in the joints, where the nearest points are several
    assert (np.abs(slope[at_the_surface] - 1.0) < 0.05).mean() > 0.9


@pytest.mark.parametrize("case", CASES)
def test_labels_and_signs_are_those_of_the_label_map(case: str) -> None:
    truth = truth_of(case)
    labels = truth.label_map()
    assert set(np.unique(labels)) == {0, *truth.names}
    k, j, i = np.nonzero(labels)
    outside = np.argwhere(labels == 0)[:: labels.size // 3000]
    k, j, i = (np.concatenate((a, b)) for a, b in zip((k, j, i), outside.T, strict=True))
    points = np.stack((i, j, k), axis=1) @ truth.affine[:3, :3].T + truth.affine[:3, 3]
    said, drawn = truth.label(points), labels[k, j, i]
    different = said != drawn
    distance = truth.signed_distance(points)
    assert (np.abs(distance[different]) < 1e-3).all()  # the drawing has float32
    assert np.array_equal(said > 0, distance <= 0.0)
    assert different.mean() < 0.001


def test_levels_and_names_are_those_of_the_settings() -> None:
    truth = truth_of("scoliotic, with facets")
    assert truth.levels == ("L2", "L3") and truth.names == {21: "L2", 22: "L3"}
    made = make_phantom(truth.settings)[2]["spine"]["vertebrae"]
    said = truth.label([level["center_lps_mm"] for level in made])
    assert said.tolist() == [21, 22] == [level["label"] for level in made]


def test_truth_of_the_default_spine_has_17_levels_and_labels_of_those_in_view() -> None:
    truth = clrecon.phantom_truth(PhantomSettings(**SMALL))
    assert truth.levels[0] == "T1" and truth.levels[-1] == "L5" and len(truth.names) == 17
    labels = truth.label_map()
    assert {18, 19, 20} <= set(np.unique(labels))


@pytest.mark.parametrize("kind", ["sphere", "torus"])
def test_analytic_shapes_have_their_exact_distance(kind: str) -> None:
    settings = PhantomSettings(kind=kind, size=(40, 36), slices=30, tilt=10.0)
    truth = clrecon.phantom_truth(settings)
    labels = truth.label_map()
    voxels = make_phantom(settings)[0]
    assert truth.levels == () and truth.names == {1: kind}
    assert (voxels[labels == 1] >= 0).mean() > 0.99 and (voxels[labels == 0] <= 0).mean() > 0.99
    described = make_phantom(settings)[2]["surface"]
    centre = np.array([described["center_lps_mm"]])
    if kind == "sphere":
        assert truth.signed_distance(centre) == pytest.approx([-described["radius_mm"]])
    assert truth.label(centre).tolist() == [int(kind == "sphere")]


def test_a_folder_gives_the_same_truth_as_its_settings(tmp_path: Path) -> None:
    settings = PhantomSettings(kind="spine", **SMALL, levels="L5")
    write_phantom(tmp_path / "ct", settings)
    truth = clrecon.phantom_truth(tmp_path / "ct")
    assert truth.settings == settings and truth.levels == ("L5",)
    written = json.loads((tmp_path / "ct" / "truth.json").read_text())
    written["spine"]["vertebrae"][0]["center_lps_mm"][2] += 1.0
    (tmp_path / "ct" / "truth.json").write_text(json.dumps(written))
    with pytest.raises(UsageError, match="makes it in another way: write it again"):
        clrecon.phantom_truth(tmp_path / "ct")
    for text in ("[]", "{", '{"generator": "clrecon phantom", "settings": {"colour": 1}}'):
        (tmp_path / "ct" / "truth.json").write_text(text)
        with pytest.raises(UsageError, match="not of a phantom"):
            clrecon.phantom_truth(tmp_path / "ct")
    with pytest.raises(UsageError, match="cannot be read"):
        clrecon.phantom_truth(tmp_path)


@pytest.mark.parametrize("points", [[1.0, 2.0, 3.0], [[1.0, 2.0]], [[np.nan, 0.0, 0.0]]])
def test_points_that_are_none_are_refused(points: list) -> None:
    with pytest.raises(UsageError, match=r"points (have shape \(n, 3\)|are not finite)|of 1 points"):
        truth_of("straight").signed_distance(points)


def test_scenes_have_no_surface_as_a_function() -> None:
    with refused(UsageError, "materials.nrrd"):
        clrecon.phantom_truth(PhantomSettings(kind="skull"))


def test_cover_of_a_vertebra_has_no_holes() -> None:
    """Each point of the surface has one of the cover within the diagonal of a cell."""
    truth = truth_of("scoliotic, with facets")
    vertebra = truth._bone.vertebrae[0]
    low, high = (np.array(corner) for corner in local_bounds(vertebra))
    at = np.random.default_rng(9).uniform(low, high, (40_000, 3))
    shape = cover._Shape(vertebra)
    at = at[np.abs(shape(at)) < 0.5]
    for _ in range(6):
        value, gradient = cover.gradient_of(shape, at)
        at = at - (value / np.maximum((gradient**2).sum(axis=1), 1e-3))[:, None] * gradient
    at = at[np.abs(shape(at)) < 1e-6]
    apart = truth._bone._tree.query(vertebra.center + at @ vertebra.axes)[0]
    assert len(at) > 500 and apart.max() < cover._STEP_MM
