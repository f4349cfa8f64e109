"""Surfaces of label masks: the mask tells which samples are inside, its smoothed occupancy places the vertices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from clrecon.errors import RefusedInputError
from clrecon.labels import LabelMap
from clrecon.labels.enclosed import find_enclosed
from clrecon.labels.occupancy import FULL
from clrecon.labels.solid import Box
from clrecon.labels.volumes import label_ml
from clrecon.mesh import Mesh
from clrecon.mesh.compare.gates import judge_label_volume
from clrecon.mesh.triangles import enclosed_ml
from clrecon.opencl import (
    Device,
    Stopwatch,
    take_device,
    work_on,
)
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.extraction import Part
from clrecon.operators.surface.label_groups import each_label
from clrecon.operators.surface.label_survey import survey_labels
from clrecon.operators.surface.mask_extraction import HeldMap, MaskExtraction
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress


@explains_arguments
def extract_label_masks(
    labels: LabelMap,
    *,
    device: Device | str | int | None = None,
    numbers: Sequence[int | str] | int | str | None = None,
    closed: bool = True,
    memory: int | None = None,
    progress: Progress | None = None,
) -> dict[int, Mesh]:
    """Extract each label's own surface: that of its mask without the steps, with the volume of its voxels.

    Every voxel of the label is inside of its mesh, and no other voxel is, so nothing is lost and nothing joined.
    Vertices lie on the edges between the centres of differing neighbours, within half a voxel of their common face.
    Their place on an edge comes from the occupancy: the mask smoothed by two rounds of [1 2 1] / 4 along each axis.  It
    is where the occupancy crosses the level that gives the mesh the volume of the label's voxels; between two labels it
    is where the leads of both are equal, and both meshes have the same vertices, bit for bit.  At the ends of the map
    the mesh ends flat, at the faces of the voxels.  HU are not used, so bones, organs and air are all possible.

    Parameters
    ----------
    labels : LabelMap
        The surfaces lie on its own grid: nothing is resampled.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    numbers : sequence of int or str, optional
        Labels to extract, as `LabelMap.find` takes them.  None: all that occur.
    closed : bool
        Close the surface where it meets the border of the map.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.  If the slices of all labels do not fit
        together, the labels are processed one by one; the meshes are the same.
    progress : callable, optional
        Called as ``progress("labels", done, total)``.

    Returns
    -------
    dict of int to Mesh
        In the order asked for, else ascending.  Each mesh is closed and manifold.  ``Mesh.report`` has ``surface``
        ("mask"), ``label``, ``label_name``, ``label_ml`` (the volume of its voxels), ``label_mesh_ml`` (what the mesh
        encloses, None where it is open), ``mask_level`` (the share of occupancy at which it lies),
        ``closed_at_border``, the affine, the device, the seconds, and ``warnings``, among them one where the mesh is
        more than 1 % larger or smaller than its label: labels that fill the map, or touch at its ends, cannot all keep
        their volume.

    Raises
    ------
    UsageError
        ``labels`` is not a LabelMap, a label is unknown, or rows of the map are too long.
    RefusedInputError
        The label map is empty.
    DeviceError
        No device, not even one label fits its memory, 2^32 vertices or triangles or more, or the device fails.

    References
    ----------
    Gibson 1998, Constrained elastic surface nets (a surface that is smoothed within the voxels of its mask); Lorensen
    and Cline 1987.
    """
    if not labels.numbers:
        raise RefusedInputError("the label map is empty: no voxel has a label")
    marching_cubes.check_row(labels.shape_ijk[0])
    chosen = labels.choose(numbers)

    def make(current: Device, told: list[str]) -> dict[int, Mesh]:
        run = MaskExtraction(labels, current, memory, closed)
        run.warnings += told
        return _make_meshes(run, chosen, progress)

    return work_on(take_device(device), make)


def warn_of_volume(report: Mapping[str, Any]) -> list[str]:
    """Return a warning where the mesh of a label has not its volume, from the mesh's own report."""
    gate = judge_label_volume(report["label_mesh_ml"], report["label_ml"], by_hu=False)
    if gate.ok is not False:
        return []
    return [f"label {report['label']}: {gate['text']}; labels that fill the map or touch at its ends lose volume there"]


def _make_meshes(run: MaskExtraction, chosen: Sequence[int], progress: Progress | None) -> dict[int, Mesh]:
    labels = run.labels
    everywhere, faces = survey_labels(labels, run.device, run.memory, run.stopwatch)
    if run.grid.rule.closed and faces[:, 1].any() and (enclosed := find_enclosed(labels.voxels, faces, everywhere)):
        run.keep_enclosed(enclosed, everywhere)
    boxes = {number: everywhere[number] for number in chosen}
    meshes: dict[int, Mesh] = {}
    groups = run.group(boxes)
    run.groups = len(groups)

    def extract(held: HeldMap, number: int, box: Box) -> tuple[Part, int]:
        if progress is not None:
            progress("labels", len(meshes), len(boxes))
        return run.extract_one(held, number, box)

    for number, ((positions, normals, triangles), level) in each_label(groups, run.hold, extract, run.warnings):
        own = {"label": number, "label_name": labels.name(number), "label_ml": label_ml(labels, number)}
        mesh = Mesh(run.placement.to_lps(positions), triangles, normals, {**run.describe(), **own}, trusted=True)
        mesh_ml = enclosed_ml(mesh.vertices, triangles) if run.grid.rule.closed else None
        mesh.report |= {"mask_level": level / FULL, "label_mesh_ml": mesh_ml}
        mesh.report["warnings"] += warn_of_volume(mesh.report)
        meshes[number] = mesh
        run.stopwatch = Stopwatch()  # the time of common work counts for the first label
    return meshes
