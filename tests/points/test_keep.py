"""Keep rules: which clusters stay, for which reason the others go; and the sheet rule."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.points import PointCloud
from clrecon.points.keep import keep_clusters, measure_clusters, parse_keep_rules


def block(n: int, corner: tuple[float, float, float]) -> np.ndarray:
    """n points in a block of 10 x 10 points a layer."""
    index = np.arange(n)
    return np.stack([index % 10, index // 10 % 10, index // 100], axis=1) + corner


def sheet(nx: int, ny: int, corner: tuple[float, float, float], thickness: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(nx), np.arange(ny))
    z = thickness * ((x + y) % 2)
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1) + corner


PARTS = (block(300, (0, 0, 0)), sheet(40, 30, (100, 0, 0)), block(700, (0, 100, 0)), block(300, (0, 0, 100)))
LABELS = np.concatenate([np.full(len(part), number) for number, part in enumerate(PARTS)])


def a_cloud() -> PointCloud:
    noise = np.array([[500.0, 0.0, 0.0], [0.0, 500.0, 0.0]])
    return PointCloud(np.concatenate([*PARTS, noise]), labels=np.append(LABELS, [-1, -1]))


@pytest.mark.parametrize(
    ("rules", "kept", "counts"),
    [
        ((), {0, 1, 2, 3}, {"noise": 2}),
        ("largest", {1}, {"noise": 2, "other cluster": 1300}),
        ("largest:2", {1, 2}, {"noise": 2, "other cluster": 600}),
        ("largest:3", {0, 1, 2}, {"noise": 2, "other cluster": 300}),  # a tie: the lower number
        ("largest:9", {0, 1, 2, 3}, {"noise": 2}),
        ("min:301", {1, 2}, {"noise": 2, "small cluster": 600}),
        ("no-sheets", {0, 2, 3}, {"noise": 2, "sheet": 1200}),
        (["largest", "no-sheets"], {2}, {"noise": 2, "sheet": 1200, "other cluster": 600}),
        (["largest:2", "min:300", "no-sheets"], {0, 2}, {"noise": 2, "sheet": 1200, "other cluster": 300}),
        ("seed:0,0,103", {3}, {"noise": 2, "other cluster": 2200}),
        (["seed:0,0,103", "seed:0,90,0"], {2, 3}, {"noise": 2, "other cluster": 1500}),
    ],
)
def test_rules_keep_the_clusters_that_they_name(rules, kept: set[int], counts: dict[str, int]) -> None:
    step = keep_clusters(a_cloud(), rules)
    assert set(step.cloud.labels.tolist()) == kept
    assert {reason: count for reason, count in step.counts.items() if count} == counts
    assert step.facts["clusters_before"] == 4 and step.facts["clusters_after"] == len(kept)
    assert len(step.cloud) + sum(counts.values()) == len(step.removed)


def test_a_seed_takes_the_nearest_core_point() -> None:
    cloud = a_cloud()
    cores = np.ones(len(cloud), bool)
    assert set(keep_clusters(cloud, "seed:0,60,0", cores=cores).cloud.labels.tolist()) == {2}
    cores[LABELS.searchsorted(2) : LABELS.searchsorted(3)] = False  # all of cluster 2 are border points
    assert set(keep_clusters(cloud, "seed:0,60,0", cores=cores).cloud.labels.tolist()) == {0}
    step = keep_clusters(cloud, "seed:0,-3,0")
    assert step.facts["seed_distances_mm"] == [3.0]


def test_a_sheet_has_no_thickness_and_enough_points() -> None:
    parts = (
        sheet(40, 30, (0, 0, 0), 1.0),
        sheet(40, 30, (0, 0, 50), 2.0),
        sheet(24, 20, (0, 0, 90)),
        block(600, (0, 90, 0)),
    )
    labels = np.concatenate([np.full(len(part), number) for number, part in enumerate(parts)])
    figures = measure_clusters(PointCloud(np.concatenate(parts), labels=labels))
    # Second deviation sqrt((30^2 - 1) / 12) = 8.66; the first is half the thickness: 17.3 and 8.66 times less.
    assert figures.deviations[0, 1] / figures.deviations[0, 0] == pytest.approx(17.31, abs=0.02)
    assert figures.sheets.tolist() == [True, False, False, False]  # the third has 480 points


def test_figures_of_a_turned_cluster_are_those_of_its_points() -> None:
    rng = np.random.default_rng(3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    points = (rng.normal(size=(5000, 3)) * (0.5, 2.0, 7.0)) @ turn.T + (900.0, -300.0, 40.0)
    cloud = PointCloud(np.concatenate([points, points + 100.0]), labels=np.repeat([1, 0], 5000))
    figures = measure_clusters(cloud)
    lengths = np.sqrt(np.linalg.eigvalsh(np.cov(points.T, bias=True)))
    np.testing.assert_allclose(figures.deviations, [lengths, lengths], rtol=1e-4)
    np.testing.assert_allclose(figures.centres[1], points.mean(axis=0), atol=1e-3)
    np.testing.assert_allclose(figures.boxes[1], [points.min(axis=0), points.max(axis=0)], atol=1e-3)
    assert figures.points.tolist() == [5000, 5000]


def test_figures_do_not_depend_on_the_order_of_the_points() -> None:
    rng = np.random.default_rng(11)
    labels = np.repeat([2, -1, 0, 4, 0, -3, 2], [400, 70, 300, 9, 250, 30, 800])  # 1 and 3 have no points
    points = (rng.normal(size=(len(labels), 3)) * (1.0, 3.0, 9.0) + labels[:, None] * 20.0).astype(np.float32)
    for order in (np.arange(len(labels)), rng.permutation(len(labels))):  # in runs, and hardly ever
        figures = measure_clusters(PointCloud(points[order], labels=labels[order]))
        assert figures.points.tolist() == [550, 0, 1200, 0, 9]
        for cluster in (0, 2, 4):
            own = points[labels == cluster].astype(np.float64)
            np.testing.assert_array_equal(figures.boxes[cluster], [own.min(axis=0), own.max(axis=0)])
            np.testing.assert_allclose(figures.centres[cluster], own.mean(axis=0), rtol=1e-12)
            squares = np.linalg.eigvalsh(np.cov(own.T, bias=True))
            np.testing.assert_allclose(figures.deviations[cluster], np.sqrt(squares), rtol=1e-9)
        assert np.isinf(figures.boxes[[1, 3]]).all() and not figures.deviations[[1, 3]].any()


def test_any_negative_label_is_noise() -> None:
    cloud = PointCloud(np.arange(15.0).reshape(5, 3), labels=[0, -1, -7, 1, 0])
    step = keep_clusters(cloud)
    assert step.removed.tolist() == [0, 1, 1, 0, 0]
    assert step.counts == {"noise": 2, "sheet": 0, "small cluster": 0, "other cluster": 0}
    assert step.cloud.points[:, 0].tolist() == [0.0, 9.0, 12.0]


@pytest.mark.parametrize(
    "rule",
    ["", "biggest", "largest:0", "largest:1.5", "largest:", "min", "min:-3", "seed:1,2", "seed:a,b,c", "no-sheets:3"],
)  # fmt: skip
def test_bad_rules_are_refused(rule: str) -> None:
    with refused(UsageError, "POINTS", "rules"):
        keep_clusters(a_cloud(), rule)


def test_what_cannot_be_kept_is_refused() -> None:
    with pytest.raises(UsageError, match="no labels"):
        keep_clusters(PointCloud([[0.0, 0.0, 0.0]]))
    with pytest.raises(UsageError, match="seeds say which clusters stay"):
        keep_clusters(a_cloud(), ["seed:0,0,0", "largest"])
    with pytest.raises(UsageError, match="a truth value for each of 2,502 points"):
        keep_clusters(a_cloud(), "seed:0,0,0", cores=np.ones(3, bool))
    with pytest.raises(NoSurfaceError, match=r"no cluster is left of 4: 2 of 2,502 points are noise.*4 are too small"):
        keep_clusters(a_cloud(), "min:5000")
    with pytest.raises(
        NoSurfaceError,
        match="no cluster is left: all of 1 points are noise, as none has enough others near it; take a larger eps",
    ):
        keep_clusters(PointCloud([[0.0, 0.0, 0.0]], labels=[-1]))
    with pytest.raises(NoSurfaceError, match="all are noise"):
        keep_clusters(PointCloud([[0.0, 0.0, 0.0]], labels=[-1]), "seed:0,0,0")


def test_rules_are_read_with_spaces_and_capitals() -> None:
    assert [rule.kind for rule in parse_keep_rules([" Largest:2", "No-Sheets "])] == ["largest", "no-sheets"]


def test_a_seed_outside_of_all_points_is_warned_of():
    cloud = PointCloud(np.array([[0.0, 0, 0], [1, 1, 1], [9, 9, 9]]), labels=[0, 0, 1])
    assert keep_clusters(cloud, "seed:1,1,0.5").warnings == ()
    step = keep_clusters(cloud, ["seed:1,1,0.5", "seed:9,9,4000"])
    assert len(step.cloud) == 3
    assert step.warnings == (
        "seed:9,9,4000 (mm LPS) lies outside of the box of the points, 3,991.0 mm from the nearest one in a cluster,"
        " which was kept",
    )
