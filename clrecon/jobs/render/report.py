"""The report of the render job: entries of the whole job, and of each picture."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

from clrecon.anatomy.head import SKIN_SEEN_HU, warn_of_face
from clrecon.jobs.inputs import describe_cloud
from clrecon.jobs.render.settings import LabelLook, RenderSettings
from clrecon.jobs.run import Run, RunReport
from clrecon.rendering.pictures.annotations import edge_letters
from clrecon.rendering.pictures.label_style import NO_LABEL, find_shown
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.styles import CurveCut, PlaneCut, Style, SurfaceLook, VolumeLook
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import asdict, dataclass

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.jobs.render.picture_taker import PictureTaker
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.points import PointCloud
    from clrecon.rendering import Rendering, TransferFunction
    from clrecon.rendering.views.camera import Camera


def describe_camera(camera: Camera | None) -> dict[str, Any] | None:
    """Describe a camera by the arguments of `Camera`, LPS mm; None for a picture without a camera."""
    if camera is None:
        return None
    return {
        "position_lps_mm": list(camera.position),
        "focal_point_lps_mm": list(camera.focal_point),
        "up_lps": list(camera.up),
        "view_angle_deg": camera.view_angle,
        "parallel_scale_mm": camera.parallel_scale,
    }


def describe_picture(picture: Rendering, name: str, view: str) -> dict[str, Any]:
    """Make one entry of ``pictures``, without the files; ranges are None for a picture without values or hits."""
    import numpy as np

    report = picture.report
    values = None if picture.values is None else _range(picture.values[np.isfinite(picture.values)])
    is_water = picture.mode == "drr"
    hit = np.isfinite(picture.depth)
    return {
        "name": name or None,
        "view": view,
        "size": list(picture.size),
        "camera": describe_camera(picture.camera),
        "pixel_mm": picture.pixel_mm,
        "hit_share": float(hit.mean()) if picture.camera is not None else None,
        "depth_mm": _range(picture.depth[hit]),
        "values_hu": None if is_water else values,
        "window_hu": report.get("window_hu"),
        "values_mm_water": values if is_water else None,
        "window_mm_water": report.get("window_mm_water"),
        **{name: report.get(name) for name in ("ray_step_mm", "slices", "plane", "curve")},
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
    import numpy as np

    values = None if picture.values is None else picture.values[np.isfinite(picture.values)]
    if values is None or not values.size:
        if np.isfinite(picture.depth).any():
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

    PARTS = ("device", "read", "mask", "render", "turntable", "write")

    mode: str
    preset: str | None
    transfer_function: Mapping[str, Any] | None
    iso_value_hu: float | None
    color: Any
    depth_cue: float | None
    lighting: Mapping[str, Any] | None
    shadows: bool
    jitter: bool
    background: Any
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
    from clrecon.geometry import Volume
    from clrecon.points import PointCloud

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
        [*device.warnings, *taker.warnings, *face],
        volume,
        on=device,
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
        jitter=getattr(style, "jitter", False),
        background=settings.background,
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


def _describe_meshes(
    subject: Volume | PointCloud | Mesh, settings: RenderSettings, taker: PictureTaker
) -> list[dict[str, Any]]:
    from clrecon.mesh import Mesh

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
    from clrecon.labels import file_suffixes

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
    import numpy as np

    if isinstance(style, SurfaceLook):
        return [style.iso_value]
    if not isinstance(style, VolumeLook):
        return []
    hu = np.arange(SKIN_SEEN_HU[0], SKIN_SEEN_HU[1] + 1.0)
    shown = hu[style.function(hu)[:, 3] > 0.0]
    return [float(shown[0]), float(shown[-1])] if len(shown) else []


def _range(values: Any) -> list[float] | None:
    return [float(values.min()), float(values.max())] if values.size else None
