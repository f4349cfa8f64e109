"""``clrecon view``: look at scans and meshes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh import add_labels, add_levels
from clrecon.errors import UsageError
from clrecon.jobs.mesh.purposes import mesh_fields
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.options import size_option, space_option
from clrecon.jobs.view import ViewSettings
from clrecon.system.records import describe_volume, name_schema
from clrecon.system.text import format_bytes, format_volume

_EPILOG = """\
Without --html and --window the inputs are shown in a browser of this computer and drawn on the OpenCL device: a slider
for the iso value, presets, slices, parts, measurements, clips, and saved files; the key h shows all keys. OpenGL is not
needed; over a network use an ssh tunnel. Ctrl-C, or q in the page, ends the command.

The page of --html is one file: any browser from 2023 on shows it, without a server and offline. It loads nothing from
outside and holds no patient data: files are numbered, not named, unless --name is given. It turns, clips and measures,
and shows or hides each part (component, label, file). See docs/view.md.

examples:
  clrecon view
  clrecon view CT_FOLDER
  clrecon view CT_FOLDER bone.stl cloud.ply --labels spine.nii.gz --save-as shown.3mf
  clrecon view CT_FOLDER --no-open --port 8000
  clrecon view CT_FOLDER --window
  clrecon view shown.view.json CT_FOLDER
  clrecon view shown.view.json
  clrecon view CT_FOLDER --state shown.view.json --picture shown.png
  clrecon view CT_FOLDER --html page.html --with-slices
  clrecon view CT_FOLDER --html spine.html --labels spine.nii.gz
  clrecon view bone.stl implant.ply --html both.html --name bone --name implant"""
_SHOWN_PARTS = 12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument(
        "inputs",
        metavar="INPUT",
        nargs="*",
        help="file of a mesh or cloud, or a scan: DICOM folder or file, NIfTI, NRRD or MetaImage file; a saved view"
        " (.json) is shown of the other inputs (default: a page where files are dropped)",
    )
    shown = parser.add_argument_group("what is shown")
    shown.add_argument("--html", metavar="FILE", help="write a page that shows the inputs: .html", first=True)
    common.add_picture(shown, "draw what the view begins with into a file: .png, .jpg or .tif")
    common.add_option(shown, "size", size_option())
    shown.add_argument(
        "--window", action="store_true", help="open a plain window of PyVista instead of the browser", first=True
    )
    shown.add_argument(
        "--no-open", dest="opens", action="store_false", help="only print the address, do not open the browser"
    )
    shown.add_argument("--port", type=int, metavar="N", help="port on 127.0.0.1 (default: a free one)")
    shown.add_argument(
        "--save-as",
        action="append",
        default=[],
        metavar="FILE",
        help="file that the key s writes into the current folder: a mesh, cloud, volume or picture by its extension;"
        " numbered if it exists; may be given again (default: a download)",
        first=True,
    )
    common.add_fields(shown, ViewSettings, "", "state")
    common.add_option(shown, "space", space_option("frame of picked points"))
    common.add_no_clobber(shown)
    common.add_reading(parser)
    common.add_masking(parser, crop=True)
    common.add_fields(add_levels(parser, "surface of a scan"), MeshSettings, "kind")
    common.add_fields(parser.add_argument_group("components of a scan"), MeshSettings, "selection")
    add_labels(parser)
    common.add_device(parser.add_argument_group("device, for scans"))


def run(options: argparse.Namespace, console: Console) -> int:
    _take_saved_view(options)
    _check_faces(options)
    if options.window:
        return _show_window(options, console)
    if options.picture is not None:
        how = {"size": options.size, "no_clobber": options.no_clobber}
        return draw_view(options.inputs, _settings(options), options.picture, console, **how)
    if options.html is None:
        return _serve(options, _settings(options), console)
    from clrecon.jobs.view.job import write_view

    settings = _settings(options)
    report = write_view(options.inputs, options.html, settings, **common.run_options(options, console))
    common.show_report(report, _describe_view(report, options.html), options, console)
    return 0


def _settings(options: argparse.Namespace) -> ViewSettings:
    return common.make_settings(ViewSettings, options, scan=MeshSettings(**mesh_fields(vars(options))))


def _take_saved_view(options: argparse.Namespace) -> None:
    """Take a saved view among the inputs for that of --state."""
    saved = [path for path in options.inputs if path.lower().endswith(".json")]
    if len(saved) + (options.state is not None) > 1:
        raise UsageError("one saved view can be shown at a time: leave the others, or --state, out")
    if saved:
        (options.state,) = saved
        options.inputs = [path for path in options.inputs if path not in saved]


def _check_faces(options: argparse.Namespace) -> None:
    faces = {"--window": options.window, "--html": options.html, "--picture": options.picture}
    given = [name for name, value in faces.items() if value]
    if len(given) > 1:
        raise UsageError(f"{' and '.join(given)} show the inputs in different ways: ask for one of them")
    if options.state is not None and given in (["--window"], ["--html"]):
        raise UsageError(f"--state belongs to the view in the browser and to --picture: leave out {given[0]}, or it")
    if options.with_slices and options.html is None:
        raise UsageError("--with-slices belongs to the page of --html: name its file with --html")
    if options.size is not None and options.picture is None:
        raise UsageError("--size is that of the picture: name its file with --picture")
    if given and not options.inputs:
        raise UsageError(f"{given[0]} needs an input: name a scan or a mesh")
    if given:
        for name, is_given in (
            ("--port", options.port is not None), ("--no-open", not options.opens), ("--save-as", options.save_as)
        ):  # fmt: skip
            if is_given:
                raise UsageError(f"{name} belongs to the view in the browser: leave out {given[0]}, or it")
    elif options.quiet and not (options.opens or options.json):
        raise UsageError("-q hides the address that is to be opened: leave it out, or --no-open")
    if options.html is None and options.picture is None and options.no_clobber:
        raise UsageError("a view replaces no file: leave --no-clobber out")


def _show_window(options: argparse.Namespace, console: Console) -> int:
    from clrecon.system.display import DisplayProbe, NoDisplayError

    warnings: list[str] = []

    def ready(warned: list[str]) -> None:
        warnings.extend(warned)
        for warning in warned:
            console.warn(warning)
        console.finish()

    try:
        with DisplayProbe() as probe:  # it takes half a second, in which the settings are made
            settings = _settings(options)
            from clrecon.viewer.plotter import show_inputs

            show_inputs(options.inputs, settings, progress=console.progress, ready=ready, probe=probe)
    except NoDisplayError as error:
        raise NoDisplayError(
            f"{error}; without --window this is shown in a browser, --html page.html writes a page, and clrecon render"
            " draws pictures"
        ) from error
    console.result(name_schema("view", {"warnings": warnings}))
    return 0


def draw_view(
    inputs: Sequence[str], settings: ViewSettings, output: str, console: Console, *, size: Any, no_clobber: bool
) -> int:
    """Draw what a view begins with into a file: ``view --picture`` and ``render --state``."""
    from clrecon.viewer.session import opening

    warnings, lines = opening.draw_view(
        inputs, settings, output, size or (1024, 1024), no_clobber=no_clobber, progress=console.progress
    )
    console.result(name_schema("view", {"warnings": warnings}))
    for warning in warnings:
        console.warn(warning)
    for line in lines:
        console.say(f"wrote    {printable(line)}")
    return 0


def _serve(options: argparse.Namespace, settings: ViewSettings, console: Console) -> int:
    """Serve until Ctrl-C, which is how it ends: exit code 0.  Faults, after which the view goes on, are shown with
    their traces.
    """
    import logging

    from clrecon.viewer.web.server import serve_view

    faults = logging.StreamHandler()
    faults.setLevel(logging.ERROR)
    log = logging.getLogger("clrecon.viewer")
    log.addHandler(faults)

    def ready(server: Any, used: Any, warnings: list[str]) -> None:
        device = used.label
        facts = {"address": server.address, "port": server.port, "device": device, "warnings": warnings}
        console.result(name_schema("view", facts))
        for warning in warnings:
            console.warn(warning)
        console.say(f"device   {printable(device)}")
        console.say(f"view     {server.address}", whole=True)
        console.say("         for browsers of this computer; whoever has this address can see the scan; Ctrl-C ends")
        console.finish()

    try:
        serve_view(
            options.inputs,
            settings,
            port=options.port,
            opens=options.opens,
            save_as=options.save_as,
            wrote=lambda line: console.say(f"wrote    {printable(line)}"),
            progress=console.progress,
            ready=ready,
        )
    finally:
        log.removeHandler(faults)
    return 0


def _describe_view(report: dict[str, Any], output: str) -> list[str]:
    lines = [f"input    {_describe_input(entry)}" for entry in report["inputs"]]
    lines.append(f"mesh     {report['vertices']:,} vertices, {report['triangles']:,} triangles")
    rows = [
        [part["name"], f"{part['triangles']:,} triangles", "" if part["ml"] is None else format_volume(part["ml"])]
        for part in report["parts"][:_SHOWN_PARTS]
    ]
    if len(report["parts"]) > 1:
        lines += [f"         {printable(row)}" for row in common.table(rows, right=(1, 2))]
    if len(report["parts"]) > _SHOWN_PARTS:
        lines.append(f"         and {len(report['parts']) - _SHOWN_PARTS:,} more")
    if report["device"]:
        lines.append(f"device   {printable(report['device'])}")
    size = f"{format_bytes(report['output']['bytes'])}, vertices moved by at most {report['half_step_mm']:.2g} mm"
    return [*lines, f"wrote    {printable(output)}, {size}", f"time     {report['seconds']['total']:.2f} s"]


def _describe_input(entry: dict[str, Any]) -> str:
    if entry["kind"] == "scan":
        return f"{describe_volume(entry['volume']) or printable(entry['name'])}, surface of {entry['surface']}"
    return f"{printable(entry['name'])}, {entry['triangles']:,} triangles, {common.describe_frame(entry)}"
