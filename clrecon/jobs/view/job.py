"""The job that shows scans and meshes together: as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from clrecon.errors import UsageError
from clrecon.exchange.page import read_facts
from clrecon.exchange.page_slices import pack_slices
from clrecon.geometry import Volume
from clrecon.jobs.distance import doubt_frames
from clrecon.jobs.inputs import may_be_mesh
from clrecon.jobs.mesh.bone import judge_surfaces
from clrecon.jobs.mesh.make import make_parts
from clrecon.jobs.mesh.refinement import label_part
from clrecon.jobs.options import changed_fields
from clrecon.jobs.outputs import commit_all
from clrecon.jobs.run import JobReport, Run
from clrecon.jobs.view import ViewSettings
from clrecon.jobs.view.inputs import read_shown_mesh
from clrecon.mesh import Mesh
from clrecon.rendering.looks.window import WINDOWS
from clrecon.rendering.pictures.label_style import distinct_colors
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.text import escape_text

log = get_logger(__name__)

_PAGE_WINDOWS = ("bone", "soft", "lung", "brain")

_OF_THE_MACHINE = ("device", "memory", "space", "keep_ids")
"""Settings of scans that may be given without one."""


@dataclass(frozen=True, eq=False)
class _ShownInput:
    """What became of an input: its meshes, its entry in the report, and the device that worked on it."""

    meshes: list[Mesh]
    entry: dict[str, Any]
    warnings: list[str]
    device: str | None = None


def write_view(
    inputs: Sequence[str | Path], output: str | Path, settings: ViewSettings | None = None, **how: Any
) -> ViewReport:
    """Write a page of scans and meshes, each in its place; one mesh alone is divided into its components."""
    settings = settings or ViewSettings()
    with Run(settings.scan, **how) as run:
        _check_inputs(inputs, output, settings)
        labels = settings.scan.labels
        run.check([("the page", output)], *inputs, None if labels is None else labels.path)
        # Mesh files first: they are read in a moment, and a wrong one is said before the device works on a scan.
        order = sorted(range(len(inputs)), key=lambda place: not may_be_mesh(inputs[place]))
        by_position = {place: _read_input(inputs[place], settings, run) for place in order}
        shown = [by_position[place] for place in range(len(inputs))]
        meshes = _name_and_color(shown, settings)
        placed = [
            (mesh, {"name": one.entry["name"], "space_from": one.entry["space_from"], "bounds_mm": mesh.bounds})
            for one in shown
            for mesh in one.meshes[:1]
        ]
        doubts = []
        for mesh, entry in placed[1:]:
            pair = [{**own, "bounds_mm": own["bounds_mm"].tolist()} for own in (placed[0][1], entry)]
            doubts += doubt_frames([placed[0][0], mesh], pair)
        warnings = [*chain(*(one.warnings for one in shown)), *doubts]
        run.progress("write", 0, 0)
        file = run.write_meshes(meshes, [output])[0] if len(meshes) == 1 else run.write_together(meshes, output)
        run.lap("write")
        commit_all(run.files)
        facts = read_facts(output)
        report = run.report(
            ViewReport,
            warnings,
            inputs=[one.entry for one in shown],
            parts=[
                {"name": part["name"], "triangles": part["count"], "ml": part["ml"], "color": part["color"]}
                for part in facts["parts"]
            ],
            vertices=facts["vertices"],
            triangles=facts["triangles"],
            half_step_mm=facts["half_step_mm"],
            space=settings.scan.space,
            output={"format": "html", "bytes": file.size},
            device=next((one.device for one in shown if one.device), None),
        )
    log_warnings(log, report.warnings)
    return report


def _check_inputs(inputs: Sequence[str | Path], output: str | Path, settings: ViewSettings) -> None:
    """Refuse what can be refused before anything is read."""
    if not inputs:
        raise UsageError("there is nothing to show: name a scan or a mesh file")
    if Path(output).suffix.lower() != ".html":
        raise UsageError(f"a page is a file .html, not {escape_text(Path(output).name)[-40:]!r}")
    if len(settings.names) > len(inputs):
        raise UsageError(f"{len(settings.names)} names for {len(inputs)} input{'s' * (len(inputs) > 1)}: one for each")
    scans = [path for path in inputs if not may_be_mesh(path)]
    for path in inputs:
        if may_be_mesh(path) and not Path(path).is_file():
            raise UsageError(f"{escape_text(str(path), 200)}: there is no file of that name")
    changed = [name for name in changed_fields(settings.scan) if name not in _OF_THE_MACHINE]
    if changed and not scans:
        raise UsageError(
            f"{name_parameter(changed[0])} says what is made of a scan, and all inputs are mesh files: leave it out, or"
            " name a scan"
        )
    if settings.with_slices and len(scans) != 1:
        raise UsageError(f"{name_parameter('with_slices')} shows those of one scan, {len(scans)} are given")
    if settings.scan.labels is not None and len(scans) > 1:
        raise UsageError(f"a label map belongs to one scan, {len(scans)} are given")


def _read_input(path: str | Path, settings: ViewSettings, run: Run) -> _ShownInput:
    if may_be_mesh(path):
        run.progress("read", 0, 0)
        shown = _read_mesh(path, settings)
        run.lap("read")
        return shown
    result = make_parts(path, run)
    label = partial(label_part, device=result.device, settings=settings.scan)
    judge_surfaces(result.parts, result.volume, settings.scan, label)
    run.lap("select")
    windows = {name: WINDOWS[name] for name in _PAGE_WINDOWS}
    slices = pack_slices(result.volume, windows) if settings.with_slices else None
    run.lap("slices")
    meshes = []
    for part in result.parts:
        if len(result.parts) > 1 and "part_name" not in part.mesh.report:
            part.mesh.report["part_name"] = part.name.replace("_", " ")
        meshes.append(part.mesh)
    if slices is not None:
        meshes[0].report["page_slices"] = slices
    return _ShownInput(
        meshes,
        {
            **_describe_scan(path, result.volume, meshes, run),
            "surface": ", ".join(dict.fromkeys(part.surface.describe() for part in result.parts)),
        },
        [*result.volume.report.get("warnings", ()), *chain(*(mesh.report.get("warnings", ()) for mesh in meshes))],
        result.device.current.label,
    )


def _read_mesh(path: str | Path, settings: ViewSettings) -> _ShownInput:
    mesh, name = read_shown_mesh(path, settings.mesh_space)
    file = mesh.report["file"]
    entry = {
        "name": name,
        **{fact: file[fact] for fact in ("kind", "space", "space_from")},
        "triangles": mesh.triangle_count,
        "volume": None,
        "surface": None,
    }
    return _ShownInput([mesh], entry, list(file["warnings"]))


def _describe_scan(path: str | Path, volume: Volume, meshes: Sequence[Mesh], run: Run) -> dict[str, Any]:
    certificate = run.certificate(volume)
    certificate.pop("warnings", None)
    return {
        "name": escape_text(Path(path).name),
        "kind": "scan",
        "space": None,
        "space_from": None,
        "triangles": sum(mesh.triangle_count for mesh in meshes),
        "volume": certificate,
    }


def _name_and_color(shown: Sequence[_ShownInput], settings: ViewSettings) -> list[Mesh]:
    colors = distinct_colors(len(shown))
    for number, item in enumerate(shown, start=1):
        given = settings.names[number - 1] if number <= len(settings.names) else ""
        name = given or (f"surface {number}" if len(shown) > 1 else "")
        for mesh in item.meshes:
            for entry in ("part_name", "label_name"):
                if words := " ".join(filter(None, (name, mesh.report.get(entry)))):
                    mesh.report[entry] = words
            if len(shown) > 1 and "color" not in mesh.report:
                mesh.report["color"] = [float(value) for value in colors[number - 1]]
    return list(chain(*(one.meshes for one in shown)))


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewReport(JobReport):
    SCHEMA = "page"

    _LAST = ("device", *JobReport._LAST)

    inputs: list[dict[str, Any]]
    parts: list[dict[str, Any]]
    vertices: int
    triangles: int
    half_step_mm: float
    space: str
    output: Mapping[str, Any]
    device: str | None
