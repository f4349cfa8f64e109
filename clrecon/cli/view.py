"""``clrecon view``: look at scans and meshes."""

from __future__ import annotations

import argparse
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from clrecon.cli.common import add_device, add_keep_ids, add_memory, add_no_clobber, megabytes, pick, table
from clrecon.cli.console import Console, describe_stage, printable
from clrecon.cli.mesh import add_levels, add_selection, add_solid, describe_volume
from clrecon.cli.mesh_options import add_label_arguments, label_choice
from clrecon.cli.options import add_cropping, add_masking, add_reading
from clrecon.errors import UsageError
from clrecon.system.text import format_volume

if TYPE_CHECKING:
    from clrecon.jobs.view.inputs import ViewSettings
    from clrecon.system.display import DisplayProbe

_EPILOG = """\
Without --web and --html a window opens: turn with the mouse, move the slider, h shows all keys; q closes it. It needs a
display with OpenGL. What is saved gets a name that no file has.

--web shows everything in a browser of this computer, drawn on the OpenCL device: a slider for the iso value, presets,
slices, parts, measures, clips, and files of what is shown. It needs the package aiohttp, and no screen and no OpenGL:
over a network use an ssh tunnel. Ctrl-C ends it.

The page of --html is one file: any browser from 2023 on shows it, without a server and offline. It asks for nothing
from outside and holds no patient data: files are numbered, not named, unless --name is given. It turns, clips and
measures; parts (components, labels, files) are switched one by one. See docs/view.md.

examples:
  clrecon view CT_FOLDER
  clrecon view CT_FOLDER bone.stl cloud.ply --labels spine.nii.gz --save-as shown.3mf
  clrecon view CT_FOLDER --web
  clrecon view CT_FOLDER --html page.html
  clrecon view CT_FOLDER --html spine.html --labels spine.nii.gz
  clrecon view bone.stl implant.ply --html both.html --name bone --name implant"""
_SHOWN_PARTS = 12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = _EPILOG
    parser.add_argument(
        "inputs",
        metavar="INPUT",
        nargs="+",
        help="mesh file (.stl, .ply), or a scan: DICOM folder or file, NIfTI, NRRD or MetaImage file",
    )
    shown = parser.add_argument_group("what is shown")
    shown.add_argument(
        "--save-as",
        action="append",
        default=[],
        metavar="FILE",
        help="what the key s writes: a mesh, cloud, volume or picture by its extension; numbered where it exists;"
        " repeat it for several (default: clrecon-view.stl, with --web a download)",
    )
    shown.add_argument("--html", metavar="FILE", help="write a page that shows the inputs: .html")
    shown.add_argument("--web", action="store_true", help="show them in a browser of this computer, until Ctrl-C")
    shown.add_argument("--port", type=int, metavar="N", help="of --web, on 127.0.0.1 (default: a free one)")
    shown.add_argument("--open", action="store_true", help="with --web: open the browser too, not only say the address")
    shown.add_argument(
        "--name",
        dest="names",
        action="append",
        default=[],
        metavar="TEXT",
        help="name of an input on the page, in the order of the inputs; repeat it for several (default: surface 1 ...)",
    )
    shown.add_argument(
        "--mesh-space",
        type=str.lower,
        metavar="lps|ras",
        help="patient frame of mesh files that do not name theirs (default: lps, with a warning)",
    )
    shown.add_argument(
        "--space", type=str.lower, default="lps", metavar="lps|ras", help="frame of picked points (default: lps)"
    )
    add_no_clobber(shown)
    add_keep_ids(shown)
    add_reading(parser)
    add_masking(parser)
    add_cropping(parser)
    surface = parser.add_argument_group("surface of a scan")
    add_levels(surface)
    add_solid(surface)
    add_selection(parser.add_argument_group("components of a scan"))
    add_label_arguments(parser)
    device = parser.add_argument_group("device, for scans")
    add_device(device)
    add_memory(device)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    _check_faces(options)
    if options.web:
        return _serve(options, _settings(options), console)
    if options.html is None:
        from clrecon.system.display import DisplayProbe
        from clrecon.system.progress import held_interrupts

        # Both before numpy is loaded: the probe takes half a second, and numpy's threads hold Ctrl-C back too.
        with held_interrupts(), DisplayProbe() as probe:
            return _show(options, _settings(options), probe, console)
    from clrecon.jobs.view.job import write_view

    settings = _settings(options)
    report = write_view(
        options.inputs, options.html, settings, no_clobber=options.no_clobber, progress=console.progress
    )
    console.result(report)
    for line in _describe(report, options.html):
        console.say(line)
    for warning in report["warnings"]:
        console.warn(warning)
    return 0


def _settings(options: argparse.Namespace) -> ViewSettings:
    from clrecon.jobs.mesh.settings import MeshSettings
    from clrecon.jobs.view.inputs import ViewSettings

    given = {**pick(options, {own.name for own in fields(MeshSettings)}), **options.hu, "labels": label_choice(options)}
    if options.labels is not None:
        given.pop("solid", None)  # it says how each label becomes a mesh
    scan = MeshSettings(**{name: value for name, value in given.items() if value is not None})
    return ViewSettings(scan=scan, mesh_space=options.mesh_space, names=options.names)


def _check_faces(options: argparse.Namespace) -> None:
    """Refuse options that say two things, or nothing."""
    if options.web and options.html is not None:
        raise UsageError("--web shows a view and --html writes a page: ask for one of them")
    for name in ("port", "open"):
        if getattr(options, name) not in (None, False) and not options.web:
            raise UsageError(f"--{name} belongs to --web: ask for that too")
    if options.web and options.quiet and not (options.open or options.json):
        raise UsageError("-q hides the address that is to be opened: leave it out, or ask for --open too")
    if options.web and options.no_clobber:
        raise UsageError("--web writes no file by itself: leave --no-clobber out")
    if options.save_as and options.html is not None:
        raise UsageError("--save-as says what is written while you look: leave out --html, or it")
    if options.html is None and not options.web and options.no_clobber:
        raise UsageError("a window replaces no file: leave --no-clobber out")


def _show(options: argparse.Namespace, settings: ViewSettings, probe: DisplayProbe, console: Console) -> int:
    """Show a window until it is closed."""
    from clrecon.system.display import NoDisplayError
    from clrecon.viewer.window.open_window import open_window

    facts: dict[str, Any] = {"device": None, "warnings": []}

    def ready(view: Any) -> None:
        facts.update(device=view.painter.device.label, warnings=list(view.said))
        for warning in view.said:
            console.warn(warning)
        console.say(f"device   {printable(facts['device'])}")

    try:
        saved = open_window(
            options.inputs,
            settings,
            save_as=options.save_as,
            progress=console.progress,
            ready=ready,
            say=lambda line: console.say(f"wrote    {printable(line)}"),
            describe=describe_stage,
            probe=probe,
        )
    except NoDisplayError as error:
        raise NoDisplayError(
            f"{error}; without one: --web shows this in a browser, --html page.html writes a page, and clrecon render"
            " draws pictures"
        ) from error
    console.result({**facts, "saved": saved})
    return 0


def _serve(options: argparse.Namespace, settings: ViewSettings, console: Console) -> int:
    """Serve until Ctrl-C, which is how it ends: exit code 0."""
    from clrecon.viewer.web.serve import serve_view

    def ready(server: Any, view: Any, warnings: list[str]) -> None:
        device = view.painter.device.label
        console.result({"address": server.address, "port": server.port, "device": device, "warnings": warnings})
        for warning in warnings:
            console.warn(warning)
        console.say(f"device   {printable(device)}")
        console.say(f"view     {server.address}", whole=True)
        console.say(
            "         open it in a browser of this computer; whoever has this address can see the scan; Ctrl-C ends"
        )
        console.finish()

    serve_view(
        options.inputs,
        settings,
        port=options.port,
        opens=options.open,
        save_as=options.save_as,
        wrote=lambda line: console.say(f"wrote    {printable(line)}"),
        progress=console.progress,
        ready=ready,
    )
    return 0


def _describe(report: dict[str, Any], output: str) -> list[str]:
    lines = [f"input    {_describe_input(entry)}" for entry in report["inputs"]]
    lines.append(f"mesh     {report['vertices']:,} vertices, {report['triangles']:,} triangles")
    rows = [
        [part["name"], f"{part['triangles']:,} triangles", "" if part["ml"] is None else format_volume(part["ml"])]
        for part in report["parts"][:_SHOWN_PARTS]
    ]
    if len(report["parts"]) > 1:
        lines += [f"         {printable(row)}" for row in table(rows, right=(1, 2))]
    if len(report["parts"]) > _SHOWN_PARTS:
        lines.append(f"         and {len(report['parts']) - _SHOWN_PARTS:,} more")
    if report["device"]:
        lines.append(f"device   {printable(report['device'])}")
    size = f"{megabytes(report['output']['bytes'])}, vertices moved by at most {report['half_step_mm']:.2g} mm"
    return [*lines, f"wrote    {printable(output)}, {size}", f"time     {report['seconds']['total']:.2f} s"]


def _describe_input(entry: dict[str, Any]) -> str:
    if entry["kind"] == "scan":
        return f"{describe_volume(entry['volume']) or printable(entry['name'])}, surface of {entry['surface']}"
    turned = ", turned to LPS" if entry["space"] != "LPS" else ""
    source = {"file": "named by the file", "argument": "as you say", "assumed": "assumed"}[entry["space_from"]]
    return f"{printable(entry['name'])}, {entry['triangles']:,} triangles, {entry['space']}, {source}{turned}"
