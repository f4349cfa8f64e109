"""Iso surfaces of labels: the label selects the cells, HU place the vertices."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from clrecon.anatomy.head import SKIN_HU, warn_of_skin
from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule
from clrecon.labels import LabelMap, ResampledLabels
from clrecon.labels.growth import Growth
from clrecon.labels.solid import Box, find_boxes
from clrecon.labels.volumes import count_ml, label_ml, slice_voxel_ml
from clrecon.mesh import Mesh
from clrecon.opencl import (
    Device,
    Stopwatch,
)
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.extraction import Part
from clrecon.operators.surface.label_extraction import HeldSlices, LabelExtraction
from clrecon.operators.surface.label_groups import each_label
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress

_FILLS = "the whole CT is inside of it, and a surface that ends open has nowhere to lie; close it"


def _refuse_label(
    volume: Volume, taken: ResampledLabels, labels: LabelMap, rule: IsoRule, number: int
) -> NoSurfaceError:
    label = f"{number} {labels.name(number)}"
    mask = taken.voxels == number
    if not mask.any():
        return NoSurfaceError(f"label {label} has no voxel in the CT: it lies outside")
    hu = volume.voxels[mask]
    if not rule.closed and hu.max() >= rule.lowest_inside:
        return NoSurfaceError(f"no surface of label {label} at {rule.iso_value:g} HU: {_FILLS}")
    return NoSurfaceError(
        f"no surface of label {label} at {rule.iso_value:g} HU: its voxels run from {float(hu.min()):g} to"
        f" {float(hu.max()):g} HU"
    )


@explains_arguments
def extract_labels(
    volume: Volume | DeviceVolume,
    labels: LabelMap,
    iso_value: float,
    *,
    device: Device | str | int | None = None,
    numbers: Sequence[int | str] | int | str | None = None,
    grow_mm: float | None = None,
    closed: bool = True,
    solid: bool = False,
    memory: int | None = None,
    progress: Progress | None = None,
) -> dict[int, Mesh]:
    """Extract the iso surface of a volume label by label: the label selects the cells, HU place the vertices.

    A voxel is inside of a label when it is dense (``iso_value`` or more) and belongs to the label: by the map, or, if
    it has no label, because the label is the nearest one within the growth.  Between a dense voxel of the label and one
    that is neither dense nor labelled, the vertex is that of `extract_isosurface`, bit for bit.  Elsewhere (the border
    of two labels, dense voxels beyond the growth) it lies half way.  Every mesh is closed and manifold; two labels
    share the vertices of their border, bit for bit.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        A `DeviceVolume` is used directly, with its own device and memory.
    labels : LabelMap
        On any grid, see `resample_labels`.
    iso_value : float
        HU.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    numbers : sequence of int or str, optional
        Labels to extract, as `LabelMap.find` takes them; each must have a surface.  None: all that have one.
    grow_mm : float, optional
        Distance of growth; None is one voxel each way, the 26 neighbours.
    closed : bool
        As `extract_isosurface`.
    solid : bool
        True: fill less dense parts within a label, see ``clrecon.labels.solid``.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.  If the slices of all labels do not fit
        together, the labels are processed one by one; the meshes are the same.
    progress : callable, optional
        Called as ``progress("labels", done, total)``.

    Returns
    -------
    dict of int to Mesh
        In the order asked for, else ascending.  ``Mesh.report`` has, beside what `extract_isosurface` says, ``label``,
        ``label_name``, ``label_inside_share`` (of the labelled voxels, in the volume), ``label_ml`` (volume of its
        voxels, on the map's own grid), ``label_taken_ml`` (the same on the grid of the volume),
        ``vertices_by_hu_share``, ``grow_mm`` and ``solid``.

    Raises
    ------
    NoSurfaceError
        A label that was asked for, or every label, has no dense voxel; the message gives the range of its HU.
    UsageError
        The arguments are not a Volume and a LabelMap, a label is unknown, or as `extract_isosurface`.
    RefusedInputError
        The labels do not lie on the volume.
    DeviceError
        As `extract_isosurface`.
    """
    with open_volume(volume, device, memory, "a surface of a label") as resident:
        taken = resident.bring(labels)
        rule = choose_iso_rule(resident.volume, iso_value, closed, values=resident.values)
        marching_cubes.check_row(resident.volume.shape_ijk[0])
        growth = Growth.of(resident.volume, grow_mm)

        def make(told: list[str]) -> dict[int, Mesh]:
            run = LabelExtraction(resident, taken, rule, growth, solid)
            run.warnings += told
            return _make_meshes(run, labels, taken, numbers, progress)

        meshes = resident.attempt(make)
    if not meshes:
        raise _refuse_all(resident.volume, taken, labels, rule)
    return meshes


def _refuse_all(volume: Volume, taken: ResampledLabels, labels: LabelMap, rule: IsoRule) -> NoSurfaceError:
    """The error where no label has a surface: none has a dense voxel, or one is all of an open volume."""
    for values, numbers in zip(volume.voxels, taken.voxels, strict=True):
        dense = numbers[(numbers > 0) & rule.mark_inside(values)]
        if dense.size:
            return _refuse_label(volume, taken, labels, rule, int(dense[0]))
    return NoSurfaceError(f"no label has a voxel of {rule.iso_value:g} HU or more in the CT")


def _make_meshes(
    run: LabelExtraction,
    labels: LabelMap,
    taken: ResampledLabels,
    numbers: Sequence[int | str] | int | str | None,
    progress: Progress | None,
) -> dict[int, Mesh]:
    """Make the meshes of labels that have one; a label that was named must have one."""
    chosen = labels.choose(numbers)
    boxes = find_boxes(taken.voxels, chosen, run.growth.reach)
    refuse = None if numbers is None else partial(_refuse_label, run.volume, taken, labels, run.rule)
    missing = [number for number in chosen if number not in boxes]
    if missing and refuse is not None:
        raise refuse(missing[0])
    meshes: dict[int, Mesh] = {}
    for number, part in _extract_each(run, boxes, refuse, progress):
        report = {**run.describe(), **_describe_label(run.volume, labels, taken, number, boxes[number])}
        meshes[number] = _as_mesh(run, taken, report, part)
    return meshes


def _extract_each(
    run: LabelExtraction,
    boxes: dict[int, Box],
    refuse: Callable[[int], NoSurfaceError] | None,
    progress: Progress | None,
) -> Iterator[tuple[int, Part]]:
    """Yield labels with their surfaces, as many at once as fit the device; labels without surface are left out or
    refused.
    """
    groups = run.group(boxes) if boxes else []
    run.groups = len(groups)
    done = 0

    def extract(held: HeldSlices, number: int, box: Box) -> Part | None:
        if progress is not None:
            progress("labels", done, len(boxes))
        return run.extract_one(held, number, box)

    for number, part in each_label(groups, run.find_inside, extract, run.warnings):
        if part is not None:
            done += 1
            yield number, part
        elif refuse is not None:
            raise refuse(number)


def _as_mesh(run: LabelExtraction, taken: ResampledLabels, report: dict[str, Any], part: Part) -> Mesh:
    report["vertices_by_hu_share"] = run.share_by_hu
    report["warnings"] += _warn(taken, report)
    positions, normals, triangles = part
    mesh = Mesh(run.placement.to_lps(positions), triangles, normals, report, trusted=True)
    if SKIN_HU[0] <= run.rule.iso_value <= SKIN_HU[1]:
        report["warnings"] += warn_of_skin(run.volume, mesh.vertices, mesh.triangles)
    run.stopwatch = Stopwatch()  # the time of common work counts for the first label
    return mesh


def _describe_label(volume: Volume, labels: LabelMap, taken: ResampledLabels, number: int, box: Box) -> dict[str, Any]:
    """Describe a label before its surface is known."""
    return {
        "label": number,
        "label_name": labels.name(number),
        "label_inside_share": taken.inside[number],
        "label_ml": label_ml(labels, number),
        "label_taken_ml": count_ml(taken.voxels, number, box, slice_voxel_ml(volume)),
    }


def _warn(taken: ResampledLabels, report: dict[str, Any]) -> list[str]:
    warnings = list(taken.warnings)
    if report["label_inside_share"] < 1.0:
        share = 100.0 * (1.0 - report["label_inside_share"])
        warnings.append(
            f"{share:.3g} % of label {report['label']} lie outside the CT: its surface ends where the CT does"
        )
    return warnings
