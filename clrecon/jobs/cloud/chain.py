"""The steps of a cloud job after the points are there, in their one order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from clrecon.jobs.cloud.settings import CloudSettings
from clrecon.jobs.cloud.trail import Trail
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.opencl import Device
    from clrecon.operators.resident.device_volume import DeviceVolume


def run_steps(
    trail: Trail, settings: CloudSettings, device: Device, resident: DeviceVolume | None, progress: Progress
) -> None:
    """Run the steps that are asked for, from the clusters to the spacing.

    trail: Gets the result of each step.
    resident: The volume of the points; None for clouds that were read.
    """
    shared: dict[str, Any] = {"device": device.current, "memory": settings.memory, "progress": progress}
    for run in (_cluster, _remove_sparse, _remove_outliers, _denoise, _find_normals, _thin):
        trail.start()
        run(trail, settings, resident, shared)


def _cluster(trail: Trail, settings: CloudSettings, resident: DeviceVolume | None, shared: dict[str, Any]) -> None:
    """Cluster the points; noise goes, and what the rules do not keep."""
    chosen = settings.clustering
    if chosen is None:
        return
    from clrecon.operators.points.clusters import cluster_points
    from clrecon.points.keep import keep_clusters

    eps, volume = chosen.eps, resident
    if resident is not None and not trail.cloud.has_ijk:  # points of a surface: free, but of that scan
        from clrecon.points.stencil import Lattice

        eps, volume = Lattice.of(resident.volume).default_eps if eps is None else eps, None
    found = cluster_points(trail.cloud, eps, chosen.min_samples, **_with_volume(volume, shared))
    trail.add("clusters", found)
    trail.start()
    rules = rules_in_lps(settings)
    trail.add("keep", keep_clusters(found.cloud, rules, cores=found.cores, figures=found.figures), takes_noise=True)


def _with_volume(resident: DeviceVolume | None, shared: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments for a function that wants the volume, which has a device of its own."""
    return shared if resident is None else {"volume": resident, "progress": shared["progress"]}


def in_lps(point: Sequence[float], space: str) -> tuple[float, ...]:
    """Return a point of the frame of the output, mm, in LPS."""
    x, y, z = point
    return (x, y, z) if space == "lps" else (-x, -y, z)


def rules_in_lps(settings: CloudSettings) -> list[str]:
    """Return the keep rules with seeds in LPS; they are given in the frame of the output."""
    if settings.space == "lps":
        return list(settings.keep)
    rules = []
    for rule in settings.keep:
        kind, _, rest = rule.partition(":")
        if kind.strip().lower() == "seed":
            point = in_lps([float(word) for word in rest.split(",")], settings.space)
            rule = f"seed:{','.join(map(repr, point))}"
        rules.append(rule)
    return rules


def _remove_sparse(
    trail: Trail, settings: CloudSettings, resident: DeviceVolume | None, shared: dict[str, Any]
) -> None:
    """Remove what paper B's grid takes for noise."""
    if "grid" not in settings.denoise:
        return
    from clrecon.operators.points.thinning import remove_sparse_cells

    trail.add("sparse cells", remove_sparse_cells(trail.cloud, **shared), takes_noise=True)


def _remove_outliers(
    trail: Trail, settings: CloudSettings, resident: DeviceVolume | None, shared: dict[str, Any]
) -> None:
    if settings.outliers is None:
        return
    from clrecon.operators.points.denoising import remove_outliers

    trail.add("outliers", remove_outliers(trail.cloud, deviations=settings.outliers, **shared), takes_noise=True)


def _denoise(trail: Trail, settings: CloudSettings, resident: DeviceVolume | None, shared: dict[str, Any]) -> None:
    if "bilateral" not in settings.denoise:
        return
    from clrecon.operators.points.denoising import denoise_points

    trail.add("bilateral", denoise_points(trail.cloud, paper=settings.paper, **shared))


def _find_normals(trail: Trail, settings: CloudSettings, resident: DeviceVolume | None, shared: dict[str, Any]) -> None:
    """Estimate normals where the points have none: those of a surface have the normals of its field until they move."""
    if not settings.normals or trail.cloud.normals is not None:
        return
    from clrecon.operators.points.normals import estimate_normals

    inside = None if settings.viewpoint is None else in_lps(settings.viewpoint, settings.space)
    trail.add("normals", estimate_normals(trail.cloud, viewpoint=inside, **_with_volume(resident, shared)))


def _thin(trail: Trail, settings: CloudSettings, resident: DeviceVolume | None, shared: dict[str, Any]) -> None:
    if settings.spacing is None:
        return
    from clrecon.operators.points.thinning import thin_points

    trail.add("spacing", thin_points(trail.cloud, settings.spacing, **shared))
