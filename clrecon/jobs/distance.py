"""The job of distances: two meshes in; figures, a mesh coloured by distance and a picture of it out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.content import certificate_lines
from clrecon.exchange.formats import FORMATS, MESH_INPUTS, stage_content
from clrecon.jobs.outputs import MeshFiles
from clrecon.jobs.run import JobReport, Run
from clrecon.jobs.settings import FITTED_FROM_HU, DistanceSettings
from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import SAMPLES, DistanceSummary
from clrecon.mesh.compare.signed import Ruler, SideDistance, compare_sides
from clrecon.mesh.mesh_reader import read_mesh
from clrecon.mesh.quality import MeshQuality, survey_surface
from clrecon.system.arguments import Space, name_parameter
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.pieces import side_by_side
from clrecon.system.text import escape_text, format_digits

if TYPE_CHECKING:
    from clrecon.opencl import Device
    from clrecon.rendering import Rendering
    from clrecon.system.color_scale import ColorScale
    from clrecon.system.files import StagedFile


_LEAST_RANGE_MM = 1e-3
"""Least distance at which colours end where it is chosen; float32 is as exact 8 m from the origin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DistanceReport(JobReport):
    SCHEMA = "distance"

    a: Mapping[str, Any]
    b: Mapping[str, Any]
    hausdorff_mm: float
    hd95_mm: float
    assd_mm: float
    a_to_b_mm: DistanceSummary
    b_to_a_mm: DistanceSummary
    a_to_b_signed_mm: SideDistance | None
    b_to_a_signed_mm: SideDistance | None
    samples: int
    colors: Mapping[str, Any] | None
    outputs: list[dict[str, Any]]
    device: str | None


def measure_meshes(
    mesh: str | Path,
    reference: str | Path,
    files: MeshFiles | None = None,
    settings: DistanceSettings | None = None,
    **how: Any,
) -> DistanceReport:
    """Measure how far two meshes lie apart, files A and B, or a mesh and the bone of a scan."""
    from clrecon.operators import take_device

    files, settings = files or MeshFiles(), settings or DistanceSettings()
    with Run(settings, **how) as run:
        from clrecon.rendering.pictures.picture import check_image_path
        from clrecon.rendering.pictures.pillow import load_pillow

        if files.output is not None and not os.fspath(files.output).lower().endswith(".ply"):
            raise UsageError(
                f"a mesh coloured by distance is a .ply file, not {os.path.basename(os.fspath(files.output))[-40:]!r}"
            )
        if files.picture is not None:
            load_pillow()
            check_image_path(files.picture)
        run.check(files.named("the coloured mesh"), mesh, reference)
        if settings.surface is not None and os.fspath(reference).lower().endswith(MESH_INPUTS):
            raise UsageError(
                f"{name_parameter('surface', settings.surface)} needs a scan as B: with a mesh leave it out"
            )
        device = take_device(settings.device) if files.picture is not None or settings.surface is not None else None
        run.progress("read", 0, 0)
        read_own = partial(read_side, mesh, settings.mesh_space)
        if settings.surface is None or device is None:
            # That which this thread raises is told: of two harmed files the first.
            meshes = side_by_side(partial(read_side, reference, settings.mesh_space), read_own)[::-1]
        else:
            meshes = side_by_side(read_own, partial(_make_side, run, reference, device))
        survey_side = partial(survey_surface, by_triangle=True)
        surveys = side_by_side(*(partial(survey_side, own.vertices, own.triangles) for own in meshes))
        entries = [
            describe_mesh(own, path, survey[0])
            for own, path, survey in zip(meshes, (mesh, reference), surveys, strict=True)
        ]
        for entry in entries:
            if not entry["area_mm2"]:
                raise NoSurfaceError(f"{entry['name']} has no triangle with an area: there is nothing to measure")
        run.lap("read")
        names = (entries[0]["name"], entries[1]["name"])
        rulers = side_by_side(*(partial(Ruler.of, meshes[side], names[side], surveys[side]) for side in (1, 0)))
        apart = compare_sides(meshes, rulers, settings.samples or SAMPLES, run.progress)
        colored = None
        if files.output is not None or files.picture is not None:
            from clrecon.system.color_scale import ColorScale, round_up

            distances = rulers[0].measure(meshes[0].vertices, run.progress)
            limit = settings.range_mm or round_up(max(apart.to_reference_mm.p95, _LEAST_RANGE_MM))
            colored = _Colored(distances, ColorScale(limit, rulers[0].signed))
        run.lap("measure")
        drawn = None
        if device is not None and colored is not None and files.picture is not None:
            run.progress("render", 0, 0)
            drawn = _draw_mesh(meshes[0], colored, settings, device)
            run.lap("render")
        outputs = _write_files(run, meshes[0], colored, drawn, files)
        run.lap("write")
        warnings = list(chain(*(mesh.report["file"]["warnings"] for mesh in meshes)))
        report = run.report(
            DistanceReport,
            [*warnings, *doubt_frames(meshes, entries), *apart.warnings],
            a=entries[0],
            b=entries[1],
            **{name: apart[name] for name in ("hausdorff_mm", "hd95_mm", "assd_mm", "samples")},
            a_to_b_mm=apart.to_reference_mm,
            b_to_a_mm=apart.from_reference_mm,
            a_to_b_signed_mm=apart.to_reference_signed_mm,
            b_to_a_signed_mm=apart.from_reference_signed_mm,
            colors=None if colored is None else colored.describe(),
            outputs=outputs,
            device=None if device is None else device.current.label,
        )
        return run.finish(report, files.report)


@dataclass(frozen=True)
class _Colored:
    distances: NDArray[np.float64]
    scale: ColorScale

    @property
    def colors(self) -> NDArray[np.uint8]:
        return self.scale.colors(self.distances)

    def describe(self) -> dict[str, Any]:
        beyond = float(np.mean(np.abs(self.distances) > self.scale.limit))
        return {"range_mm": self.scale.limit, "signed": self.scale.signed, "beyond_share": beyond}


def _draw_mesh(mesh: Mesh, colored: _Colored, settings: DistanceSettings, device: Device) -> Rendering:
    from clrecon.operators.rays.mesh_pictures import box_around, mesh_corners
    from clrecon.operators.rays.scene import ScenePictures
    from clrecon.rendering.pictures.object_looks import MeshLook
    from clrecon.rendering.pictures.sheets import add_scale
    from clrecon.rendering.views.camera import Camera
    from clrecon.rendering.views.directions import DEFAULT_SIZE, read_view

    camera = Camera.fit(box_around([mesh_corners(mesh)]), read_view(settings.view))
    look = MeshLook(vertex_colors=colored.colors)
    with ScenePictures([(mesh, look)], device=device, memory=settings.memory) as scene:
        picture: Rendering = scene.take(camera, DEFAULT_SIZE, "white")
    title = "mm, + is\noutside of B" if colored.scale.signed else "mm from B"
    return add_scale(picture.annotated(letters=True, scale_bar=True), colored.scale, title)


def _write_files(
    run: Run, mesh: Mesh, colored: _Colored | None, drawn: Rendering | None, files: MeshFiles
) -> list[dict[str, Any]]:
    written: list[tuple[str, str | Path, StagedFile]] = []
    if files.output is not None and colored is not None:
        values = {"distance_mm": colored.distances.astype(np.float32)}
        content = replace(mesh.describe(run.settings.space), vertex_colors=colored.colors, values=values)
        counted = f"{mesh.triangle_count} triangles"
        file = run.stage(stage_content(content, files.output, FORMATS[".ply"], counted, "fewer triangles"))
        written.append(("mesh", files.output, file))
    if files.picture is not None and drawn is not None:
        written.append(("picture", files.picture, run.write_picture(files.picture, drawn)))
    return [
        {"kind": what, "name": os.path.basename(os.fspath(path)), "bytes": file.size} for what, path, file in written
    ]


_OTHER_UNIT = 100.0
"""Ratio of the sizes of two meshes from which on their units are doubted; metres and millimetres differ by 1000."""


def read_side(path: str | Path, space: Space | None) -> Mesh:
    """Read a mesh; `space` is the frame of its coordinates if the file does not name one."""
    mesh = read_mesh(path)
    if space is not None and mesh.report["file"]["space_from"] == "assumed":
        return read_mesh(path, space=space)
    return mesh


def _make_side(run: Run, source: str | Path, device: Device) -> Mesh:
    """Return the surface of the bone of a scan: at its level, or moved onto the bone."""
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.operators.surface.cortex_mesh import fit_meshes
    from clrecon.operators.surface.extract import SurfaceExtractor

    settings: DistanceSettings = run.settings
    volume = run.read(source)
    run.lap("read")
    level = FITTED_FROM_HU if settings.iso_value is None else settings.iso_value
    with DeviceVolume(volume, device=device, memory=settings.memory) as resident:
        with SurfaceExtractor(resident) as extractor:
            mesh = extractor.extract(level, progress=run.progress)
        if settings.surface == "cortex":
            (mesh,) = fit_meshes([mesh], resident, progress=run.progress)
    run.lap("surface")
    file = {"kind": "scan", "space": "LPS", "space_from": "file", "warnings": volume.report.get("warnings", ())}
    mesh.report |= {"file": file, "certificate_lines": certificate_lines(volume.report, keep_ids=True)}
    return mesh


def describe_mesh(mesh: Mesh, path: str | Path, quality: MeshQuality) -> dict[str, Any]:
    """Return the report's entry of a mesh; the name of its file without folders."""
    file = mesh.report["file"]
    closed = quality.closed and quality.oriented
    return {
        "name": escape_text(Path(path).name),
        **{fact: file[fact] for fact in ("kind", "space", "space_from")},
        "vertices": mesh.vertex_count,
        "triangles": mesh.triangle_count,
        "closed": closed,
        "area_mm2": quality.area_mm2,
        "volume_ml": abs(quality.volume_ml) if closed else None,
        "bounds_mm": quality.bounds_mm,
        "iso_value_hu": mesh.report.get("iso_value_hu") if file["kind"] == "scan" else None,
        "cortex": mesh.report.get("cortex"),
    }


def doubt_frames(meshes: Sequence[Mesh], entries: Sequence[dict[str, Any]]) -> list[str]:
    """Return what speaks against both meshes lying in one frame and unit."""
    doubts = []
    hashes = [_frame_of_reference(mesh) for mesh in meshes]
    a, b = (entry["name"] for entry in entries)
    if None not in hashes and hashes[0] != hashes[1]:
        doubts.append(
            f"{a} and {b} are from different frames of reference ({hashes[0]}, {hashes[1]}, hashes): it is not"
            " verified that their coordinates agree"
        )
    boxes = [np.array(entry["bounds_mm"]) for entry in entries if entry["bounds_mm"]]
    if len(boxes) < 2:
        return doubts
    sizes = [float(np.linalg.norm(box[1] - box[0])) for box in boxes]
    if min(sizes) > 0.0 and max(sizes) / min(sizes) >= _OTHER_UNIT:
        doubts.append(
            f"{a} is {format_digits(sizes[0], 4)} mm across and {b} {format_digits(sizes[1], 4)} mm: is"
            f" one of them in another unit?"
        )
    gap = float(np.linalg.norm(np.maximum(0.0, np.maximum(boxes[0][0] - boxes[1][1], boxes[1][0] - boxes[0][1]))))
    if gap > 0.0:
        sources = {entry["space_from"] for entry in entries}
        hint = ": is the frame of the file that names none another?" if "assumed" in sources else ""
        doubts.append(f"the boxes round {a} and {b} lie {format_digits(gap, 4)} mm apart{hint}")
    return doubts


def _frame_of_reference(mesh: Mesh) -> str | None:
    lines = mesh.report.get("certificate_lines") or ()
    return next((line.split()[1] for line in lines if line.startswith("frame_of_reference ")), None)
