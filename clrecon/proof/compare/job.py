"""The compare job: a scan in; the methods one after another, measured, as a page, as JSON and as pictures.

The folder of a comparison appears as a whole or not at all."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

from clrecon.errors import ClreconError, DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.make import check_levels, mask_and_preprocess, mask_parts
from clrecon.jobs.mesh.surfaces import choose_level, describe_level, plan_surfaces
from clrecon.jobs.outputs import check_kept
from clrecon.jobs.run import DeviceOpening, Laps, to_json
from clrecon.opencl import Device
from clrecon.proof.compare.figures import (
    SIZE,
    Figures,
    along_slices,
    choose_camera,
    collect_figures,
    draw_figures,
    find_planes,
)
from clrecon.proof.compare.findings import CompareReport
from clrecon.proof.compare.methods import COMPARED, Compared, CompareSettings, choose_methods
from clrecon.proof.compare.page import make_page
from clrecon.proof.compare.processes import Request, measure_in_processes, open_methods, save_volume
from clrecon.proof.compare.records import Given, compose_report, make_record
from clrecon.proof.phantom import phantom_truth
from clrecon.reading import read_selected
from clrecon.system.files import StagedFolder, check_folder, temporary_folder
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.packages import is_installed, missing_package, package_of
from clrecon.system.paths import final_mode, keep_existing, system_errors
from clrecon.system.progress import Progress, device_seconds, ignore_progress
from clrecon.system.text import format_hu, list_names

PAGE, REPORT = "index.html", "report.json"

_NAMES = "|".join(map(re.escape, COMPARED))
_OWN = re.compile(rf"index\.html|report\.json|(?:{_NAMES})(?:-difference|-along)?\.png|slice-[a-z]+(?:-detail)?\.png")


def check_report_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder that will be made, or that of an earlier comparison, which will be replaced."""
    folder = check_folder(path, _OWN, "report")
    names = set(os.listdir(folder)) if folder.is_dir() else set()
    if names and not {PAGE, REPORT} <= names:
        raise UsageError(
            f"the folder {path} holds pictures without the page of a comparison: name a new or empty one for the report"
        )
    return folder


@contextlib.contextmanager
def stage_report_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Make a folder under a temporary name; at the end of the block its files go to the disk, and it to its place."""
    folder, size = check_report_folder(path), 0
    with system_errors(path), temporary_folder(folder.parent) as staged:
        staged.chmod(final_mode(folder, 0o777))
        yield staged
        for file in staged.iterdir():
            with open(file, "rb") as stream:
                os.fsync(stream.fileno())
                size += os.fstat(stream.fileno()).st_size
        StagedFolder(path, staged, folder, size).commit()


log = get_logger(__name__)


def make_comparison(
    source: str | Path,
    output: str | Path,
    settings: CompareSettings | None = None,
    *,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> CompareReport:
    """Run all methods on one scan at one level, measure what they make, and write the page.

    Each method runs in a process of its own, one after another: the first run in a new process, then warm ones.  A
    method that fails is a row that says so; a warning names the methods and plots whose packages are not installed.

    source: See `clrecon.reading.read_volume`.
    output: Folder for ``index.html``, ``report.json`` and pictures: a new or empty one, or that of an earlier
        comparison, which is replaced; with `no_clobber` a folder that holds anything stays and is an `OutputError`.
    """
    settings = settings or CompareSettings()
    progress = progress or ignore_progress
    watch = Laps()
    truth = None if settings.truth is None else _check_truth(Path(settings.truth))
    methods, left_out = choose_installed(settings)
    with keep_existing(keep=no_clobber):
        folder = check_report_folder(output)
    check_kept([("the report", output)], source, settings.truth)
    volume, device, read_s = _open_input(source, settings, progress, watch)
    given = _prepare_volume(volume, settings, device, progress)
    given = given._replace(warnings=[*left_out, *given.warnings])
    volume, level = given.volume, given.level
    watch.lap("mask")
    with contextlib.ExitStack() as stack:
        with system_errors(output):
            work = stack.enter_context(temporary_folder(folder.parent))
            save_volume(work, volume)
        figures = Figures(work, volume, level, settings.reference)
        figures.planes, figures.box = find_planes(volume, level)
        rows = _run_methods(figures, methods, settings, device, progress)
        watch.lap("methods")
        measured = _measure_methods(rows, figures, settings, truth, progress)
        watch.lap("measure")
        progress("report", 0, 0)
        records = [make_record(COMPARED[name], each, measured.get(name, {}), read_s) for name, each in rows.items()]
        collect_figures(figures, records)
        records = figures.complete(records)
        if settings.paper:
            figures.compare_with_slice()
        report = compose_report(given, settings, device, records, figures, read_s, watch)
        with keep_existing(keep=no_clobber), stage_report_folder(output) as staged:
            draw_figures(figures, staged)
            for name, text in ((PAGE, make_page(report, figures)), (REPORT, to_json(report) + "\n")):
                (staged / name).write_text(text, encoding="utf-8", newline="\n")
    log_warnings(log, report.warnings, volume.report.get("warnings", ()))
    log.info("%d methods compared on %s in %.3f s", len(records), report.device, watch.total())
    return report


def choose_installed(settings: CompareSettings) -> tuple[list[Compared], list[str]]:
    """Return the methods whose packages are installed, and a line on what is left out; named methods must be there."""
    absent: dict[str, list[str]] = {} if is_installed("matplotlib") else {"matplotlib": ["plots"]}
    chosen = choose_methods(settings.methods, settings.reference)
    lacking = [method for method in chosen if method.module and not is_installed(method.module)]
    for method in lacking:
        if method.name in (*settings.methods, settings.reference):
            raise missing_package(method.module, f"the method {method.name}")
        absent.setdefault(package_of(method.module), []).append(method.name)
    names = ", ".join(f"{list_names(names)} ({package})" for package, names in absent.items())
    left_out = [f"left out, their packages are not installed: {names}"] if absent else []
    return [method for method in chosen if method not in lacking], left_out


def _check_truth(path: Path) -> str:
    """Return the folder of a phantom's truth, which can be read."""
    folder = path.parent if path.name == "truth.json" and not path.is_dir() else path
    phantom_truth(folder)
    return str(folder.resolve())


def _open_input(
    source: str | Path, settings: CompareSettings, progress: Progress, watch: Laps
) -> tuple[Volume, Device, dict[str, float]]:
    """Read the input twice, while the device opens; also return the seconds of both times."""
    progress("device", 0, 0)
    read_s: dict[str, float] = {}
    with DeviceOpening(settings.device, lambda device: None) as opening:
        device = opening.wait()
        watch.lap("device")
        read = partial(read_selected, source, settings, progress=progress)
        for name in ("first", "warm"):
            start = perf_counter()
            volume = read()
            read_s[name] = perf_counter() - start
        watch.lap("read")
    return volume, device, read_s


def _prepare_volume(volume: Volume, settings: CompareSettings, device: Device, progress: Progress) -> Given:
    wanted = settings.as_mesh()
    surfaces = plan_surfaces(wanted.levels)
    volume = mask_parts(volume, surfaces, wanted, device, progress)
    choice = choose_level(volume, wanted, progress)
    if choice is not None:
        surfaces = plan_surfaces([choice.iso_value])
    check_levels(volume, surfaces)
    volume = mask_and_preprocess(volume, surfaces, wanted, device, progress)
    facts, warnings = describe_level(volume, wanted, choice)
    level = surfaces[0].iso_value
    assert isinstance(level, float | int)
    low, high = volume.hu_range or (math.nan, math.nan)
    if not level <= high:
        raise NoSurfaceError(
            f"no surface at {level:g} HU: the volume runs from {format_hu(low)} to {format_hu(high)} HU"
        )
    return Given(volume, float(level), str(facts["iso_value_reason"]), warnings)


def _run_methods(
    figures: Figures, methods: Sequence[Compared], settings: CompareSettings, device: Device, progress: Progress
) -> dict[str, dict[str, Any]]:
    """Run the methods one after another; those on a device that hangs are not tried any more."""
    volume = figures.volume
    camera = choose_camera(volume, figures.box)
    along = along_slices(volume) if settings.paper else None
    rows: dict[str, dict[str, Any]] = {}
    hung = False
    with open_methods() as run:
        for done, method in enumerate(methods):
            progress("compare methods", done, len(methods))
            if hung and method.on_device:
                rows[method.name] = {"state": "failed", "kind": "DeviceError", "error": "not run: the device hangs"}
                continue
            request = Request(
                method=method.name, folder=str(figures.work), iso_value=figures.level, closed=settings.closed,
                device=device.index, memory=settings.memory, repeat=settings.repeat, timeout=device_seconds(),
                camera=camera, size=SIZE, along=along,
            )  # fmt: skip
            rows[method.name] = run(request)
            hung = hung or bool(rows[method.name].get("hung"))
    progress("compare methods", len(methods), len(methods))
    _refuse_nothing(rows)
    return rows


def _refuse_nothing(rows: dict[str, dict[str, Any]]) -> None:
    """Raise the first error where no method works: NoSurfaceError where they found none, else that of a device."""
    if any(each["state"] == "done" for each in rows.values()):
        return
    errors: Sequence[dict[str, Any]] = list(rows.values())
    empty = [each for each in errors if each["kind"] == "NoSurfaceError"]
    kind: type[ClreconError] = NoSurfaceError if empty else DeviceError
    first = (empty or errors)[0]["error"]
    raise kind(str(first) if empty else f"none of {len(errors)} methods works; the first says: {first}")


def _measure_methods(
    rows: dict[str, dict[str, Any]], figures: Figures, settings: CompareSettings, truth: str | None, progress: Progress
) -> dict[str, dict[str, Any]]:
    done = [name for name, each in rows.items() if each["state"] == "done" and (each["triangles"] or each["points"])]
    asked = {
        "folder": str(figures.work),
        "reference": settings.reference if settings.reference in done else None,
        "iso_value": figures.level,
        "closed": settings.closed,
        "truth": truth,
    }
    measured: dict[str, dict[str, Any]] = {}
    progress("measure methods", 0, len(done))
    for name, measures in measure_in_processes(asked, done):
        measured[name] = measures
        progress("measure methods", len(measured), len(done))
    return measured
