"""What a batch makes: the settings, the cases of a table or a folder, and the key by which a case is known again."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, get_args

from clrecon.errors import NoDicomError, UsageError
from clrecon.exchange.formats import CLOUD_FORMATS, MESH_INPUTS
from clrecon.jobs.cluster import LOCAL
from clrecon.jobs.devices import check_indexes, list_usable
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.options import ALL_DEVICES, DeviceSettings, ScanSettings, scheduler_option, view_option
from clrecon.reading import tell_format
from clrecon.reading.sources import open_remote
from clrecon.reading.urls import check_url, is_url, refuse_url
from clrecon.system.arguments import DirectionName, name_parameter
from clrecon.system.light_dataclass import asdict, dataclass, fields, replace
from clrecon.system.options import option
from clrecon.system.packages import import_package
from clrecon.system.paths import open_regular, shown_path
from clrecon.system.text import escape_text, guess_word, unknown_name
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
    state: str | None = option(
        "--state FILE",
        "draw each case as in a saved view (.view.json) of one scan: from its direction, framed anew, without what lies"
        " at a place in that patient",
        group="make",
        first=True,
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
    """A row of a manifest, or a series of a folder."""

    name: str
    source: str
    series: str | None
    labels: str | None


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a worker needs to know of the whole batch, and what the key of a case counts.

    plain, labelled: Settings of the meshes of cases without and with a label map, whose path each case has itself.
    options: Names of parameters in the messages of a worker, see `OptionSpeaker`; None: as in Python.
    carried: The saved view as JSON, what of it holds for all cases; it is drawn by `drawer`, a function ("module:name")
        that is called as `draw_carried`.
    """

    output: str
    batch: BatchSettings
    plain: MeshSettings | None = None
    labelled: MeshSettings | None = None
    options: Mapping[str, str] | None = None
    timeout: float
    no_clobber: bool = False
    drawer: str | None = None
    carried: str | None = None

    def to_json(self) -> str:
        return json.dumps(asdict(self), default=os.fspath)

    @classmethod
    def from_json(cls, text: str) -> Plan:
        values = _with_tuples(json.loads(text))
        for kind in ("plain", "labelled"):
            if values[kind] is not None:
                labels = values[kind]["labels"]
                values[kind]["labels"] = None if labels is None else LabelChoice(**labels)
                values[kind] = MeshSettings(**values[kind])
        return cls(**values | {"batch": BatchSettings(**values["batch"])})

    @property
    def device(self) -> str | None:
        return (self.plain or self.labelled or DeviceSettings()).device

    def settings_of(self, case: Case) -> MeshSettings:
        settings = self.plain if case.labels is None else self.labelled
        assert settings is not None  # made for each kind of row that there is
        if case.labels is not None:
            assert settings.labels is not None
            settings = replace(settings, labels=replace(settings.labels, path=case.labels))
        return settings if case.series is None else replace(settings, series=case.series)

    def folder_of(self, case: Case) -> Path:
        return Path(self.output, case.name)


def _with_tuples(value: Any) -> Any:
    """Return what was read from JSON with a tuple for each list, as settings have them."""
    if isinstance(value, dict):
        return {name: _with_tuples(entry) for name, entry in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


_FORMAT = 2
"""Rises when files of a case change their names or their meaning."""

_ANY_MACHINE = ("device", "memory", "labels")
"""Settings that change nothing of what is made; the label map counts by its files, and by the choice of labels."""


def make_key(case: Case, plan: Plan) -> str:
    """Return a hash of the version, of all settings that matter, and of names, sizes and times of the files read.

    The server of a URL is asked for them, of DICOMweb for the UIDs of the instances, which change with the content.
    """
    settings = plan.settings_of(case)
    values = {own.name: getattr(settings, own.name) for own in fields(settings) if own.name not in _ANY_MACHINE}
    labels = None if settings.labels is None else replace(settings.labels, path="")
    outputs = [getattr(plan.batch, name) for name in ("format", "mesh", "measure", "cloud", "picture", "views")]
    asked = (_FORMAT, package_version(), values, labels, outputs, *filter(None, [plan.carried]))
    digest = hashlib.sha256(repr(asked).encode("utf-8", "replace"))
    for path in filter(None, (case.source, case.labels)):
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


COLUMNS = ("case", "input", "series", "labels")
TABLE, PAGE = "cohort.csv", "cohort.html"
REPORT = "case.json"

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,98}[A-Za-z0-9_-])?")


def read_cases(manifest: str | Path, selection: ScanSettings) -> list[Case]:
    """Read the rows of a CSV file, or find the series of a folder, in order."""
    refuse_url(manifest, "manifest")
    return _find_series(manifest, selection) if os.path.isdir(manifest) else _read_table(manifest)


def _read_table(path: str | Path) -> list[Case]:
    name, folder = escape_text(os.path.basename(path)), os.path.dirname(os.path.abspath(path))
    try:
        if os.path.splitext(path)[1].lower() == ".parquet":
            cases = _read_parquet(name, path, folder)
        else:
            with io.TextIOWrapper(open_regular(path), "utf-8-sig", newline="") as stream:
                delimiter = ";" if ";" in stream.readline() else ","  # no name of a column has one
                stream.seek(0)
                table = csv.reader(stream, delimiter=delimiter, strict=True)
                places = _find_columns(name, next(table, []))
                cases = _read_rows(name, ((table.line_num, row) for row in table), places, folder)
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


def _read_parquet(name: str, path: str | Path, folder: str) -> list[Case]:
    """Read the rows of a Parquet file, which count as the lines of a table below its line of columns."""
    parquet = import_package("pyarrow.parquet", "a manifest in Parquet")
    with open_regular(path) as stream:
        try:
            table = parquet.ParquetFile(stream)
            places = _find_columns(name, table.schema_arrow.names)
            rows = chain.from_iterable(batch.to_pylist() for batch in table.iter_batches(1000))
            cells = (["" if cell is None else str(cell) for cell in row.values()] for row in rows)
            return _read_rows(name, enumerate(cells, start=2), places, folder)
        except (ValueError, OSError) as error:  # as pyarrow's errors are
            if isinstance(error, UsageError):
                raise
            raise UsageError(f"the manifest {name} is no table in Parquet: {error!s:.200}") from None


def _find_columns(name: str, header: Sequence[str]) -> dict[str, int]:
    """Return the place of each column, by the first line of a table."""
    words = [word.strip() for word in header]
    unknown = [word for word in words if word not in COLUMNS]
    if unknown:
        shown = ", ".join(f"{word!r:.60}{guess_word(word, COLUMNS)}" for word in unknown[:5])
        raise UsageError(f"the manifest {name} has unknown columns: {shown}; there are {', '.join(COLUMNS)}")
    missing = [word for word in COLUMNS[:2] if word not in words]
    if missing or len(set(words)) < len(words):
        wrong = f"no column {' and no column '.join(missing)}" if missing else "a column twice"
        raise UsageError(
            f"the manifest {name} has {wrong}: its first line is {','.join(COLUMNS)}, the last two optional"
        )
    return {word: place for place, word in enumerate(words)}


def _read_rows(name: str, rows: Iterable[tuple[int, Sequence[str]]], places: dict[str, int], folder: str) -> list[Case]:
    lines: dict[str, int] = {}
    cases: list[Case] = []
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(places):
            raise UsageError(f"line {line} of the manifest {name} has {len(row)} cells, its first line {len(places)}")
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
        except UsageError as error:
            raise UsageError(f"line {line} of the manifest {name}: {error}") from None
        cases.append(Case(case, source or "", cells.get("series") or None, labels))
    return cases


def _find_path(folder: str, text: str) -> str | None:
    """Return what a cell names, a URL or a path below the folder; a URL must be sound, and hold no password."""
    if is_url(text):
        check_url(text)
        return text
    return os.path.join(folder, text) if text else None


def _find_series(folder: str | Path, selection: ScanSettings) -> list[Case]:
    """Return a case for each stack of CT slices below a folder, by its number: names of folders can be patients'."""
    from clrecon.reading.dicom.reader import list_stacks

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
    return [Case(f"series-{stack.number:0{width}d}", str(stack.folder), stack.series, None) for stack in stacks]


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
