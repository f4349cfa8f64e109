"""One case of a batch, made in a folder under a temporary name that takes its place as a whole; and its report."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from itertools import chain
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple, NoReturn

from clrecon.errors import ClreconError, DeviceError, OutputError, UnreachableError
from clrecon.jobs.batch.plan import REPORT, BatchSettings, Case, Plan, make_key
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.options import DeviceSettings, InputSettings, ScanSettings
from clrecon.jobs.run import JobReport, Run, SharedScan, error_as_dict, stage_report
from clrecon.system.arguments import OptionSpeaker, in_python, spoken_by
from clrecon.system.files import hold_interrupts, temporary_folder
from clrecon.system.light_dataclass import dataclass, fields
from clrecon.system.packages import hide_unused
from clrecon.system.paths import final_mode, place_folder, system_errors
from clrecon.system.processes import end_process
from clrecon.system.progress import time_limit

DONE, GATE = "done", "gate"
REFUSED = "refused"
FAILED, LOST = "failed", "lost"
"""Status of a case: with strict gates a failed one, a verdict on the input, bad luck, and the death of its process."""

_REFUSED_CODES = (2, 3, 4)
"""Exit codes of verdicts on the input and the settings, which another run repeats; others may be luck of the run."""

PICTURE, LABELS = "picture.png", "labels.csv"


@dataclass(frozen=True, eq=False, kw_only=True)
class CaseReport(JobReport):
    """Report of a case, the commit mark of its folder; docs/contract.md explains its entries.

    key: See `make_key`; None where the input could not be listed.
    mesh, labels, volume: Entries of the reports of both jobs; None where a case failed, or has no label map.
    """

    SCHEMA = "case"

    _LAST = ("device", "driver", *JobReport._LAST)

    case: str
    status: str
    error: Mapping[str, Any] | None
    key: str | None
    files: list[dict[str, Any]]
    mesh: Mapping[str, Any] | None = None
    labels: list[Any] | None = None
    device: str | None = None
    driver: str | None = None
    volume: Mapping[str, Any] | None = None


_SHARED = {"schema", "device", "driver", "memory_allowed_bytes", *JobReport._LAST}


class Answer(NamedTuple):
    """What came of a case: `is_last` of a process whose device hangs, `kept` of an earlier run, `error` its words."""

    status: str
    is_last: bool = False
    kept: bool = False
    error: str = ""


def make_case(case: Case, plan: Plan) -> Answer:
    """Make the files of a case and its report, and put its folder in place, unless an earlier one is to be kept.

    Only what the output folder itself cannot take is an error, an `OutputError`: it ends the batch.
    """
    key, silence = None, ""
    try:
        key = make_key(case, plan)
    except UnreachableError as error:
        silence = f"kept, and not compared with its input: {error}"
    except (ClreconError, OSError):
        pass  # reading says what is wrong
    earlier = read_report(plan.folder_of(case)) if plan.batch.resume else None
    if earlier and earlier["status"] in (DONE, GATE, REFUSED) and (silence or (key and earlier["key"] == key)):
        return Answer(earlier["status"], kept=True, error=silence or (earlier["error"] or {}).get("message", ""))
    with _folder_in_place(case, plan) as folder:
        with suppress(OSError):  # the largest memory begins anew: Linux measures that of each case, others that of all
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        with Run(plan) as run:
            report = _make_or_fail(case, plan, run, folder, key)
        return Answer(report.status, error=(report.error or {}).get("message", ""))


def read_report(folder: Path) -> dict[str, Any] | None:
    """Return the report of a case; None if there is none, or a file of the case is not there as it says."""
    try:
        report: dict[str, Any] = json.loads((folder / REPORT).read_bytes())
        whole = all(os.stat(folder / file["name"]).st_size == file["bytes"] for file in report["files"])
        return report if whole and report["case"] == folder.name and report["status"] else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


def fail_case(case: Case, plan: Plan, status: str, error: Mapping[str, Any]) -> None:
    """Write the report of a case whose process has died, in place of what was there."""
    with _folder_in_place(case, plan) as folder, Run(plan) as run:
        _write_report(run, folder, case=case.name, status=status, error=error, key=None, files=[])


@contextmanager
def _folder_in_place(case: Case, plan: Plan) -> Iterator[Path]:
    """Make a folder that replaces that of the case at the end of the block; messages know it by that name alone."""
    target = plan.folder_of(case)
    with system_errors(target), temporary_folder(Path(plan.output)) as folder:
        try:
            yield folder
        except OutputError as error:
            raise OutputError(str(error).replace(str(folder), str(target))) from error
        with hold_interrupts():
            folder.chmod(final_mode(target, 0o777))
            place_folder(folder, target, target, keep=plan.no_clobber)


def _make_or_fail(case: Case, plan: Plan, run: Run, folder: Path, key: str | None) -> CaseReport:
    try:
        return _fill_folder(case, plan, run, folder, key)
    except Exception as error:
        if isinstance(error, OutputError) and isinstance(error.__cause__, OSError):
            raise
        problem = _as_known(error)
    for entry in os.scandir(folder):
        os.unlink(entry)
    status = REFUSED if problem["exit_code"] in _REFUSED_CODES else FAILED
    return _write_report(run, folder, case=case.name, status=status, error=problem, key=key, files=[])


def _as_known(error: Exception) -> dict[str, Any]:
    """Return an error as reports have it; what is no error of clrecon is one case, and no end of the others."""
    if isinstance(error, ClreconError):
        known: dict[str, Any] = error_as_dict(error)["error"]
        return known
    words = "out of memory" if isinstance(error, MemoryError) else f"unexpected error ({error!s:.300})"
    return {"kind": type(error).__name__, "exit_code": ClreconError.exit_code, "message": words}


def _fill_folder(case: Case, plan: Plan, run: Run, folder: Path, key: str | None) -> CaseReport:
    from clrecon.jobs.mesh.job import make_mesh
    from clrecon.jobs.mesh.refinement import find_failed
    from clrecon.jobs.mesh.surfaces import names_level

    settings, asked = plan.settings_of(case), plan.outputs_of(case)
    shared = None if (case.labels, asked.cloud, plan.drawer) == (None, None, None) else SharedScan()
    mesh = make_mesh(case.source, folder / f"mesh{asked.format}", settings, measure=asked.measure, shared=shared)
    run.lap("mesh")
    warnings = list(mesh.warnings)
    stats = None
    if case.labels is not None:
        from clrecon.jobs.settings import StatsSettings
        from clrecon.jobs.stats import measure_stats

        assert settings.labels is not None
        scan = _settings_in(settings, ScanSettings, DeviceSettings)
        asked_of = StatsSettings(**scan, labels=case.labels, label=settings.labels.label)
        stats = measure_stats(case.source, asked_of, csv_path=folder / LABELS, shared=shared)
        warnings += stats.warnings
        run.lap("labels")
    if asked.cloud is not None:
        warnings += _write_cloud(case, folder, asked.cloud, settings, mesh.iso_value_hu, shared)
        run.lap("cloud")
    if shared is not None and plan.drawer is not None:
        draw = resolve_name(plan.drawer)
        shown = MeshSettings(**_settings_in(settings, InputSettings))
        how = {"size": asked.size, "carried": plan.carried, "read": shared.read}
        warnings += draw(case.source, case.labels, shown, folder / PICTURE, **how)
        run.lap("picture")
    elif asked.picture:
        warnings += _take_pictures(folder, asked, settings)
        run.lap("picture")
    if not asked.mesh:
        for path in folder.glob(f"mesh*{asked.format}"):
            path.unlink()
    own_units = settings.is_for_print and names_level(settings)
    gates = find_failed(mesh, own_units=own_units) if settings.strict else ()
    return _write_report(
        run,
        folder,
        warnings,
        volume=mesh.volume,
        case=case.name,
        status=GATE if any(gates) else DONE,
        error=None,
        key=key,
        files=[{"name": entry.name, "bytes": entry.stat().st_size} for entry in sorted(folder.iterdir())],
        mesh={name: value for name, value in mesh.as_dict().items() if name not in _SHARED},
        labels=None if stats is None else [label.as_dict() for label in stats.labels],
        device=mesh.device,
        driver=mesh.driver,
    )


def _settings_in(settings: MeshSettings, *classes: type) -> dict[str, Any]:
    """Return those settings of the mesh that these classes have as well."""
    shared = chain(*map(fields, classes))
    return {field.name: getattr(settings, field.name) for field in shared}


def _write_cloud(
    case: Case, folder: Path, extension: str, settings: MeshSettings, level: float | None, shared: SharedScan | None
) -> list[str]:
    """Write the points of the surface that was extracted, from the same voxels; return the warnings."""
    from clrecon.jobs.cloud.job import CloudFiles, make_cloud
    from clrecon.jobs.cloud.settings import CloudSettings

    files = CloudFiles(folder / f"cloud{extension}")
    asked = CloudSettings(
        **_settings_in(settings, InputSettings), hu=level, labels=case.labels, space=settings.space, normals=True
    )
    return make_cloud(case.source, files, asked, shared=shared).warnings


def _take_pictures(folder: Path, asked: BatchSettings, settings: MeshSettings) -> list[str]:
    """Take the pictures of the meshes that were written; return their warnings."""
    from clrecon.jobs.render.job import PictureFiles, make_pictures
    from clrecon.jobs.render.settings import MeshFile, RenderSettings

    first, *others = sorted(folder.glob(f"mesh*{asked.format}"))
    meshes = tuple(MeshFile(str(path)) for path in others)
    look = RenderSettings.of(
        "mesh", meshes=meshes, mesh_space=settings.space, size=asked.size, device=settings.device,
        memory=settings.memory, views=asked.views,
    )  # fmt: skip
    return make_pictures(first, PictureFiles(folder / PICTURE), look).warnings


def _write_report(run: Run, folder: Path, warnings: Sequence[str] = (), **entries: Any) -> CaseReport:
    report = run.report(CaseReport, warnings, **entries)
    with stage_report(folder / REPORT, report) as file:
        file.commit()
    return report


def run_worker() -> NoReturn:
    """Make cases that are named on standard input, a line of JSON each behind that of the plan.

    Each is answered by a line: an `Answer`, or an error, see `error_as_dict`.  Ctrl-C is for the process that asks: it
    ends this one, and the folder of a case that is not whole is removed.
    """
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # a driver may print
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    hide_unused()
    from clrecon.opencl import has_hung_commands

    try:
        plan = Plan.from_json(sys.stdin.readline())
        speaker = in_python if plan.options is None else OptionSpeaker(plan.options)
        with spoken_by(speaker), time_limit(plan.timeout):
            problem = _open_device(plan)
            for line in sys.stdin:
                try:
                    if problem is not None:
                        raise problem
                    answer: Any = make_case(Case(*json.loads(line)), plan)._replace(is_last=has_hung_commands())
                except (DeviceError, OutputError) as error:
                    answer = error_as_dict(error)
                answers.write(json.dumps(answer) + "\n")
                answers.flush()
    except (KeyboardInterrupt, BrokenPipeError):
        pass
    end_process()


def _open_device(plan: Plan) -> DeviceError | None:
    """Open the device of this worker; return why there is none, which no case could change."""
    from clrecon.operators import choose_device

    with suppress(ImportError):  # before threads: one that imports scipy beside one with nibabel gets it half made
        import_module("scipy")
    try:
        choose_device(plan.device)
    except DeviceError as error:
        return error
    return None
