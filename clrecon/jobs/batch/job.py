"""The batch job: which cases are made, who makes them, and the table and the page of all at the end."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from time import perf_counter

from clrecon.errors import PARTLY_DONE, OutputError, UnreachableError, UsageError
from clrecon.jobs.batch.case import DONE, LOST, fail_case, read_report
from clrecon.jobs.batch.cohort import MISSING, write_cohort
from clrecon.jobs.batch.plan import PAGE, TABLE, Case, Plan, check_places
from clrecon.jobs.batch.scheduler import DaskScheduler, LocalScheduler, Outcome, Scheduler
from clrecon.jobs.outputs import check_files
from clrecon.jobs.run import JobReport, Run
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.paths import resolve_target, shown_path, system_errors
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import escape_text


@dataclass(frozen=True, eq=False, kw_only=True)
class BatchReport(JobReport):
    """Report of `run_batch`.

    cases: Of this run: those of the part.
    made, kept: Cases that this run made, done or not, and those that it left as an earlier one had made them.
    statuses: How many of the cases have each status, see docs/batch.md.
    """

    SCHEMA = "batch"

    cases: int
    made: int
    kept: int
    statuses: dict[str, int]

    @property
    def exit_code(self) -> int:
        return 0 if self.statuses.get(DONE, 0) == self.cases else PARTLY_DONE


def run_batch(
    cases: Sequence[Case],
    plan: Plan,
    *,
    tell: Callable[[Outcome], None] = lambda outcome: None,
    warn: Callable[[str], None] = lambda text: None,
    progress: Progress = ignore_progress,
) -> BatchReport:
    """Make the cases that the plan asks for, each as a whole, and write the table and the page of all.

    tell: Gets the outcome of each case as it ends.
    warn: Gets what the user should know at once, such as that a scheduler has no workers.
    """
    asked = plan.batch
    _check_choice(plan)
    check_places(cases, plan.output)
    root = _open_output(plan, cases)
    if cases and cases[0].carried:
        columns = ", ".join(map(escape_text, cases[0].carried))
        warn(f"no options, but carried into {TABLE}: the columns {columns}")
    chosen = list(cases) if asked.part is None else list(cases[asked.part[0] - 1 :: asked.part[1]])
    counts: Counter[str] = Counter()
    kept_count = made_count = 0
    with Run(plan) as run:
        if asked.part is None:
            check_files([("the table", root / TABLE), ("the page", root / PAGE)])
        waiting = [] if asked.collect else chosen
        if asked.retry:
            earlier = [(case, _find_status(case, plan)) for case in chosen]
            waiting = [case for case, status in earlier if status in asked.retry]
            counts.update(status for _, status in earlier if status not in asked.retry)
            kept_count = counts.total() - counts[MISSING]
        start = perf_counter()
        progress(_count_cases(0, len(waiting), None), 0, 0)
        scheduler: Scheduler = (
            LocalScheduler(plan) if asked.scheduler is None else DaskScheduler(plan, asked.scheduler, warn)
        )
        outcomes = scheduler.run(waiting) if waiting else ()
        for number, outcome in enumerate(_with_advice(outcomes), start=1):
            if outcome.death:
                error = {"kind": "WorkerDied", "exit_code": None, "message": outcome.death}
                fail_case(outcome.case, plan, LOST, error)
            counts[outcome.answer.status] += 1
            kept_count += outcome.answer.kept
            made_count += not outcome.answer.kept
            tell(outcome)
            seconds = (perf_counter() - start) / max(made_count, 1) * (len(waiting) - number)
            progress(_count_cases(number, len(waiting), seconds if made_count else None), 0, 0)
        run.lap("cases")
        if asked.part is None:
            counts, names = write_cohort(cases, plan)
            if names:
                more = counts[MISSING] - len(names)
                named = f"{', '.join(names)}{f' and {more:,} more, all in {TABLE}' if more > 0 else ''}"
                retry = f"{name_parameter('retry', MISSING)} runs them"
                warn(f"{counts[MISSING]:,} of {len(cases):,} cases are missing: {named}; {retry}")
            run.lap("table")
        statuses = dict(counts.most_common())
        return run.report(BatchReport, (), cases=len(chosen), made=made_count, kept=kept_count, statuses=statuses)


def _with_advice(outcomes: Iterable[Outcome]) -> Iterator[Outcome]:
    """Yield the outcomes; an output that takes no more, or a lost scheduler, is an error that says how to go on."""
    try:
        yield from outcomes
    except (OutputError, UnreachableError) as error:
        more = f"; cases that are whole stay, and {name_parameter('resume', True)} goes on"
        raise type(error)(f"{error}{more}") from error


def _check_choice(plan: Plan) -> None:
    """Refuse options that say different things of the same case."""
    names = ("resume", "retry", "collect")
    given = [name_parameter(name, True) for name in names if getattr(plan.batch, name)]
    if plan.no_clobber:
        given.append(name_parameter("no_clobber", True))
    if len(given) > 1:
        raise UsageError(f"{' and '.join(given)} say different things of cases that are there: take one of them")
    if plan.batch.devices is not None and plan.device is not None:
        raise UsageError(f"{name_parameter('devices', 'D,D')} names the devices: leave {name_parameter('device')} out")
    if plan.batch.collect and plan.batch.part is not None:
        raise UsageError(
            f"{name_parameter('collect', True)} is about all cases: leave {name_parameter('part', 'I/N')} out"
        )


def _open_output(plan: Plan, cases: Sequence[Case]) -> Path:
    """Return the output folder, which is made unless it is there."""
    root = resolve_target(plan.output)
    if not root.exists():
        if not root.parent.is_dir():
            raise OutputError(
                f"cannot make {shown_path(plan.output)}: the folder around it does not exist; make it first"
            )
        if plan.batch.collect:
            raise UsageError(f"there is no folder {shown_path(plan.output)} whose cases could be collected")
        with system_errors(plan.output):
            root.mkdir()
    elif not root.is_dir():
        raise OutputError(f"cannot write cases into {shown_path(plan.output)}: it is a file, name a folder")
    if plan.no_clobber:
        there = [case.name for case in cases if os.path.lexists(root / case.name)]
        if there:
            raise OutputError(
                f"{len(there):,} of {len(cases):,} cases exist already and stay ({name_parameter('no_clobber', True)}),"
                f" such as {there[0]}: {name_parameter('resume', True)} makes the others"
            )
    return root


def _find_status(case: Case, plan: Plan) -> str:
    report = read_report(plan.folder_of(case))
    return MISSING if report is None else str(report["status"])


def _count_cases(number: int, total: int, seconds: float | None) -> str:
    """Return how many cases have ended, and how long the others may take."""
    if seconds is None or number == total:
        return f"{number:,} of {total:,} cases"
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.5 * length:
            return f"{number:,} of {total:,} cases, about {seconds / length:.0f} {unit} left"
    return f"{number:,} of {total:,} cases, about {seconds:.0f} s left"
