"""The render job: from a CT series to pictures, moving pictures and their report."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs.render.files import PictureFiles, check_pictures, format_of, name_view, stage_picture
from clrecon.jobs.render.report import (
    PictureReport,
    describe_picture,
    describe_pictures,
    find_emptiness,
    warn_of_picture,
)
from clrecon.jobs.render.settings import RenderSettings
from clrecon.jobs.render.studio import Studio, read_curve, read_function, read_look
from clrecon.jobs.shared.clouds import is_cloud_file, is_mesh_file, refuse_scan_settings
from clrecon.jobs.shared.labelled import read_with_labels
from clrecon.jobs.shared.laps import Laps
from clrecon.jobs.shared.masking import mask_volume
from clrecon.jobs.shared.opening import DeviceOpening
from clrecon.jobs.shared.outputs import check_kept, commit_all
from clrecon.jobs.shared.preprocess import preprocess_volume
from clrecon.jobs.shared.region import Band, restrict_volume
from clrecon.jobs.shared.report import stage_report
from clrecon.mesh import Mesh
from clrecon.mesh.reader import read_mesh
from clrecon.reading import read_selected
from clrecon.rendering.pictures.styles import Projection, SurfaceLook
from clrecon.system.files import allow_open_files
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.opencl import Device
    from clrecon.points import PointCloud
    from clrecon.rendering import Rendering
    from clrecon.system.files import Staged

log = get_logger(__name__)


def make_pictures(
    source: str | Path,
    files: PictureFiles,
    settings: RenderSettings | None = None,
    *,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> PictureReport:
    """Read a CT series or a cloud and take the pictures that are asked for.

    Checks come in this order: the outputs, the settings files (transfer function, centre line, meshes), the device, the
    input.  Pictures and turntable are written under temporary names and renamed when all are done.  The report is
    renamed last: it marks that everything is complete.

    source: DICOM folder or file, or a file of another format, see `clrecon.reading.read_volume`; for mode points a file
        of points, see `clrecon.read_points`, and for mode mesh one of a mesh, see `clrecon.read_mesh`.
    no_clobber: What exists stays and is an `OutputError`, before any work; an empty folder of frames is filled.
    progress: ``progress(stage, done, total)``.
    """
    settings = settings or RenderSettings()
    progress = progress or ignore_progress
    if (files.turntable is None) != (settings.turntable is None):
        raise UsageError("a turntable needs both: where it goes, and how it turns")
    watch = Laps()
    with keep_existing(no_clobber):
        outputs = check_pictures(files, settings)
    check_kept(outputs, source, *settings.files_read)
    allow_open_files(3 * len(settings.views_used) + 2)  # 3 for each view, turntable and report
    function = read_function(settings.transfer_function)
    curve = read_curve(settings.curve)
    meshes = [read_mesh(mesh.path, space=settings.mesh_space) for mesh in settings.meshes]

    subject, labels, device = _open(source, settings, progress, watch)
    studio = Studio(
        subject, device, settings, function=function, curve=curve, labels=labels, meshes=meshes, progress=progress
    )
    with (
        keep_existing(no_clobber),
        studio,
        ExitStack() as staged,
    ):  # all files are on the disk before any of them replaces an older one
        pictures, written = _take_views(studio, settings, files, staged, watch, progress)
        turntable, moving = _turn(studio, settings, files, staged, watch, progress)
        written += moving
        device = device.current
        report = describe_pictures(subject, settings, studio, device, pictures, turntable, _seconds(watch))
        if files.report is not None:
            written.append(staged.enter_context(stage_report(files.report, report)))
        commit_all(written)
    log_warnings(log, report.warnings, subject.report.get("warnings", ()))
    log.info("%d files of pictures made on %s in %.3f s", len(written), device.label, watch.total())
    return report


def _open(
    source: str | Path, settings: RenderSettings, progress: Progress, watch: Laps
) -> tuple[Volume | PointCloud | Mesh, LabelMap | None, Device]:
    """Read the scan and its labels, the cloud or the mesh, while the device opens and builds its kernels."""
    is_mesh = settings.mode == "mesh"
    is_cloud = is_cloud_file(source) and not is_mesh
    if is_mesh:
        refuse_scan_settings(settings, noun="a mesh")
    elif is_mesh_file(source):
        raise UsageError(f"the input is a mesh, which mode mesh shows, and not mode {settings.mode}")
    elif is_cloud != (settings.mode == "points"):
        raise UsageError(
            f"the input is a cloud of points, which mode points shows, and not mode {settings.mode}"
            if is_cloud
            else "mode points shows a file of points, and the input is none: make a cloud of it first"
        )
    if is_cloud:
        refuse_scan_settings(settings)
    progress("device", 0, 0)
    with DeviceOpening(settings.device, partial(_prepare, settings=settings)) as opening:
        subject: Volume | PointCloud | Mesh
        labels = None
        if is_mesh:
            progress("read", 0, 0)
            subject = read_mesh(source, space=settings.mesh_space)
        elif is_cloud:
            from clrecon.points.reader import read_points

            progress("read", 0, 0)
            subject = read_points(source)
        else:
            subject, labels = read_with_labels(
                partial(read_selected, source, settings, progress=progress),
                None if settings.labels is None else settings.labels.path,
                partial(read_look, settings.labels),
            )
        watch.lap("read")
        device = opening.wait()
        watch.lap("device")
    if not (is_cloud or is_mesh):
        subject = _narrow(subject, settings, device, progress)  # type: ignore[arg-type]
        watch.lap("mask")
    return subject, labels, device


def _narrow(volume: Volume, settings: RenderSettings, device: Device, progress: Progress) -> Volume:
    """Turn what the settings name into air, and run the steps of preprocessing."""
    style = settings.style
    bands: list[Band] = [(style.iso_value, math.inf)] if isinstance(style, SurfaceLook) else []
    volume = mask_volume(volume, settings, progress)
    if isinstance(style, Projection) and style.leaves_out:
        return _leave_out(volume, settings, device, progress)
    volume = restrict_volume(volume, settings, device, bands, progress)
    return preprocess_volume(volume, settings, device, bands, progress)


def _leave_out(volume: Volume, settings: RenderSettings, device: Device, progress: Progress) -> Volume:
    """Leave out what lies outside of the body and of the region, whose voxels get a value above those that count."""
    from clrecon.anatomy.surroundings import LEFT_OUT, leave_out_surroundings
    from clrecon.geometry.certificate import amend

    measured = volume.report.get("hu_range")
    volume = leave_out_surroundings(volume, progress=progress)
    bands: list[Band] = [(-math.inf, volume.report[LEFT_OUT]["value_hu"] - 1.0)]
    volume = restrict_volume(volume, settings, device, bands, progress)
    volume = preprocess_volume(volume, settings, device, bands, progress)
    volume.report = amend(volume.report, hu_range=measured)
    return volume


def _prepare(device: Device, settings: RenderSettings) -> None:
    """Build the kernels for int16 by taking a small picture of an empty volume, or of one point."""
    import numpy as np

    from clrecon.geometry import Volume
    from clrecon.points import PointCloud

    if settings.mode == "mesh":
        small = RenderSettings.of("mesh", size=(8, 8))
        with Studio(Mesh(np.eye(3), [(0, 1, 2)]), device, small, progress=ignore_progress) as studio:
            studio.take_view("anterior")
        return
    if settings.mode == "points":
        small = RenderSettings.of("points", size=(8, 8))
        with Studio(PointCloud([(0.0, 0.0, 0.0)]), device, small, progress=ignore_progress) as studio:
            studio.take_view("anterior")
        return
    nothing = Volume(np.zeros((2, 2, 2), np.int16), np.eye(4))
    mode = "slice" if settings.mode == "cpr" else settings.mode  # the same kernel, and no curve is needed
    small = RenderSettings.of(mode, size=(8, 8), iso_value=0.0 if mode == "surface" else None)
    with Studio(nothing, device, small, progress=ignore_progress) as studio:
        studio.take_view("anterior")


def _take_views(
    studio: Studio,
    settings: RenderSettings,
    files: PictureFiles,
    staged: ExitStack,
    watch: Laps,
    progress: Progress,
) -> tuple[list[dict[str, Any]], list[Staged]]:
    """Take the picture of each view and write it under a temporary name; returns the report's entries of them."""
    pictures: list[dict[str, Any]] = []
    written: list[Staged] = []
    if files.picture is None:
        return pictures, written
    views = studio.views
    for place, view in enumerate(views):
        progress("render", place, len(views) if len(views) > 1 else 0)
        picture = studio.take_view(view)
        watch.lap("render")
        name = name_view(view, views)
        own = stage_picture(staged, picture, files, name)
        outputs = {what: {"format": format_of(path), "bytes": file.size} for what, (path, file) in own.items()}
        pictures.append(describe_picture(picture, name, view) | outputs)
        studio.warnings += warn_of_picture(picture, studio.device.warnings)
        written += [file for _, file in own.values()]
        watch.lap("write")
    return pictures, written


def _turn(
    studio: Studio,
    settings: RenderSettings,
    files: PictureFiles,
    staged: ExitStack,
    watch: Laps,
    progress: Progress,
) -> tuple[dict[str, Any] | None, list[Staged]]:
    """Write the turntable frame by frame under a temporary name; returns the report's entry of it."""
    turn = settings.turntable
    if files.turntable is None or turn is None:
        return None, []
    from clrecon.rendering.movies.movie import animation_kind, stage_animation, turntable_cameras

    first = settings.camera(studio.box, studio.views[0], turning=True)
    cameras = turntable_cameras(first, turn.frames, turn.degrees)

    empty: list[str] | None = []

    def frames() -> Iterator[Rendering]:
        nonlocal empty
        for camera in cameras:
            picture = studio.take(camera)
            why = None if empty is None else find_emptiness(picture)
            empty = None if empty is None or why is None else [*empty, why]
            yield picture

    progress("frames", 0, turn.frames)
    moving = staged.enter_context(
        stage_animation(frames(), files.turntable, turn.fps, total=turn.frames, progress=progress)
    )
    seconds = watch.lap("turntable")
    studio.warnings += (empty or [])[:1]  # one frame that is not empty is enough
    described = {
        "frames": turn.frames,
        "fps": turn.fps,
        "degrees": turn.degrees,
        "seconds_a_frame": round(seconds / turn.frames, 4),
        "output": {"format": animation_kind(files.turntable)[1:] or "folder", "bytes": moving.size},
    }
    return described, [moving]


def _seconds(watch: Laps) -> dict[str, float]:
    parts = ("device", "read", "mask", "render", "turntable", "write")
    seconds = {part: watch.seconds.get(part, 0.0) for part in parts}
    seconds["other"] = max(0.0, watch.total() - sum(seconds.values()))
    seconds["total"] = watch.total()
    return {part: round(value, 4) for part, value in seconds.items()}
