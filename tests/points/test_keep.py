"""Keep rules: which clusters stay, for which reason the others go; and the sheet rule."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.points.cloud import PointCloud
from clrecon.points.keep import keep_clusters, measure_clusters, parse_keep_rules


def block(n: int, *, corner: tuple[float, float, float]) -> np.ndarray:
    """n points in a block of 10 x 10 points a layer."""
    index = np.arange(n)
    return np.stack([index % 10, index // 10 % 10, index // 100], axis=1) + corner


def sheet(nx: int, ny: int, *, corner: tuple[float, float, float], thickness: float = 0.0) -> np.ndarray:
    """nx x ny points 1 mm apart, every other one higher by the thickness."""
    x, y = np.meshgrid(np.arange(nx), np.arange(ny))
    z = thickness * ((x + y) % 2)
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1) + corner


SMALL_BLOCK, SHEET, LARGE_BLOCK, OTHER_BLOCK = range(4)
PARTS = (
    block(300, corner=(0, 0, 0)), sheet(40, 30, corner=(100, 0, 0)), block(700, corner=(0, 100, 0)),
    block(300, corner=(0, 0, 100)),
)  # fmt: skip
LABELS = np.concatenate([np.full(len(part), number) for number, part in enumerate(PARTS)])


def four_clusters() -> PointCloud:
    """Blocks of 300, 700 and 300 points, a sheet of 1200, and two points of noise."""
    noise = np.array([[500.0, 0.0, 0.0], [0.0, 500.0, 0.0]])
    return PointCloud(np.concatenate([*PARTS, noise]), labels=np.append(LABELS, [-1, -1]))


RULES = {  # rules, the clusters that they keep, and the points that they remove by reason
    "no rule": ((), {0, 1, 2, 3}, {}),
    "the largest": ("largest", {SHEET}, {"other cluster": 1300}),
    "two largest": ("largest:2", {SHEET, LARGE_BLOCK}, {"other cluster": 600}),
    "three largest, of two equal the first": ("largest:3", {0, 1, 2}, {"other cluster": 300}),
    "more than there are": ("largest:9", {0, 1, 2, 3}, {}),
    "at least 301 points": ("min:301", {SHEET, LARGE_BLOCK}, {"small cluster": 600}),
    "no sheets": ("no-sheets", {SMALL_BLOCK, LARGE_BLOCK, OTHER_BLOCK}, {"sheet": 1200}),
    "the largest but no sheets": (["largest", "no-sheets"], {LARGE_BLOCK}, {"sheet": 1200, "other cluster": 600}),
    "three rules": (
        ["largest:2", "min:300", "no-sheets"],
        {SMALL_BLOCK, LARGE_BLOCK},
        {"sheet": 1200, "other cluster": 300},
    ),
    "a seed": ("seed:0,0,103", {OTHER_BLOCK}, {"other cluster": 2200}),
    "two seeds": (["seed:0,0,103", "seed:0,90,0"], {LARGE_BLOCK, OTHER_BLOCK}, {"other cluster": 1500}),
}


@pytest.mark.parametrize(("rules", "kept", "removed"), RULES.values(), ids=RULES)
def test_rules_keep_the_clusters_that_they_choose_and_count_the_rest_by_reason(
    rules, kept: set[int], removed: dict[str, int]
) -> None:
    step = keep_clusters(four_clusters(), rules)
    assert set(step.cloud.labels.tolist()) == kept
    assert {reason: count for reason, count in step.counts.items() if count} == {"noise": 2, **removed}


@pytest.mark.parametrize(("rules", "kept", "removed"), RULES.values(), ids=RULES)
def test_a_step_counts_clusters_before_and_after_and_every_point_once(
    rules, kept: set[int], removed: dict[str, int]
) -> None:
    step = keep_clusters(four_clusters(), rules)
    assert (step.facts["clusters_before"], step.facts["clusters_after"]) == (4, len(kept))
    noise = 2
    assert len(step.removed) == 300 + 1200 + 700 + 300 + noise
    assert len(step.cloud) + sum(removed.values()) + noise == len(step.removed)


@pytest.mark.parametrize(
    ("border_points_of", "kept"), [(None, LARGE_BLOCK), (LARGE_BLOCK, SMALL_BLOCK)], ids=["all are cores", "border"]
)
def test_a_seed_keeps_the_cluster_of_the_nearest_core_point(border_points_of: int | None, kept: int) -> None:
    """At y = 60 the large block, from y = 100 on, is nearer than the small one, up to y = 9."""
    cores = np.append(LABELS != border_points_of, [True, True])
    step = keep_clusters(four_clusters(), "seed:0,60,0", cores=cores)
    assert set(step.cloud.labels.tolist()) == {kept}


def test_a_seed_reports_its_distance_from_the_nearest_point() -> None:
    assert keep_clusters(four_clusters(), "seed:0,-3,0").facts["seed_distances_mm"] == [3.0]


def clusters_of(*parts: np.ndarray) -> PointCloud:
    """A cluster of each part, numbered from 0."""
    labels = np.concatenate([np.full(len(part), number) for number, part in enumerate(parts)])
    return PointCloud(np.concatenate(parts), labels=labels)


@pytest.mark.parametrize(
    ("points", "is_sheet"),
    [
        (sheet(40, 30, corner=(0, 0, 0), thickness=1.0), True),
        (sheet(40, 30, corner=(0, 0, 0), thickness=2.0), False),
        (sheet(24, 20, corner=(0, 0, 0)), False),
        (block(600, corner=(0, 0, 0)), False),
    ],
    ids=["17 times as wide as thick", "9 times as wide as thick", "480 points", "block"],
)
def test_a_sheet_is_more_than_15_times_as_wide_as_thick_and_has_500_points(points: np.ndarray, is_sheet: bool) -> None:
    assert measure_clusters(clusters_of(points)).sheets.tolist() == [is_sheet]


def test_deviations_of_a_sheet_are_half_its_thickness_and_those_of_rows_of_numbers() -> None:
    """Of n numbers in a row it is sqrt((n^2 - 1) / 12)."""
    (deviations,) = measure_clusters(clusters_of(sheet(40, 30, corner=(0, 0, 0), thickness=1.0))).deviations
    expected = [0.5, np.sqrt((30**2 - 1) / 12), np.sqrt((40**2 - 1) / 12)]
    assert deviations == pytest.approx(expected, rel=1e-4)  # checks of the thickness tilt the axes by a hair


def test_figures_of_a_turned_cluster_are_those_of_its_points() -> None:
    rng = np.random.default_rng(3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    points = (rng.normal(size=(5000, 3)) * (0.5, 2.0, 7.0)) @ turn.T + (900.0, -300.0, 40.0)
    figures = measure_clusters(clusters_of(points, points + 100.0))
    deviations = np.sqrt(np.linalg.eigvalsh(np.cov(points.T, bias=True)))
    assert figures.points.tolist() == [5000, 5000]
    np.testing.assert_allclose(figures.deviations, [deviations, deviations], rtol=1e-4)  # float32 of 900 mm
    np.testing.assert_allclose(figures.centres[0], points.mean(axis=0), atol=tolerances.FLOAT32_POINT_MM)
    box = [points.min(axis=0), points.max(axis=0)]
    np.testing.assert_allclose(figures.boxes[0], box, atol=tolerances.FLOAT32_POINT_MM)


LABELS_OF_RUNS = np.repeat([2, -1, 0, 4, 0, -3, 2], [400, 70, 300, 9, 250, 30, 800])
"""1 and 3 have no points."""


@pytest.fixture(scope="module", params=["in runs", "in any order"])
def points_and_figures(request: pytest.FixtureRequest) -> tuple[np.ndarray, Any]:
    """Random points of the labels above, and the figures of their clusters, measured in this order of the points."""
    rng = np.random.default_rng(11)
    count = len(LABELS_OF_RUNS)
    points = rng.normal(size=(count, 3)) * (1.0, 3.0, 9.0) + LABELS_OF_RUNS[:, None] * 20.0
    points = points.astype(np.float32)
    order = np.arange(count) if request.param == "in runs" else rng.permutation(count)
    return points, measure_clusters(PointCloud(points[order], labels=LABELS_OF_RUNS[order]))


@pytest.mark.parametrize("cluster", [0, 2, 4])
def test_box_centre_and_deviations_of_a_cluster_are_those_of_its_points_in_any_order(
    points_and_figures: tuple[np.ndarray, Any], cluster: int
) -> None:
    points, figures = points_and_figures
    members = points[LABELS_OF_RUNS == cluster].astype(np.float64)
    deviations = np.sqrt(np.linalg.eigvalsh(np.cov(members.T, bias=True)))
    np.testing.assert_array_equal(figures.boxes[cluster], [members.min(axis=0), members.max(axis=0)])
    np.testing.assert_allclose(figures.centres[cluster], members.mean(axis=0), rtol=tolerances.FLOAT64_SHARE)
    np.testing.assert_allclose(figures.deviations[cluster], deviations, rtol=1e-9)  # squares in float64


def test_clusters_without_points_are_counted_with_an_infinite_box_and_no_deviation(
    points_and_figures: tuple[np.ndarray, Any],
) -> None:
    _, figures = points_and_figures
    assert figures.points.tolist() == [550, 0, 1200, 0, 9]
    assert np.isinf(figures.boxes[[1, 3]]).all()
    assert not figures.deviations[[1, 3]].any()


def test_points_of_any_negative_label_are_removed_as_noise() -> None:
    cloud = PointCloud(np.arange(15.0).reshape(5, 3), labels=[0, -1, -7, 1, 0])
    step = keep_clusters(cloud)
    assert step.removed.tolist() == [0, 1, 1, 0, 0]
    assert step.counts == {"noise": 2, "sheet": 0, "small cluster": 0, "other cluster": 0}
    assert step.cloud.points[:, 0].tolist() == [0.0, 9.0, 12.0]


@pytest.mark.parametrize(
    "rule",
    ["", "biggest", "largest:0", "largest:1.5", "largest:", "min", "min:-3", "seed:1,2", "seed:a,b,c", "no-sheets:3"],
)  # fmt: skip
def test_rules_that_cannot_be_read_are_refused(rule: str) -> None:
    with refused(UsageError, "POINTS", "rules"):
        keep_clusters(four_clusters(), rule)


def test_keeping_clusters_of_a_cloud_without_labels_is_refused() -> None:
    with refused(UsageError, "points", "labels", "cluster"):
        keep_clusters(PointCloud([[0.0, 0.0, 0.0]]))


def test_a_seed_beside_another_rule_on_which_clusters_stay_is_refused() -> None:
    with refused(UsageError, "seeds", "clusters", "stay"):
        keep_clusters(four_clusters(), ["seed:0,0,0", "largest"])


def test_too_few_truth_values_of_cores_are_refused() -> None:
    with refused(UsageError, "truth", 2502, "points"):
        keep_clusters(four_clusters(), "seed:0,0,0", cores=np.ones(3, bool))


def test_a_rule_that_leaves_no_cluster_is_refused_with_the_reasons() -> None:
    with pytest.raises(NoSurfaceError, match=r"no cluster is left of 4: 2 of 2,502 points are noise.*4 are too small"):
        keep_clusters(four_clusters(), "min:5000")


@pytest.mark.parametrize(
    ("rules", "words"),
    [
        ((), "all of 1 points are noise, as none has enough others near it; take a larger eps"),
        ("seed:0,0,0", "all are noise"),
    ],
    ids=["no rule", "seed"],
)
def test_a_cloud_of_noise_alone_is_refused(rules, words: str) -> None:
    with pytest.raises(NoSurfaceError, match=words):
        keep_clusters(PointCloud([[0.0, 0.0, 0.0]], labels=[-1]), rules)


def test_rules_are_read_with_spaces_and_capitals() -> None:
    assert [rule.kind for rule in parse_keep_rules([" Largest:2", "No-Sheets "])] == ["largest", "no-sheets"]


@pytest.fixture
def two_small_clusters() -> PointCloud:
    """Points at 0 and 1 mm along the diagonal, and one at 9."""
    return PointCloud(np.array([[0.0, 0, 0], [1, 1, 1], [9, 9, 9]]), labels=[0, 0, 1])


def test_a_seed_among_the_points_is_not_warned_of(two_small_clusters: PointCloud) -> None:
    assert keep_clusters(two_small_clusters, "seed:1,1,0.5").warnings == ()


def test_a_seed_outside_of_all_points_keeps_the_nearest_cluster_with_a_warning(two_small_clusters: PointCloud) -> None:
    step = keep_clusters(two_small_clusters, ["seed:1,1,0.5", "seed:9,9,4000"])
    assert set(step.cloud.labels.tolist()) == {0, 1}
    assert step.warnings == (
        "seed:9,9,4000 (mm LPS) lies outside of the box of the points, 3,991.0 mm from the nearest one in a cluster,"
        " which was kept",
    )
