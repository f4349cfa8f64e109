"""The job that looks into vertebrae: a CT series and its labels in, meshes of the parts and their volumes out."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.jobs.inside.pictures import check_pictures, describe_picture, draw_parts
from clrecon.jobs.inside.report import InsideReport, describe_job, describe_mesh_file
from clrecon.jobs.inside.settings import InsideSettings
from clrecon.jobs.shared.labelled import read_with_labels
from clrecon.jobs.shared.laps import Laps
from clrecon.jobs.shared.opening import DeviceOpening
from clrecon.jobs.shared.outputs import (
    check_distinct,
    check_kept,
    check_outputs,
    commit_all,
    name_outputs,
    refuse_files,
    stage_meshes,
)
from clrecon.jobs.shared.pictures import stage_picture
from clrecon.jobs.shared.report import stage_report
from clrecon.reading import read_selected
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.operators.vertebrae.inside import VertebraInside
    from clrecon.rendering import Rendering
    from clrecon.system.files import StagedFile

log = get_logger(__name__)


def make_inside(
    source: str | Path,
    output: str | Path,
    settings: InsideSettings,
    *,
    picture: str | Path | None = None,
    report_path: str | Path | None = None,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> InsideReport:
    """Read a CT series and its labels, look into vertebrae, and write the surfaces of their parts.

    The files have the names of the parts: ``inside.stl`` becomes ``inside_solid.stl``, ``inside_dense.stl`` and so on,
    with several vertebrae ``inside_L3_solid.stl``.  All are written under temporary names, then renamed; the report
    comes last, as the commit mark.

    source: DICOM folder or file, or a file of another format, see `clrecon.read_volume`.
    output: Mesh file; its extension gives the format.
    picture: Picture, .png, .jpg or .tif: one of each part, with names like those of the meshes.
    report_path: File for the report as JSON.
    no_clobber: Files that exist stay and are an `OutputError`.
    progress: ``progress(stage, done, total)``.
    """
    from clrecon.operators.vertebrae.inside import PARTS

    progress = progress or ignore_progress
    watch = Laps()
    with keep_existing(no_clobber):
        _check_files(source, output, picture, report_path, settings)
    volume, labels, device = _open(source, settings, progress)
    suffixes = _name_labels(labels, settings)
    if no_clobber:
        names = [name_part(suffix, part, several=len(suffixes) > 1) for suffix in suffixes for part in PARTS]
        refuse_files(name_outputs(output, names) + ([] if picture is None else name_outputs(picture, names)))
    watch.lap("read")
    found: list[_Found] = []
    for number, suffix in zip(_numbers(labels, settings), suffixes, strict=True):
        progress("inside", len(found), len(suffixes) if len(suffixes) > 1 else 0)
        inside = _look(volume, labels, number, settings, device)
        found.append(_Found(suffix, inside, inside.extract_meshes(memory=settings.memory)))
    watch.lap("inside")
    if picture is not None:
        for place, one in enumerate(found):
            progress("render", place, len(found) if len(found) > 1 else 0)
            one.pictures = draw_parts(one.meshes, settings.view, device, settings.memory)
        watch.lap("render")
    with keep_existing(no_clobber):
        report = _write(found, (output, picture, report_path), volume, settings, device, watch, progress)
    log_warnings(log, report.warnings, volume.report.get("warnings", ()))
    log.info("%d vertebrae looked into, on %s in %.3f s", len(found), report.device, report.seconds["total"])
    return report


@dataclass
class _Found:
    """One vertebra: its name in files, its parts, their surfaces and their pictures."""

    suffix: str
    inside: VertebraInside
    meshes: dict[str, Mesh]
    pictures: dict[str, Rendering] = field(default_factory=dict)


def _check_files(
    source: str | Path,
    output: str | Path,
    picture: str | Path | None,
    report_path: str | Path | None,
    settings: InsideSettings,
) -> None:
    """Refuse outputs that cannot be written or would replace an input."""
    from clrecon.operators.vertebrae.inside import PARTS
    from clrecon.system.files import check_writable

    # names of several vertebrae are those of the label map, which is not read yet: their number stands for them
    first = [part if len(settings.only) == 1 else f"{len(settings.only)}_{part}" for part in PARTS]
    outputs = check_outputs(output, report_path, first)
    if picture is not None:
        check_pictures(picture, settings.view)
        drawn = [("the picture", path) for path in name_outputs(picture, first)]
        check_distinct(outputs, drawn)
        for _, path in drawn:
            check_writable(path)
        outputs += drawn
    check_kept(outputs, source, settings.labels)


def _open(source: str | Path, settings: InsideSettings, progress: Progress) -> tuple[Volume, LabelMap, Device]:
    """Read the input while the device opens and builds its kernels."""
    from clrecon.labels import read_labels

    progress("device", 0, 0)
    with DeviceOpening(settings.device, _prepare) as opening:
        volume, labels = read_with_labels(
            partial(read_selected, source, settings, progress=progress),
            settings.labels,
            lambda volume: read_labels(settings.labels, volume=volume),
        )
        device = opening.wait()
    assert labels is not None
    return volume, labels, device


def _prepare(device: Device) -> None:
    from clrecon.operators.surface.label_masks import prepare_label_masks

    prepare_label_masks(device)


def _numbers(labels: LabelMap, settings: InsideSettings) -> list[int]:
    return list(dict.fromkeys(labels.find(label) for label in settings.only))


def _name_labels(labels: LabelMap, settings: InsideSettings) -> list[str]:
    """Return the names of the vertebrae in files and in the report."""
    from clrecon.labels import file_suffixes

    return list(file_suffixes({number: labels.name(number) for number in _numbers(labels, settings)}).values())


def name_part(suffix: str, part: str, *, several: bool) -> str:
    """Return the name of a part in those of its files; of several vertebrae with that of its own."""
    return f"{suffix}_{part}" if several else part


def _look(volume: Volume, labels: LabelMap, number: int, settings: InsideSettings, device: Device) -> VertebraInside:
    from clrecon.operators.vertebrae.inside import vertebra_inside

    given = {name: getattr(settings, name) for name in ("dense", "close_mm") if getattr(settings, name) is not None}
    return vertebra_inside(
        volume, labels, number, settings.iso_value, grow_mm=settings.grow_mm, device=device, memory=settings.memory,
        **given,
    )  # fmt: skip


def _write(
    found: list[_Found],
    outputs: tuple[str | Path, str | Path | None, str | Path | None],
    volume: Volume,
    settings: InsideSettings,
    device: Device,
    watch: Laps,
    progress: Progress,
) -> InsideReport:
    """Write all files, with the report of all vertebrae as the last one, and return the report."""
    from clrecon.operators.vertebrae.solid import CLOSE_MM

    output, picture, report_path = outputs
    suffixes = [one.suffix for one in found]
    with ExitStack() as staged:
        files: list[StagedFile] = []
        vertebrae: list[dict[str, Any]] = []
        for one in found:
            names = [name_part(one.suffix, part, several=len(suffixes) > 1) for part in one.meshes]
            paths = name_outputs(output, names, report_path)
            written = stage_meshes(
                staged, list(one.meshes.values()), paths, settings.space, progress, keep_ids=settings.keep_ids
            )
            told: dict[str, Any] = {**one.inside.as_dict(), "name": one.suffix, "pictures": []}
            parts = zip(one.meshes, one.meshes.values(), paths, written, strict=True)
            told["meshes"] = [describe_mesh_file(part, mesh, path, file.size) for part, mesh, path, file in parts]
            files += written
            for part, drawn in one.pictures.items():
                assert picture is not None
                (path,) = name_outputs(picture, [name_part(one.suffix, part, several=len(suffixes) > 1)])
                files.append(stage_picture(staged, drawn, path))
                told["pictures"].append(describe_picture(part, drawn, path, files[-1].size))
                told["warnings"] += drawn.report["warnings"]
            vertebrae.append(told)
        watch.lap("write")
        seconds = {part: round(value, 4) for part, value in {**watch.seconds, "total": watch.total()}.items()}
        report = describe_job(
            volume, vertebrae, settings, device.current, close_mm=settings.close_mm or CLOSE_MM, seconds=seconds
        )
        if report_path is not None:
            files.append(staged.enter_context(stage_report(report_path, report)))
        commit_all(files)
    return report
