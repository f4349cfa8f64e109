"""``clrecon batch``: the meshes of many scans, each read once, with a table and a page of all."""

from __future__ import annotations

import argparse
import json
import os
from functools import partial
from typing import TYPE_CHECKING, Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.cli.mesh import add_mesh_options
from clrecon.errors import UsageError
from clrecon.jobs.batch.plan import COLUMNS, PAGE, TABLE, BatchSettings, Plan, read_cases
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.options import ALL_DEVICES, locate_region_rule
from clrecon.system.arguments import current_speaker
from clrecon.system.light_dataclass import replace
from clrecon.system.progress import DEFAULT_SECONDS

if TYPE_CHECKING:
    from clrecon.jobs.batch.job import BatchReport
    from clrecon.jobs.batch.scheduler import Outcome

_EPILOG = """\
A manifest is a table in UTF-8 with commas or semicolons. Its first line names the columns: case, input, and if needed
labels and options of the meshes and pictures, such as hu. Paths start at its folder. Of a folder each series of CT
slices is a case, named by its number.

OUT/CASE holds the mesh, a picture, with labels a table of them, and case.json, all or nothing. OUT/cohort.csv and
OUT/cohort.html show all cases, and name no file and no patient. See docs/batch.md.

examples:
  clrecon batch cohort.csv -o OUT --hu 300
  clrecon batch CT_FOLDER -o OUT --format ply --workers 2
  clrecon batch cohort.csv -o OUT --hu 300 --resume
  clrecon batch cohort.csv -o OUT --hu 300 --state shown.view.json
  clrecon batch cohort.csv -o OUT --hu 300 --part 3/40
  clrecon batch cohort.csv -o OUT --collect"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("input", metavar="MANIFEST", help="table of the cases, or a folder whose series are the cases")
    common.add_output(parser, "folder that gets a folder for each case, the table and the page")
    common.add_fields(parser.add_argument_group("output of each case"), BatchSettings, "make")
    common.add_fields(parser.add_argument_group("how it runs"), BatchSettings, "run")
    common.add_fields(parser.add_argument_group("existing cases"), BatchSettings, "again")
    add_mesh_options(parser, without=("path",))


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.batch.job import run_batch

    if options.device == ALL_DEVICES and options.devices is None:
        options.device, options.devices = None, ALL_DEVICES
    batch = common.make_settings(BatchSettings, options)
    plan = Plan(
        output=options.output,
        batch=batch,
        given=_pick_options(options),
        options=getattr(current_speaker(), "options", None),
        timeout=DEFAULT_SECONDS if options.timeout is None else options.timeout,
        no_clobber=options.no_clobber,
    )
    cases = read_cases(options.input, plan)
    if batch.state is not None:
        plan = replace(plan, **_carry_view(batch.state, {case.labels is not None for case in cases}))

    def tell_outcome(outcome: Outcome) -> None:
        answer = outcome.answer
        if answer.status != "done" or answer.error:
            before, reason = " before" * answer.kept, outcome.death or answer.error or "see its report"
            console.warn(f"{outcome.case.name}: {answer.status}{before}, {printable(reason)}", with_json=True)

    try:
        report = run_batch(
            cases, plan, tell=tell_outcome, warn=partial(console.warn, with_json=True), progress=console.progress
        )
    except KeyboardInterrupt:
        console.warn("cases that are whole stay, and --resume goes on", with_json=True)
        raise
    console.result(report)
    for line in _describe_batch(report, options.output, is_part=batch.part is not None):
        console.say(line)
    return report.exit_code


def _carry_view(path: str, is_labelled: set[bool]) -> dict[str, Any]:
    """Return the entries of a plan of what a saved view shows of the cases, and by what it is drawn."""
    from clrecon.viewer.model.saved_view import carry_view, read_view
    from clrecon.viewer.session.opening import draw_carried

    view = carry_view(read_view(path))
    if False in is_labelled and "labels" in view["objects"]:
        raise UsageError(f"the saved view shows a label map: name one in the column {COLUMNS[2]} of each row")
    return {"carried": json.dumps(view, sort_keys=True), "drawer": f"{draw_carried.__module__}:{draw_carried.__name__}"}


def _pick_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options of the meshes by their names; the files of regions by full paths, for workers elsewhere."""
    given = common.pick(options, LabelChoice) | common.pick(options, MeshSettings)
    given.pop("scheduler", None)  # deals out cases here
    rules = [locate_region_rule(rule, os.getcwd()) for rule in given.get("region", ())]
    return given | ({"region": tuple(rules)} if rules else {})


def _describe_batch(report: BatchReport, output: str, *, is_part: bool) -> list[str]:
    counts = ", ".join(f"{count:,} {status}" for status, count in report.statuses.items()) or "none was left to make"
    earlier = f"; {report.kept:,} kept as an earlier run made them" if report.kept else ""
    paths = [os.path.join(output, name) for name in (PAGE, TABLE)]
    if is_part:
        wrote = f"cases in {printable(output)}; --collect writes the table and the page of all parts"
    else:
        wrote = " and ".join(map(printable, paths))
    return [
        f"cases    {report.cases:,}: {counts}{earlier}",
        f"time     {common.describe_times(report.seconds)}",
        f"wrote    {wrote}",
    ]
