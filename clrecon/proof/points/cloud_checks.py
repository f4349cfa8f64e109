"""Checks of clouds: the grid and what its cells decide, the nearest points and what is made of them, the field around a
cloud.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.opencl import Device, Stopwatch, download
from clrecon.operators.points.denoising import denoise_points, remove_outliers
from clrecon.operators.points.field import LEAST_SHARE, FieldSettings, Masks, NodeField, decide_signs
from clrecon.operators.points.free_clusters import ClusterSearch, cluster_free_points, plan_cells
from clrecon.operators.points.grid import fill_grid, make_grid, plan_grid
from clrecon.operators.points.neighbours import find_neighbours
from clrecon.operators.points.normals import estimate_normals, find_gradients
from clrecon.operators.points.thinning import choose_points, grow_cells
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points.cloud import PointCloud
from clrecon.points.spacing import VARIATION_OF_FEATURES, distance_ratios, find_features, ratio_threshold
from clrecon.proof.checking import (
    OBLIQUE,
    VOXEL_TYPES,
    Check,
    random_integers,
    require_close,
    require_equal,
    require_share,
    stack,
)
from clrecon.proof.points import clusters as cluster_twin
from clrecon.proof.points import field as field_twin
from clrecon.proof.points import neighbours as neighbour_twin


def scattered_points(n: int) -> NDArray[np.float32]:
    """Return points in a box of 60 x 40 x 30 mm, one in twenty of them twice."""
    points = np.random.default_rng(23).random((n, 3), np.float32) * np.array([60, 40, 30], np.float32)
    points[n // 2 : n // 2 + n // 20] = points[: n // 20]
    return points


def _check_grid(device: Device) -> str:
    points = scattered_points(20_000)
    for edge in (0.5, 2.3):
        device_grid, grid = make_grid(device, points, edge), cluster_twin.make_grid(points, edge)
        subject = f"of a grid of {edge} mm"
        require_equal(device_grid.cells, len(grid.starts) - 1, f"the number of cells {subject}")
        for name, buffer, expected in (
            ("mask", device_grid.mask_d, grid.mask),
            ("ranks", device_grid.ranks_d, grid.ranks),
            ("starts", device_grid.starts_d, grid.starts),
            ("order", device_grid.order_d, grid.order),
            *zip("xyz", (device_grid.x_d, device_grid.y_d, device_grid.z_d), grid.points.T, strict=True),
        ):
            content = download(device, np.empty(expected.shape, expected.dtype), buffer)
            require_equal(content, expected, f"{name} {subject}")
    return "2 grids over 20,000 points equal"


def _check_neighbours(device: Device) -> str:
    """Compare neighbours of scattered points with far ones, a crowd and many at one place, and of a lattice."""
    scattered = scattered_points(6_000)
    scattered[:500] *= 0.01
    scattered[500:540] = scattered[0]
    scattered[540:545] += np.float32(40.0)  # not farther: rows of cells are steps too, and llvmpipe ends long loops
    lattice = np.argwhere(np.ones((20, 20, 20))).astype(np.float32)
    many = scattered_points(30_000)  # in some 15,000 cells, of which a work-item takes 16
    for points, k in ((scattered, 16), (scattered, 5), (lattice, 16), (many, 2)):
        neighbours = find_neighbours(points, k, device=device)
        indices, distances = neighbour_twin.find_neighbours(points, k)
        require_equal(neighbours.indices, indices, f"{k} nearest of {len(points):,} points")
        require_equal(neighbours.distances, distances, f"distances of the {k} nearest of {len(points):,} points")
    return "2 to 16 neighbours of up to 30,000 points equal"


GRID_CHECKS = (
    Check(
        "grid of points", ("clear_cells", "mark_cells", "count_marked", "number_points", "gather_points"), _check_grid
    ),
    Check("nearest points", ("list_neighbours",), _check_neighbours),
)


EPS = 0.97
"""mm: clusters of all sizes in the scattered points, border points and noise."""


def _check_clusters(device: Device) -> str:
    points = scattered_points(20_000)
    for samples in (1, 3):
        clusters = cluster_free_points(points, EPS, samples, device=device)
        count, labels, cores = cluster_twin.cluster_points(points, EPS, samples)
        subject = f"with {samples} samples"
        require_equal(clusters.count, count, f"the number of clusters {subject}")
        require_equal(clusters.cores, cores, f"core points {subject}")
        require_equal(clusters.labels, labels, f"labels {subject}")
    return f"clusters of 20,000 points equal, {count:,} of them"


def _check_passes(device: Device) -> str:
    """Compare links within chunks, the roots of words, and the forecast of pairs; chunks are small here."""
    points = scattered_points(20_000)
    samples, per_chunk = 3, 32
    plan = plan_cells(points, EPS)
    device_grid, grid = fill_grid(device, plan), cluster_twin.make_grid(points, float(plan.edge))
    search = ClusterSearch(device, device_grid, EPS, samples, per_chunk)
    pairs = cluster_twin.count_pairs(grid, float(plan.edge), samples)
    require_close(search.count_pairs(), pairs, 1e-3, "pairs of points")
    search.find_cores()
    search.join_within()
    _, labels, cores = cluster_twin.cluster_points(points, EPS, samples)
    expected = cluster_twin.join_chunks(grid, cores[grid.order], EPS * (1.0 + 1e-6), per_chunk)
    downloaded = download(device, np.empty(device_grid.cells, np.uint32), search.labels_d)
    require_equal(downloaded, expected, "labels within chunks")
    search.note_words()
    roots = cluster_twin.note_words(grid, expected)
    require_equal(download(device, np.empty(roots.shape, np.uint32), search.roots_d), roots, "roots of words")
    search.hook_chunks()
    require_equal(search.label()[0], labels, "labels of clusters that were found in small chunks")
    return f"links of {device_grid.cells:,} cells equal"


def _check_thin(device: Device) -> str:
    points = scattered_points(20_000)
    chosen = choose_points(device, plan_grid(points, 2.1))
    require_equal(chosen, cluster_twin.choose_points(points, 2.1), "points nearest to the means of cells")
    return f"{len(chosen):,} points of 20,000 equal"


def _check_sparse_cells(device: Device) -> str:
    points = scattered_points(20_000)
    for edge, fewest, threshold, largest in ((1.1, 2, 3, False), (1.6, 2, 4, True)):
        removed = grow_cells(device, plan_grid(points, edge), fewest, threshold, largest).removed
        expected = cluster_twin.grow_cells(points, edge, fewest, threshold, largest)
        require_equal(removed, expected, f"what becomes of points in cells of {edge} mm")
    return "growth over 2 grids equal"


CLUSTER_CHECKS = (
    Check("thinned points", ("choose_points",), _check_thin),
    Check("sparse cells of points", ("label_crowded", "hook_touching", "mark_places"), _check_sparse_cells),
    Check(
        "clusters of free points",
        (
            "find_core_points", "join_chunks", "hook_cells", "find_firsts", "mark_firsts", "number_cells",
            "label_free_points",
        ),
        _check_clusters,
    ),
    Check("links of free points", ("join_chunks", "note_words", "hook_cells", "count_pairs"), _check_passes),
)  # fmt: skip


K = 12

NORMAL = 1e-3
"""Largest difference of a unit vector's numbers, where the axis is clear."""

_MOVED_MM = 2e-5
"""Largest difference of a filtered point: exp and normals in float32."""

_GRADIENT_HU_MM = 0.02
"""Largest difference of a gradient of up to 150 HU/mm: weights from float32 coordinates."""

_OTHER_SIDE = 0.002
"""Share of points that float32 puts on the other side of the bound of features."""


def _bumpy_sheet(n: int) -> NDArray[np.float32]:
    """Return points on a bent sheet with noise, 2 a square millimetre."""
    rng = np.random.default_rng(31)
    u, v = rng.uniform(0.0, (n / 2.0) ** 0.5, (2, n))
    return np.column_stack([u, v, 3.0 * np.sin(0.2 * u) + rng.normal(0.0, 0.15, n)]).astype(np.float32)


def _check_normals(device: Device) -> str:
    points = _bumpy_sheet(9_000)
    indices, _ = neighbour_twin.find_neighbours(points, K)
    axes, eigenvalues = neighbour_twin.principal_axes(points, indices)
    clear = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues[:, 2] > 0.03
    viewpoint = np.array([30.0, 30.0, -90.0])
    expected = neighbour_twin.orient_from(axes, points, viewpoint)
    normals = estimate_normals(PointCloud(points), K, viewpoint=viewpoint, device=device).cloud.normals
    assert normals is not None
    return f"9,000 normals within {require_close(normals[clear], expected[clear], NORMAL, 'normals'):.1e}"


def _check_oriented(device: Device) -> str:
    """Compare normals of points in a volume of random HU: any of them may be doubtful."""
    volume = stack(random_integers((12, 40, 45), "int16", 100), np.eye(4), uneven=False)
    points = (_bumpy_sheet(2_500) + np.array([2.0, 2.0, 5.0], np.float32)).astype(np.float32)
    gradients = cluster_twin.find_gradients(volume, points, 0.0)
    axes, eigenvalues = neighbour_twin.principal_axes(points, neighbour_twin.find_neighbours(points, K)[0])
    expected, doubtful = neighbour_twin.orient_by_gradients(axes, gradients)
    cosines = np.abs(np.einsum("ni,ni->n", axes, gradients)) / np.linalg.norm(gradients, axis=1)
    clear = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues[:, 2] > 0.03
    clear &= (cosines > 0.01) & (np.abs(cosines - neighbour_twin.DOUBTFUL_COSINE) > 1e-3)
    step = estimate_normals(PointCloud(points), K, volume=volume, device=device)
    assert step.cloud.normals is not None
    require_share(step.facts["doubtful"], int(doubtful.sum()), 10.0, 0.0, "number of doubtful normals")
    return f"2,500 normals within {require_close(step.cloud.normals[clear], expected[clear], NORMAL, 'normals'):.1e}"


def _check_gradients(device: Device, types: tuple[str, ...], uneven: bool) -> str:
    worst = 0.0
    for dtype in types:
        volume: Volume = stack(random_integers((9, 17, 15), dtype, 100), OBLIQUE, uneven=uneven)
        last = np.array(volume.shape_ijk) - 1.0
        points = volume.ijk_to_lps(np.random.default_rng(5).uniform(-1.0, last + 1.0, (2_000, 3)))
        resident = DeviceVolume(volume, device=device)
        slopes = find_gradients(resident, points, stopwatch=Stopwatch())
        expected = cluster_twin.find_gradients(volume, points, resident.values.lowest)
        worst = max(
            worst, require_share(slopes, expected, _GRADIENT_HU_MM, _OTHER_SIDE, f"gradients of {dtype} voxels")
        )
    return f"2,000 gradients in {len(types)} volumes within {worst:.1e} HU/mm"


def _filtered(points: NDArray[np.float32], features: str | None, cells_edge: float = 0.0) -> NDArray[np.float64]:
    indices, distances = neighbour_twin.find_neighbours(points, K)
    axes, eigenvalues = neighbour_twin.principal_axes(points, indices)
    scales = neighbour_twin.filter_scales(points, axes, indices, 2.0)
    factors = neighbour_twin.bilateral_factors(points, axes, indices, *scales)
    if features is not None:
        edge = np.float32(cells_edge)
        corner = (points.min(axis=0).astype(np.float64) - 1e-3 * float(edge)).astype(np.float32)
        steps = ((points - corner) * (np.float32(1.0) / edge)).astype(np.int64)
        cells = np.unique(steps, axis=0, return_inverse=True)[1].ravel()
        if features == "paper":
            ratios = distance_ratios(neighbour_twin.mean_distances(distances), distances[:, 1], cells)
            is_feature = find_features(ratios, ratio_threshold(ratios))
        else:
            is_feature = eigenvalues[:, 0] / eigenvalues.sum(axis=1) > VARIATION_OF_FEATURES
        factors = np.where(is_feature, factors, neighbour_twin.cell_factors(points, axes, cells, *scales))
    moved: NDArray[np.float64] = points - factors[:, None] * axes
    return moved


def _check_filter(device: Device) -> str:
    points = _bumpy_sheet(9_000)
    step = denoise_points(PointCloud(points), K, device=device)
    away = require_share(step.cloud.points, _filtered(points, None), _MOVED_MM, _OTHER_SIDE, "filtered points, in mm")
    for features in ("paper", "variation"):
        cells = denoise_points(PointCloud(points), K, features=features, device=device)
        expected = _filtered(points, features, cells.facts["cell_mm"])
        require_share(cells.cloud.points, expected, _MOVED_MM, _OTHER_SIDE, "points filtered by cells, in mm")
    return f"9,000 points in three ways within {away:.1e} mm"


def _check_outliers(device: Device) -> str:
    points = _bumpy_sheet(9_000)
    _, distances = neighbour_twin.find_neighbours(points, K)
    step = remove_outliers(PointCloud(points), K, 1.0, device=device)
    require_share(step.removed, neighbour_twin.find_outliers(distances, 1.0), 0.0, _OTHER_SIDE, "outliers")
    require_equal(len(step.cloud), int(np.count_nonzero(step.removed == 0)), "points that are kept")
    return f"{int(step.removed.sum())} outliers of 9,000 points"


FILTER_CHECKS = (
    Check("normals of points", ("fit_planes", "orient_normals"), _check_normals),
    Check("normals by the gradient", ("fit_planes", "orient_normals", "find_gradients"), _check_oriented),
    Check("gradients at points", ("find_gradients",), partial(_check_gradients, types=VOXEL_TYPES, uneven=False)),
    Check("gradients in uneven stacks", ("find_gradients",), partial(_check_gradients, types=("int16",), uneven=True)),
    Check("filter of points", ("fit_planes", "filter_points", "filter_cells", "measure_distances"), _check_filter),
    Check("outliers of points", ("measure_distances",), _check_outliers),
)


_FIELD_MM = 5e-5
"""float32 sums of heights of up to 2 mm, at places up to 150 mm; measured 1e-5."""

ROUNDS = 3
"""Odd: what inverts the signs in each round is not seen after an even number."""

SETTINGS = FieldSettings(0.65, 1.5, 0.1, 1.3)


def _two_balls() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points on two balls of 14 and 6 mm, and their normals, of which one in twenty points inward."""
    normals = np.random.default_rng(5).normal(size=(7000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 14.0 * normals
    points[6000:] = 6.0 * normals[6000:] + (0.0, 0.0, 130.0)
    normals[::20] *= -1.0
    return points.astype(np.float32), normals.astype(np.float32)


def _fetch(masks: Masks, mask_d: Any) -> NDArray[np.bool_]:
    """Return a mask of nodes, shape (nz, ny, nx)."""
    nx, ny, nz = masks.shape
    mask_bytes = download(masks.device, np.empty((nz, ny, 4 * masks.words), np.uint8), mask_d)
    return np.unpackbits(mask_bytes, axis=2, bitorder="little")[:, :, :nx].astype(bool)


def _check_field(device: Device) -> str:
    points, normals = _two_balls()
    field = NodeField(device, points, normals, SETTINGS)
    nodes, masks = field.nodes, field.masks
    h = SETTINGS.spacing
    expected = field_twin.measure_field(
        points, normals, nodes.corner, h, nodes.shape, reach=SETTINGS.reach, smoothing=SETTINGS.smoothing
    )
    near = np.isfinite(expected.value) & (expected.squared <= np.float32(SETTINGS.bridge) ** 2)
    core = near & (expected.squared <= np.float32(h) ** 2)
    negative = _fetch(masks, masks.negative_d)
    require_equal(_fetch(masks, masks.near_d), near, "near nodes of a field")
    require_equal(_fetch(masks, masks.core_d), core, "core of a field")
    clear = near & (np.abs(np.where(near, expected.value, 0.0)) > _FIELD_MM)
    require_equal(negative[clear], expected.value[clear] <= 0.0, "signs of a field")
    require_equal(negative[~near], np.zeros(int((~near).sum()), bool), "signs far from a field")
    signs = decide_signs(masks, field.limits, ROUNDS)
    decided = field_twin.decide_signs(near, core, negative, ROUNDS)
    require_equal(
        (signs.votes, signs.against, signs.regions, signs.outside_is_inside),
        (decided.votes, decided.against, decided.regions, bool(decided.inside[0, 0, 0])),
        "votes of regions",
    )
    require_equal(_fetch(masks, signs.inside_d), decided.inside, "nodes inside")
    far = float(np.float32(SETTINGS.bridge))
    filled = field_twin.fill_nodes(expected, near, decided, far, LEAST_SHARE * h)
    apart = require_close(field.fill(signs), filled, _FIELD_MM, "the field on nodes")
    return f"{field.bricks} bricks of nodes within {apart:.1g} mm, signs of {nodes.count:,} nodes equal"


FIELD_CHECKS = (
    Check(
        "field around points",
        (
            "merge_rows", "mark_reached", "sort_normals", "measure_nodes", "fill_far", "place_bricks",
            "count_runs", "list_runs", "count_joins", "list_joins", "count_votes", "paint_regions", "flood_signs",
        ),
        _check_field,
    ),
)  # fmt: skip
