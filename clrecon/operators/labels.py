"""Extract the surfaces of labels: the label picks the cells, HU place the vertices.

The host side of cl/labels/own_samples.cl; counting and writing are those of cl/isosurface/marching_cubes.cl.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume, is_left_handed
from clrecon.geometry.field import IsoRule, choose_iso_rule, vertex_margin
from clrecon.kernels import Stopwatch, allocate, download, empty_output, launch, load_program, upload
from clrecon.labels import LabelMap, ResampledLabels, resample_labels
from clrecon.labels.growth import checked_growth, near_offsets
from clrecon.labels.solid import Box, fill_solid, find_boxes
from clrecon.mesh import Mesh
from clrecon.opencl import Device, check_budget, choose_device
from clrecon.operators import isosurface as plain
from clrecon.operators.compaction import prepare_compaction

__all__ = ["extract_labels", "prepare_labels"]

Surface = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]

SPARE_SLICES = 2
"""Beyond the label's box: the far end of a crossed edge, and what its gradient needs."""


@dataclass(frozen=True)
class _Part:
    """The slices of a volume that a device holds, and what is inside of which label in them."""

    volume: Volume
    rule: IsoRule
    first: int
    last: int
    voxels_d: Any
    inside_d: Any
    inside: NDArray[np.uint16]

    @property
    def bytes(self) -> int:
        """What the device holds."""
        held = slice(self.first, self.last)
        return self.volume.voxels[held].nbytes + self.inside[held].nbytes


@dataclass(frozen=True)
class _Window:
    """The slices of the sample grid that hold one label and a layer around it, and how its mask packs them."""

    first: int
    shape: tuple[int, int, int]

    @property
    def rows(self) -> int:
        """Rows along i."""
        return self.shape[1] * self.shape[2]

    @property
    def words(self) -> int:
        """32-bit words of the mask a row."""
        return -(-self.shape[0] // 32)

    @property
    def flag_words(self) -> int:
        """32-bit words a row of one flag a word."""
        return -(-self.words // 32)


def prepare_labels(device: Device, dtype: Any = np.int16) -> tuple[Any, Any]:
    """Build the kernels for volumes of `dtype`: those that find what is inside, and those of the surface.

    Raises
    ------
    DeviceError
        The driver's compiler refuses.
    """
    prepare_compaction(device)
    variants = {
        "VOXEL": plain.VOXEL_TYPES[np.dtype(dtype).name],
        "VALUE": "float" if np.dtype(dtype).kind == "f" else "int",
    }
    if device.type == "cpu":
        variants.update(LANES="8", WORDS_PER_ITEM="8")
    own = load_program(device, "labels/own_samples.cl", variants)
    return own, load_program(device, "isosurface/marching_cubes.cl", {**variants, "LABELS": "1"})


def _choose_numbers(labels: LabelMap, numbers: Sequence[int | str] | None) -> tuple[int, ...]:
    if numbers is None:
        return labels.numbers
    chosen = tuple(dict.fromkeys(labels.find(number) for number in numbers))
    if not chosen:
        raise UsageError("choose at least one label")
    return chosen


def _find_inside(
    device: Device,
    rule: IsoRule,
    volume: Volume,
    labels: NDArray[np.uint16],
    boxes: dict[int, Box],
    growth: tuple[NDArray[np.int32], NDArray[np.int32]],
    program: Any,
    solid: bool,
    stopwatch: Stopwatch,
) -> _Part:
    """Upload the slices that the labels need, once, and find what is inside of which label."""
    offsets, shells = growth
    spare = SPARE_SLICES + int(np.abs(offsets[:, 2]).max(initial=0))  # labels that are not asked for grow too
    first = max(0, min((box[0].start for box in boxes.values()), default=0) - spare)
    last = min(volume.voxels.shape[0], max((box[0].stop for box in boxes.values()), default=1) + spare)
    inside = np.zeros(volume.voxels.shape, dtype=np.uint16)
    part = inside[first:last]
    check_budget(device, {"volume": volume.voxels[first:last].nbytes, "labels": part.nbytes, "inside": part.nbytes})
    level = plain._voxel_level(device, volume, rule)
    near = np.concatenate([offsets, shells[:, None]], axis=1).astype(np.int32)
    with stopwatch.timed("upload"):
        voxels_d = upload(device, volume.voxels[first:last])
        labels_d = upload(device, labels[first:last])
        near_d = upload(device, near if len(near) else np.zeros((1, 4), np.int32))
    inside_d = allocate(device, part.nbytes)
    with stopwatch.running(device):
        launch(
            device, program["own_samples"], part.size, voxels_d, labels_d, near_d, inside_d, level,
            *(np.int32(n) for n in part.shape[::-1]), np.int32(len(near)),
            stopwatch=stopwatch,
        )  # fmt: skip
    with stopwatch.timed("download"):
        download(device, part, inside_d)
    if solid:
        for number, box in boxes.items():
            fill_solid(inside, labels, number, box, offsets, rule.closed)
        with stopwatch.timed("upload"):
            inside_d = upload(device, part)
    return _Part(volume, rule, first, last, voxels_d, inside_d, inside)


def _extract_one(
    device: Device, part: _Part, number: int, box: Box, own: Any, surface: Any, stopwatch: Stopwatch
) -> Surface | None:
    """Positions, normals and triangles of one label, None where nothing is inside of it."""
    volume, rule = part.volume, part.rule
    gi, gj, _ = (n + 2 * rule.border for n in volume.shape_ijk)
    window = _Window(box[0].start, (gi, gj, box[0].stop - box[0].start + 2 * rule.border))
    held = {"volume": part.bytes, "inside mask": 14 * window.rows * window.words, "row counts": 20 * window.rows}
    check_budget(device, held)
    mask_d = allocate(device, 4 * window.rows * window.words)
    with stopwatch.running(device):
        launch(
            device, own["classify_label"], window.rows * window.words, part.inside_d, mask_d, np.uint32(number),
            *_place(part, window), np.uint32(window.words),
            stopwatch=stopwatch,
        )  # fmt: skip
        counts = plain._count(device, window, surface, mask_d, stopwatch)  # type: ignore[arg-type]
    if counts.triangles == 0:
        return None
    check_budget(device, {**held, "vertices": 24 * counts.vertices, "triangles": 12 * counts.triangles})
    return _emit(device, part, window, surface, mask_d, counts, number, stopwatch)


def _place(part: _Part, window: _Window) -> tuple[Any, ...]:
    """Sizes of the volume, where buffer and mask begin, and slices of the mask, as the kernels take them."""
    sizes = tuple(np.int32(n) for n in part.volume.shape_ijk)
    places = (np.int32(part.rule.border), np.int32(part.first), np.int32(window.first), np.uint32(window.shape[2]))
    return *sizes, *places


def _emit(
    device: Device,
    part: _Part,
    window: _Window,
    program: Any,
    mask_d: Any,
    counts: Any,
    number: int,
    stopwatch: Stopwatch,
) -> Surface:
    volume, rule = part.volume, part.rule
    frames = plain._slice_frames(volume, rule.border)[window.first : window.first + window.shape[2]]
    steps = plain._pad4(np.stack([half for step in (0, 1) for half in plain._split(volume.affine[:3, step])]))
    frames_d, steps_d = upload(device, frames), upload(device, steps)
    positions, positions_d = empty_output(device, (counts.vertices, 3), np.float32)
    normals, normals_d = empty_output(device, (counts.vertices, 3), np.float32)
    triangles, triangles_d = empty_output(device, (counts.triangles, 3), np.uint32)
    active = counts.words.count
    items = -(-active // (8 if device.type == "cpu" else 1))
    packing = (np.uint32(window.words), np.uint32(window.flag_words), np.uint32(active))
    outside = (np.float32 if volume.voxels.dtype.kind == "f" else np.int32)(rule.outside)
    with stopwatch.running(device):
        launch(
            device, program["emit_vertices"], items,
            part.voxels_d, mask_d, counts.words.positions_d, counts.vertex_offsets_d, counts.word_vertices_d,
            frames_d, steps_d, positions_d, normals_d,
            np.float32(rule.iso_level), outside, np.float32(rule.value_scale),
            plain._pad4(vertex_margin(volume, rule.border)),
            *_place(part, window), *packing, part.inside_d, np.uint32(number),
            stopwatch=stopwatch,
        )  # fmt: skip
        launch(
            device, program["emit_triangles"], items,
            mask_d, counts.words.positions_d, counts.vertex_offsets_d, counts.triangle_offsets_d,
            counts.word_vertices_d, counts.word_triangles_d, triangles_d, np.uint32(0),
            *(np.uint32(n) for n in window.shape), *packing, np.int32(is_left_handed(volume.affine)),
            stopwatch=stopwatch,
        )  # fmt: skip
    with stopwatch.timed("download"):
        for array, array_d in ((positions, positions_d), (normals, normals_d), (triangles, triangles_d)):
            download(device, array, array_d)
    return positions, normals, triangles


def _share_by_hu(part: _Part, number: int, box: Box) -> float:
    """Share of the vertices of a label that HU place; the others lie half way, on a border of the mask."""
    inside = np.pad(part.inside[box], part.rule.border)
    dense = np.pad(part.volume.voxels[box] >= part.rule.lowest_inside, part.rule.border)
    placing = np.where(inside == number, dense, (inside == 0) & ~dense)
    own = inside == number
    placed = crossed = 0
    for axis in range(3):
        here, there = (np.moveaxis(own, axis, 0)[cut] for cut in (slice(None, -1), slice(1, None)))
        edges = here != there
        crossed += int(np.count_nonzero(edges))
        near, far = (np.moveaxis(placing, axis, 0)[cut] for cut in (slice(None, -1), slice(1, None)))
        placed += int(np.count_nonzero(edges & near & far))
    return placed / max(crossed, 1)


def _refuse_label(volume: Volume, taken: ResampledLabels, label: str, number: int, rule: IsoRule) -> NoSurfaceError:
    mask = taken.voxels == number
    if not mask.any():
        return NoSurfaceError(f"label {label} has no voxel in the CT: it lies outside")
    hu = volume.voxels[mask]
    return NoSurfaceError(
        f"no surface of label {label} at {rule.iso_value:g} HU: its voxels run from {float(hu.min()):g} to"
        f" {float(hu.max()):g} HU"
    )


def extract_labels(
    volume: Volume,
    labels: LabelMap,
    iso_value: float,
    device: Device | str | int | None = None,
    *,
    numbers: Sequence[int | str] | None = None,
    grow_mm: float | None = None,
    closed: bool = True,
    solid: bool = False,
    progress: plain.Progress | None = None,
) -> dict[int, Mesh]:
    """Extract the iso surface of a volume label by label: the label picks the cells, HU place the vertices.

    A voxel is inside of a label when it is dense (`iso_value` or more) and the label owns it: by the map, or, without
    a label there, as the nearest one within `grow_mm`.  Between a dense voxel of the label and one that is neither
    dense nor of any label the vertex is that of `extract_isosurface`, bit for bit.  Elsewhere (the border of two
    labels, dense voxels beyond the growth) it lies half way.  Every mesh is closed and manifold; two labels share the
    vertices of their border, bit for bit.

    Parameters
    ----------
    volume : Volume
    labels : LabelMap
        On any grid, see `clrecon.labels.resample_labels`.
    iso_value : float
        HU.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    numbers : sequence of int or str, optional
        Labels to extract, as `LabelMap.find` takes them; each must have a surface.  None: all that have one.
    grow_mm : float, optional
        None is 1.5 times the larger in-plane spacing.
    closed : bool
        As `extract_isosurface`.
    solid : bool
        Fill what is less dense within a label, see `clrecon.labels.solid`.
    progress : callable, optional
        Called as ``progress("labels", done, total)``.

    Returns
    -------
    dict of int to Mesh
        In the order asked for, else ascending.  `Mesh.report` has, beside what `extract_isosurface` says, ``label``,
        ``label_name``, ``label_inside_share`` (of the labelled voxels, in the volume), ``vertices_by_hu_share``,
        ``grow_mm`` and ``solid``.

    Raises
    ------
    NoSurfaceError
        A label that was asked for, or every label, has no dense voxel; the message gives the range of its HU.
    UsageError
        Not a Volume and a LabelMap, an unknown label, or as `extract_isosurface`.
    RefusedInputError
        The labels do not lie on the volume.
    DeviceError
        As `extract_isosurface`.
    """
    taken = resample_labels(labels, volume)
    chosen = _choose_numbers(labels, numbers)
    rule = choose_iso_rule(volume, iso_value, closed)
    grow_mm = checked_growth(volume, grow_mm)
    offsets, shells = near_offsets(volume.affine, grow_mm)
    reach = np.abs(offsets).max(axis=0, initial=0)
    device = choose_device(device)
    plain._check_grid(plain._SampleGrid(volume, rule))
    boxes = find_boxes(taken.voxels, chosen, (int(reach[0]), int(reach[1]), int(reach[2])))
    names = {number: f"{number} {labels.name(number)}" for number in chosen}
    for number in chosen:
        if number not in boxes and numbers is not None:
            raise _refuse_label(volume, taken, names[number], number, rule)
    stopwatch = Stopwatch()
    with stopwatch.timed("build"):
        own, surface = prepare_labels(device, volume.voxels.dtype)
    part = _find_inside(device, rule, volume, taken.voxels, boxes, (offsets, shells), own, solid, stopwatch)
    meshes: dict[int, Mesh] = {}
    for done, number in enumerate(boxes):
        if progress is not None:
            progress("labels", done, len(boxes))
        extracted = _extract_one(device, part, number, boxes[number], own, surface, stopwatch)
        if extracted is None:
            if numbers is not None:
                raise _refuse_label(volume, taken, names[number], number, rule)
            continue
        positions, normals, triangles = extracted
        report = {
            **plain._describe(device, plain._SampleGrid(volume, rule), stopwatch),
            "label": number,
            "label_name": labels.name(number),
            "label_inside_share": taken.inside[number],
            "vertices_by_hu_share": _share_by_hu(part, number, boxes[number]),
            "grow_mm": grow_mm,
            "solid": solid,
        }
        report["warnings"] += _warn(taken, report)
        meshes[number] = Mesh(positions, triangles, normals, report)
        stopwatch = Stopwatch()
    if not meshes:
        raise NoSurfaceError(f"no label has a voxel of {rule.iso_value:g} HU or more in the CT")
    return meshes


def _warn(taken: ResampledLabels, report: dict[str, Any]) -> list[str]:
    warnings = list(taken.warnings)
    if report["label_inside_share"] < 1.0:
        share = 100.0 * (1.0 - report["label_inside_share"])
        warnings.append(f"{share:.3g} % of label {report['label']} lie outside the CT: its surface ends there")
    return warnings
