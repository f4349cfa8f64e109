"""CT images with many frames: the elements of each frame, as if the frame were a file of its own.

An enhanced image has its elements in functional groups, shared by all frames or for each frame.  The wanted values of
the groups replace those of the top level, so that slices and frames pass the same checks (`header`). A frame's place
comes from its Plane Position alone; In-Stack Position Number and Dimension Index Values only help to distinguish frames
at the same place.

CT Image Storage has one slice in a file, yet many cone beams write a whole volume as its frames.  The places are known
where ImagePositionPatient, ImageOrientationPatient and PixelSpacing stand beside GridFrameOffsetVector, whose offsets
run along the normal (row x column), or beside SpacingBetweenSlices, which leaves open which way the frames run.

Sources: DICOM PS3.3 A.38 (Enhanced CT), A.70 (Legacy Converted Enhanced CT), C.7.6.16 (functional groups), C.7.6.17
(dimensions), C.8.15 (Enhanced CT), C.7.6.6 (Multi-frame), C.8.8.3.2 (Grid Frame Offset Vector).
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clrecon.reading.dicom.headers import slice_header
from clrecon.reading.dicom.parse.plain import IMPLICIT_LITTLE, META_START, DicomElements
from clrecon.reading.dicom.parse.values import (
    Item,
    Schema,
    ValueProblem,
    Values,
    decode_number,
    decode_text,
    name_element,
    name_tag,
    read_sequences,
)
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text, join_names

ENHANCED_CT = ("1.2.840.10008.5.1.4.1.1.2.1", "1.2.840.10008.5.1.4.1.1.2.2")
"""SOP classes: Enhanced CT Image Storage, Legacy Converted Enhanced CT Image Storage."""

_FRAMES_LIMIT = 65_536
_HEADER_BYTES_LIMIT = 256 * 1024 * 1024
ITEMS_PER_FRAME = 64

_SHARED_GROUPS, _FRAME_GROUPS = 0x52009229, 0x52009230
_PLANE_POSITION, _PLANE_ORIENTATION, _PIXEL_MEASURES = 0x00209113, 0x00209116, 0x00289110
_PIXEL_VALUE_TRANSFORMATION = 0x00289145
_FRAME_TYPE_GROUP, _FRAME_CONTENT = 0x00189329, 0x00209111
_REAL_WORLD_VALUES = 0x00409096
_UNASSIGNED_SHARED, _UNASSIGNED_FRAME = 0x00209170, 0x00209171
_DIMENSIONS, _DIMENSION_POINTER, _DIMENSION_VALUES = 0x00209222, 0x00209165, 0x00209157

_FRAME_ACQUISITION_TIME, _FRAME_REFERENCE_TIME = 0x00189074, 0x00189151
_ACQUISITION_DATE_AND_TIME = (0x00080022, 0x00080032)
_IMAGE_TYPE, _FRAME_TYPE = 0x00080008, 0x00089007
_PIXEL_PRESENTATION, _VOLUMETRIC_PROPERTIES, _CALCULATION_TECHNIQUE = 0x00089205, 0x00089206, 0x00089207
RESCALE_INTERCEPT, RESCALE_SLOPE, _RESCALE_TYPE = 0x00281052, 0x00281053, 0x00281054
_RESCALE = (RESCALE_INTERCEPT, RESCALE_SLOPE, _RESCALE_TYPE)
_LOSSY = 0x00282110
_REAL_SLOPE, _REAL_INTERCEPT, _REAL_UNITS, _CODE_VALUE = 0x00409225, 0x00409224, 0x004008EA, 0x00080100
_CALIBRATING = (_PLANE_POSITION, _PLANE_ORIENTATION, _PIXEL_MEASURES, _PIXEL_VALUE_TRANSFORMATION, _REAL_WORLD_VALUES)
_HU_CODES = ("[hnsf'U]", "HU")  # codes of UCUM
GEOMETRY = (0x00200032, 0x00200037, 0x00280030, 0x00180050, 0x00180088)
"""ImagePositionPatient, ImageOrientationPatient, PixelSpacing, SliceThickness, SpacingBetweenSlices: at the top level
of a multi-frame image they have no meaning."""

DIMENSIONS_OF_PLACE = (0x00200032, 0x00200037, 0x00209057, 0x00201041, 0x00209113, 0x00209116, 0x00200013)
"""Dimensions that only number the places: position, orientation, InStackPositionNumber, SliceLocation; and
InstanceNumber, which numbers the files that a converter read."""


def _wanted(*tags: int) -> Schema:
    return dict.fromkeys(tags)


_MACROS: dict[int, Schema] = {
    _PLANE_POSITION: _wanted(0x00200032),
    _PLANE_ORIENTATION: _wanted(0x00200037),
    _PIXEL_MEASURES: _wanted(0x00280030, 0x00180050, 0x00180088),
    _PIXEL_VALUE_TRANSFORMATION: _wanted(*_RESCALE),
    _FRAME_TYPE_GROUP: _wanted(_FRAME_TYPE, _PIXEL_PRESENTATION, _VOLUMETRIC_PROPERTIES, _CALCULATION_TECHNIQUE),
    _FRAME_CONTENT: _wanted(
        0x00209056, 0x00209128, 0x00209156, _FRAME_ACQUISITION_TIME, _FRAME_REFERENCE_TIME, _DIMENSION_VALUES
    ),
    0x00189118: _wanted(0x00209241, 0x00209153),  # CardiacSynchronizationSequence
    0x00209253: _wanted(0x00209245, 0x00209255),  # RespiratorySynchronizationSequence
    0x00209310: _wanted(0x0020930D),  # TemporalPositionSequence
    0x00189314: _wanted(0x00181210),  # CTReconstructionSequence: ConvolutionKernel
    0x00189325: _wanted(0x00180060),  # CTXRayDetailsSequence: KVP
}
_MAPPING: Schema = {_REAL_SLOPE: None, _REAL_INTERCEPT: None, _REAL_UNITS: _wanted(_CODE_VALUE)}
# Elements of a classic image that no macro holds: time and manner of acquisition, padding, and rescale where a
# converter did not move it.  The geometry and the form of the pixels are not among them.
_UNASSIGNED = _wanted(
    0x00080022, 0x00080023, 0x00080032, 0x00080033, 0x00180060, 0x00181060, 0x00181210, 0x00200012, 0x00200100,
    0x00280120, 0x00280121, *_RESCALE, _LOSSY,
)  # fmt: skip
_GROUPS: Schema = {**_MACROS, _REAL_WORLD_VALUES: _MAPPING}
_SCHEMA: Schema = {
    _DIMENSIONS: _wanted(_DIMENSION_POINTER),
    **dict.fromkeys(slice_header.CONCATENATION_TAGS),
    _SHARED_GROUPS: {**_GROUPS, _UNASSIGNED_SHARED: _UNASSIGNED},
    _FRAME_GROUPS: {**_GROUPS, _UNASSIGNED_FRAME: _UNASSIGNED},
}

NO_PLANE = ("CURVED_MPR", "VOLUME_RENDER", "SURFACE_RENDER")
_COMPUTED = ("MAX_IP", "MIN_IP", "MPR")
_COMPUTED_CONTRAST = (
    "ADDITION DIVISION MASKED MAXIMUM MEAN MEDIAN MINIMUM MULTIPLICATION QUANTITY STD_DEVIATION SUBTRACTION"
).split()


@dataclass(frozen=True)
class Groups:
    """The functional groups of a file, undecoded; index and name of the dimensions that are no place in the patient."""

    shared: Item
    frames: list[Item]
    dimensions: tuple[tuple[int, str], ...]
    concatenation: slice_header.Concatenation | None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Frame:
    """A frame in the form of a classic image, not to be used with a problem; `phase` is as in `SliceHeader`."""

    elements: DicomElements
    phase: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    problem: ValueProblem | None = None


def read_groups(path: Path, elements: DicomElements) -> Groups:
    """Read the functional groups of a multi-frame image with pixel data, given the elements of its top level."""
    if elements.restored:
        raise ValueProblem("multi-frame image without preamble or meta header: convert it to a DICOM file first")
    values = Values(elements)
    count = values.whole_or_none("NumberOfFrames")
    if count is None or not 1 <= count <= _FRAMES_LIMIT:
        raise values.wrong("NumberOfFrames", f"a whole number from 1 to {_FRAMES_LIMIT}")
    data, start = _read_header_bytes(path, elements)
    try:
        top = read_sequences(
            data,
            start,
            _SCHEMA,
            implicit=(elements.transfer_syntax == IMPLICIT_LITTLE) != elements.encoding_differs,
            little_endian=elements.little_endian,
            items_limit=ITEMS_PER_FRAME * (count + 1),
        )
    except ValueProblem as problem:
        raise ValueProblem(f"the functional groups cannot be parsed: {problem}") from problem
    frames = top.sequences.get(_FRAME_GROUPS, [])
    if not frames:
        raise ValueProblem(
            "PerFrameFunctionalGroupsSequence (5200,9230) is missing or empty: the places of the frames are not known"
        )
    if len(frames) != count:
        raise ValueProblem(
            f"NumberOfFrames (0028,0008) is {count}, PerFrameFunctionalGroupsSequence (5200,9230) holds {len(frames)} "
            "items: one a frame expected"
        )
    shared = top.sequences.get(_SHARED_GROUPS, [])
    if len(shared) > 1:
        raise ValueProblem(f"SharedFunctionalGroupsSequence (5200,9229) holds {len(shared)} items, expected 1")
    return Groups(
        shared[0] if shared else Item(),
        frames,
        tuple(_name_dimensions(top.sequences.get(_DIMENSIONS, []), elements.little_endian)),
        slice_header.read_concatenation(top, count, elements.little_endian),
        tuple(f"{name_tag(tag)} is there twice in one item, with the same value" for tag in sorted(top.repeated)),
    )


def split_frames(elements: DicomElements, groups: Groups) -> Iterator[Frame]:
    """Give each frame, in the order of the file, the elements that a classic image of it would have.

    Where a value is given at several places, the first of these is used: macro of the frame, shared macro, unassigned
    attributes of the frame, shared unassigned attributes, top level.
    """
    top_values = {tag: value for tag, value in elements.values.items() if tag not in GEOMETRY}
    top_vrs = {tag: vr for tag, vr in elements.vrs.items() if tag not in GEOMETRY}
    for item in groups.frames:
        frame = elements._replace(values=dict(top_values), vrs=dict(top_vrs))
        warnings: list[str] = []
        try:
            macros = _merge_macros(groups.shared, item)
            _lay_over(frame, groups.shared.sequences.get(_UNASSIGNED_SHARED, []))
            _lay_over(frame, item.sequences.get(_UNASSIGNED_FRAME, []))
            if _PIXEL_VALUE_TRANSFORMATION in macros:
                for tag in _RESCALE:  # slope and intercept must come from the same place
                    frame.values.pop(tag, None)
            if elements.values.get(_LOSSY):  # a lossy file has lossy frames
                frame.values[_LOSSY] = max(elements.values[_LOSSY], frame.values[_LOSSY])
            _lay_over(frame, (items[0] for tag, items in macros.items() if tag != _REAL_WORLD_VALUES))
            _take_times(frame)
            _check_frame_type(frame, warnings)
            _take_real_world_values(frame, macros.get(_REAL_WORLD_VALUES, []), warnings)
        except ValueProblem as problem:
            yield Frame(elements, (), (), problem)
        else:
            yield Frame(frame, tuple(_describe_phase(frame, groups.dimensions)), tuple(warnings))


def _merge_macros(shared: Item, frame: Item) -> dict[int, list[Item]]:
    """Return the macros of one frame that are not empty; refuse macros that occur twice and differ."""
    macros: dict[int, list[Item]] = {}
    for source in (shared, frame):
        for tag, items in source.sequences.items():
            if tag in (_UNASSIGNED_SHARED, _UNASSIGNED_FRAME) or not items:
                continue
            if len(items) > 1 and tag != _REAL_WORLD_VALUES:
                raise ValueProblem(f"{name_tag(tag)} holds {len(items)} items, expected 1")
            if tag in macros and tag in _CALIBRATING and items != macros[tag]:
                raise ValueProblem(f"{name_tag(tag)} is in the shared and in the frame's groups, and they differ")
            macros[tag] = items
    return macros


def _lay_over(frame: DicomElements, items: Iterable[Item]) -> None:
    for item in items:
        frame.values.update(item.values)
        frame.vrs.update(item.vrs)


def _take_times(frame: DicomElements) -> None:
    """Write the time of a frame to the elements that a slice has for it: date and time separately."""
    for tag in (_FRAME_ACQUISITION_TIME, _FRAME_REFERENCE_TIME):
        match = re.match(rb"(\d{8})(\d{2,6}(?:\.\d{1,6})?)", frame.values.get(tag, b""))
        if match is not None:
            frame.values.update(zip(_ACQUISITION_DATE_AND_TIME, match.groups(), strict=True))
            frame.vrs.update(zip(_ACQUISITION_DATE_AND_TIME, ("DA", "TM"), strict=True))
            return


def _check_frame_type(frame: DicomElements, warnings: list[str]) -> None:
    """Use FrameType as ImageType; refuse frames that are not planes; refuse or warn of values not measured as HU."""
    values = frame.values
    if _FRAME_TYPE in values:
        values[_IMAGE_TYPE], frame.vrs[_IMAGE_TYPE] = values.pop(_FRAME_TYPE), frame.vrs.pop(_FRAME_TYPE)
    elif _words(values.get(_IMAGE_TYPE))[0] == "MIXED":
        raise ValueProblem(f"{name_tag(_FRAME_TYPE)} is missing, and ImageType (0008,0008) is MIXED")
    presentation = _words(values.get(_PIXEL_PRESENTATION))[0]
    if presentation not in ("", "MONOCHROME"):
        raise ValueProblem(f"{name_tag(_PIXEL_PRESENTATION)} is '{presentation}', expected MONOCHROME")
    if _words(values.get(_VOLUMETRIC_PROPERTIES))[0] == "DISTORTED":
        raise ValueProblem(f"{name_tag(_VOLUMETRIC_PROPERTIES)} is 'DISTORTED': the frame is no plane of the patient")
    technique = _words(values.get(_CALCULATION_TECHNIQUE))[0]
    if technique in NO_PLANE:
        raise ValueProblem(f"{name_tag(_CALCULATION_TECHNIQUE)} is '{technique}', expected a plane of measured HU")
    computed = [technique] if technique in _COMPUTED else []
    computed += [word for word in _words(values.get(_IMAGE_TYPE))[3:4] if word in _COMPUTED_CONTRAST]
    if computed:
        warnings.append(f"computed frames ({', '.join(computed)}): maybe not measured HU")


def _take_real_world_values(frame: DicomElements, mappings: list[Item], warnings: list[str]) -> None:
    """Use the real-world mapping to HU as the rescale, if there is no rescale or it gives other values."""
    kind = _words(frame.values.get(_RESCALE_TYPE))[0]
    if RESCALE_SLOPE in frame.values and kind in ("", "HU"):
        return
    for mapping in mappings:
        units = [unit.values.get(_CODE_VALUE, b"") for unit in mapping.sequences.get(_REAL_UNITS, [])]
        if not any(decode_text(unit) in _HU_CODES for unit in units):
            continue
        for tag, target in ((_REAL_SLOPE, RESCALE_SLOPE), (_REAL_INTERCEPT, RESCALE_INTERCEPT)):
            number = decode_number(mapping.values.get(tag, b""), "d", frame.little_endian)
            if number is None or not math.isfinite(number) or (tag == _REAL_SLOPE and number == 0.0):
                value_text = "missing" if number is None else f"{number:g}"
                raise ValueProblem(f"{name_tag(tag)} is {value_text}, expected a finite number")
            frame.values[target], frame.vrs[target] = repr(number).encode(), "DS"
        frame.values[_RESCALE_TYPE], frame.vrs[_RESCALE_TYPE] = b"HU", "LO"
        warnings.append(f"RescaleType is {escape_text(kind, 16)}: " if kind else "no RescaleSlope: ")
        warnings[-1] += "HU by RealWorldValueMappingSequence (0040,9096)"
        return


def _describe_phase(frame: DicomElements, dimensions: tuple[tuple[int, str], ...]) -> Iterator[tuple[str, str]]:
    for keyword, tag, form in slice_header.FRAME_PHASES:
        raw = frame.values.get(tag)
        if not raw:
            continue
        if form:
            number = decode_number(raw, form, frame.little_endian)
            text = "" if number is None else f"{number:.10g}"
        else:
            text = escape_text(decode_text(raw))
        if text:
            yield keyword, text
    indices = frame.values.get(_DIMENSION_VALUES, b"")
    for dimension_number, name in dimensions:
        number = decode_number(indices[4 * dimension_number : 4 * dimension_number + 4], "L", frame.little_endian)
        if number is not None:
            yield f"DimensionIndexValues {name}", f"{number:g}"


def _name_dimensions(dimensions: list[Item], little: bool) -> Iterator[tuple[int, str]]:
    for number, dimension in enumerate(dimensions):
        raw = dimension.values.get(_DIMENSION_POINTER, b"")
        if len(raw) != 4:
            continue
        group, element = struct.unpack("<HH" if little else ">HH", raw)
        pointer = group << 16 | element
        if pointer not in DIMENSIONS_OF_PLACE:
            yield number, name_element(pointer)


def _read_header_bytes(path: Path, elements: DicomElements) -> tuple[bytes, int]:
    """Return the data set up to its pixel data, and the offset in these bytes where it starts."""
    if elements.pixel_offset > _HEADER_BYTES_LIMIT:
        raise ValueProblem(f"a header of {elements.pixel_offset} bytes, no more than {_HEADER_BYTES_LIMIT} are read")
    with open_regular(path) as file:
        if elements.inflate_from >= 0:
            file.seek(elements.inflate_from)
            deflated = file.read(2 * elements.pixel_offset + 1024)  # incompressible data grow by 5 bytes in 16 KiB
            return zlib.decompressobj(-zlib.MAX_WBITS).decompress(deflated, elements.pixel_offset), 0
        data = file.read(elements.pixel_offset)
    return data, find_data_set(data)


def find_data_set(data: bytes) -> int:
    """Return the offset of the byte after the file meta elements."""
    start = META_START
    while data[start : start + 2] == b"\x02\0":  # file meta elements: explicit VR little endian
        long = data[start + 4 : start + 6] in (b"OB", b"UN", b"OW", b"SQ", b"UT")
        length = int.from_bytes(data[start + 8 : start + 12] if long else data[start + 6 : start + 8], "little")
        start += (12 if long else 8) + length
    return start


def _words(raw: bytes | None) -> list[str]:
    """Return the values of a code string, at least one."""
    return [word.strip(" ") for word in decode_text(raw or b"").upper().split("\\")]


PLACE_POINTERS = frozenset({0x3004000C, 0x00180050, 0x00180088, 0x00200013, 0x00200032, 0x00201041, 0x00540080})
"""Elements to which FrameIncrementPointer points where frames are slices: GridFrameOffsetVector, SliceThickness,
SpacingBetweenSlices, InstanceNumber, ImagePositionPatient, SliceLocation, SliceVector.  Others are times or phases."""
SAME_PLACE_MM = 0.01
WAYS = (("left", "right"), ("back", "front"), ("head", "feet"))
_EXACT_DIGITS = 15


@dataclass(frozen=True)
class FramePlaces:
    """Where the frames of a file lie: offsets (n,) from the first along the normal, their decimals and element."""

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
    if frames > _FRAMES_LIMIT:
        raise ValueProblem(
            f"multi-frame image of {frames} frames, SOP class {sop_class}: no more than {_FRAMES_LIMIT} are read"
        )
    return max(frames, 1)


def find_places(values: Values, sop_class: str, frames: int) -> FramePlaces:
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
    raw = values.elements.values.get(0x00280009, b"")
    form = "<HH" if values.elements.little_endian else ">HH"
    pointers = {group << 16 | element for group, element in struct.iter_unpack(form, raw[: len(raw) // 4 * 4])}
    if not pointers <= PLACE_POINTERS:
        raise ValueProblem(
            f"{image}: FrameIncrementPointer (0028,0009) does not say that its frames are slices, but names "
            f"{join_names(map(name_element, sorted(pointers - PLACE_POINTERS)))}: export one volume as single slices"
        )
    if "GridFrameOffsetVector" in values:
        return _read_offsets(values, frames)
    spacing = values.decimals("SpacingBetweenSlices", 1)[0]
    if spacing == 0.0:
        raise values.wrong("SpacingBetweenSlices", f"the distance of {frames} frames, other than 0")
    return FramePlaces(spacing * np.arange(frames, dtype=np.float64), _EXACT_DIGITS, "SpacingBetweenSlices")


def _read_offsets(values: Values, frames: int) -> FramePlaces:
    """Read GridFrameOffsetVector: relative to the first frame, or z itself in axial frames."""
    offsets = np.array(values.decimals("GridFrameOffsetVector", frames))
    digits = max(values.decimal_places("GridFrameOffsetVector"))
    if offsets[0] != 0.0:
        cosines = values.decimals("ImageOrientationPatient", 6)
        normal, z = _cross(cosines[:3], cosines[3:]), values.decimals("ImagePositionPatient", 3)[2]
        if abs(offsets[0] - z) > SAME_PLACE_MM or abs(normal[2]) < 1.0 - 1e-6:
            raise ValueProblem(
                f"GridFrameOffsetVector (3004,000C) begins with {offsets[0]:g}, expected 0, or in axial frames the z "
                "of ImagePositionPatient (0020,0032)"
            )
        offsets = (offsets - offsets[0]) * round(normal[2])
    return FramePlaces(offsets, digits, "GridFrameOffsetVector")


def _cross(row: tuple[float, ...], column: tuple[float, ...]) -> NDArray[np.float64]:
    normal = np.cross(row, column)
    length = math.hypot(*normal)
    return np.asarray(normal / length if length > 0.0 else normal)


def spread_frames(header: slice_header.SliceHeader, places: FramePlaces) -> Iterator[slice_header.SliceHeader]:
    """Return one header for each frame, given that of the first one."""
    normal = _cross(header.row_cosines, header.column_cosines)
    first = np.array(header.position_mm)
    remark = f"{header.frames} frames in one classic CT image: {_describe_way(places, normal)}"
    for number, offset in enumerate(places.offsets_mm.tolist()):
        yield replace(
            header,
            frame=number,
            name=f"{header.name} frame {number + 1}",
            position_mm=tuple((first + offset * normal).tolist()),
            position_digits=(places.digits,) * 3,
            stated_gap_mm=None if header.stated_gap_mm is None else abs(header.stated_gap_mm),
            warnings=(*header.warnings, remark),
        )


def _describe_way(places: FramePlaces, normal: NDArray[np.float64]) -> str:
    """Say from which end of the patient the frames run, and how this is known."""
    axis = int(np.argmax(np.abs(normal)))
    towards, away = WAYS[axis] if (normal[axis] > 0.0) == (places.offsets_mm[-1] > 0.0) else WAYS[axis][::-1]
    direction = f"they run from {away} to {towards}"
    if places.element == "GridFrameOffsetVector":
        steps = np.diff(places.offsets_mm)
        ordered = bool((steps > 0.0).all() or (steps < 0.0).all())
        return f"{direction if ordered else 'they are in no order'}, as GridFrameOffsetVector says"
    return (
        f"{direction}, along the normal of rows and columns in steps of SpacingBetweenSlices,"
        f" {places.offsets_mm[1]:g} mm; "
        "no element says that they do not run the other way, and then the volume is mirrored: compare left and "
        "right with the scanner's pictures"
    )
