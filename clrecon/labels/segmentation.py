"""DICOM SEG (Segmentation and Label Map Segmentation): every frame is placed by its own position.

The frames form a stack of evenly spaced slices.  Writers leave out frames without a labelled pixel, so a hole is a
slice without labels, not an error.

Source: DICOM PS3.3 A.51 and C.8.20 (Segmentation), C.7.6.16 (multi-frame functional groups), PS3.5 8.1.1 (one-bit
pixels are packed without a gap between frames, lowest bit first).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, compose_affine
from clrecon.labels.label_map import LabelMap
from clrecon.labels.segments import Painter, Wanted, empty_labels
from clrecon.reading.dicom.headers.multiframe import find_data_set
from clrecon.reading.dicom.parse.plain import EXPLICIT_LITTLE, IMPLICIT_LITTLE
from clrecon.reading.dicom.parse.transfer_syntaxes import RLE
from clrecon.reading.dicom.parse.values import Schema, ValueProblem, read_sequences
from clrecon.reading.grids.grid_file import check_size
from clrecon.system.light_dataclass import dataclass
from clrecon.system.paths import open_regular
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import escape_text, hash_uid

_DIRECTIONS_DIFFER = 1e-4
"""Largest difference between direction cosines; the gate of a CT series allows as much between slices."""

SAME_PLACE_MM = 1e-3
"""Frames that are no farther apart than this have the same position."""
OFF_GRID_MM = 0.05
"""Largest distance of a frame from its place in an even stack.  Writers round positions to 0.01 mm or seven digits."""

MOST_SLICES = 100_000

_UNSAID = "says neither SpacingBetweenSlices nor SliceThickness"


@dataclass(frozen=True)
class FrameStack:
    """The evenly spaced stack that frames form; `places` are the slice index k of each frame."""

    affine: Float64Array
    places: list[int]
    slices: int
    warnings: tuple[str, ...] = ()


def _floats(value: Any, count: int) -> NDArray[np.float64]:
    numbers = np.array([float(number) for number in value], dtype=np.float64)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"{count} numbers are needed, there are {numbers.tolist()}")
    return numbers


def _group(shared: Any, group: Any, sequence: str) -> Any:
    for owner in (group, shared):
        if owner is not None and owner.get(sequence):
            return owner[sequence][0]
    raise ValueError(f"no {sequence}")


def place_frames(shared: Any, groups: list[Any], name: str) -> FrameStack:
    """Place the frames of a SEG by their own positions, from its shared and its per-frame functional groups."""
    directions = np.stack(
        [_floats(_group(shared, g, "PlaneOrientationSequence").ImageOrientationPatient, 6) for g in groups]
    )
    measures = [_group(shared, g, "PixelMeasuresSequence") for g in groups]
    spacings = np.stack([_floats(m.PixelSpacing, 2) for m in measures])
    positions = np.stack([_floats(_group(shared, g, "PlanePositionSequence").ImagePositionPatient, 3) for g in groups])
    if np.ptp(directions, axis=0).max() > _DIRECTIONS_DIFFER or np.ptp(spacings, axis=0).max() > _DIRECTIONS_DIFFER:
        raise RefusedInputError(f"the frames of {name} differ in direction or pixel spacing: they form no stack")
    row, column = directions[0, :3], directions[0, 3:]
    normal = np.cross(row, column)
    if max(abs(np.linalg.norm(v) - 1) for v in (row, column, normal)) > 1e-3 or spacings.min() <= 0:
        raise RefusedInputError(f"the frames of {name} cannot be placed: direction {directions[0].tolist()}, spacing"
                                f" {spacings[0].tolist()}")  # fmt: skip
    stated = (_stated_mm(measures[0], keyword) for keyword in ("SpacingBetweenSlices", "SliceThickness"))
    gap, warnings = _choose_gap(positions @ normal, *stated)
    step, places, origin = _fit_stack(positions, normal, gap, name)
    (dj, di) = spacings[0]
    try:
        affine = checked_affine(compose_affine(row * di, column * dj, step, origin))
    except UsageError as error:
        raise RefusedInputError(f"the frames of {name} cannot be placed: {error}") from error
    return FrameStack(affine, places, max(places) + 1, warnings)


def _stated_mm(measures: Any, keyword: str) -> float | None:
    """Return a length of the pixel measures, None where there is none."""
    value = measures.get(keyword)
    length = float("nan") if value in (None, "") else float(value)
    return length if np.isfinite(length) and length > SAME_PLACE_MM else None


def _choose_gap(
    along: NDArray[np.float64], spacing: float | None, thickness: float | None
) -> tuple[float, tuple[str, ...]]:
    """Return the step between slices in mm, and warnings about it.

    The step is the smallest gap between frames, divided by a whole number where no two frames are neighbours: by
    SpacingBetweenSlices, or where that is absent by SliceThickness.
    """
    stated = thickness if spacing is None else spacing
    gaps = np.diff(np.sort(along))
    gaps = gaps[gaps > SAME_PLACE_MM]
    if not len(gaps):
        return (1.0, (f"its one slice {_UNSAID}: a thickness of 1 mm is assumed",)) if stated is None else (stated, ())
    gap = float(gaps.min())
    if stated is None:
        return gap, (f"its header {_UNSAID}: the smallest distance of two frames, {gap:g} mm, is taken as the step",)
    parts = max(1, round(gap / stated))
    even = abs(gap - parts * stated) <= OFF_GRID_MM
    step = gap / parts if even else gap
    if spacing is None and (gap < stated or (even and parts == 1)):
        return step, ()  # slices may overlap
    if spacing is not None and even:
        return step, ()
    keyword = "SpacingBetweenSlices" if spacing is not None else "SliceThickness, and there is no SpacingBetweenSlices"
    return step, (
        f"its frames are {gap:g} mm apart, its header says {stated:g} mm ({keyword}): the step is {step:g} mm",
    )


def _fit_stack(
    positions: NDArray[np.float64], normal: NDArray[np.float64], gap: float, name: str
) -> tuple[NDArray[np.float64], list[int], NDArray[np.float64]]:
    """Return the slice step, the slice index of each frame, and the position of slice 0."""
    along = positions @ normal
    heights = np.sort(along)
    if np.diff(heights).max(initial=0.0) <= SAME_PLACE_MM:
        return normal * gap, [0] * len(positions), positions[0]
    if (heights[-1] - heights[0]) / gap > MOST_SLICES:
        raise RefusedInputError(
            f"the frames of {name} lie {gap:g} mm apart over {np.ptp(heights):g} mm: too many slices"
        )
    lowest = positions[int(np.argmin(along))]
    places = np.rint((along - heights[0]) / gap).astype(np.int64)
    # Fit a line through all positions: the rounding error of the smallest gap alone would add up over the stack.
    for _ in range(2):
        design = np.stack([np.ones(len(places)), places], axis=1)
        (origin, step), *_ = np.linalg.lstsq(design, positions, rcond=None)
        places = np.rint((along - origin @ normal) / (step @ normal)).astype(np.int64)
    residual = np.linalg.norm(positions - origin - places[:, None] * step, axis=1)
    worst = int(np.argmax(residual))
    if residual[worst] > OFF_GRID_MM or places.min() < 0:
        raise RefusedInputError(
            f"the frames of {name} do not lie evenly: the one at {along[worst]:.2f} mm along the normal is"
            f" {residual[worst]:.2f} mm off steps of {np.linalg.norm(step):.3f} mm from {lowest.round(2).tolist()}"
        )
    return step, [int(place) for place in places], origin


SEGMENTATION_CLASSES = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
MOST_FRAMES = 1_000_000
Check = Callable[[tuple[int, int, int], int], None]
"""Called with the shape (i, j, k) of a map and its unpacked bytes, before anything is unpacked; may refuse it."""

LARGEST_BYTES = 2**32
_PLACE: Schema = {
    0x00209113: {0x00200032: None},  # PlanePositionSequence: ImagePositionPatient
    0x00209116: {0x00200037: None},  # PlaneOrientationSequence: ImageOrientationPatient
    0x00289110: dict.fromkeys((0x00180050, 0x00180088, 0x00280030)),  # PixelMeasuresSequence
    0x0062000A: {0x0062000B: None},  # SegmentIdentificationSequence: ReferencedSegmentNumber
}
_ONCE: Schema = {
    **dict.fromkeys((0x00200052, 0x00280008, 0x00280010, 0x00280011, 0x00280100, 0x00280101, 0x00620001)),
    0x00620002: dict.fromkeys((0x00620004, 0x00620005)),  # SegmentSequence: SegmentNumber, SegmentLabel
    0x52009229: _PLACE,
    0x52009230: _PLACE,
}
"""Elements that give the places and names of segments; each may occur only once."""


@dataclass(frozen=True)
class _Layout:
    """The frames of a SEG as its header describes them."""

    kind: str
    rows: int
    columns: int
    frames: int
    bits: int

    @property
    def pixel_bytes(self) -> int:
        """Bytes of all frames, unpacked to a byte or two a pixel."""
        return self.rows * self.columns * self.frames * max(1, self.bits // 8)


def read_segmentation(
    path: Path, wanted: Wanted, progress: Progress = ignore_progress, check: Check | None = None
) -> LabelMap:
    """Read a DICOM SEG of a label map or of binary segments; only those that are not wanted may overlap."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pydicom's messages quote the file unescaped
        return _read_frames(path, escape_text(path.name), wanted, progress, check)


def tell_pixel_bytes(path: Path) -> int:
    """Tell from the header of a DICOM SEG how many bytes its pixels take unpacked; 0 where it does not say so."""
    from pydicom import dcmread

    try:
        with warnings.catch_warnings(), open_regular(path) as file:
            warnings.simplefilter("ignore")
            dataset = dcmread(
                file, stop_before_pixels=True, specific_tags=["Rows", "Columns", "NumberOfFrames", "BitsAllocated"]
            )
            layout = _layout_of(dataset, "")
    except Exception:  # pydicom raises many error types; told by `read_segmentation`
        return 0
    return layout.pixel_bytes


def _read_frames(path: Path, name: str, wanted: Wanted, progress: Progress, check: Check | None) -> LabelMap:
    dataset = _parse_dataset(path, name)
    try:
        layout = _read_layout(dataset, name, path.stat().st_size)
        segments = {int(s.SegmentNumber): str(s.get("SegmentLabel", "")) for s in dataset.SegmentSequence}
        groups = list(dataset.PerFrameFunctionalGroupsSequence)
        if len(groups) != layout.frames:
            raise RefusedInputError(f"{name} is corrupt: {layout.frames} frames and {len(groups)} descriptions of them")
        shared = (list(dataset.get("SharedFunctionalGroupsSequence") or []) or [None])[0]
        stack = place_frames(shared, groups, name)
        if check is not None:
            check((layout.columns, layout.rows, stack.slices), layout.pixel_bytes)
        frame_of_reference = str(dataset.get("FrameOfReferenceUID", ""))
        numbers = None if layout.kind == "LABELMAP" else [_segment_of(group, shared) for group in groups]
        pixels = _FramePixels(dataset, layout, name)
    except ClreconError:
        raise
    except Exception as error:  # pydicom raises many error types for corrupt values
        raise RefusedInputError(f"{name} is no usable DICOM SEG: {_first_line(error)}") from error
    frame_hash = hash_uid(frame_of_reference)
    voxels = empty_labels(name, (stack.slices, layout.rows, layout.columns))
    if numbers is None:
        _join_maps(voxels, stack, pixels, progress)
        return LabelMap(voxels, stack.affine, segments, frame_of_reference_hash=frame_hash, warnings=stack.warnings)
    painter = Painter(name, voxels, segments, wanted)
    painted: set[tuple[int, int]] = set()
    frames = _frames_in_order(numbers, painter.order, segments, name)
    for done, frame in enumerate(frames, start=1):
        k, number = stack.places[frame], numbers[frame]
        mask = pixels.read(frame).astype(bool)
        if (k, number) in painted and not np.array_equal(voxels[k] == number, mask):
            raise _contradiction(name, stack, k, f"segment {number} different voxels")
        painter.paint(k, number, mask)
        painted.add((k, number))
        progress("read", done, len(frames))
    return painter.finish(stack.affine, frame_of_reference_hash=frame_hash, warnings=stack.warnings)


def _join_maps(voxels: NDArray[Any], stack: FrameStack, pixels: _FramePixels, progress: Progress) -> None:
    """Read the frames of a label map; frames at one place may each hold some of its segments."""
    written: set[int] = set()
    for frame, k in enumerate(stack.places):
        plane = pixels.read_map(frame)
        if k in written:
            clash = (voxels[k] != 0) & (plane != 0) & (voxels[k] != plane)
            if clash.any():
                pair = f"{voxels[k][clash][0]} and {plane[clash][0]}"
                raise _contradiction(pixels.name, stack, k, f"{np.count_nonzero(clash):,} voxels two segments, {pair}")
        np.copyto(voxels[k], plane, where=plane != 0)
        written.add(k)
        progress("read", frame + 1, len(stack.places))


def _contradiction(name: str, stack: FrameStack, k: int, problem: str) -> RefusedInputError:
    return RefusedInputError(
        f"{name} contradicts itself: two of its frames lie at one place, slice {k + 1} of {stack.slices}, and give"
        f" {problem}"
    )


def _first_line(error: Exception) -> str:
    return escape_text((str(error).splitlines() or [""])[0] or type(error).__name__, 200)


def _parse_dataset(path: Path, name: str, most: int = LARGEST_BYTES) -> Any:
    from pydicom import dcmread
    from pydicom.filereader import read_file_meta_info

    try:
        syntax = str(read_file_meta_info(path).get("TransferSyntaxUID", ""))
        if syntax not in (IMPLICIT_LITTLE, EXPLICIT_LITTLE, RLE):
            raise RefusedInputError(
                f"{name} is stored with transfer syntax {escape_text(syntax)}: of DICOM SEG uncompressed little endian"
                " and RLE are read, convert it"
            )
        with open_regular(path) as file:
            _check_elements(file.read(most + 1), name, syntax == IMPLICIT_LITTLE, most)
            file.seek(0)
            dataset = dcmread(file)
        sop_class = str(dataset.get("SOPClassUID", ""))
    except ClreconError:
        raise
    except Exception as error:
        raise RefusedInputError(f"{name} is a corrupt DICOM file: {_first_line(error)}") from error
    if sop_class not in SEGMENTATION_CLASSES:
        raise RefusedInputError(
            f"{name} is DICOM but no segmentation (class {escape_text(sop_class)}): a SEG object holds labels"
        )
    return dataset


def _check_elements(data: bytes, name: str, implicit: bool, most: int = LARGEST_BYTES) -> None:
    """Refuse elements that occur twice with two values: pydicom silently keeps the last one."""
    if len(data) > most:
        raise RefusedInputError(f"{name} is larger than {most:,} bytes: no segmentation is read from it")
    try:
        read_sequences(
            data, find_data_set(data), _ONCE, implicit=implicit, little_endian=True, items_limit=4 * MOST_FRAMES
        )
    except ValueProblem as problem:
        raise RefusedInputError(f"{name} is a corrupt DICOM file: {problem}") from problem


def _read_layout(dataset: Any, name: str, file_bytes: int) -> _Layout:
    kind = str(dataset.get("SegmentationType", "")).upper()
    if kind not in ("BINARY", "LABELMAP"):
        raise RefusedInputError(
            f"{name} holds segments of type {escape_text(kind) or 'unknown'}: binary ones and label maps are read,"
            " fractional ones do not say which voxels they mean"
        )
    layout = _layout_of(dataset, kind)
    if layout.bits not in ((1, 8) if kind == "BINARY" else (8, 16)) or not 0 < layout.frames <= MOST_FRAMES:
        raise RefusedInputError(f"{name} is corrupt: {layout.frames} frames of {layout.bits} bits a pixel")
    compressed = dataset.file_meta.TransferSyntaxUID == RLE
    # RLE writes two bytes for up to 128, and a header of 64 bytes or more for each frame: it never shrinks more than 64
    # to 1.
    most_bytes = file_bytes * (8 if layout.bits == 1 else 1) * (64 if compressed else 1)
    shape = (layout.columns, layout.rows, layout.frames)
    check_size(name, shape, max(1, layout.bits // 8), most_bytes, compressed=False)
    return layout


def _layout_of(dataset: Any, kind: str) -> _Layout:
    frames = int(dataset.get("NumberOfFrames", 1))
    return _Layout(kind, int(dataset.Rows), int(dataset.Columns), frames, int(dataset.BitsAllocated))


def _segment_of(group: Any, shared: Any) -> int:
    for owner in (group, shared):
        if owner is not None and owner.get("SegmentIdentificationSequence"):
            return int(owner.SegmentIdentificationSequence[0].ReferencedSegmentNumber)
    raise ValueError("a frame does not say to which segment it belongs")


class _FramePixels:
    """Reads the pixels of the frames one after the other."""

    def __init__(self, dataset: Any, layout: _Layout, name: str):
        self._layout, self.name = layout, name
        self._background = int(dataset.get("PixelPaddingValue", 0))
        self._items = layout.rows * layout.columns
        self._data = bytes(dataset.PixelData)
        self._fragments: list[bytes] | None = None
        if dataset.file_meta.TransferSyntaxUID == RLE:
            from pydicom.encaps import generate_frames

            self._fragments = list(generate_frames(self._data, number_of_frames=layout.frames))
            if layout.bits == 1 or len(self._fragments) != layout.frames:
                raise ValueError(f"{len(self._fragments)} compressed frames of {layout.bits} bits")
        elif len(self._data) * 8 < layout.frames * self._items * layout.bits:
            raise RefusedInputError(
                f"{name} is cut: {layout.frames} frames of {layout.columns} x {layout.rows} do not fit"
                f" {len(self._data):,} bytes"
            )

    def read(self, frame: int) -> NDArray[Any]:
        """Return frame `frame`, counted from 0, shape (rows, columns), uint8 or uint16."""
        layout = self._layout
        if self._fragments is not None:
            plane = self._decode(self._fragments[frame])
        elif layout.bits == 1:
            first = frame * self._items
            packed = np.frombuffer(self._data, np.uint8)[first // 8 : -(-(first + self._items) // 8)]
            plane = np.unpackbits(packed, bitorder="little")[first % 8 : first % 8 + self._items]
        else:
            plane = np.frombuffer(
                self._data, f"<u{layout.bits // 8}", self._items, frame * self._items * layout.bits // 8
            )
        return plane.reshape(layout.rows, layout.columns)

    def read_map(self, frame: int) -> NDArray[Any]:
        """Return frame `frame` of a label map, its background 0."""
        plane = self.read(frame)
        if not self._background:
            return plane
        if not plane.all():
            raise RefusedInputError(
                f"{self.name} numbers a segment 0 and its background {self._background}: segments from 1 are read"
            )
        return np.where(plane == self._background, 0, plane)

    def _decode(self, fragment: bytes) -> NDArray[Any]:
        from pydicom.pixels.decoders.rle import _rle_decode_frame

        layout = self._layout
        try:
            planes = _rle_decode_frame(fragment, layout.rows, layout.columns, 1, layout.bits, "<")
            return np.frombuffer(bytes(planes), f"<u{layout.bits // 8}", self._items)
        except Exception as error:
            raise RefusedInputError(f"{self.name} has a corrupt RLE frame: {_first_line(error)}") from error


def _frames_in_order(numbers: list[int], order: Sequence[int], segments: Collection[int], name: str) -> list[int]:
    unknown = sorted(set(numbers) - set(segments))
    if unknown:
        raise RefusedInputError(f"{name} is corrupt: a frame belongs to segment {unknown[0]}, which it does not list")
    turn = {number: place for place, number in enumerate(order)}
    frames = [frame for frame, number in enumerate(numbers) if number in turn]
    return sorted(frames, key=lambda frame: turn[numbers[frame]])
