"""What a batch makes: the settings, the cases of a table or a folder, and the key by which a case is known again."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, get_args

from clrecon.errors import NoDicomError, UsageError
from clrecon.exchange.formats import CLOUD_FORMATS, MESH_INPUTS
from clrecon.jobs.cluster import LOCAL
from clrecon.jobs.devices import check_indexes, list_usable
from clrecon.jobs.mesh.purposes import settings_from
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.options import (
    ALL_DEVICES,
    ScanSettings,
    locate_region_rule,
    parse_region_rules,
    scheduler_option,
    size_option,
    view_option,
)
from clrecon.reading import tell_format
from clrecon.reading.sources import open_remote
from clrecon.reading.urls import check_url, is_url, refuse_url
from clrecon.system.arguments import DirectionName, name_parameter
from clrecon.system.light_dataclass import asdict, dataclass, field, fields, replace
from clrecon.system.options import option, options_of, pick_fields, read_cell
from clrecon.system.packages import import_package
from clrecon.system.paths import open_regular, shown_path
from clrecon.system.progress import DEFAULT_SECONDS
from clrecon.system.text import escape_text, unknown_name
from clrecon.version import package_version

_MOST_WORKERS = 256


def _parse_part(text: str) -> tuple[int, int]:
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise ValueError(f"{text!r:.40} is no part I/N of the cases: 1/4 is the first of four, 4/4 the last")
    return int(number), int(count)


_STATUSES = ("gate", "refused", "failed", "lost", "missing")
"""What can be said of a case that is not done, see docs/batch.md."""


def _parse_statuses(text: str) -> tuple[str, ...]:
    statuses = tuple(part.strip().lower() for part in text.split(","))
    for status in statuses:
        if status not in _STATUSES:
            raise ValueError(unknown_name("status", status, _STATUSES))
    return statuses


def _check_extension(parameter: str, extension: str, known: Iterable[str]) -> None:
    if extension not in known:
        raise UsageError(f"{name_parameter(parameter)}: {unknown_name('format', extension, known)}")


def _parse_extension(text: str) -> str:
    return text.lower() if text.startswith(".") else f".{text.lower()}"


_VIEWS: tuple[str, ...] = get_args(DirectionName)
_SIZE = (360, 360)


def _parse_views(text: str) -> tuple[str, ...]:
    views = tuple(part.strip().lower() for part in text.split(","))
    for view in views:
        if view not in _VIEWS or views.count(view) > 1:
            fault = unknown_name("view", view, _VIEWS) if view not in _VIEWS else f"the view {view} is given twice"
            raise ValueError(fault)
    return views


@dataclass(frozen=True, kw_only=True)
class BatchSettings:
    """What is made of each case beside the settings of its mesh, and how the cases are dealt out."""

    format: str = option(
        "--format EXT",
        f"format of the meshes, one of: {', '.join(MESH_INPUTS)} (default: .stl)",
        group="make",
        default=".stl",
        first=True,
        parse=_parse_extension,
        words=tuple(extension[1:] for extension in MESH_INPUTS),
    )
    measure: bool = option(
        "--no-measure", "leave out area, volume, components and gates of the meshes", group="make", default=True
    )
    mesh: bool = option(
        "--no-mesh",
        "delete the meshes of a case once they are measured and in its pictures",
        group="make",
        default=True,
    )
    cloud: str | None = option(
        "--cloud EXT",
        "also write a cloud of points of the same surface, with normals, as clrecon cloud --hu: format, such as ply",
        group="make",
        parse=_parse_extension,
        words=tuple(extension[1:] for extension in CLOUD_FORMATS),
    )
    picture: bool = option("--no-picture", "leave out the pictures of each case", group="make", default=True)
    views: Sequence[str] = view_option(
        "V[,V...]",
        f"sides of the patient from which pictures are taken: {', '.join(_VIEWS)} (default: {_VIEWS[0]})",
        group="make",
        default=(_VIEWS[0],),
        parse=_parse_views,
        words=_VIEWS,
    )
    size: tuple[int, int] = size_option(group="make", default=_SIZE)
    state: str | None = option(
        "--state FILE",
        "draw each case as in a saved view (.view.json) of one scan: from its direction, framed anew, without what lies"
        " at a place in that patient",
        group="make",
    )
    workers: int | None = option(
        "--workers N", "processes that run cases in parallel (default: one for each device)", group="run", first=True
    )
    devices: str | None = option(
        "--devices D,D",
        f"OpenCL devices by index, assigned to the workers in turn; {ALL_DEVICES}: those of this machine (default: the"
        " one of --device)",
        group="run",
    )
    scheduler: str | None = scheduler_option(
        f"run the cases on the workers of this Dask scheduler, such as tls://host:8786; {LOCAL}: start a scheduler and"
        " workers on this machine",
        group="run",
    )
    part: tuple[int, int] | None = option(
        "--part I/N",
        "make only every N-th case, from the I-th on, 1/N to N/N; write the table and the page with --collect",
        group="run",
        parse=_parse_part,
    )
    resume: bool = option(
        "--resume", "skip cases that exist already, made from the same files with the same settings", group="again",
        first=True,
    )  # fmt: skip
    retry: Sequence[str] = option(
        "--retry STATUS[,STATUS]",
        f"run only cases with one of these statuses: {', '.join(_STATUSES)} (without a status: all of them but"
        f" {_STATUSES[-1]})",
        group="again",
        first=True,
        default=(),
        nargs="?",
        const=_STATUSES[:-1],
        parse=_parse_statuses,
        words=_STATUSES,
    )
    collect: bool = option(
        "--collect", "make no case: write the table and the page of the existing cases", group="again", first=True
    )

    def __post_init__(self) -> None:
        _check_extension("format", self.format, MESH_INPUTS)
        if self.cloud is not None:
            _check_extension("cloud", self.cloud, CLOUD_FORMATS)
        if self.state is not None and not (self.picture and self.views == (_VIEWS[0],)):
            option_beside = name_parameter("views") if self.picture else name_parameter("picture", True)
            raise UsageError(f"{name_parameter('state')} draws one picture as saved: leave {option_beside} out, or it")
        if self.size != _SIZE:
            from clrecon.rendering.views.directions import checked_size

            checked_size(self.size)
        if self.workers is not None and not 1 <= self.workers <= _MOST_WORKERS:
            raise UsageError(f"a batch takes 1 to {_MOST_WORKERS} workers, not {self.workers}")
        if self.devices not in (None, ALL_DEVICES) and not all(
            word.strip().isdecimal() for word in str(self.devices).split(",")
        ):
            raise UsageError(
                f"{self.devices!r:.60} are no devices: their indexes with commas, such as 0,1, or {ALL_DEVICES}"
            )
        if self.scheduler not in (None, LOCAL) and (self.workers, self.devices) != (None, None):
            names = f"{name_parameter('workers', 'N')} and {name_parameter('devices', 'D,D')}"
            raise UsageError(
                f"{names} start workers on this machine: those of {self.scheduler!s:.60} are there already"
            )

    def deal_devices(self) -> list[str | None]:
        """Return a device for each worker, None for the one that each job would choose."""
        devices: list[str | None] = [None]
        if self.devices == ALL_DEVICES:
            devices = [str(device.index) for device in list_usable()]
        elif self.devices is not None:
            devices = [*map(str.strip, self.devices.split(","))]
            check_indexes(self.devices, name_parameter("devices"))
        return [devices[number % len(devices)] for number in range(self.workers or len(devices))]


class Case(NamedTuple):
    """A row of a manifest, or a series of a folder.

    cells: Options of its own, each a pair of name and text.
    carried: Cells of the columns that are no options, which the table of the cohort takes over.
    """

    name: str
    source: str
    labels: str | None = None
    cells: Sequence[Sequence[str]] = ()
    carried: Mapping[str, str] = {}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a worker needs to know of the whole batch, and what the key of a case counts.

    given: Options of the meshes by their names, see `clrecon.jobs.mesh.purposes.settings_from`; a case's own win.
    options: Names of parameters in the messages of a worker, see `OptionSpeaker`; None: as in Python.
    carried: The saved view as JSON, what of it holds for all cases; it is drawn by `drawer`, a function ("module:name")
        that is called as `draw_carried`.
    """

    output: str
    batch: BatchSettings = BatchSettings()
    given: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, str] | None = None
    timeout: float = DEFAULT_SECONDS
    no_clobber: bool = False
    drawer: str | None = None
    carried: str | None = None

    def to_json(self) -> str:
        return json.dumps(asdict(self), default=os.fspath)

    @classmethod
    def from_json(cls, text: str) -> Plan:
        values = _with_tuples(json.loads(text))
        return cls(**values | {"batch": BatchSettings(**values["batch"])})

    @property
    def device(self) -> str | None:
        return self.given.get("device")

    def settings_of(self, case: Case) -> MeshSettings:
        cells = _read_cells(case)
        replaced = _LEVELS if _LEVELS & cells.keys() else ()  # one level takes the place of another
        given = {name: value for name, value in self.given.items() if name not in replaced}
        return settings_from({**given, **cells, "path": case.labels}, "in the column labels of each row")

    def outputs_of(self, case: Case) -> BatchSettings:
        return replace(self.batch, **pick_fields(BatchSettings, _read_cells(case)))

    def check(self, case: Case) -> None:
        """Refuse the options of a case where they cannot be together, or name no value."""
        settings, outputs = self.settings_of(case), self.outputs_of(case)
        levels = () if settings.below is not None else settings.levels
        if outputs.cloud is not None and (len(levels) != 1 or isinstance(levels[0], tuple)):
            raise UsageError(
                f"{name_parameter('cloud')} is of one iso value: give one in {name_parameter('iso_value')}, without"
                f" ranges, {name_parameter('below')} and surfaces of the labels themselves"
            )

    def folder_of(self, case: Case) -> Path:
        return Path(self.output, case.name)


def _with_tuples(value: Any) -> Any:
    """Return what was read from JSON with a tuple for each list, as settings have them."""
    if isinstance(value, dict):
        return {name: _with_tuples(entry) for name, entry in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


_FORMAT = 2
"""Rises when files of a case change their names or their meaning."""


def make_key(case: Case, plan: Plan) -> str:
    """Return a hash of the version, of all settings that matter, and of names, sizes and times of the files read.

    The server of a URL is asked for them, of DICOMweb for the UIDs of the instances, which change with the content.
    """
    settings, batch = plan.settings_of(case), plan.outputs_of(case)
    rules = parse_region_rules(settings.region or ())
    values = {own.name: getattr(settings, own.name) for own in fields(settings) if own.name not in _ANY_MACHINE}
    values["region"] = [str(rule) for rule in rules]
    labels = None if settings.labels is None else replace(settings.labels, path="")
    outputs = [getattr(batch, own.name) for own in options_of(BatchSettings, "make") if own.name != "state"]
    asked = (_FORMAT, package_version(), values, labels, outputs, *filter(None, [plan.carried]))
    digest = hashlib.sha256(repr(asked).encode("utf-8", "replace"))
    for path in filter(None, (case.source, case.labels, *(rule.path for rule in rules))):
        remote = open_remote(path).list_entries() if is_url(path) else None
        for name, size, version in remote or _list_files(path, follow_links=settings.follow_links):
            digest.update(f"{name}\0{size}\0{version}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _list_files(path: str, *, follow_links: bool) -> Iterator[tuple[str, int, int]]:
    """Yield name, size and time of a file, or of all files of a folder in order."""
    if not os.path.isdir(path):
        status = os.stat(path)
        yield "", status.st_size, status.st_mtime_ns
        return
    for folder, folders, names in os.walk(path, followlinks=follow_links):
        folders.sort()
        for name in sorted(names):
            file = os.path.join(folder, name)
            status = os.stat(file, follow_symlinks=follow_links and os.path.exists(file))
            yield os.path.relpath(file, path), status.st_size, status.st_mtime_ns


_ANY_MACHINE = ("device", "memory", "scheduler", "labels")
"""Settings that change nothing of what is made; the label map counts by its files, and by the choice of labels."""

_OPTIONS = {
    own.flags[0].removeprefix("--"): own
    for own in chain(options_of(MeshSettings, None), options_of(LabelChoice, None), options_of(BatchSettings, "make"))
    if own.name not in (*_ANY_MACHINE, "path", "state")
}
"""Options that a column of a manifest gives for each case, by the names of their columns."""

_LEVELS = {own.name for own in options_of(MeshSettings, "level")}

COLUMNS = ("case", "input", "labels")

TABLE_COLUMNS = (
    *("case", "status", "error", "slices", "spacing_i_mm", "spacing_j_mm", "spacing_k_mm", "tilt_deg", "iso_value_hu"),
    *("meshes", "triangles", "components", "area_mm2", "volume_ml", "closed", "gates_failed", "warnings", "outliers"),
    *("seconds", "peak_memory_bytes", "device"),
)
"""Columns of the table of the cohort, before those that a manifest has beside its options."""

_OF_THE_BATCH = {own.flags[0].removeprefix("--") for own in options_of(BatchSettings, None)} | {"device", "memory"}
_CLOSE = 0.8
"""Likeness of words (`difflib`) from which on a column counts as a misspelt option, not as one to be carried."""


def _read_cells(case: Case) -> dict[str, Any]:
    """Return the values of a case's own options, by the names of fields."""
    values = {}
    for column, text in case.cells:
        try:
            values[_OPTIONS[column].name] = read_cell(_OPTIONS[column], text)
        except ValueError as error:
            raise UsageError(f"column {column}: {error}") from None
    return values


TABLE, PAGE = "cohort.csv", "cohort.html"
REPORT = "case.json"

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,98}[A-Za-z0-9_-])?")


def read_cases(manifest: str | Path, plan: Plan) -> list[Case]:
    """Read the rows of a CSV or Parquet file, or find the series of a folder, in order; all have settings that work."""
    refuse_url(manifest, "manifest")
    return _find_series(manifest, plan) if os.path.isdir(manifest) else _read_table(manifest, plan)


def _read_table(path: str | Path, plan: Plan) -> list[Case]:
    name, folder = escape_text(os.path.basename(path)), os.path.dirname(os.path.abspath(path))
    try:
        if os.path.splitext(path)[1].lower() == ".parquet":
            cases = _read_parquet(name, path, folder, plan)
        else:
            with io.TextIOWrapper(open_regular(path), "utf-8-sig", newline="") as stream:
                delimiter = ";" if ";" in stream.readline() else ","  # no name of a column has one
                stream.seek(0)
                table = csv.reader(stream, delimiter=delimiter, strict=True)
                places = _find_columns(name, next(table, []))
                cases = _read_rows(name, ((table.line_num, row) for row in table), places, folder, plan)
    except (UnicodeDecodeError, csv.Error) as error:
        reason = error if isinstance(error, csv.Error) else "it is no text in UTF-8"
        raise UsageError(
            f"the manifest {name} is no table with commas or semicolons: {reason}; save it as CSV in UTF-8"
        ) from None
    except OSError as error:
        raise UsageError(f"the manifest {name} cannot be read: {error.strerror or error}") from None
    if not cases:
        raise UsageError(f"the manifest {name} has no case below its line of columns")
    return cases


def _read_parquet(name: str, path: str | Path, folder: str, plan: Plan) -> list[Case]:
    """Read the rows of a Parquet file, which count as the lines of a table below its line of columns."""
    parquet = import_package("pyarrow.parquet", "a manifest in Parquet")
    with open_regular(path) as stream:
        try:
            table = parquet.ParquetFile(stream)
            places = _find_columns(name, table.schema_arrow.names)
            rows = chain.from_iterable(batch.to_pylist() for batch in table.iter_batches(1000))
            cells = ([*map(_write_cell, row.values())] for row in rows)
            return _read_rows(name, enumerate(cells, start=2), places, folder, plan)
        except (ValueError, OSError) as error:  # as pyarrow's errors are
            if isinstance(error, UsageError):
                raise
            raise UsageError(f"the manifest {name} is no table in Parquet: {error!s:.200}") from None


def _write_cell(cell: Any) -> str:
    """Return a cell of Parquet as that of a text: nothing is None or NaN, and whole numbers are without decimals."""
    if cell is None or cell != cell:
        return ""
    return str(int(cell)) if isinstance(cell, float) and cell.is_integer() else str(cell)


def _find_columns(name: str, header: Sequence[str]) -> dict[str, int]:
    """Return the place of each column, by the first line of a table; those that are carried keep their spelling."""
    known = (*COLUMNS, *_OPTIONS)
    words = [word.strip().lower().removeprefix("--").replace("_", "-") for word in header]
    words = [word if word in known else given.strip() for word, given in zip(words, header, strict=True)]
    for word in words:
        reason = None if word in known else _refuse_column(word.lower().replace("_", "-"), known)
        if reason:
            raise UsageError(f"the column {word!r:.60} of the manifest {name} {reason}")
    missing = [word for word in COLUMNS[:2] if word not in words]
    twice = [word for word in words if words.count(word) > 1]
    if missing or twice:
        wrong = f"no column {' and no column '.join(missing)}" if missing else f"the column {twice[0]} twice"
        raise UsageError(f"the manifest {name} has {wrong}: its first line names the columns, as case,input,hu")
    return {word: place for place, word in enumerate(words)}


def _refuse_column(word: str, known: Sequence[str]) -> str | None:
    """Return why a column of the table of the cohort cannot have this name; None if it can."""
    misspelt = get_close_matches(word, known, n=1, cutoff=_CLOSE)
    if not word.strip():
        return "has no name"
    if word in _OF_THE_BATCH:
        return "is an option of the whole batch, not of a case: give it to the command"
    if word in (column.replace("_", "-") for column in TABLE_COLUMNS):
        return f"has the name of one of the columns of {TABLE}: rename it"
    if misspelt:
        return f"is no option (did you mean {misspelt[0]}?); to carry it into {TABLE}, rename it"
    return None


def _read_rows(
    name: str, rows: Iterable[tuple[int, Sequence[str]]], places: dict[str, int], folder: str, plan: Plan
) -> list[Case]:
    known = {*COLUMNS, *_OPTIONS}
    lines: dict[str, int] = {}
    checked: dict[tuple[bool, Any], Any] = {}
    cases: list[Case] = []
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(places):
            raise UsageError(
                f"line {line} of the manifest {name} has {len(row)} cells, its first line {len(places)}: put a cell"
                " with commas into quotes"
            )
        cells = {column: row[place].strip() for column, place in places.items()}
        case = cells["case"]
        if not _NAME.fullmatch(case) or case.lower() in (TABLE, PAGE):
            raise UsageError(
                f"line {line} of the manifest {name}: the case {case!r:.60} cannot be the name of a folder: up to 100"
                " letters, digits, dots, dashes and underscores, a letter or digit first"
            )
        first = lines.setdefault(case.lower(), line)
        if first != line:
            raise UsageError(f"lines {first} and {line} of the manifest {name} are both the case {case}: name one else")
        if not cells["input"]:
            raise UsageError(f"line {line} of the manifest {name}: the case {case} has no input")
        try:
            refuse_url(cells.get("labels"), "label map")
            source, labels = (_find_path(folder, cells.get(column, "")) for column in ("input", "labels"))
            if rules := cells.get("region"):
                cells["region"] = "|".join(locate_region_rule(rule, folder) for rule in rules.split("|"))
            options = tuple(cell for cell in cells.items() if cell[0] in _OPTIONS and cell[1])
            if (labels is None, options) not in checked:
                plan.check(Case(case, source or "", labels, options))
        except UsageError as error:
            raise UsageError(f"line {line} of the manifest {name}: {error}") from None
        options = checked.setdefault((labels is None, options), options)  # one for all equal ones
        carried = {column: cell for column, cell in cells.items() if column not in known}
        cases.append(Case(case, source or "", labels, options, carried))
    return cases


def _find_path(folder: str, text: str) -> str | None:
    """Return what a cell names, a URL or a path below the folder; a URL must be sound, and hold no password."""
    if is_url(text):
        check_url(text)
        return text
    return os.path.join(folder, text) if text else None


def _find_series(folder: str | Path, plan: Plan) -> list[Case]:
    """Return a case for each stack of CT slices below a folder, by its number: names of folders can be patients'."""
    from clrecon.reading.dicom.reader import list_stacks

    plan.check(Case("", str(folder)))
    selection = ScanSettings(**pick_fields(ScanSettings, plan.given))
    if selection.series is not None:
        raise UsageError(
            f"each series of a folder is a case: leave {name_parameter('series')} out, or write a manifest"
        )
    stacks = list_stacks(folder, selection) if tell_format(folder) is None else []
    if not stacks:
        raise NoDicomError(
            "no series of CT slices in this folder; files of other formats are named by a manifest, a table of"
            f" {', '.join(COLUMNS)}"
        )
    width = max(3, len(str(stacks[-1].number)))
    return [
        Case(f"series-{stack.number:0{width}d}", str(stack.folder), cells=(("series", stack.series),))
        for stack in stacks
    ]


def check_places(cases: Sequence[Case], output: str | Path) -> None:
    """Refuse an output folder that holds an input or lies in one, or whose folders of these names are no cases."""
    root = os.path.join(os.path.realpath(output), "")
    parents: dict[str, str] = {}
    for case in cases:
        for path in filter(None, (case.source, case.labels)):
            if is_url(path):
                continue
            parent, name = os.path.split(os.path.normpath(path))
            if parent not in parents:
                parents[parent] = os.path.realpath(parent)
            read = os.path.join(parents[parent], name, "")
            if root.startswith(read) or read.startswith(root):
                raise UsageError(
                    f"the output folder {shown_path(output)} and what the case {case.name} reads lie one in the other:"
                    " name another output"
                )
    if not os.path.isdir(output):
        return
    names = {case.name.lower() for case in cases}
    with os.scandir(output) as entries:
        for entry in entries:
            if entry.name.lower() in names and not os.path.isfile(os.path.join(entry.path, REPORT)):
                raise UsageError(
                    f"{shown_path(entry.path)} is no case of a batch, and one of that name would replace it: name"
                    " another output folder"
                )
