"""Checks of what is made of grids over free points: clusters and their passes, thinning, sparse cells."""

from __future__ import annotations

import numpy as np

from clrecon.jobs.selftest.check import Check, require_close, require_equal
from clrecon.jobs.selftest.points import scattered_points
from clrecon.opencl import Device, download
from clrecon.operators.points.free_clusters import ClusterSearch, cluster_free_points, plan_cells
from clrecon.operators.points.grid import fill_grid, plan_grid
from clrecon.operators.points.thinning import choose_points, grow_cells
from clrecon.reference.points import clusters as clusters_twin
from clrecon.reference.points import free_clusters as passes_twin
from clrecon.reference.points import grid as grid_twin
from clrecon.reference.points import sparse_cells as sparse_twin
from clrecon.reference.points import thin as thin_twin

EPS = 0.97
"""mm: clusters of all sizes in the scattered points, border points and noise."""


def _check_clusters(device: Device) -> str:
    points = scattered_points(20_000)
    for samples in (1, 3):
        found = cluster_free_points(points, EPS, samples, device=device)
        count, labels, cores = clusters_twin.cluster_points(points, EPS, samples)
        what = f"with {samples} samples"
        require_equal(found.count, count, f"the number of clusters {what}")
        require_equal(found.cores, cores, f"core points {what}")
        require_equal(found.labels, labels, f"labels {what}")
    return f"clusters of 20,000 points equal, {count:,} of them"


def _check_passes(device: Device) -> str:
    """Compare links within chunks, the roots of words, and the forecast of pairs; chunks are small here."""
    points, samples, per_chunk = scattered_points(20_000), 3, 32
    plan = plan_cells(points, EPS)
    made, grid = fill_grid(device, plan), grid_twin.make_grid(points, float(plan.edge))
    search = ClusterSearch(device, made, EPS, samples, per_chunk)
    pairs = passes_twin.count_pairs(grid, float(plan.edge), samples)
    require_close(search.count_pairs(), pairs, 1e-3, "pairs of points")
    search.find_cores()
    search.join_within()
    _, labels, cores = clusters_twin.cluster_points(points, EPS, samples)
    expected = passes_twin.join_chunks(grid, cores[grid.order], EPS * (1.0 + 1e-6), per_chunk)
    found = download(device, np.empty(made.cells, np.uint32), search.labels_d)
    require_equal(found, expected, "labels within chunks")
    search.note_words()
    roots = passes_twin.note_words(grid, expected)
    require_equal(download(device, np.empty(roots.shape, np.uint32), search.roots_d), roots, "roots of words")
    search.hook_chunks()
    require_equal(search.label()[0], labels, "labels of clusters that were found in small chunks")
    return f"links of {made.cells:,} cells equal"


def _check_thin(device: Device) -> str:
    points = scattered_points(20_000)
    chosen = choose_points(device, plan_grid(points, 2.1))
    require_equal(chosen, thin_twin.choose_points(points, 2.1), "points nearest to the means of cells")
    return f"{len(chosen):,} points of 20,000 equal"


def _check_sparse_cells(device: Device) -> str:
    points = scattered_points(20_000)
    for edge, fewest, threshold, largest in ((1.1, 2, 3, False), (1.6, 2, 4, True)):
        found = grow_cells(device, plan_grid(points, edge), fewest, threshold, largest).removed
        expected = sparse_twin.grow_cells(points, edge, fewest, threshold, largest)
        require_equal(found, expected, f"what becomes of points in cells of {edge} mm")
    return "growth over 2 grids equal"


CHECKS = (
    Check("thinned points", ("choose_points",), _check_thin),
    Check("sparse cells of points", ("label_crowded", "hook_touching", "mark_places"), _check_sparse_cells),
    Check(
        "clusters of free points",
        (
            "find_core_points",
            "join_chunks",
            "hook_cells",
            "find_firsts",
            "mark_firsts",
            "number_cells",
            "label_free_points",
        ),
        _check_clusters,
    ),
    Check("links of free points", ("join_chunks", "note_words", "hook_cells", "count_pairs"), _check_passes),
)
