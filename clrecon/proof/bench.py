"""The bench job: the speed of clrecon on this computer and this scan, stage by stage, beside VTK's flying edges
(Schroeder, Maynard and Geveci 2015, 10.1109/LDAV.2015.7348069; vtkFlyingEdges3D).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.jobs.outputs import check_kept
from clrecon.jobs.presets import DEFAULT_PRESET, find_iso_preset
from clrecon.jobs.run import Laps, platform_name, stage_report
from clrecon.proof.timing import alternate, free_cores, processor_name, spread, summarise, usable_cores
from clrecon.system.files import check_writable
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import name_schema
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device


class PeerRun(NamedTuple):
    """One run: wall seconds of ``Update()``, and its output."""

    seconds: float
    vertices: int
    triangles: int


class FlyingEdges:
    """vtkFlyingEdges3D on the voxels of a volume, shared without a copy.

    Normals are on, scalars and gradients off, as in clrecon's surfaces.  VTK's wheels run sequentially by default: for
    more than one of `threads` the backend is "STDThread".  Spacing and origin of the grid are set, its direction is
    not: VTK would turn an oblique surface in a second pass, while clrecon does so in the same pass.
    """

    def __init__(self, volume: Volume, threads: int):
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonDataModel import vtkImageData

        self.threads = threads
        self._grid = vtkImageData()
        self._grid.SetDimensions(*volume.shape_ijk)
        self._grid.SetSpacing(*volume.spacing)
        self._grid.SetOrigin(*(float(value) for value in volume.affine[:3, 3]))
        self._grid.GetPointData().SetScalars(numpy_to_vtk(volume.voxels.reshape(-1)))

    @property
    def version(self) -> str:
        from vtkmodules.vtkCommonCore import vtkVersion

        return str(vtkVersion.GetVTKVersion())

    def run(self, level: float, keep: list[Any] | None = None) -> PeerRun:
        """Contour at `level`, the HU between voxels, with a new filter, whose output is freed or goes to `keep`."""
        from vtkmodules.vtkCommonCore import vtkSMPTools
        from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

        vtkSMPTools.SetBackend("STDThread" if self.threads > 1 else "Sequential")
        vtkSMPTools.Initialize(self.threads)
        contour = vtkFlyingEdges3D()
        contour.SetInputData(self._grid)
        contour.SetValue(0, level)
        contour.ComputeNormalsOn()
        contour.ComputeScalarsOff()
        contour.ComputeGradientsOff()
        start = perf_counter()
        contour.Update()
        seconds = perf_counter() - start
        output = contour.GetOutput()
        if keep is not None:
            keep.append(output)
        return PeerRun(seconds, output.GetNumberOfPoints(), output.GetNumberOfCells())


_ALL_DEVICES = "all"
DEFAULT_RUNS = 7
MOST_RUNS = 1000
BUSY_SHARE = 0.5
"""Smallest share of free cores without a warning: with fewer, other programs distort the times."""


def run_bench(
    source: str | Path | None = None,
    *,
    iso_value: float | None = None,
    device: str | None = None,
    runs: int = DEFAULT_RUNS,
    series: str | None = None,
    report_path: str | Path | None = None,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Time the stages from a CT series to its surface on one device or on all devices.

    The surface is open at the border of the volume, like that of flying edges, which work in turn on the same voxels.

    source: DICOM folder or file; None makes a phantom of the spine, 512 x 512 x 149 voxels.
    device: As in `choose_device`; "all" means every usable device except simulators, one after the other.
    runs: Timed pairs of clrecon and flying edges, 1 to 1000.
    """
    progress = progress or ignore_progress
    _check_arguments(source, iso_value, runs, series)
    if report_path is not None:
        with keep_existing(keep=no_clobber):
            check_writable(report_path)
        check_kept([("the report", report_path)], source)
    progress("device", 0, 0)
    devices = _choose_devices(device)
    watch = Laps()
    volume, suggested = _get_volume(source, series, progress)
    watch.lap("make" if source is None else "read")
    hu = suggested if iso_value is None else iso_value
    result = name_schema(
        "bench",
        {
            "input": {
                "kind": "phantom" if source is None else "series",
                "shape_ijk": volume.shape_ijk,
                "spacing_mm": volume.spacing,
                "voxels": volume.voxels.size,
                "bytes": volume.voxels.nbytes,
            },
            "iso_value_hu": hu,
            "runs": runs,
            "processor": processor_name(),
            "cores": usable_cores(),
            "free_cores": round(free_cores(), 2),
            "platform": platform_name(),
            "version": package_version(),
        },
    )
    measured = _measure_devices(devices, volume, hu, runs, progress)
    result["iso_level_hu"] = next(entry["iso_level_hu"] for entry in measured if entry["error"] is None)
    result["devices"] = measured
    watch.lap("bench")
    result["seconds"] = {**watch.seconds, "total": watch.total()}
    result["warnings"] = _collect_warnings(result, volume, devices)
    if report_path is not None:
        with keep_existing(keep=no_clobber), stage_report(report_path, result) as staged:
            staged.commit()
    return result


def _check_arguments(source: str | Path | None, iso_value: float | None, runs: int, series: str | None) -> None:
    if not 1 <= runs <= MOST_RUNS:
        raise UsageError(f"the number of runs must be 1 to {MOST_RUNS}, not {runs}")
    if iso_value is not None and not math.isfinite(iso_value):
        raise UsageError(f"the iso value must be a finite number of HU, not {iso_value}")
    if source is None and series is not None:
        raise UsageError("a series can be chosen only of an input: name a DICOM folder too")


def _choose_devices(name: str | None) -> list[Device]:
    from clrecon.opencl import list_devices
    from clrecon.operators import choose_device

    if (name or "").strip().lower() != _ALL_DEVICES:
        return [choose_device(name)]
    usable = [device for device in list_devices() if not device.is_simulator and not device.shortcoming]
    return usable or [choose_device(None)]  # its error says why there is no device


def _get_volume(source: str | Path | None, series: str | None, progress: Progress) -> tuple[Volume, float]:
    """Read or make the volume; also return its iso value."""
    if source is not None:
        from clrecon.reading import read_volume

        return read_volume(source, series, progress=progress), find_iso_preset(DEFAULT_PRESET).iso_value
    from clrecon.geometry import Volume
    from clrecon.proof.phantom import PhantomSettings, make_phantom

    settings = PhantomSettings(kind="spine", size=(512, 512), slices=149, spacing=(0.7, 0.7, 1.0))
    voxels, affine, truth = make_phantom(settings, progress)
    return Volume(voxels, affine), float(truth["iso_value_hu"])


def _measure_devices(
    devices: Sequence[Device], volume: Volume, hu: float, runs: int, progress: Progress
) -> list[dict[str, Any]]:
    """Return one entry per device; the entry of a device that fails has its error."""
    measured, first_error = [], None
    for number, device in enumerate(devices):
        progress("bench", number, len(devices))
        entry: dict[str, Any] = {"device": device.describe(), "error": None}
        try:
            entry.update(_measure_device(device, volume, hu, runs))
        except DeviceError as error:
            first_error = first_error or error
            entry["error"] = str(error)
        measured.append(entry)
    progress("bench", len(devices), len(devices))
    if first_error is not None and all(entry["error"] for entry in measured):
        raise first_error
    return measured


class _OwnRuns:
    """Runs of clrecon on one device, with the reports of their surfaces."""

    def __init__(self, device: Device, volume: Volume, hu: float):
        from clrecon.operators.surface.extract import extract_isosurface

        self._extract = lambda: extract_isosurface(volume, hu, device=device, closed=False)
        self.reports: list[dict[str, Any]] = []
        self.counts = (0, 0)

    def run(self) -> float:
        """Extract one surface and return its wall seconds; the mesh is freed before the return."""
        start = perf_counter()
        mesh: Mesh = self._extract()
        seconds = perf_counter() - start
        self.reports.append(mesh.report)
        self.counts = len(mesh.vertices), len(mesh.triangles)
        return seconds

    def medians(self, name: str) -> dict[str, float]:
        """Median seconds of each part over the warm runs."""
        warm = [report[name] for report in self.reports[1:]]
        return {part: spread([parts[part] for parts in warm])["median"] for part in warm[0]} if warm else {}


def _measure_device(device: Device, volume: Volume, hu: float, runs: int) -> dict[str, Any]:
    start = perf_counter()
    _ = device.queue
    opened = perf_counter() - start
    own_runs = _OwnRuns(device, volume, hu)
    first = own_runs.run()
    first_parts = own_runs.reports[0]["seconds"]
    level = float(own_runs.reports[0]["iso_level_hu"])
    ours, peer = _time_warm(own_runs, volume, level, runs)
    vertices, triangles = own_runs.counts
    median = ours["median"]
    return {
        "iso_level_hu": level,
        "vertices": vertices,
        "triangles": triangles,
        "first_seconds": {"open": opened, **first_parts, "total": opened + first},
        "warm_seconds": ours,
        "part_seconds": own_runs.medians("seconds"),
        "kernel_seconds": own_runs.medians("kernel_seconds") if device.has_event_times else {},
        "resident_seconds": _time_resident(device, volume, hu, runs),
        "mvoxels_per_s": 1e-6 * volume.voxels.size / median,
        "mtriangles_per_s": 1e-6 * triangles / median,
        "peer": peer,
        "ratio": None if peer is None else peer["ratio"],
    }


def _time_warm(
    runner: _OwnRuns, volume: Volume, level: float, runs: int
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Spreads of the warm runs and of flying edges, run in turn; the second is None if VTK is not installed."""
    try:
        flying_edges = FlyingEdges(volume, usable_cores())
    except ImportError:
        runner.run()
        return spread([runner.run() for _ in range(runs)]), None
    counts: list[tuple[int, int]] = []

    def run_peer() -> float:
        done = flying_edges.run(level)
        counts.append((done.vertices, done.triangles))
        return done.seconds

    summary = summarise(*alternate(runner.run, run_peer, runs))
    vertices, triangles = counts[-1]
    peer = {
        "name": "vtkFlyingEdges3D",
        "version": flying_edges.version,
        "threads": flying_edges.threads,
        "seconds": summary["peer_s"],
        "vertices": vertices,
        "triangles": triangles,
        "ratio": summary["ratio"],
    }
    return summary["clrecon_s"], peer


def _time_resident(device: Device, volume: Volume, hu: float, runs: int) -> dict[str, float] | None:
    """Spread of seconds at iso values that are new to a volume on the device; None if no other value has a surface."""
    from clrecon.operators.surface.extract import SurfaceExtractor

    seconds = []
    with SurfaceExtractor(volume, device=device) as extractor:
        extractor.extract(hu, closed=False)
        for number in range(runs):
            # Steps of whole HU, up and down in turn: no value comes twice, and all stay close to `hu`.
            step = (number // 2 + 1) * (1 if number % 2 == 0 else -1)
            start = perf_counter()
            try:
                extractor.extract(hu + step, closed=False)
            except NoSurfaceError:  # beyond the values of the scan
                continue
            seconds.append(perf_counter() - start)
    return spread(seconds) if seconds else None


def _collect_warnings(result: dict[str, Any], volume: Volume, devices: list[Device]) -> list[str]:
    warnings = [str(text) for text in volume.report.get("warnings", [])]
    warnings += chain(*(device.warnings for device in devices))
    if result["free_cores"] < BUSY_SHARE * result["cores"]:
        warnings.append(
            f"only {result['free_cores']:.1f} of {result['cores']} cores are free: end other programs and run again"
        )
    for entry in result["devices"]:
        name = entry["device"]["name"]
        if entry["error"]:
            warnings.append(f"{name} failed: {entry['error']}")
        elif entry["peer"] is None:
            warnings.append("VTK is not installed: there is nothing to compare with")
        elif entry["peer"]["triangles"] != entry["triangles"]:
            counts = f"{entry['triangles']:,} triangles, flying edges {entry['peer']['triangles']:,}"
            warnings.append(f"{name} made {counts}: the times are not of the same work")
    return list(dict.fromkeys(warnings))
