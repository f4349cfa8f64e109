"""What every job does beside its own work: its times, the device, and the report, which is its commit mark."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from copy import copy
from functools import partial
from io import BytesIO
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast

from clrecon.errors import Cancelled, ClreconError, DeviceError
from clrecon.exchange.formats import stage_assembly, stage_mesh
from clrecon.jobs.outputs import check_files, check_kept, commit_all
from clrecon.system.files import Staged, StagedFile, allow_open_files, stage_file
from clrecon.system.light_dataclass import dataclass
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import extension_of, keep_existing
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Record, name_schema
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.rendering.pictures.annotations import PictureData

Found = TypeVar("Found")
Report = TypeVar("Report", bound="JobReport")
StagedAs = TypeVar("StagedAs", bound="Staged")

log = get_logger(__name__)


class Laps:
    def __init__(self) -> None:
        self._start = self._lap = perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, part: str) -> float:
        """Add the time since the last lap to `part` and return it."""
        now = perf_counter()
        elapsed = now - self._lap
        self._lap = now
        self.seconds[part] = self.seconds.get(part, 0.0) + elapsed
        log.debug("%s: %.3f s", part, elapsed)
        return elapsed

    def total(self) -> float:
        return perf_counter() - self._start

    def rounded(self, parts: Sequence[str] = ()) -> dict[str, float]:
        """Return the seconds of each part and ``total``, as reports have them; of `parts` all, and ``other``."""
        seconds, total = {part: self.seconds.get(part, 0.0) for part in parts or self.seconds}, self.total()
        if parts:
            seconds["other"] = max(0.0, total - sum(seconds.values()))
        return {part: round(value, 4) for part, value in {**seconds, "total": total}.items()}


def _choose_device(name: str | int | Device | None) -> Device:
    from clrecon.operators import take_device

    return take_device(name)


def _try_device(chosen: Future[Device], trial: Callable[[Device], object]) -> None:
    try:
        trial(chosen.result())
    except DeviceError:
        raise
    except ClreconError:
        pass  # a step that leaves nothing of the cube


def trial_cube() -> Volume:
    """Return the volume of trial runs: a cube of 12 voxels a side, from -600 HU at its faces to 3000 in its middle."""
    import numpy as np

    from clrecon.geometry import Volume

    k, j, i = np.indices((12, 12, 12))
    return Volume((3000 - 600 * np.abs([i - 5, j - 5, k - 5]).max(axis=0)).astype(np.int16), np.eye(4))


class DeviceOpening:
    """A device that is chosen, opened and given its kernels beside the work of a ``with`` block.

    The order of errors does not depend on which side is faster: if both the block and the device fail, the device's
    error is raised.  Only a cancellation by the caller is passed on in any case.

    trial: Builds the kernels by the steps of the job on something small, such as `trial_cube`; its result is dropped.
    """

    def __init__(self, name: str | int | Device | None, trial: Callable[[Device], object]):
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="device")
        self._chosen = self._pool.submit(_choose_device, name)
        self._prepared = self._pool.submit(_try_device, self._chosen, trial)

    def wait(self) -> Device:
        """Return the device, ready to work; its stand-in may have taken over."""
        device = self._chosen.result()
        self._prepared.result()
        return device

    def __enter__(self) -> DeviceOpening:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        is_interrupted = error is not None and not isinstance(error, Exception)  # nobody waits for a compiler then
        try:
            if isinstance(error, Exception) and not isinstance(error, Cancelled):
                self._chosen.result()
        finally:
            self._pool.shutdown(wait=not is_interrupted, cancel_futures=True)


def to_json(value: Any, indent: int | None = 2) -> str:
    """Return strict JSON (ASCII): numpy values become plain ones, NaN and infinities become null."""
    return json.dumps(_as_plain(value), indent=indent, allow_nan=False)


def _as_plain(value: Any) -> Any:
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _as_plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_as_plain(entry) for entry in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays, without importing numpy
        return _as_plain(value.tolist())
    raise TypeError(f"{type(value).__name__} has no place in a report")


def stage_report(path: str | Path, report: Mapping[str, Any]) -> AbstractContextManager[StagedFile]:
    """Write `report` as JSON under a temporary name, to be committed after the files that it describes."""
    content = (to_json(report) + "\n").encode("ascii")
    return stage_file(path, lambda stream: stream.write(content))


def error_as_dict(error: ClreconError) -> dict[str, Any]:
    """Return the JSON form of an error: ``{"error": {"kind", "exit_code", "message"}}``."""
    facts = {"kind": type(error).__name__, "exit_code": error.exit_code, "message": str(error)}
    return name_schema("error", {"error": facts})


def platform_name() -> str:
    """Return operating system, machine and Python, without the name of the computer."""
    import platform

    return f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"


_OWN_STATUS = Path("/proc/self/status")


def peak_memory_bytes(status: Path = _OWN_STATUS) -> int | None:
    """Return the largest resident memory of this process so far, by Linux of it alone, None if it is not told."""
    try:
        lines = status.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    peaks = [line.split()[1] for line in lines if line.startswith("VmHWM:")]
    if peaks:
        return 1024 * int(peaks[0])
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak) if sys.platform == "darwin" else int(peak) * 1024


@dataclass(frozen=True, eq=False, kw_only=True)
class JobReport(Record):
    """The entries that all reports share.  In JSON they come last: first those that a report declares itself."""

    SCHEMA: ClassVar[str] = ""
    """Name of its JSON Schema in docs/schemas; empty: it has none."""
    _LAST: ClassVar[tuple[str, ...]] = ("version", "platform", "warnings", "volume", "seconds", "peak_memory_bytes")
    """Names of the entries at the end, in their order."""
    PARTS: ClassVar[tuple[str, ...]] = ()
    """Parts whose seconds are always told, also where they are 0; none: those that there were."""

    version: str
    platform: str
    warnings: list[str]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None

    def _entries(self) -> dict[str, Any]:
        entries = super()._entries()
        first = {name: entries[name] for name in entries if name not in self._LAST}
        entries = first | {name: entries[name] for name in self._LAST if name in entries}
        return name_schema(self.SCHEMA, entries) if self.SCHEMA else entries


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanReport(JobReport):
    """Those of jobs that read a scan; `volume` is its `Certificate` without warnings."""

    volume: Mapping[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport(ScanReport):
    """Those of jobs that work on a device; the affine has shape (4, 4), None where no scan was read."""

    _LAST = ("device", "driver", "memory_allowed_bytes", *JobReport._LAST)

    affine_ijk_to_lps_mm: list[list[float]] | None
    device: str
    driver: str
    memory_allowed_bytes: int | None


class SharedScan:
    """A scan that several jobs read one after another, from the disk once."""

    def __init__(self) -> None:
        self._volume: Volume | None = None

    def read(self, source: str | Path, settings: Any, *, progress: Progress) -> Volume:
        """Return a volume whose report is its own: a job puts another in its place."""
        from clrecon.reading import read_selected

        if self._volume is None:
            self._volume = read_selected(source, settings, progress=progress)
        return copy(self._volume)


class Run(Laps):
    """One run of a job: checks and stages its files, times it, composes the shared part of its report, and commits.

    All files are on the disk before the first replaces an older one, the report is renamed last, as the commit mark;
    those that are not committed at the end of the ``with`` block are removed.

    no_clobber: Files that exist stay and are an `OutputError`, before any work.
    shared: The scan, of a caller whose other jobs read the same part of it.
    logged: Warnings that are in the log already: those of the volume of the report.
    """

    def __init__(
        self,
        settings: Any,
        *,
        no_clobber: bool = False,
        progress: Progress | None = None,
        shared: SharedScan | None = None,
    ):
        super().__init__()
        self.settings, self.no_clobber = settings, no_clobber
        self.progress = progress or ignore_progress
        self._shared = shared
        self.files: list[Staged] = []
        self.logged: Iterable[str] = ()
        self._keep_ids: bool = getattr(settings, "keep_ids", False)
        self._stack = ExitStack()

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)

    def keeping(self) -> AbstractContextManager[None]:
        """In the ``with`` block, of checks and staging alone, files that exist stay if the run was asked for it."""
        return keep_existing(keep=self.no_clobber)

    def check(self, outputs: Sequence[tuple[str, str | Path | None]], *inputs: str | Path | None) -> None:
        """Refuse outputs that are the same file, cannot be written, or would replace one of the inputs."""
        named = [(what, path) for what, path in outputs if path is not None]
        with self.keeping():
            check_files(named)
        check_kept(named, *inputs)

    def open(self, source: str | Path) -> str | Path:
        """Return an input as a path that stays until the end of the run: what a URL or an archive holds."""
        from clrecon.reading.sources import opened

        return cast("str | Path", self._stack.enter_context(opened(source, self.progress)))

    def read(self, source: str | Path) -> Volume:
        from clrecon.reading import read_selected

        read = read_selected if self._shared is None else self._shared.read
        return read(source, self.settings, progress=self.progress)

    def read_labelled(self, source: str | Path, label: Sequence[str | int] | None = None) -> tuple[Volume, LabelMap]:
        """Read the scan and the label map of the settings; with `label` these labels of it."""
        from clrecon.jobs.inputs import read_with_labels
        from clrecon.labels import read_labels

        path, linked = self.settings.labels, self.settings.follow_links
        volume, labels = read_with_labels(
            partial(self.read, source), path, lambda scan: read_labels(path, label, volume=scan, follow_links=linked)
        )
        assert labels is not None
        return volume, labels

    def read_beside(self, trial: Callable[[Device], object], read: Callable[[], Found]) -> tuple[Found, Device]:
        """Read the input while the device opens and builds its kernels, see `DeviceOpening`; return both."""
        self.progress("device", 0, 0)
        with DeviceOpening(getattr(self.settings, "main_device", self.settings.device), trial) as opening:
            content = read()
            self.lap("read")
            device = opening.wait()
            self.lap("device")
        return content, device

    def stage(self, staging: AbstractContextManager[StagedAs]) -> StagedAs:
        """Write a file under a temporary name."""
        with self.keeping():
            file = self._stack.enter_context(staging)
        self.files.append(file)
        return file

    def write(self, path: str | Path, content: bytes) -> StagedFile:
        """Write bytes under a temporary name."""
        return self.stage(stage_file(path, lambda stream: stream.write(content), expected_bytes=len(content)))

    def write_picture(self, path: str | Path, picture: PictureData) -> StagedFile:
        from clrecon.rendering.pictures.picture import encode_image

        return self.write(path, encode_image(picture, extension_of(path)))

    def write_meshes(self, meshes: Sequence[Mesh], paths: Sequence[str | Path]) -> list[StagedFile]:
        allow_open_files(len(meshes))
        staged: list[StagedFile] = []
        for mesh, path in zip(meshes, paths, strict=True):
            if len(meshes) > 1:
                self.progress("write", len(staged), len(meshes))
            staged.append(self.stage(stage_mesh(mesh, path, self.settings.space, keep_ids=self._keep_ids)))
        return staged

    def write_together(self, meshes: Sequence[Mesh], path: str | Path) -> StagedFile:
        """Write all meshes as named objects of one file under a temporary name."""
        return self.stage(stage_assembly(meshes, path, self.settings.space, keep_ids=self._keep_ids))

    def certificate(self, volume: Volume) -> dict[str, Any]:
        """Return the certificate of a volume as reports have it: with hashes of UIDs if they are asked for."""
        from clrecon.geometry.certificate import without_ids

        return dict(volume.report) if self._keep_ids else without_ids(volume.report)

    def report(
        self,
        kind: type[Report],
        warnings: Iterable[str],
        volume: Volume | None = None,
        /,
        *,
        on: Device | None = None,
        before: Iterable[str] = (),
        **entries: Any,
    ) -> Report:
        """Compose a report of this kind: a `ScanReport` has the certificate of `volume`, a `RunReport` the device `on`.

        warnings, before: Those of the job that come after and before those of the volume.
        """
        certificate = {} if volume is None else self.certificate(volume)
        self.logged = certificate.pop("warnings", ())
        if issubclass(kind, ScanReport):
            entries["volume"] = certificate
        if on is not None:
            of_device = {"device": on.label, "driver": on.driver, "memory_allowed_bytes": self.settings.memory}
            entries = of_device | entries
        return kind(
            version=package_version(),
            platform=platform_name(),
            warnings=list(dict.fromkeys(map(str, (*before, *self.logged, *warnings)))),
            seconds=self.rounded(kind.PARTS),
            peak_memory_bytes=peak_memory_bytes(),
            **entries,
        )

    def finish(self, report: Report, path: str | Path | None) -> Report:
        """Put all files in their places, the report at `path` as the last, and log its warnings; return the report."""
        if path is not None:
            self.stage(stage_report(path, report))
        commit_all(self.files)
        log_warnings(log, report.warnings, self.logged)
        return report


class ArchiveTarget:
    """An archive that gets the results of a run, each with patient, study and slices of the scan at `source`."""

    def __init__(self, url: str, source: str | Path, run: Run):
        from clrecon.reading.dicom.storing import read_origin
        from clrecon.reading.dicomweb import Store

        self._archive = Store(url)
        self._archive.check()
        self.source = run.open(source)
        self.origin = read_origin(self.source, run.settings)

    def store(self, instances: Iterable[tuple[str, bytes]]) -> dict[str, int]:
        """Store instances, each with its UID; return their number and bytes."""
        sizes = []
        for uid, instance in instances:
            self._archive.store(uid, instance)
            sizes.append(len(instance))
        return {"instances": len(sizes), "bytes": sum(sizes)}

    def store_meshes(self, meshes: Sequence[Mesh], *, is_modified: bool) -> dict[str, int]:
        """Store each mesh as Encapsulated STL in the frame of the scan."""
        return self.store(self._encode_meshes(meshes, is_modified))

    def _encode_meshes(self, meshes: Sequence[Mesh], is_modified: bool) -> Iterator[tuple[str, bytes]]:
        from clrecon.exchange import stl
        from clrecon.reading.dicom.storing import encode_model

        for mesh in meshes:
            stream = BytesIO()
            stl.write(stream, mesh.describe("lps"))
            title = str(mesh.report.get("part_name") or "surface")
            yield encode_model(stream.getvalue(), self.origin, title, is_modified=is_modified)
