"""Checks of what is made of each point's neighbours: normals, the bilateral filter, mean distances."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.jobs.selftest.check import Check, require_close, require_equal, require_share
from clrecon.jobs.selftest.scenes import OBLIQUE, random_integers, stack
from clrecon.opencl import Device, Stopwatch
from clrecon.operators.points.denoising import denoise_points, remove_outliers
from clrecon.operators.points.normals import estimate_normals, find_gradients
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points import PointCloud
from clrecon.points.spacing import VARIATION_OF_FEATURES, distance_ratios, find_features, ratio_threshold
from clrecon.reference.points import bilateral as filter_twin
from clrecon.reference.points import gradients as gradients_twin
from clrecon.reference.points import neighbours as neighbours_twin
from clrecon.reference.points import normals as normals_twin
from clrecon.reference.points import outliers as outliers_twin

K = 12

NORMAL = 1e-3
"""Largest difference of a unit vector's numbers, where the axis is clear."""

MOVED_MM = 2e-5
"""Largest difference of a filtered point: exp and normals in float32."""

GRADIENT_HU_MM = 0.02
"""Largest difference of a gradient of up to 150 HU/mm: weights from float32 coordinates."""

OTHER_SIDE = 0.002
"""Share of points that float32 puts on the other side of the bound of features."""


def _bumpy_sheet(n: int) -> NDArray[np.float32]:
    """Return points on a bent sheet with noise, 2 a square millimetre."""
    rng = np.random.default_rng(31)
    u, v = rng.uniform(0.0, (n / 2.0) ** 0.5, (2, n))
    return np.column_stack([u, v, 3.0 * np.sin(0.2 * u) + rng.normal(0.0, 0.15, n)]).astype(np.float32)


def _check_normals(device: Device) -> str:
    points = _bumpy_sheet(9_000)
    indices, _ = neighbours_twin.find_neighbours(points, K)
    axes, eigenvalues = normals_twin.principal_axes(points, indices)
    clear = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues[:, 2] > 0.03
    viewpoint = np.array([30.0, 30.0, -90.0])
    expected = normals_twin.orient_from(axes, points, viewpoint)
    found = estimate_normals(PointCloud(points), K, viewpoint=viewpoint, device=device).cloud.normals
    assert found is not None
    return f"9,000 normals within {require_close(found[clear], expected[clear], NORMAL, 'normals'):.1e}"


def _check_oriented(device: Device) -> str:
    """Compare normals of points in a volume of random HU: any of them may be doubtful."""
    volume = stack(random_integers((12, 40, 45), "int16", 100), np.eye(4), False)
    points = (_bumpy_sheet(2_500) + np.array([2.0, 2.0, 5.0], np.float32)).astype(np.float32)
    gradients = gradients_twin.find_gradients(volume, points, 0.0)
    axes, eigenvalues = normals_twin.principal_axes(points, neighbours_twin.find_neighbours(points, K)[0])
    expected, doubtful = normals_twin.orient_by_gradients(axes, gradients)
    cosines = np.abs(np.einsum("ni,ni->n", axes, gradients)) / np.linalg.norm(gradients, axis=1)
    clear = (eigenvalues[:, 1] - eigenvalues[:, 0]) / eigenvalues[:, 2] > 0.03
    clear &= (cosines > 0.01) & (np.abs(cosines - normals_twin.DOUBTFUL_COSINE) > 1e-3)
    step = estimate_normals(PointCloud(points), K, volume=volume, device=device)
    assert step.cloud.normals is not None
    require_share(step.facts["doubtful"], int(doubtful.sum()), 10.0, 0.0, "number of doubtful normals")
    return f"2,500 normals within {require_close(step.cloud.normals[clear], expected[clear], NORMAL, 'normals'):.1e}"


def _check_gradients(device: Device, types: tuple[str, ...], uneven: bool) -> str:
    worst = 0.0
    for dtype in types:
        volume: Volume = stack(random_integers((9, 17, 15), dtype, 100), OBLIQUE, uneven)
        last = np.array(volume.shape_ijk) - 1.0
        points = volume.ijk_to_lps(np.random.default_rng(5).uniform(-1.0, last + 1.0, (2_000, 3)))
        resident = DeviceVolume(volume, device=device)
        found = find_gradients(resident, points, stopwatch=Stopwatch())
        expected = gradients_twin.find_gradients(volume, points, resident.values.lowest)
        worst = max(worst, require_share(found, expected, GRADIENT_HU_MM, OTHER_SIDE, f"gradients of {dtype} voxels"))
    return f"2,000 gradients in {len(types)} volumes within {worst:.1e} HU/mm"


def _filtered(points: NDArray[np.float32], features: str | None, cells_edge: float = 0.0) -> NDArray[np.float64]:
    indices, distances = neighbours_twin.find_neighbours(points, K)
    axes, eigenvalues = normals_twin.principal_axes(points, indices)
    scales = filter_twin.filter_scales(points, axes, indices, 2.0)
    factors = filter_twin.bilateral_factors(points, axes, indices, *scales)
    if features is not None:
        edge = np.float32(cells_edge)
        corner = (points.min(axis=0).astype(np.float64) - 1e-3 * float(edge)).astype(np.float32)
        steps = ((points - corner) * (np.float32(1.0) / edge)).astype(np.int64)
        cells = np.unique(steps, axis=0, return_inverse=True)[1].ravel()
        if features == "paper":
            ratios = distance_ratios(outliers_twin.mean_distances(distances), distances[:, 1], cells)
            kept = find_features(ratios, ratio_threshold(ratios))
        else:
            kept = eigenvalues[:, 0] / eigenvalues.sum(axis=1) > VARIATION_OF_FEATURES
        factors = np.where(kept, factors, filter_twin.cell_factors(points, axes, cells, *scales))
    moved: NDArray[np.float64] = points - factors[:, None] * axes
    return moved


def _check_filter(device: Device) -> str:
    points = _bumpy_sheet(9_000)
    step = denoise_points(PointCloud(points), K, device=device)
    away = require_share(step.cloud.points, _filtered(points, None), MOVED_MM, OTHER_SIDE, "filtered points, in mm")
    for features in ("paper", "variation"):
        cells = denoise_points(PointCloud(points), K, features=features, device=device)
        expected = _filtered(points, features, cells.facts["cell_mm"])
        require_share(cells.cloud.points, expected, MOVED_MM, OTHER_SIDE, "points filtered by cells, in mm")
    return f"9,000 points in three ways within {away:.1e} mm"


def _check_outliers(device: Device) -> str:
    points = _bumpy_sheet(9_000)
    _, distances = neighbours_twin.find_neighbours(points, K)
    step = remove_outliers(PointCloud(points), K, 1.0, device=device)
    require_share(step.removed, outliers_twin.find_outliers(distances, 1.0), 0.0, OTHER_SIDE, "outliers")
    require_equal(len(step.cloud), int(np.count_nonzero(step.removed == 0)), "points that are kept")
    return f"{int(step.removed.sum())} outliers of 9,000 points"


CHECKS = (
    Check("normals of points", ("fit_planes", "orient_normals"), _check_normals),
    Check("normals by the gradient", ("fit_planes", "orient_normals", "find_gradients"), _check_oriented),
    Check(
        "gradients at points",
        ("find_gradients",),
        partial(_check_gradients, types=("int8", "uint8", "int16", "uint16", "int32", "float32"), uneven=False),
    ),
    Check("gradients in uneven stacks", ("find_gradients",), partial(_check_gradients, types=("int16",), uneven=True)),
    Check(
        "filter of points",
        ("fit_planes", "filter_points", "filter_cells", "measure_distances"),
        _check_filter,
    ),
    Check("outliers of points", ("measure_distances",), _check_outliers),
)
