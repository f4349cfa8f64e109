"""The render job: from a CT series to pictures, animations and their report, of the whole job and of each picture."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.anatomy.head import SKIN_SEEN_HU, warn_of_face
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.certificate import amend
from clrecon.jobs.devices import list_usable
from clrecon.jobs.inputs import describe_cloud, holds_triangles, is_cloud_file, read_with_labels, refuse_scan_settings
from clrecon.jobs.outputs import check_distinct, check_files, check_kept
from clrecon.jobs.preprocess import Band, mask_volume, preprocess_volume, restrict_volume
from clrecon.jobs.render.picture_taker import Beside, PictureTaker, read_curve, read_function, read_look
from clrecon.jobs.render.settings import LabelLook, RenderSettings
from clrecon.jobs.run import Run, RunReport
from clrecon.labels import LabelMap, file_suffixes
from clrecon.mesh import Mesh
from clrecon.mesh.mesh_reader import read_mesh
from clrecon.points.cloud import PointCloud
from clrecon.rendering.movies import animation_kind, check_animation, stage_animation, turntable_cameras
from clrecon.rendering.pictures.annotations import check_caption, edge_letters
from clrecon.rendering.pictures.label_style import NO_LABEL, find_shown
from clrecon.rendering.pictures.modes import check_known
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.picture import check_float_path, check_image_path, encode_floats
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.rendering.pictures.styles import CurveCut, PlaneCut, Projection, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import describe_camera
from clrecon.system.arguments import name_parameter
from clrecon.system.files import StagedFile, allow_open_files
from clrecon.system.light_dataclass import asdict, dataclass
from clrecon.system.log import get_logger
from clrecon.system.paths import extension_of
from clrecon.system.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from clrecon.opencl import Device
    from clrecon.rendering import Rendering, TransferFunction


def describe_picture(picture: Rendering, name: str, view: str) -> dict[str, Any]:
    """Make one entry of ``pictures``, without the files; ranges are None for a picture without values or hits."""
    report = picture.report
    values = None if picture.values is None else _range(picture.values[np.isfinite(picture.values)])
    is_water = picture.mode == "drr"
    hit = np.isfinite(picture.depth)
    return {
        "name": name or None,
        "view": view,
        "size": list(picture.size),
        "camera": None if picture.camera is None else describe_camera(picture.camera),
        "pixel_mm": picture.pixel_mm,
        "hit_share": float(hit.mean()) if picture.camera is not None else None,
        "depth_mm": _range(picture.depth[hit]),
        "values_hu": None if is_water else values,
        "window_hu": report.get("window_hu"),
        "values_mm_water": values if is_water else None,
        "window_mm_water": report.get("window_mm_water"),
        **{name: report.get(name) for name in ("ray_step_mm", "smooth_light_mm", "slices", "plane", "curve")},
        "edges": report.get("edges") if picture.camera is None else edge_letters(picture.camera),
        "points": _describe_points(report),
        **{name: report.get(name) for name in ("left_out", "labels", "tiles", "tile_size")},
        "slabs": report.get("slabs", 1),
        "seconds": report.get("seconds"),
    }


def _describe_points(report: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return how the points of a cloud are shown; None in other modes."""
    if report.get("mode") != "points":
        return None
    return {name: report[name] for name in ("points", "radius_mm", "color_by", "shading", "legend", "legend_left_out")}


_NOUNS = {"points": "cloud", "mesh": "mesh"}


def find_emptiness(picture: Rendering) -> str | None:
    values = None if picture.values is None else picture.values[np.isfinite(picture.values)]
    if values is None or not values.size:
        if np.isfinite(picture.depth).any() or picture.mode == "presets":
            return None
        return (
            f"nothing of the {_NOUNS.get(picture.mode, 'volume')} shows in mode {picture.mode}:"
            " look at view and zoom, at what is clipped, and at the iso value or the transfer function"
        )
    is_water = picture.mode == "drr"
    low, high = picture.report.get("window_mm_water" if is_water else "window_hu") or (-np.inf, np.inf)
    if not (values.max() <= low or values.min() >= high):
        return None
    shade = "black" if values.max() <= low else "white"
    shown, unit = f"{values.min():g} to {values.max():g}", "mm of water" if is_water else "HU"
    is_kept = picture.mode == "minip" and "left_out" not in picture.report
    air = f": the air round the body is the lowest, do not keep it ({name_parameter('keep_air')})" if is_kept else ""
    return f"all of the picture is {shade}: its {shown} {unit} lie beyond the window from {low:g} to {high:g}{air}"


def warn_of_picture(picture: Rendering, known: Collection[str] = ()) -> list[str]:
    """Return warnings about a picture; those that are `known` are about its device."""
    report = picture.report
    warnings = [str(text) for text in report.get("warnings", []) if text not in known]
    empty = find_emptiness(picture)
    if empty is not None and not warnings:  # slices seen edge-on have a warning of their own
        warnings.append(empty)
    taken_curve = (report.get("curve") or {}).get("found")
    if taken_curve is not None:
        warnings.append("the centre line is the spinal canal as it was found: look whether it is the canal")
    return warnings


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureReport(RunReport):
    """Report of a render job; docs/contract.md explains its entries, None where a mode has no such thing."""

    SCHEMA = "render"

    PARTS = ("device", "read", "mask", "render", "turntable", "write")

    mode: str
    preset: str | None
    transfer_function: Mapping[str, Any] | None
    iso_value_hu: float | None
    color: Any
    depth_cue: float | None
    lighting: Mapping[str, Any] | None
    shadows: bool
    ambient_occlusion: float
    jitter: bool
    background: Any
    dpi: float | None
    clip_planes_lps_mm: list[list[float]]
    thickness_mm: float | None
    combine: str | None
    offset_mm: float | None
    labels: list[dict[str, Any]] | None
    meshes: list[dict[str, Any]]
    cloud: Mapping[str, Any] | None
    pictures: list[dict[str, Any]]
    turntable: Mapping[str, Any] | None


def report_of(
    run: Run,
    subject: Volume | PointCloud | Mesh,
    taker: PictureTaker,
    device: Device,
    pictures: Sequence[dict[str, Any]],
    turntable: dict[str, Any] | None,
) -> PictureReport:
    """Compose the report of a job; the `taker` knows transfer function, light and warnings."""
    settings: RenderSettings = run.settings
    volume = subject if isinstance(subject, Volume) else None
    cloud = describe_cloud(subject) if isinstance(subject, PointCloud) else None
    meshes = _describe_meshes(subject, settings, taker)
    files = [(each or {}).get("file") or {} for each in (cloud, *meshes)]
    face = [] if volume is None else warn_of_face(volume, _skin_shown(taker.style), "picture")
    style, lighting = taker.style, taker.lighting
    clip = getattr(style, "clip", None)
    surface = style if isinstance(style, SurfaceLook) else None
    colored = style if isinstance(style, SurfaceLook | PointLook | MeshLook) else None
    return run.report(
        PictureReport,
        [*chain(*(own.current.warnings for own in taker.devices)), *taker.warnings, *face],
        volume,
        on=device,
        **_name_devices(taker) if settings.uses_all_devices else {},
        before=list(chain(*(file.get("warnings", ()) for file in files))),
        affine_ijk_to_lps_mm=subject.report.get("affine_ijk_to_lps_mm") if volume is None else volume.affine.tolist(),
        mode=style.mode,
        preset=settings.preset_used,
        transfer_function=_describe_function(taker.function),
        iso_value_hu=None if surface is None else surface.iso_value,
        color=None if colored is None else colored.color,
        depth_cue=None if surface is None else surface.depth_cue,
        lighting=None if lighting is None else asdict(lighting),
        shadows=getattr(style, "shadows", False),
        ambient_occlusion=getattr(style, "ambient_occlusion", 0.0),
        jitter=getattr(style, "jitter", False),
        background=settings.background,
        dpi=settings.dpi,
        clip_planes_lps_mm=[] if clip is None else clip.planes.tolist(),
        thickness_mm=style.thickness if isinstance(style, PlaneCut | CurveCut) else None,
        combine=style.combine if isinstance(style, PlaneCut | CurveCut) and style.thickness else None,
        offset_mm=style.offset_mm if isinstance(style, PlaneCut) else None,
        labels=_describe_labels(settings.labels, taker.labels),
        meshes=meshes,
        cloud=cloud,
        pictures=list(pictures),
        turntable=turntable,
    )


def _name_devices(taker: PictureTaker) -> dict[str, str]:
    devices = [device.current for device in taker.devices]
    return {
        "device": " and ".join(device.label for device in devices),
        "driver": " and ".join(device.driver for device in devices),
    }


def _describe_meshes(
    subject: Volume | PointCloud | Mesh, settings: RenderSettings, taker: PictureTaker
) -> list[dict[str, Any]]:
    shown = [(subject, taker.style)] if isinstance(subject, Mesh) else []
    described = []
    for mesh, look in [*shown, *zip(taker.meshes, settings.mesh_looks(), strict=True)]:
        assert isinstance(look, MeshLook)
        scale = None if look.color_by is None else look.find_scale(mesh.values)[0]
        described.append(
            {
                "triangles": mesh.triangle_count,
                "color": [round(float(share), 4) for share in look.rgb],
                "color_by": look.color_by,
                "range_mm": None if scale is None else [scale.low, scale.limit],
                "opacity": look.opacity,
                "file": mesh.report.get("file"),
            }
        )
    return described


def _describe_function(function: TransferFunction | None) -> dict[str, Any] | None:
    if function is None:
        return None
    gradient = function.gradient_opacity
    return {
        "points": function.points.tolist(),
        "unit_distance_mm": function.unit_distance,
        "gradient_opacity": None if gradient is None else gradient.tolist(),
    }


def _describe_labels(look: LabelLook | None, labels: LabelMap | None) -> list[dict[str, Any]] | None:
    """Describe the labels with a look of their own, by names that files can have: the map's own can be anything."""
    if look is None or labels is None:
        return None
    looks: dict[int, dict[str, Any]] = {}
    for look_name, chosen in (("color", look.colors), ("opacity", look.opacities)):
        for label, value in chosen.items():
            looks.setdefault(find_shown(labels, label), {})[look_name] = value
    names = file_suffixes({number: labels.name(number) for number in looks if number != NO_LABEL})
    names[NO_LABEL] = "none"
    return [
        {"label_number": number, "label": names[number], "color": own.get("color"), "opacity": own.get("opacity")}
        for number, own in sorted(looks.items())
    ]


def _skin_shown(style: Style) -> list[float]:
    """Return the HU of the skin that a picture shows: the level of a surface, or where a volume is not transparent."""
    if isinstance(style, SurfaceLook):
        return [style.iso_value]
    if not isinstance(style, VolumeLook):
        return []
    hu = np.arange(SKIN_SEEN_HU[0], SKIN_SEEN_HU[1] + 1.0)
    shown = hu[style.function(hu)[:, 3] > 0.0]
    return [float(shown[0]), float(shown[-1])] if len(shown) else []


def _range(values: Any) -> list[float] | None:
    return [float(values.min()), float(values.max())] if values.size else None


log = get_logger(__name__)


def make_pictures(
    source: str | Path, files: PictureFiles, settings: RenderSettings | None = None, **how: Any
) -> PictureReport:
    """Read a scan, a cloud (mode points) or a mesh (mode mesh), and take the pictures that are asked for."""
    settings = settings or RenderSettings()
    if (files.turntable is None) != (settings.turntable is None):
        raise UsageError("a turntable needs both: where it goes, and how it turns")
    with Run(settings, **how) as run:
        with run.keeping():
            outputs = check_pictures(files, settings)
        check_kept(outputs, source, *settings.files_read)
        allow_open_files(3 * len(settings.views_used) + 2)  # 3 for each view, turntable and report
        function = read_function(settings.transfer_function)
        curve = read_curve(settings.curve)
        meshes = [read_mesh(mesh.path, space=settings.mesh_space) for mesh in settings.meshes]
        _check_kind(source, settings)
        (subject, labels), device = run.read_beside(
            partial(_try_picture, settings=settings), lambda: _read_input(source, run)
        )
        if settings.mode not in _OTHER_INPUTS:
            subject = _mask_scan(subject, settings, device, run.progress)  # type: ignore[arg-type]
            run.lap("mask")
        beside = Beside(function, curve, labels, meshes)
        with PictureTaker(subject, device, settings, run.progress, beside) as taker:
            if settings.uses_all_devices:
                taker.share_with([other for other in list_usable() if other.index != device.current.index])
                taker.warnings += _warn_of_platforms(taker.devices)
            pictures = [] if files.picture is None else _take_views(run, taker, files)
            turntable = _take_turntable(run, taker, files)
            report = report_of(run, subject, taker, device.current, pictures, turntable)
            run.finish(report, files.report)
    log.info("%d files of pictures made on %s in %.3f s", len(run.files), report.device, run.total())
    return report


def _warn_of_platforms(devices: Sequence[Device]) -> list[str]:
    platforms = list(dict.fromkeys(device.platform for device in devices))
    if len(platforms) == 1:
        return []
    return [
        f"devices of {' and '.join(platforms)} take pictures in turn: their volume renderings and means can differ by a"
        " grey level or two in single pixels"
    ]


_OTHER_INPUTS = ("mesh", "points")
"""Modes whose input is no scan."""


def _check_kind(source: str | Path, settings: RenderSettings) -> None:
    """Refuse an input that the mode does not show, and settings that mean nothing for it."""
    if settings.mode == "mesh":
        refuse_scan_settings(settings, noun="a mesh")
        return
    is_cloud = is_cloud_file(source)
    if is_cloud and settings.mode == "points":
        refuse_scan_settings(settings)
    elif is_cloud or holds_triangles(source):
        kind, mode = ("a mesh", "mesh") if holds_triangles(source) else ("a cloud of points", "points")
        raise UsageError(f"the input is {kind}, which mode {mode} shows, and not mode {settings.mode}")
    elif settings.mode == "points":
        raise UsageError("mode points shows a file of points, and the input is none: make a cloud of it first")


def _read_input(source: str | Path, run: Run) -> tuple[Volume | PointCloud | Mesh, LabelMap | None]:
    settings: RenderSettings = run.settings
    if settings.mode in _OTHER_INPUTS:
        run.progress("read", 0, 0)
        if settings.mode == "mesh":
            return read_mesh(source, space=settings.mesh_space), None
        from clrecon.points.cloud_reader import read_points

        return read_points(source), None
    path = None if settings.labels is None else settings.labels.path
    read_map = partial(read_look, settings.labels, follow_links=settings.follow_links)
    return read_with_labels(partial(run.read, source), path, read_map)


def _mask_scan(volume: Volume, settings: RenderSettings, device: Device, progress: Progress) -> Volume:
    """Turn what the settings name into air, and run the steps of preprocessing."""
    style = settings.style
    bands: list[Band] = [(style.iso_value, math.inf)] if isinstance(style, SurfaceLook) else []
    volume = mask_volume(volume, settings, progress)
    if isinstance(style, Projection) and style.leaves_out:
        return _leave_out_surroundings(volume, settings, device, progress)
    volume = restrict_volume(volume, settings, device, bands, progress)
    return preprocess_volume(volume, settings, device, bands, progress)


def _leave_out_surroundings(volume: Volume, settings: RenderSettings, device: Device, progress: Progress) -> Volume:
    """Leave out what lies outside of the body and of the region, whose voxels get a value above those that count."""
    from clrecon.anatomy.surroundings import LEFT_OUT, leave_out_surroundings

    measured = volume.report.get("hu_range")
    volume = leave_out_surroundings(volume, progress=progress)
    bands: list[Band] = [(-math.inf, volume.report[LEFT_OUT]["value_hu"] - 1.0)]
    volume = restrict_volume(volume, settings, device, bands, progress)
    volume = preprocess_volume(volume, settings, device, bands, progress)
    volume.report = amend(volume.report, hu_range=measured)
    return volume


def _try_picture(device: Device, settings: RenderSettings) -> None:
    """Build the kernels, of volumes those for int16, by taking a small picture of an empty volume or of one point."""
    # The same kernels, without a curve and in one picture.
    mode = {"cpr": "slice", "presets": "dvr"}.get(settings.mode, settings.mode)
    subject: Volume | PointCloud | Mesh
    if mode == "mesh":
        subject = Mesh(np.eye(3), [(0, 1, 2)])
    elif mode == "points":
        subject = PointCloud([(0.0, 0.0, 0.0)])
    else:
        subject = Volume(np.zeros((2, 2, 2), np.int16), np.eye(4))
    small = RenderSettings.of(mode, size=(8, 8), iso_value=0.0 if mode == "surface" else None)
    with PictureTaker(subject, device, small, ignore_progress) as taker:
        taker.take_view("anterior")


def _take_views(run: Run, taker: PictureTaker, files: PictureFiles) -> list[dict[str, Any]]:
    """Take the picture of each view and write it under a temporary name; return the report's entries of them."""
    pictures: list[dict[str, Any]] = []
    views = taker.views
    total = len(views) if len(views) > 1 else 0
    run.progress("render", 0, total)
    for number, (view, picture) in enumerate(zip(views, taker.take_views(), strict=True), start=1):
        run.lap("render")
        name = name_view(view, views)
        pictures.append(describe_picture(picture, name, view) | _write_picture(run, picture, files, name))
        taker.warnings += warn_of_picture(picture, [*chain(*(device.warnings for device in taker.devices))])
        run.lap("write")
        if number < total:
            run.progress("render", number, total)
    return pictures


def _take_turntable(run: Run, taker: PictureTaker, files: PictureFiles) -> dict[str, Any] | None:
    """Write the turntable frame by frame under a temporary name; return the report's entry of it."""
    settings: RenderSettings = run.settings
    turn = settings.turntable
    if files.turntable is None or turn is None:
        return None
    first = settings.camera(taker.box, taker.views[0], turning=True)
    cameras = turntable_cameras(first, turn.frames, turn.degrees)

    empty: list[str] | None = []

    def frames() -> Iterator[Rendering]:
        nonlocal empty
        for picture in taker.take_all(cameras):
            why = None if empty is None else find_emptiness(picture)
            empty = None if empty is None or why is None else [*empty, why]
            yield picture

    run.progress("frames", 0, turn.frames)
    moving = run.stage(stage_animation(frames(), files.turntable, turn.fps, total=turn.frames, progress=run.progress))
    seconds = run.lap("turntable")
    taker.warnings += (empty or [])[:1]  # one frame that is not empty is enough
    return {
        "frames": turn.frames,
        "fps": turn.fps,
        "degrees": turn.degrees,
        "seconds_a_frame": round(seconds / turn.frames, 4),
        "output": {"format": animation_kind(files.turntable)[1:] or "folder", "bytes": moving.size},
    }


_OPAQUE_ONLY = (".jpg", ".jpeg", ".mp4", ".webm", ".gif")


@dataclass(frozen=True)
class PictureFiles:
    """Paths of the outputs: `depth` has mm to the first hit, `values` HU; each view gets file names of its own."""

    picture: str | Path | None = None
    depth: str | Path | None = None
    values: str | Path | None = None
    turntable: str | Path | None = None
    report: str | Path | None = None

    def __post_init__(self) -> None:
        if self.picture is None and self.turntable is None:
            raise UsageError(
                f"there is nothing to write: name a picture ({name_parameter('picture', 'out.png')}) or a turntable"
                f" ({name_parameter('turntable')})"
            )
        if self.picture is None and (self.depth is not None or self.values is not None):
            raise UsageError(
                f"depths and values belong to a picture: name it too ({name_parameter('picture', 'out.png')})"
            )


def name_view(view: str, views: Sequence[str]) -> str:
    """Name a view for its files: its own name, or ``az30_el-15`` for angles; empty for a single view."""
    if len(views) == 1:
        return ""
    azimuth, comma, elevation = view.strip().lower().partition(",")
    return f"az{float(azimuth):g}_el{float(elevation):g}" if comma else azimuth


def path_of(path: str | Path, name: str) -> str | Path:
    """Insert a name into a path: ``out.png`` and ``left`` give ``out_left.png``; an empty name changes nothing."""
    stem, extension = os.path.splitext(os.fspath(path))
    return f"{stem}_{name}{extension}" if name else path


def check_pictures(files: PictureFiles, settings: RenderSettings) -> list[tuple[str, str | Path]]:
    """Refuse outputs that cannot be written, before any work is done; return description and path of each."""
    load_pillow()
    check_caption(settings.caption)
    for name in ("depth", "values"):
        if getattr(files, name) is not None:
            check_known(settings.mode, name)
    if files.depth is not None and settings.style.is_sheet:
        raise UsageError("a contact sheet has no depths: its slices lie in planes of their own")
    if settings.background == "transparent":
        picture = "" if files.picture is None else extension_of(files.picture)[1:]
        turntable = "" if files.turntable is None else animation_kind(files.turntable)[1:]
        for kind in (picture, turntable):
            if f".{kind}" in _OPAQUE_ONLY:
                raise UsageError(
                    f"{kind.upper()} cannot hold a transparent background:"
                    f" choose PNG, TIFF or APNG, or a colour ({name_parameter('background')})"
                )
    of_views = {"the picture": files.picture, "the depths": files.depth, "the values": files.values}
    owned: list[tuple[str, str | Path]] = [] if files.report is None else [("the report", files.report)]
    for role, path in of_views.items():
        if path is not None:
            if role == "the picture":
                check_image_path(path, has_vectors=True)
            else:
                check_float_path(path)
            names = [name_view(view, settings.views_used) for view in settings.views_used]
            owned += [(f"{role} {name}".rstrip(), path_of(path, name)) for name in names]
    moving = [] if files.turntable is None else [("the turntable", files.turntable)]
    check_distinct(owned, moving)
    check_files(owned)
    if files.turntable is not None and settings.turntable is not None:
        if check_animation(files.turntable, settings.turntable.fps) == "":
            _check_outside_frames(files.turntable, owned)
    return [*owned, *moving]


def _check_outside_frames(folder: str | Path, owned: Sequence[tuple[str, str | Path]]) -> None:
    """Refuse files in the folder of frames, because that folder is replaced as a whole."""
    frames = Path(os.path.realpath(folder))
    for role, path in owned:
        if frames in Path(os.path.realpath(path)).parents:
            raise UsageError(f"{role} cannot lie in {folder}, which holds frames and nothing else: name another folder")


def _write_picture(run: Run, picture: Rendering, files: PictureFiles, name: str) -> dict[str, dict[str, Any]]:
    """Write a picture, and its depths and values if asked for; return their entries in the report."""

    def entry(path: str | Path, file: StagedFile) -> dict[str, Any]:
        return {"format": extension_of(path)[1:], "bytes": file.size}

    assert files.picture is not None
    path = path_of(files.picture, name)
    outputs = {"output": entry(path, run.write_picture(path, picture))}
    for kind, named, floats in (("depth", files.depth, picture.depth), ("values", files.values, picture.values)):
        if named is not None and floats is not None:
            path = path_of(named, name)
            content = encode_floats(floats, extension_of(path), picture.pixel_mm)
            outputs[f"{kind}_output"] = entry(path, run.write(path, content))
    return outputs
