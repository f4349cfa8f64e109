"""The main job: a CT series in, a calibrated mesh out, with its report."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.pipeline.opening import DeviceOpening
from clrecon.pipeline.presets import find_preset
from clrecon.pipeline.progress import Progress, Stopwatch, ignore_progress
from clrecon.pipeline.report import peak_memory_bytes, platform_name, stage_report
from clrecon.pipeline.settings import MeshSettings
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device

__all__ = ["make_mesh"]

_DEVICE_PARTS = ("upload", "build", "kernels", "download")
_SAID_ABOVE = ("vertices", "triangles", "closed", "manifold", "components", "area_mm2", "volume_ml", "bounds_mm")


def make_mesh(
    source: str | Path,
    output: str | Path,
    settings: MeshSettings | None = None,
    *,
    report_path: str | Path | None = None,
    measure: bool | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Read a CT series, extract the surface at the iso value, write it.

    Outputs that cannot be written are refused first, then a device that is not there, then the input.  The device
    is opened and its kernels are built while the input is read.
    Mesh and report are written to temporary files, then renamed; the report comes last, as the commit mark.

    Parameters
    ----------
    source : path
        DICOM folder or file.
    output : path
        Mesh file; its extension says the format.
    settings : MeshSettings, optional
    report_path : path, optional
        Where the report goes as JSON.
    measure : bool, optional
        Measure the mesh (area, volume, components, manifold or not).  It costs time; without it those entries of
        the report are None.  Default: when there is a `report_path`.
    progress : callable, optional
        ``progress(stage, done, total)``.

    Returns
    -------
    dict
        The report, see `describe`; with ``output`` (format, bytes), ``seconds`` and ``peak_memory_bytes``.

    Raises
    ------
    UsageError, OutputError, DeviceError, NoDicomError, RefusedInputError, NoSurfaceError
        Nothing is written then, and older files are intact.
    """
    settings = settings or MeshSettings()
    progress = progress or ignore_progress
    measure = report_path is not None if measure is None else measure
    watch = Stopwatch()
    check_outputs(output, report_path)

    progress("device", 0, 0)
    with DeviceOpening(settings.device) as opening:
        from clrecon.dicom import read_volume

        volume = read_volume(source, settings.series, progress=progress)
        watch.lap("read")
        device = opening.wait()
        watch.lap("device")

    _check_level(volume, settings.level)
    from clrecon.operators.isosurface import extract_isosurface

    mesh = extract_isosurface(volume, settings.level, device, closed=settings.closed, progress=progress)
    if settings.keep_largest is not None or settings.min_volume_ml is not None:
        from clrecon.mesh import select_components

        progress("select", 0, 0)
        mesh = select_components(mesh, keep_largest=settings.keep_largest, min_volume_ml=settings.min_volume_ml)
    watch.lap("surface")

    quality: dict[str, Any] = {}
    if measure:
        progress("measure", 0, 0)
        quality = mesh.quality()
        watch.lap("measure")

    from clrecon.mesh import stage_mesh

    progress("write", 0, 0)
    with ExitStack() as staged:  # both files are on the disk before either replaces an older one
        mesh_file = staged.enter_context(stage_mesh(mesh, output, settings.space))
        watch.lap("write")
        report = describe(volume, mesh, quality, settings, device)
        report["output"] = {"format": Path(output).suffix.lower().lstrip("."), "bytes": mesh_file.size}
        report["seconds"] = _seconds(watch, mesh)
        report["peak_memory_bytes"] = peak_memory_bytes()
        report_file = None if report_path is None else staged.enter_context(stage_report(report_path, report))
        mesh_file.commit()
        if report_file is not None:
            report_file.commit()
    return report


def _check_level(volume: Volume, level: float) -> None:
    """Refuse an iso value that has every voxel inside: the surface would be the box of the scan."""
    low, high = volume.report["hu_range"]
    if level <= low:
        raise NoSurfaceError(
            f"no surface at {level:g} HU: every voxel is inside, the volume runs from {low:g} to {high:g} HU"
        )


def check_outputs(output: str | Path, report_path: str | Path | None) -> None:
    """Refuse outputs that cannot be written, before any work is done.

    Raises
    ------
    UsageError
        Unknown extension, or both outputs are one file.
    OutputError
        A folder is missing or cannot be written, or a target is no regular file.
    """
    from clrecon.files import check_writable
    from clrecon.mesh import check_format

    check_format(output)
    check_writable(output)
    if report_path is not None:
        if Path(report_path).resolve() == Path(output).resolve():
            raise UsageError(f"the mesh and the report cannot be the same file: {output}")
        check_writable(report_path)


def describe(
    volume: Volume, mesh: Mesh, quality: dict[str, Any], settings: MeshSettings, device: Device
) -> dict[str, Any]:
    """Compose the report of a mesh, all but output, times and memory.

    Lengths are mm, areas mm2, volumes ml (1 ml = 1000 mm3).  ``bounds_mm`` is ``[[x, y, z], [x, y, z]]``, the
    lowest and the highest corner in the patient frame ``space``, also for formats that store another frame
    (GLB: metres, Y up).  ``affine_ijk_to_lps_mm`` is always LPS.
    """
    from clrecon.geometry import frame_from_lps

    frame = frame_from_lps(settings.space)
    bounds = None
    if len(mesh.vertices):
        corners = (frame @ mesh.vertices.min(axis=0), frame @ mesh.vertices.max(axis=0))
        bounds = [[float(pick(a, b)) for a, b in zip(*corners, strict=True)] for pick in (min, max)]
    certificate = dict(volume.report)
    warnings = [str(text) for text in certificate.pop("warnings", [])]
    warnings += [str(text) for text in (mesh.report or {}).get("warnings", [])]
    if settings.preset_used == "skin":
        warnings.append("a surface of the skin can show a face: treat the file as one that identifies the patient")
    report: dict[str, Any] = {
        "affine_ijk_to_lps_mm": volume.affine.tolist(),
        "iso_value_hu": settings.level,
        "iso_level_hu": (mesh.report or {}).get("iso_level_hu"),
        "outside_hu": (mesh.report or {}).get("outside_hu"),
        "preset": settings.preset_used,
        "space": settings.space,
        "unit": "mm",
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "closed": quality.get("closed"),
        "manifold": quality.get("manifold"),
        "components": quality.get("components"),
        "area_mm2": quality.get("area_mm2"),
        "volume_ml": quality.get("volume_ml") if quality.get("closed") else None,
        "bounds_mm": bounds,
        "closed_at_border": settings.closed,
        "keep_largest": settings.keep_largest,
        "min_volume_ml": settings.min_volume_ml,
        "device": device.label,
        "driver": device.driver,
        "version": package_version(),
        "platform": platform_name(),
        "warnings": list(dict.fromkeys(warnings)),
        "volume": certificate,
        "quality": {name: value for name, value in quality.items() if name not in _SAID_ABOVE} or None,
    }
    if settings.preset_used is not None:
        report["preset_reason"] = find_preset(settings.preset_used).source
    return report


def _seconds(watch: Stopwatch, mesh: Mesh) -> dict[str, float]:
    measured = (mesh.report or {}).get("seconds", {})
    seconds = {"device": watch.seconds.get("device", 0.0), "read": watch.seconds.get("read", 0.0)}
    seconds.update({part: float(measured.get(part, 0.0)) for part in _DEVICE_PARTS})
    seconds.update(write=watch.seconds.get("write", 0.0), measure=watch.seconds.get("measure", 0.0))
    seconds["other"] = max(0.0, watch.total() - sum(seconds.values()))
    seconds["total"] = watch.total()
    return {part: round(value, 4) for part, value in seconds.items()}
