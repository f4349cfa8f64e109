"""The corridor job: a CT series and its label map in; corridors, grades of screws, pictures and meshes out."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.anatomy.iso_choice import IsoChoice, choose_iso_value
from clrecon.errors import NoSurfaceError, RefusedInputError, UsageError
from clrecon.exchange.formats import check_format
from clrecon.geometry import Volume, frame_from_lps
from clrecon.jobs import corridor_results
from clrecon.jobs.outputs import MeshFiles, check_files, name_outputs
from clrecon.jobs.run import Run
from clrecon.jobs.settings import FITTED_FROM_HU, CorridorSettings
from clrecon.labels import LabelMap
from clrecon.labels.label_map import file_suffixes
from clrecon.labels.resample import resample_labels
from clrecon.mesh import Mesh
from clrecon.mesh.scanlines import cross_lines, fill_lines
from clrecon.rendering.pictures.picture import check_image_path
from clrecon.spine.corridors import VertebraCorridors, measure_corridors
from clrecon.spine.measures import SCALE, Screw, ScrewGrade, grade_screw
from clrecon.spine.solid_bone import FittedLattice, Lattice
from clrecon.system.paths import read_regular
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text

_CSV_COLUMNS = ("entry_x", "entry_y", "entry_z", "tip_x", "tip_y", "tip_z", "diameter")
"""Columns of a CSV file, beside ``name`` and ``label``, which may be left out."""

_MOST_SCREWS = 200
_LARGEST_FILE = 1 << 20


def parse_screw(text: str, space: str, number: int = 1) -> Screw:
    """Read ``X,Y,Z,X,Y,Z,D``: entry, tip and diameter in mm."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7:
        raise UsageError(f"a screw is entry, tip and diameter in mm, X,Y,Z,X,Y,Z,D, not {escape_text(text, 80)!r}")
    return _make_screw(numbers, space, f"screw {number}", None)


def _make_screw(numbers: list[float], space: str, name: str, label: str | None) -> Screw:
    turn = frame_from_lps(space).T
    entry, tip = turn @ np.array(numbers[:3]), turn @ np.array(numbers[3:6])
    return Screw(entry, tip, numbers[6], name, label)


def read_screws(path: str | Path, space: str) -> tuple[Screw, ...]:
    """Read screws from a file of JSON or CSV, told by its first character; docs/corridor.md describes both."""
    shown = escape_text(Path(path).name)
    try:
        text = read_regular(path, _LARGEST_FILE).decode("utf-8-sig")
    except OSError as error:
        raise UsageError(f"the screws in {shown} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{shown} is no text: screws are JSON or CSV") from error
    rows = _json_rows(text, shown) if text.lstrip()[:1] in ("[", "{") else _csv_rows(text, shown)
    if not 0 < len(rows) <= _MOST_SCREWS:
        raise UsageError(f"{shown} has {len(rows):,} screws: 1 to {_MOST_SCREWS} can be graded")
    screws = []
    for number, row in enumerate(rows, start=1):
        try:
            numbers = [float(value) for value in row["numbers"]]
        except (TypeError, ValueError, OverflowError):
            numbers = []
        if len(numbers) != 7:
            raise UsageError(f"screw {number} of {shown} has no three numbers of entry and of tip, and a diameter")
        name = escape_text(str(row["name"] or f"screw {number}"), 40)
        screws.append(_make_screw(numbers, space, name, None if row["label"] in (None, "") else str(row["label"])))
    return tuple(screws)


def _json_rows(text: str, shown: str) -> list[dict[str, Any]]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{shown} is no JSON: {str(error)[:80]}") from error
    if isinstance(content, dict):
        content = content.get("screws")
    if not isinstance(content, list) or not all(isinstance(entry, dict) for entry in content):
        raise UsageError(f"{shown} is no list of screws: objects with entry, tip and diameter")
    rows = []
    for entry in content:
        ends = [entry.get("entry"), entry.get("tip")]
        whole = all(isinstance(end, list) and len(end) == 3 for end in ends)
        numbers = [*ends[0], *ends[1], entry.get("diameter")] if whole else []  # type: ignore[misc]
        rows.append({"numbers": numbers, "name": entry.get("name"), "label": entry.get("label")})
    return rows


def _csv_rows(text: str, shown: str) -> list[dict[str, Any]]:
    reader = csv.DictReader(io.StringIO(text))
    missing = [name for name in _CSV_COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise UsageError(f"{shown} has no column {missing[0]}: screws have {', '.join(_CSV_COLUMNS)}")
    return [
        {"numbers": [row[name] for name in _CSV_COLUMNS], "name": row.get("name"), "label": row.get("label")}
        for row in reader
    ]


_PLACED_BY_LABEL = 0.5
"""Below this share of points that HU place a corridor says more of the label than of the bone."""


def make_corridors(
    source: str | Path, settings: CorridorSettings, files: MeshFiles | None = None, **how: Any
) -> corridor_results.CorridorReport:
    """Find the corridors through the pedicles of labelled vertebrae, and grade given screws."""
    files = files or MeshFiles()
    with Run(settings, **how) as run:
        if files.output is not None:
            check_format(files.output)
        if files.picture is not None:
            check_image_path(files.picture)
        run.check(files.named("the mesh"), source, settings.labels)
        volume, labels = run.read_labelled(source)
        run.lap("read")
        numbers = list(dict.fromkeys(labels.find(one) for one in settings.label))
        names = file_suffixes({number: labels.name(number) for number in numbers})
        with run.keeping():
            _name_files(files, list(names.values()))
        level, choice = _choose_level(volume, settings, run.progress)
        run.lap("choose")
        placed = resample_labels(labels, volume)
        fitted = _fit_vertebrae(run, volume, labels, numbers, level) if settings.surface == "cortex" else {}
        run.lap("cortex")
        corridors = []
        for done, number in enumerate(numbers):
            run.progress("corridors", done, len(numbers))
            if placed.inside[number] < 1.0:
                raise RefusedInputError(
                    f"{names[number]} is cut off: {100.0 * (1.0 - placed.inside[number]):.3g} % of its label lie"
                    " outside of the scan; corridors need the whole vertebra"
                )
            of_fit = partial(lay_on_lattice, fitted[number]) if fitted else None
            corridors.append(measure_corridors(volume, placed.voxels, number, level, names[number], of_fit))
        graded = _grade_screws(corridors, labels, numbers, settings.screws)
        run.lap("corridors")
        outputs = _draw_sheets(run, volume, corridors, graded, level, files)
        if files.output is not None:
            surfaces = fitted or _fill_vertebrae(run, volume, labels, numbers, level)
            outputs += _write_meshes(run, dict(zip(numbers, corridors, strict=True)), graded, surfaces, files.output)
        run.lap("write")
        vertebrae = [
            corridor_results.describe_vertebra(each, number, settings.margin, settings.space, own)
            for each, number, own in zip(corridors, numbers, graded, strict=True)
        ]
        report = run.report(
            corridor_results.CorridorReport,
            [*placed.warnings, *_warn_of_corridors(corridors)],
            volume,
            notice=corridor_results.NOT_FOR_PLANNING,
            level_bias=corridor_results.KNOWN_CORTEX_BIAS if fitted else corridor_results.KNOWN_BIAS,
            iso_value_hu=level,
            iso_value_reason="as given" if choice is None else choice.reason,
            iso_value_choice=None if choice is None else choice.measurements(),
            space=settings.space,
            margin_mm=float(settings.margin),
            grade_scale=SCALE if any(graded) else None,
            vertebrae=vertebrae,
            surface=settings.surface,
            outputs=outputs,
            affine_ijk_to_lps_mm=volume.affine.tolist(),
        )
        return run.finish(report, files.report)


def _picture_paths(files: MeshFiles, names: Sequence[str]) -> list[str | Path]:
    if files.picture is None:
        return []
    return name_outputs(files.picture, list(names) if len(names) > 1 else [""])


def _name_files(files: MeshFiles, names: Sequence[str]) -> None:
    """Refuse files that exist and stay, and those that two outputs would share, now that the labels are known."""
    pictures = [("the picture", path) for path in _picture_paths(files, names)]
    meshes: list[tuple[str, str | Path]] = []
    if files.output is not None:
        ends = ["".join(pair) for pair in product(names, ("", "_left", "_right"))]
        meshes = [("the mesh", path) for path in name_outputs(files.output, ends)]
    check_files(pictures, meshes, [] if files.report is None else [("the report", files.report)])


def _choose_level(volume: Volume, settings: CorridorSettings, progress: Progress) -> tuple[float, IsoChoice | None]:
    if settings.iso_value is not None or settings.surface == "cortex":
        return float(FITTED_FROM_HU if settings.iso_value is None else settings.iso_value), None
    choice = choose_iso_value(volume, progress=progress)
    return choice.iso_value, choice


def _fit_vertebrae(run: Run, volume: Volume, labels: LabelMap, numbers: Sequence[int], level: float) -> dict[int, Mesh]:
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.operators.surface.cortex_mesh import fit_labels

    settings: CorridorSettings = run.settings
    with DeviceVolume(volume, device=settings.device, memory=settings.memory) as resident:
        fitted: dict[int, Mesh] = fit_labels(resident, labels, level, numbers, progress=run.progress)
    for number, mesh in fitted.items():
        if not mesh.values:
            raise NoSurfaceError(f"{labels.name(number)}: {mesh.report['cortex']['reason']}")
    return fitted


def lay_on_lattice(mesh: Mesh, lattice: Lattice) -> FittedLattice:
    """Return what lies within a fitted surface, and where it crosses the steps of a lattice along each axis."""
    known = np.isfinite(mesh.values["thickness_mm"])[mesh.triangles].all(axis=1)
    places = lattice.indices(mesh.vertices.astype(np.float64)).T
    solid = np.zeros(lattice.shape, bool)
    shares, placed = [], []
    for axis in range(3):
        order = [other for other in range(3) if other != axis] + [axis]
        shape = [lattice.shape[each] for each in order]
        lines, along, rows = cross_lines(np.ascontiguousarray(places[:, order]), mesh.triangles, shape)
        if axis == 2:
            solid = fill_lines(lines, along, shape)
        step = np.floor(along).astype(np.int64)
        within = (step >= 0) & (step < shape[2] - 1)
        steps = (*shape[:2], shape[2] - 1)
        share, is_known = np.full(steps, 0.5, np.float32), np.zeros(steps, bool)
        hit = (lines[within] // shape[1], lines[within] % shape[1], step[within])
        share[hit], is_known[hit] = (along - step)[within], known[rows[within]]
        shares.append(np.moveaxis(share, 2, axis))
        placed.append(np.moveaxis(is_known, 2, axis))
    return FittedLattice(solid, shares, placed)


def _grade_screws(
    corridors: Sequence[VertebraCorridors], labels: LabelMap, numbers: Sequence[int], screws: Sequence[Screw]
) -> list[list[tuple[Screw, ScrewGrade]]]:
    """Grade each screw in the vertebra that it names, or else in the one whose bone its axis lies deepest in."""
    graded: list[list[tuple[Screw, ScrewGrade]]] = [[] for _ in corridors]
    for screw in screws:
        if screw.label is not None:
            number = labels.find(screw.label)
            if number not in numbers:
                raise UsageError(f"{screw.name} belongs to {labels.name(number)}, which is not among the labels named")
            position = numbers.index(number)
        else:
            axis = screw.entry + np.linspace(0.0, 1.0, 41)[:, None] * (screw.tip - screw.entry)
            position = int(np.argmax([float(each.bone.depth(axis).mean()) for each in corridors]))
        measured = corridors[position]
        graded[position].append((screw, grade_screw(measured.bone, measured.frame, screw, measured.name)))
    return graded


def _draw_sheets(
    run: Run,
    volume: Volume,
    corridors: Sequence[VertebraCorridors],
    graded: Sequence[list[tuple[Screw, ScrewGrade]]],
    level: float,
    files: MeshFiles,
) -> list[dict[str, Any]]:
    outputs = []
    for path, vertebra, grades in zip(
        _picture_paths(files, [each.name for each in corridors]), corridors, graded, strict=False
    ):
        footer = [
            f"{screw.name}: {screw.diameter:g} mm, {grade.side}, grade {grade.grade}"
            + (f", {grade.breach_mm:.1f} mm {grade.direction}" if grade.direction else "")
            for screw, grade in grades[:6]
        ]
        surface = "fitted to the bone from" if run.settings.surface == "cortex" else "at"
        footer += [f"surface {surface} {level:g} HU; green: corridor, yellow: largest screw, red: given screw"]
        footer += [corridor_results.NOT_FOR_PLANNING]
        picture = corridor_results.draw_corridors(
            volume, vertebra, [screw for screw, _ in grades], run.settings.margin, footer
        )
        outputs.append({"kind": "picture", "name": vertebra.name, "bytes": run.write_picture(path, picture).size})
    return outputs


def _fill_vertebrae(
    run: Run, volume: Volume, labels: LabelMap, numbers: Sequence[int], level: float
) -> Mapping[int, Mesh]:
    """Return the surfaces of vertebrae, filled as the mesh job does with solid labels."""
    from clrecon.operators.surface.labels import extract_labels

    return extract_labels(
        volume, labels, level, device=run.settings.device, label=numbers, solid=True, memory=run.settings.memory,
        progress=run.progress,
    )  # fmt: skip


def _write_meshes(
    run: Run,
    corridors: dict[int, VertebraCorridors],
    graded: Sequence[list[tuple[Screw, ScrewGrade]]],
    vertebrae: Mapping[int, Mesh],
    output: str | Path,
) -> list[dict[str, Any]]:
    meshes: dict[str, Mesh] = {}
    for (number, vertebra), grades in zip(corridors.items(), graded, strict=True):
        meshes[vertebra.name] = vertebrae[number]
        cylinders = corridor_results.cylinder_meshes(vertebra, [screw for screw, _ in grades])
        meshes |= {f"{vertebra.name}_{name}": mesh for name, mesh in cylinders.items()}
    written = run.write_meshes(list(meshes.values()), name_outputs(output, list(meshes)))
    return [{"kind": "mesh", "name": name, "bytes": each.size} for name, each in zip(meshes, written, strict=True)]


def _warn_of_corridors(corridors: Sequence[VertebraCorridors]) -> list[str]:
    warnings: list[str] = []
    for vertebra in corridors:
        warnings += vertebra.warnings
        for corridor in vertebra.corridors:
            if corridor.refused is not None:
                warnings.append(f"{vertebra.name}, {corridor.side}: {corridor.refused}")
            elif corridor.by_hu_share is not None and corridor.by_hu_share < _PLACED_BY_LABEL:
                warnings.append(
                    f"{vertebra.name}, {corridor.side}: HU place {100.0 * corridor.by_hu_share:.0f} % of the walls"
                    " beside the line, the label's own border the rest: the radius is that of the label"
                )
    return warnings
