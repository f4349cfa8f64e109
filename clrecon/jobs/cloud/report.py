"""The report of a cloud job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from clrecon.jobs.cloud.settings import CloudSettings
from clrecon.jobs.cloud.steps import CloudSteps, name_reasons
from clrecon.jobs.inputs import describe_cloud
from clrecon.jobs.run import Run, RunReport
from clrecon.system.paths import extension_of

if TYPE_CHECKING:
    from pathlib import Path

    from clrecon.geometry import Volume
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.points import PointCloud
    from clrecon.system.files import Staged


@dataclass(frozen=True, eq=False, kw_only=True)
class CloudReport(RunReport):
    """The report of a cloud job; docs/contract.md explains its entries."""

    PARTS = ("device", "read", "mask", "steps", "surface", "write")

    kind: str | None
    iso_value_hu: float | None
    hu: list[float | None] | None
    label: str | None
    cloud_read: Mapping[str, Any] | None
    points: int
    points_first: int
    removed: Mapping[str, int]
    normals: bool
    has_hu: bool
    labels: bool
    bounds_mm: list[list[float]]
    space: str
    unit: str = "mm"
    paper: bool
    steps: list[dict[str, Any]]
    gates: list[dict[str, Any]]
    removed_labels: list[dict[str, Any]] | None
    surface: Mapping[str, Any] | None
    outputs: list[dict[str, Any]]


def describe_file(what: str, path: str | Path, file: Staged) -> dict[str, Any]:
    """Return one entry of ``outputs``."""
    return {"what": what, "format": extension_of(path)[1:], "bytes": file.size}


def report_of(
    run: Run,
    subject: Volume | PointCloud,
    steps: CloudSteps,
    device: Device,
    *,
    surface: Mesh | None,
    has_removed: bool,
    outputs: list[dict[str, Any]],
    losses: Sequence[str],
) -> CloudReport:
    """Compose the report of a job on what was read, the `subject`; `losses` are warnings of the cloud's format."""
    from clrecon.points import PointCloud

    settings: CloudSettings = run.settings
    cloud, first = steps.cloud, steps.first.report
    volume = None if isinstance(subject, PointCloud) else subject
    read = describe_cloud(subject) if isinstance(subject, PointCloud) else None
    of_file = ((read or {}).get("file") or {}).get("warnings", ())
    of_surface = () if surface is None else surface.report["warnings"]
    return run.report(
        CloudReport,
        [*of_file, *device.warnings, *steps.warnings, *of_surface, *losses],
        volume,
        on=device,
        affine_ijk_to_lps_mm=first.get("affine_ijk_to_lps_mm") if volume is None else volume.affine.tolist(),
        kind=None if volume is None else settings.kind,
        iso_value_hu=first.get("iso_value_hu"),
        hu=first.get("band_hu"),
        label=settings.label,
        cloud_read=read,
        points=len(cloud),
        points_first=len(steps.first),
        removed=steps.counts,
        normals=cloud.normals is not None,
        has_hu=cloud.hu is not None,
        labels=cloud.labels is not None,
        bounds_mm=_bounds(cloud, settings.space),
        space=settings.space,
        paper=settings.paper,
        steps=steps.entries,
        gates=[gate.as_dict() for gate in steps.gates],
        removed_labels=name_reasons(steps.reasons) if has_removed else None,
        surface=None if surface is None else _describe_surface(surface),
        outputs=outputs,
    )


def _describe_surface(mesh: Mesh) -> dict[str, Any]:
    names = ("spacing_mm", "bridge_mm", "votes_against_share", "wall_share", "lost_share", "open_cubes", "warnings")
    facts = {name: mesh.report.get(name) for name in names}
    return {"vertices": mesh.vertex_count, "triangles": mesh.triangle_count, **facts}


def _bounds(cloud: PointCloud, space: str) -> list[list[float]]:
    points, _ = cloud.in_space(space)  # an axis at a time: ten times as fast as along axis 0
    return [[float(column.min()) for column in points.T], [float(column.max()) for column in points.T]]
