"""The cloud job: a CT series or a cloud in, a clean cloud of points out, with its report."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs.cloud.report import CloudReport, describe_clouds, describe_file
from clrecon.jobs.cloud.settings import OF_SCANS, CloudSettings
from clrecon.jobs.cloud.steps import CloudSteps, find_ghosts, iso_value_of, prepare_chain, take_points
from clrecon.jobs.inputs import is_cloud_file, read_with_labels, refuse_other_clouds, refuse_scan_settings
from clrecon.jobs.outputs import check_distinct, check_kept, commit_all
from clrecon.jobs.preprocess import Band, mask_volume, preprocess_volume, restrict_volume
from clrecon.jobs.run import DeviceOpening, Laps, stage_report
from clrecon.reading import read_selected
from clrecon.system.arguments import name_parameter
from clrecon.system.files import allow_open_files
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import keep_existing, refuse_existing, resolve_target
from clrecon.system.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.points import PointCloud
    from clrecon.points.ghost_slices import GhostSlices
    from clrecon.system.files import Staged


log = get_logger(__name__)


def make_cloud(
    source: str | Path,
    files: CloudFiles,
    settings: CloudSettings | None = None,
    *,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> CloudReport:
    """Read a CT series or a cloud, run the steps that are asked for, and write the cloud that is left.

    The steps run in the order of `clrecon.jobs.cloud.settings.STEPS`.  Checks come first: the outputs, then the device,
    then the input.  All files are written under temporary names and renamed when all are done; the report comes last,
    as the commit mark.

    source: DICOM folder or file, a file of another format, or a file of points, see `clrecon.read_points`.
    no_clobber: Files that exist stay and are an `OutputError`, before any work.
    progress: ``progress(stage, done, total)``.
    """
    settings = settings or CloudSettings()
    progress = progress or ignore_progress
    watch = Laps()
    with keep_existing(no_clobber):
        outputs = files.check()
        for _, path in outputs:
            refuse_existing(path, resolve_target(path))
    check_kept(outputs, source, settings.labels)
    refuse_other_clouds(source)
    is_cloud = is_cloud_file(source)
    if is_cloud:
        refuse_scan_settings(settings, OF_SCANS)
    elif settings.input_space is not None:
        raise UsageError(
            f"a scan says its own frame: leave out {name_parameter('input_space')}, which is for clouds of points"
        )
    elif settings.paper and settings.kind == "surface":
        raise UsageError(
            "the formulas of the papers are for voxel centres, not for points of a surface: give a band too"
            f" ({name_parameter('hu')}), or {name_parameter('points', 'voxels')}"
        )
    elif settings.viewpoint is not None:
        raise UsageError(
            f"the HU of a scan turn its normals out of bone: leave out {name_parameter('viewpoint')}, which is for"
            " clouds of points"
        )

    subject, labels, device = _open_input(source, is_cloud, settings, progress, watch)
    ghosts = None
    if not is_cloud and settings.masks:
        subject, ghosts = _mask_scan(subject, device, settings, progress)  # type: ignore[arg-type]
        watch.lap("mask")
    steps = take_points(subject, labels, device, settings, progress, ghosts)
    watch.lap("steps")
    steps.check(settings.allow_point_loss)
    surface = _reconstruct_surface(steps, files, settings, device.current, progress)
    watch.lap("surface")
    with keep_existing(no_clobber):
        report = _write_files(subject, steps, surface, files, settings, device.current, watch, progress)
    log_warnings(log, report.warnings, subject.report.get("warnings", ()))
    log.info("%d points of %d on %s in %.3f s", report.points, report.points_first, report.device, watch.total())
    return report


def _open_input(
    source: str | Path, is_cloud: bool, settings: CloudSettings, progress: Progress, watch: Laps
) -> tuple[Volume | PointCloud, LabelMap | None, Device]:
    """Read the input while the device opens and builds its kernels."""
    progress("device", 0, 0)
    labels = None
    subject: Volume | PointCloud
    with DeviceOpening(settings.device, partial(prepare_chain, settings=settings, is_cloud=is_cloud)) as opening:
        if is_cloud:
            from clrecon.points.cloud_reader import read_points

            progress("read", 0, 0)
            subject = read_points(source, space=settings.input_space)
        else:
            subject, labels = read_with_labels(
                partial(read_selected, source, settings, progress=progress),
                settings.labels,
                partial(_read_map, settings),
            )
        watch.lap("read")
        device = opening.wait()
        watch.lap("device")
    return subject, labels, device


def _mask_scan(
    volume: Volume, device: Device, settings: CloudSettings, progress: Progress
) -> tuple[Volume, GhostSlices]:
    """Turn what the settings name into air; ghost slices are found before, and do not tie the body to its table."""
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.points.ghost_slices import fill_ghost_slices

    with DeviceVolume(volume, device=device.current, memory=settings.memory) as resident:
        ghosts = find_ghosts(resident, iso_value_of(settings), settings, progress)
    if settings.ghost_slices == "drop":
        volume = fill_ghost_slices(volume, ghosts)
    level = iso_value_of(settings)
    band: Band = tuple(settings.hu) if settings.is_band else (level, math.inf)  # type: ignore[arg-type, assignment]
    volume = mask_volume(volume, settings, progress)
    volume = restrict_volume(volume, settings, device, [band], progress)
    return preprocess_volume(volume, settings, device, [band], progress), ghosts


def _read_map(settings: CloudSettings, volume: Volume | None) -> LabelMap | None:
    if settings.labels is None:
        return None
    from clrecon.labels import read_labels

    return read_labels(settings.labels, None if settings.label is None else [settings.label], volume=volume)


def _reconstruct_surface(
    steps: CloudSteps, files: CloudFiles, settings: CloudSettings, device: Device, progress: Progress
) -> Mesh | None:
    """Make the mesh around the points, if its file is named."""
    if files.surface is None:
        return None
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
    return reconstruct_surface(steps.cloud, device=device, memory=settings.memory, progress=progress)


def _write_files(
    subject: Volume | PointCloud,
    steps: CloudSteps,
    surface: Mesh | None,
    files: CloudFiles,
    settings: CloudSettings,
    device: Device,
    watch: Laps,
    progress: Progress,
) -> CloudReport:
    """Write all files, the report as the last one, and return it."""
    from clrecon.exchange.formats import describe_cloud_losses, stage_cloud

    space, ids = settings.space, settings.keep_ids
    progress("write", 0, 0)
    allow_open_files(4)
    written: list[Staged] = []
    entries: list[dict[str, Any]] = []
    with ExitStack() as staged:  # all files are on the disk before the first replaces an older one
        wanted = [("cloud", files.output, steps.cloud), ("removed", files.removed, None)]
        for what, path, cloud in wanted:
            if path is not None:
                chosen = steps.removed_cloud() if cloud is None else cloud
                file = staged.enter_context(stage_cloud(chosen, path, space, keep_ids=ids))
                written.append(file)
                entries.append(describe_file(what, path, file.size))
        if surface is not None and files.surface is not None:
            from clrecon.exchange.formats import stage_mesh  # with all its writers

            mesh_file = staged.enter_context(stage_mesh(surface, files.surface, space, keep_ids=ids))
            written.append(mesh_file)
            entries.append(describe_file("surface", files.surface, mesh_file.size))
        losses = describe_cloud_losses(steps.cloud.describe(space, with_ijk=False), f".{entries[0]['format']}")
        watch.lap("write")
        report = describe_clouds(
            subject, steps, settings, device, surface=surface, has_removed=files.removed is not None, outputs=entries,
            warnings=[*steps.warnings, *(surface.report["warnings"] if surface is not None else ()), *losses],
            seconds=_seconds(watch),
        )  # fmt: skip
        if files.report is not None:
            written.append(staged.enter_context(stage_report(files.report, report)))
        commit_all(written)
    return report


def _seconds(watch: Laps) -> dict[str, float]:
    parts = ("device", "read", "mask", "steps", "surface", "write")
    seconds = {part: watch.seconds.get(part, 0.0) for part in parts}
    seconds["other"] = max(0.0, watch.total() - sum(seconds.values()))
    seconds["total"] = watch.total()
    return {part: round(value, 4) for part, value in seconds.items()}


@dataclass(frozen=True)
class CloudFiles:
    """Files that a cloud job writes.

    output: The cloud: ``.ply``, ``.vtp``, ``.npz``, ``.xyz`` or ``.las``.
    removed: The points as they were extracted, each with the number of the reason why it went as its label; 0 is kept.
    surface: A closed mesh around the cloud, in a format of meshes.
    report: The report as JSON.
    """

    output: str | Path
    removed: str | Path | None = None
    surface: str | Path | None = None
    report: str | Path | None = None

    def check(self) -> list[tuple[str, str | Path]]:
        """Refuse outputs that cannot be written, before any work is done.

        Returns: list of (str, path). Description and path of each output.
        """
        from clrecon.exchange.formats import check_cloud_format
        from clrecon.system.files import check_writable

        named = [
            ("the cloud", self.output),
            ("the cloud of removed points", self.removed),
            ("the surface", self.surface),
            ("the report", self.report),
        ]
        outputs = [(what, path) for what, path in named if path is not None]
        for path in (self.output, self.removed):
            if path is not None:
                check_cloud_format(path)
        if self.surface is not None:
            from clrecon.exchange.formats import check_format

            check_format(self.surface)
        check_distinct(outputs)
        for _, path in outputs:
            check_writable(path)
        return outputs
