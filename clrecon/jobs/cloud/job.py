"""The cloud job: a CT series or a cloud in, a clean cloud of points out, with its report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.exchange.formats import check_cloud_format, check_format, describe_cloud_losses, stage_cloud, stage_mesh
from clrecon.jobs.cloud.settings import OF_SCANS, CloudSettings
from clrecon.jobs.cloud.steps import CloudSteps, find_ghosts, iso_value_of, take_points, try_steps
from clrecon.jobs.inputs import describe_cloud, is_cloud_file, refuse_other_clouds, refuse_scan_settings
from clrecon.jobs.preprocess import Band, mask_volume, preprocess_volume, restrict_volume
from clrecon.jobs.run import Run, RunReport
from clrecon.points import SURFACE_KINDS
from clrecon.points.cloud import PointCloud
from clrecon.points.ghost_slices import GhostSlices, fill_ghost_slices
from clrecon.system.arguments import name_parameter
from clrecon.system.files import Staged, allow_open_files
from clrecon.system.light_dataclass import dataclass
from clrecon.system.log import get_logger
from clrecon.system.paths import extension_of
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device


log = get_logger(__name__)


def make_cloud(source: str | Path, files: CloudFiles, settings: CloudSettings | None = None, **how: Any) -> CloudReport:
    """Read a CT series or a cloud, run the steps that are asked for, and write the cloud that is left."""
    settings = settings or CloudSettings()
    with Run(settings, **how) as run:
        files.check_formats()
        run.check(files.named, source, settings.labels)
        refuse_other_clouds(source)
        is_cloud = is_cloud_file(source)
        _check_kind(settings, is_cloud)
        (subject, labels), device = run.read_beside(
            partial(try_steps, settings=settings, is_cloud=is_cloud), lambda: _read_input(source, is_cloud, run)
        )
        ghosts = None
        if not is_cloud and settings.masks:
            subject, ghosts = _mask_scan(subject, device, settings, run.progress)  # type: ignore[arg-type]
            run.lap("mask")
        steps = take_points(subject, labels, device, settings, run.progress, ghosts)
        run.lap("steps")
        steps.check(settings.allow_point_loss)
        surface = None if files.surface is None else _reconstruct_surface(steps, settings, device.current, run.progress)
        run.lap("surface")
        outputs, losses = _write_files(run, steps, surface, files)
        report = report_of(run, subject, steps, device.current, surface=surface, outputs=outputs, losses=losses)
        run.finish(report, files.report)
    log.info("%d points of %d on %s in %.3f s", report.points, report.points_first, report.device, run.total())
    return report


def _check_kind(settings: CloudSettings, is_cloud: bool) -> None:
    if is_cloud:
        refuse_scan_settings(settings, OF_SCANS)
    elif settings.input_space is not None:
        raise UsageError(
            f"a scan says its own frame: leave out {name_parameter('input_space')}, which is for clouds of points"
        )
    elif settings.paper and settings.kind in SURFACE_KINDS:
        raise UsageError(
            "the formulas of the papers are for voxel centres, not for points of a surface: give a band too"
            f" ({name_parameter('hu')}), or {name_parameter('points', 'voxels')}"
        )
    elif settings.viewpoint is not None:
        raise UsageError(
            f"the HU of a scan turn its normals out of bone: leave out {name_parameter('viewpoint')}, which is for"
            " clouds of points"
        )


def _read_input(source: str | Path, is_cloud: bool, run: Run) -> tuple[Volume | PointCloud, LabelMap | None]:
    settings: CloudSettings = run.settings
    if is_cloud:
        from clrecon.points.cloud_reader import read_points

        run.progress("read", 0, 0)
        return read_points(source, space=settings.input_space), None
    if settings.labels is None:
        return run.read(source), None
    return run.read_labelled(source, None if settings.label is None else [settings.label])


def _mask_scan(
    volume: Volume, device: Device, settings: CloudSettings, progress: Progress
) -> tuple[Volume, GhostSlices]:
    """Turn what the settings name into air; ghost slices are found before, and do not tie the body to its table."""
    from clrecon.operators.resident.device_volume import DeviceVolume

    with DeviceVolume(volume, device=device.current, memory=settings.memory) as resident:
        ghosts = find_ghosts(resident, iso_value_of(settings), settings, progress)
    if settings.ghost_slices == "drop":
        volume = fill_ghost_slices(volume, ghosts)
    level = iso_value_of(settings)
    band: Band = tuple(settings.hu) if settings.is_band else (level, math.inf)  # type: ignore[arg-type, assignment]
    volume = mask_volume(volume, settings, progress)
    volume = restrict_volume(volume, settings, device, [band], progress)
    return preprocess_volume(volume, settings, device, [band], progress), ghosts


def _reconstruct_surface(steps: CloudSteps, settings: CloudSettings, device: Device, progress: Progress) -> Mesh:
    of_scan = any(step["step"] == "points" for step in steps.entries)
    if steps.cloud.normals is None:
        more = "" if of_scan else f", and name a point inside of the cloud ({name_parameter('viewpoint')})"
        raise UsageError(
            f"a surface needs points with normals out of bone: ask for them ({name_parameter('normals', True)}){more}"
        )
    if any(step["step"] == "normals" and step["oriented_by"] is None for step in steps.entries):
        raise UsageError(
            "a surface needs normals that point outward, and those of this cloud have either direction: name a point"
            f" inside of it ({name_parameter('viewpoint')})"
        )
    from clrecon.operators.points.reconstruct import reconstruct_surface

    progress("surface", 0, 0)
    mesh: Mesh = reconstruct_surface(steps.cloud, device=device, memory=settings.memory, progress=progress)
    return mesh


def _write_files(
    run: Run, steps: CloudSteps, surface: Mesh | None, files: CloudFiles
) -> tuple[list[dict[str, Any]], list[str]]:
    """Write the files but the report; return their entries, and warnings of what the cloud's format cannot hold."""
    space, keep_ids = run.settings.space, run.settings.keep_ids
    run.progress("write", 0, 0)
    allow_open_files(4)
    outputs: list[dict[str, Any]] = []
    for role, path in (("cloud", files.output), ("removed", files.removed)):
        if path is not None:
            chosen = steps.cloud if role == "cloud" else steps.removed_cloud()
            outputs.append(describe_file(role, path, run.stage(stage_cloud(chosen, path, space, keep_ids=keep_ids))))
    if surface is not None and files.surface is not None:
        file = run.stage(stage_mesh(surface, files.surface, space, keep_ids=keep_ids))
        outputs.append(describe_file("surface", files.surface, file))
    losses = describe_cloud_losses(steps.cloud.describe(space, with_ijk=False), f".{outputs[0]['format']}")
    run.lap("write")
    return outputs, losses


@dataclass(frozen=True)
class CloudFiles:
    """Files that a cloud job writes; in `removed` each point is labelled with the number of the reason why it went."""

    output: str | Path
    removed: str | Path | None = None
    surface: str | Path | None = None
    report: str | Path | None = None

    @property
    def named(self) -> list[tuple[str, str | Path | None]]:
        return [
            ("the cloud", self.output),
            ("the cloud of removed points", self.removed),
            ("the surface", self.surface),
            ("the report", self.report),
        ]

    def check_formats(self) -> None:
        check_cloud_format(self.output)
        if self.removed is not None:
            check_cloud_format(self.removed)
        if self.surface is not None:
            check_format(self.surface)


@dataclass(frozen=True, eq=False, kw_only=True)
class CloudReport(RunReport):
    SCHEMA = "cloud"

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


def describe_file(role: str, path: str | Path, file: Staged) -> dict[str, Any]:
    return {"what": role, "format": extension_of(path)[1:], "bytes": file.size}


def report_of(
    run: Run,
    subject: Volume | PointCloud,
    steps: CloudSteps,
    device: Device,
    *,
    surface: Mesh | None,
    outputs: list[dict[str, Any]],
    losses: Sequence[str],
) -> CloudReport:
    """Compose the report of a job on what was read, the `subject`; `losses` are warnings of the cloud's format."""
    settings: CloudSettings = run.settings
    cloud, first = steps.cloud, steps.first.report
    volume = None if isinstance(subject, PointCloud) else subject
    read = describe_cloud(subject) if isinstance(subject, PointCloud) else None
    of_file = ((read or {}).get("file") or {}).get("warnings", ())
    of_surface = () if surface is None else surface.report["warnings"]
    # an axis at a time: ten times as fast as along axis 0
    points, _ = cloud.in_space(settings.space)
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
        bounds_mm=[[float(column.min()) for column in points.T], [float(column.max()) for column in points.T]],
        space=settings.space,
        paper=settings.paper,
        steps=steps.entries,
        gates=[gate.as_dict() for gate in steps.gates],
        removed_labels=[{"label": number, "reason": reason} for number, reason in enumerate(("kept", *steps.reasons))]
        if any(file["what"] == "removed" for file in outputs)
        else None,
        surface=None if surface is None else _describe_surface(surface),
        outputs=outputs,
    )


def _describe_surface(mesh: Mesh) -> dict[str, Any]:
    names = ("spacing_mm", "bridge_mm", "votes_against_share", "wall_share", "lost_share", "open_cubes", "warnings")
    facts = {name: mesh.report.get(name) for name in names}
    return {"vertices": mesh.vertex_count, "triangles": mesh.triangle_count, **facts}
