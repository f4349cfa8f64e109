"""The corridor job: a CT series and its label map in; corridors, grades, pictures and meshes out."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.certificate import without_ids
from clrecon.jobs.corridor.report import KNOWN_BIAS, NOT_FOR_PLANNING, CorridorReport, describe_vertebra
from clrecon.jobs.corridor.settings import CorridorFiles, CorridorSettings
from clrecon.jobs.corridor.solids import cylinder_meshes
from clrecon.jobs.shared.labelled import read_with_labels
from clrecon.jobs.shared.laps import Laps
from clrecon.jobs.shared.outputs import check_distinct, check_kept, commit_all, name_outputs, stage_meshes
from clrecon.jobs.shared.report import peak_memory_bytes, platform_name, stage_report
from clrecon.labels.names import file_suffixes
from clrecon.labels.resample import resample_labels
from clrecon.reading import read_selected
from clrecon.spine.corridors import VertebraCorridors, measure_corridors
from clrecon.spine.measures import SCALE, Screw, ScrewGrade, grade_screw
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.anatomy.iso_choice import IsoChoice
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.system.files import StagedFile

_PLACED_BY_LABEL = 0.5
"""Below this share of points that HU place a corridor says more of the label than of the bone."""


def make_corridors(
    source: str | Path,
    settings: CorridorSettings,
    files: CorridorFiles | None = None,
    *,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> CorridorReport:
    """Find the corridors through the pedicles of labelled vertebrae, and grade given screws.

    source: DICOM folder or file, or a file of another format, see `clrecon.reading.read_volume`.
    no_clobber: Files that exist stay and are an `OutputError`, before any work.
    progress: ``progress(stage, done, total)``.
    """
    files, progress, watch = files or CorridorFiles(), progress or ignore_progress, Laps()
    with keep_existing(no_clobber):
        _check_files(source, settings, files)
    volume, labels = _read(source, settings, progress)
    watch.lap("read")
    numbers = list(dict.fromkeys(labels.find(label) for label in settings.only))
    names = file_suffixes({number: labels.name(number) for number in numbers})
    with keep_existing(no_clobber):
        _name_files(settings, files, list(names.values()))
    level, choice = _choose(volume, settings, progress)
    watch.lap("choose")
    taken = resample_labels(labels, volume)
    found = []
    for done, number in enumerate(numbers):
        progress("corridors", done, len(numbers))
        _check_inside(taken.inside[number], names[number])
        found.append(measure_corridors(volume, taken.voxels, number, level, names[number]))
    graded = _grade(found, labels, numbers, settings.screws)
    watch.lap("corridors")
    with keep_existing(no_clobber), ExitStack() as stack:
        staged, outputs = _stage(stack, volume, labels, found, numbers, graded, level, settings, files, progress)
        watch.lap("write")
        vertebrae = [
            describe_vertebra(each, number, settings.margin, settings.space, own)
            for each, number, own in zip(found, numbers, graded, strict=True)
        ]
        warnings = [*taken.warnings, *_warn(found)]
        report = _compose(volume, settings, (level, choice), vertebrae, outputs, warnings, watch)
        if files.report is not None:
            staged.append(stack.enter_context(stage_report(files.report, report)))
        commit_all(staged)
    return report


def _check_files(source: str | Path, settings: CorridorSettings, files: CorridorFiles) -> None:
    """Refuse outputs that cannot be written or would replace an input, as far as their names are known."""
    from clrecon.exchange.formats import check_format
    from clrecon.rendering.pictures.image_files import check_image_path
    from clrecon.system.files import check_writable

    if files.output is not None:
        check_format(files.output)
    if files.picture is not None:
        check_image_path(files.picture)
    named = [
        (what, path)
        for what, path in (("the mesh", files.output), ("the picture", files.picture), ("the report", files.report))
        if path is not None
    ]
    check_distinct(named)
    check_kept(named, source, settings.labels)
    for _, path in named:
        check_writable(path)


def _picture_paths(files: CorridorFiles, names: Sequence[str]) -> list[str | Path]:
    if files.picture is None:
        return []
    return name_outputs(files.picture, list(names) if len(names) > 1 else [""])


def _name_files(settings: CorridorSettings, files: CorridorFiles, names: Sequence[str]) -> None:
    """Refuse files that exist and stay, and those that two outputs would share, now that the labels are known."""
    from clrecon.system.files import check_writable

    pictures = [("the picture", path) for path in _picture_paths(files, names)]
    meshes: list[tuple[str, str | Path]] = []
    if files.output is not None:
        ends = [f"{name}{end}" for name in names for end in ("", "_left", "_right")]
        meshes = [("the mesh", path) for path in name_outputs(files.output, ends)]
    report = [] if files.report is None else [("the report", files.report)]
    check_distinct(pictures, meshes, report)
    for _, path in (*pictures, *meshes):
        check_writable(path)


def _read(source: str | Path, settings: CorridorSettings, progress: Progress) -> tuple[Volume, LabelMap]:
    from clrecon.labels import read_labels

    def read_map(volume: Volume | None) -> LabelMap | None:
        return read_labels(settings.labels, None, volume=volume)

    volume, labels = read_with_labels(
        partial(read_selected, source, settings, progress=progress), settings.labels, read_map
    )
    assert labels is not None
    return volume, labels


def _choose(volume: Volume, settings: CorridorSettings, progress: Progress) -> tuple[float, IsoChoice | None]:
    if settings.iso_value is not None:
        return float(settings.iso_value), None
    from clrecon.anatomy.iso_choice import choose_iso_value

    choice = choose_iso_value(volume, progress=progress)
    return choice.iso_value, choice


def _check_inside(share: float, name: str) -> None:
    """Refuse a label that goes on beyond the scan."""
    if share < 1.0:
        raise RefusedInputError(
            f"{name} is cut off: {100.0 * (1.0 - share):.3g} % of its label lie outside of the scan; corridors need the"
            " whole vertebra"
        )


def _grade(
    found: Sequence[VertebraCorridors], labels: LabelMap, numbers: Sequence[int], screws: Sequence[Screw]
) -> list[list[tuple[Screw, ScrewGrade]]]:
    """Grade each screw in the vertebra that it names, or else in the one whose bone its axis lies deepest in."""
    graded: list[list[tuple[Screw, ScrewGrade]]] = [[] for _ in found]
    for screw in screws:
        if screw.label is not None:
            number = labels.find(screw.label)
            if number not in numbers:
                raise UsageError(f"{screw.name} belongs to {labels.name(number)}, which is not among the labels named")
            place = numbers.index(number)
        else:
            axis = screw.entry + np.linspace(0.0, 1.0, 41)[:, None] * (screw.tip - screw.entry)
            depths = [float(each.bone.depth(axis).mean()) for each in found]
            place = int(np.argmax(depths))
        own = found[place]
        graded[place].append((screw, grade_screw(own.bone, own.frame, screw, own.name)))
    return graded


def _stage(
    stack: ExitStack,
    volume: Volume,
    labels: LabelMap,
    found: Sequence[VertebraCorridors],
    numbers: Sequence[int],
    graded: Sequence[list[tuple[Screw, ScrewGrade]]],
    level: float,
    settings: CorridorSettings,
    files: CorridorFiles,
    progress: Progress,
) -> tuple[list[Any], list[dict[str, Any]]]:
    """Write pictures and meshes under temporary names; return them and their entries."""
    staged: list[StagedFile] = []
    outputs = []
    names = [each.name for each in found]
    for path, each, own in zip(_picture_paths(files, names), found, graded, strict=False):
        staged.append(stack.enter_context(_stage_picture(path, volume, each, own, level, settings)))
        outputs.append({"kind": "picture", "name": each.name, "bytes": staged[-1].size})
    if files.output is None:
        return list(staged), outputs
    vertebrae = _extract(volume, labels, numbers, level, settings, progress)
    meshes: dict[str, Mesh] = {}
    for number, each, own in zip(numbers, found, graded, strict=True):
        meshes[each.name] = vertebrae[number]
        cylinders = cylinder_meshes(each, [screw for screw, _ in own])
        meshes |= {f"{each.name}_{name}": mesh for name, mesh in cylinders.items()}
    paths = name_outputs(files.output, list(meshes))
    written = stage_meshes(stack, list(meshes.values()), paths, settings.space, progress, keep_ids=settings.keep_ids)
    outputs += [{"kind": "mesh", "name": name, "bytes": each.size} for name, each in zip(meshes, written, strict=True)]
    return [*staged, *written], outputs


def _extract(
    volume: Volume,
    labels: LabelMap,
    numbers: Sequence[int],
    level: float,
    settings: CorridorSettings,
    progress: Progress,
) -> dict[int, Mesh]:
    """Extract the surfaces of the vertebrae, filled, as the mesh job does with solid labels."""
    from clrecon.operators.surface.labels import extract_labels

    return extract_labels(
        volume, labels, level, device=settings.device, numbers=list(numbers), solid=True, memory=settings.memory,
        progress=progress,
    )  # fmt: skip


def _stage_picture(
    path: str | Path,
    volume: Volume,
    found: VertebraCorridors,
    graded: Sequence[tuple[Screw, ScrewGrade]],
    level: float,
    settings: CorridorSettings,
) -> Any:
    from clrecon.jobs.corridor.pictures import draw_corridors
    from clrecon.rendering.pictures.image_files import check_image_path, encode_image
    from clrecon.system.files import stage_file

    footer = [f"surface at {level:g} HU; green: corridor, yellow: largest screw, red: given screw", NOT_FOR_PLANNING]
    footer[:0] = [
        f"{screw.name}: {screw.diameter:g} mm, {grade.side}, grade {grade.grade}"
        + (f", {grade.breach_mm:.1f} mm {grade.direction}" if grade.direction else "")
        for screw, grade in graded[:6]
    ]
    picture = draw_corridors(volume, found, [screw for screw, _ in graded], settings.margin, footer)
    content = encode_image(picture, check_image_path(path))

    def write(stream: BinaryIO) -> None:
        stream.write(content)

    return stage_file(path, write, expected_bytes=len(content))


def _warn(found: Sequence[VertebraCorridors]) -> list[str]:
    warnings: list[str] = []
    for each in found:
        warnings += each.warnings
        for corridor in each.corridors:
            if corridor.refused is not None:
                warnings.append(f"{each.name}, {corridor.side}: {corridor.refused}")
            elif corridor.by_hu_share is not None and corridor.by_hu_share < _PLACED_BY_LABEL:
                warnings.append(
                    f"{each.name}, {corridor.side}: HU place {100.0 * corridor.by_hu_share:.0f} % of the walls beside"
                    " the line, the label's own border the rest: the radius is that of the label"
                )
    return warnings


def _compose(
    volume: Volume,
    settings: CorridorSettings,
    level: tuple[float, IsoChoice | None],
    vertebrae: list[dict[str, Any]],
    outputs: list[dict[str, Any]],
    warnings: Sequence[str],
    watch: Laps,
) -> CorridorReport:
    certificate = dict(volume.report) if settings.keep_ids else without_ids(volume.report)
    told = [*certificate.pop("warnings", []), *warnings]
    iso_value, choice = level
    seconds = {part: round(value, 4) for part, value in watch.seconds.items()}
    return CorridorReport(
        notice=NOT_FOR_PLANNING,
        level_bias=KNOWN_BIAS,
        iso_value_hu=iso_value,
        iso_value_reason="as given" if choice is None else choice.reason,
        iso_value_choice=None if choice is None else choice.measurements(),
        space=settings.space,
        margin_mm=float(settings.margin),
        grade_scale=SCALE if any(each["screws"] for each in vertebrae) else None,
        vertebrae=vertebrae,
        outputs=outputs,
        affine_ijk_to_lps_mm=volume.affine.tolist(),
        version=package_version(),
        platform=platform_name(),
        warnings=list(dict.fromkeys(map(str, told))),
        volume=certificate,
        seconds={**seconds, "total": round(watch.total(), 4)},
        peak_memory_bytes=peak_memory_bytes(),
    )
