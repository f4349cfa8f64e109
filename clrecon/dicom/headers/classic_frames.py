"""Classic CT images with many frames: one position for the first frame, and how far the others lie from it.

CT Image Storage has one slice in a file, yet many cone beams write a whole volume as its frames.  The places are whole
where ImagePositionPatient, ImageOrientationPatient and PixelSpacing stand beside GridFrameOffsetVector, whose offsets
run along the normal (row x column), or beside SpacingBetweenSlices, which leaves open which way the frames run.

Source: DICOM PS3.3 C.7.6.6 (Multi-frame), C.8.8.3.2 (Grid Frame Offset Vector).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.headers.multiframe import FRAMES_LIMIT
from clrecon.dicom.headers.slice_header import SliceHeader
from clrecon.dicom.parse.values import ValueProblem, Values
from clrecon.system.text import join_names

PLACE_POINTERS = frozenset({0x3004000C, 0x00180050, 0x00180088, 0x00200013, 0x00200032, 0x00201041, 0x00540080})
"""Elements to which FrameIncrementPointer points where frames are slices: GridFrameOffsetVector, SliceThickness,
SpacingBetweenSlices, InstanceNumber, ImagePositionPatient, SliceLocation, SliceVector.  Others are times or phases."""
SAME_PLACE_MM = 0.01
WAYS = (("left", "right"), ("back", "front"), ("head", "feet"))
EXACT_DIGITS = 15


@dataclass(frozen=True)
class FramePlaces:
    """Where the frames of one file lie.

    offsets_mm: ndarray, shape (n,), float64. From the first frame along the normal.
    digits: Number of decimals with which they were written.
    element: The element that states them.
    """

    offsets_mm: NDArray[np.float64]
    digits: int
    element: str


def count_frames(values: Values, sop_class: str) -> int:
    """Return the number of frames of a classic image, 1 where none is stated."""
    if "NumberOfFrames" not in values:
        return 1
    frames = values.whole_or_none("NumberOfFrames")
    if frames is None or frames < 0:
        raise values.wrong("NumberOfFrames", "1, or nothing, in a single slice")
    if frames > FRAMES_LIMIT:
        raise ValueProblem(
            f"multi-frame image of {frames} frames, SOP class {sop_class}: no more than {FRAMES_LIMIT} are read"
        )
    return max(frames, 1)


def find_places(values: Values, sop_class: str, frames: int) -> FramePlaces:
    """Find the places of two frames or more."""
    image = f"multi-frame image of {frames} frames, SOP class {sop_class}"
    needed = ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing")
    missing = [keyword for keyword in needed if keyword not in values]
    if "GridFrameOffsetVector" not in values and "SpacingBetweenSlices" not in values:
        missing.append("SpacingBetweenSlices or GridFrameOffsetVector")
    if missing:
        raise ValueProblem(
            f"{image}: the places of its frames are not known, without {join_names(missing)}: export the series as "
            "single slices or as Enhanced CT"
        )
    pointers = _read_pointers(values)
    if not pointers <= PLACE_POINTERS:
        raise ValueProblem(
            f"{image}: FrameIncrementPointer (0028,0009) does not say that its frames are slices, but names "
            f"{join_names(map(_name_tag, sorted(pointers - PLACE_POINTERS)))}: export one volume as single slices"
        )
    if "GridFrameOffsetVector" in values:
        return _read_offsets(values, frames)
    spacing = values.decimals("SpacingBetweenSlices", 1)[0]
    if spacing == 0.0:
        raise values.wrong("SpacingBetweenSlices", f"the distance of {frames} frames, other than 0")
    return FramePlaces(spacing * np.arange(frames, dtype=np.float64), EXACT_DIGITS, "SpacingBetweenSlices")


def _read_pointers(values: Values) -> set[int]:
    raw = values.elements.values.get(0x00280009, b"")
    form = "<HH" if values.elements.little_endian else ">HH"
    return {group << 16 | element for group, element in struct.iter_unpack(form, raw[: len(raw) // 4 * 4])}


def _name_tag(tag: int) -> str:
    from pydicom.datadict import keyword_for_tag

    return keyword_for_tag(tag) or f"({tag >> 16:04X},{tag & 0xFFFF:04X})"


def _read_offsets(values: Values, frames: int) -> FramePlaces:
    """Read GridFrameOffsetVector: relative to the first frame, or z itself in axial frames."""
    offsets = np.array(values.decimals("GridFrameOffsetVector", frames))
    digits = max(values.decimal_places("GridFrameOffsetVector"))
    if offsets[0] != 0.0:
        normal, z = _find_normal(values), values.decimals("ImagePositionPatient", 3)[2]
        if abs(offsets[0] - z) > SAME_PLACE_MM or abs(normal[2]) < 1.0 - 1e-6:
            raise ValueProblem(
                f"GridFrameOffsetVector (3004,000C) begins with {offsets[0]:g}, expected 0, or in axial frames the z "
                "of ImagePositionPatient (0020,0032)"
            )
        offsets = (offsets - offsets[0]) * round(normal[2])
    return FramePlaces(offsets, digits, "GridFrameOffsetVector")


def _find_normal(values: Values) -> NDArray[np.float64]:
    cosines = values.decimals("ImageOrientationPatient", 6)
    return _cross(cosines[:3], cosines[3:])


def _cross(row: tuple[float, ...], column: tuple[float, ...]) -> NDArray[np.float64]:
    normal = np.cross(row, column)
    length = math.hypot(*normal)
    return np.asarray(normal / length if length > 0.0 else normal)


def spread_frames(header: SliceHeader, places: FramePlaces) -> Iterator[SliceHeader]:
    """Return one header for each frame, given that of the first one."""
    normal = _cross(header.row_cosines, header.column_cosines)
    first = np.array(header.position_mm)
    said = f"{header.frames} frames in one classic CT image: {_describe_way(places, normal)}"
    for number, offset in enumerate(places.offsets_mm.tolist()):
        yield replace(
            header,
            frame=number,
            name=f"{header.name} frame {number + 1}",
            position_mm=tuple((first + offset * normal).tolist()),
            position_digits=(places.digits,) * 3,
            stated_gap_mm=None if header.stated_gap_mm is None else abs(header.stated_gap_mm),
            warnings=(*header.warnings, said),
        )


def _describe_way(places: FramePlaces, normal: NDArray[np.float64]) -> str:
    """Say from which end of the patient the frames run, and how this is known."""
    axis = int(np.argmax(np.abs(normal)))
    towards, away = WAYS[axis] if (normal[axis] > 0.0) == (places.offsets_mm[-1] > 0.0) else WAYS[axis][::-1]
    way = f"they run from {away} to {towards}"
    if places.element == "GridFrameOffsetVector":
        steps = np.diff(places.offsets_mm)
        ordered = bool((steps > 0.0).all() or (steps < 0.0).all())
        return f"{way if ordered else 'they are in no order'}, as GridFrameOffsetVector says"
    return (
        f"{way}, along the normal of rows and columns in steps of SpacingBetweenSlices, {places.offsets_mm[1]:g} mm; "
        "no element says that they do not run the other way, and then the volume is mirrored: compare left and "
        "right with the scanner's pictures"
    )
