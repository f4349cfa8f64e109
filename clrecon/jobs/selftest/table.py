"""The table of checks: the self-test, its guard and the mutation of kernels read it."""

from __future__ import annotations

from clrecon.jobs.selftest import (
    clusters,
    fields,
    filters,
    free_clusters,
    labels,
    layers,
    masks,
    meshes,
    near_faces,
    pictures,
    point_filters,
    points,
    primitives,
    rays,
    reformat,
    resident,
    surface,
    voxel_points,
)
from clrecon.jobs.selftest.check import Check

CHECKS: tuple[Check, ...] = (
    *primitives.CHECKS,
    *resident.CHECKS,
    *surface.CHECKS,
    *meshes.CHECKS,
    *labels.CHECKS,
    *near_faces.CHECKS,
    *rays.CHECKS,
    *pictures.CHECKS,
    *layers.CHECKS,
    *reformat.CHECKS,
    *filters.CHECKS,
    *points.CHECKS,
    *clusters.CHECKS,
    *masks.CHECKS,
    *fields.CHECKS,
    *point_filters.CHECKS,
    *free_clusters.CHECKS,
    *voxel_points.CHECKS,
)


def checks_of(kernel: str) -> list[Check]:
    """Return the checks that cover a kernel, in the order of the table."""
    return [check for check in CHECKS if kernel in check.kernels]
