"""Validated slice headers from the raw elements of a file: no value gets past this module unchecked."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from clrecon.reading.dicom.headers import multiframe
from clrecon.reading.dicom.headers.slice_header import SLICE_PHASES, OtherImage, SeriesIdentity, SliceHeader
from clrecon.reading.dicom.headers.surplus import check_surplus
from clrecon.reading.dicom.parse.elements import CorruptFileError, DicomElements, FileStart, read_elements
from clrecon.reading.dicom.parse.transfer_syntaxes import describe_undecodable, is_encapsulated
from clrecon.reading.dicom.parse.values import (
    MODALITIES,
    OTHER_TERM,
    RESCALE_TYPES,
    WANTED_TAGS,
    ValueProblem,
    Values,
    name_term,
)
from clrecon.system.text import escape_text, hash_uid

CT_IMAGE_STORAGE = "1.2.840.10008.5.1.4.1.1.2"
_SECONDARY_CAPTURE = "1.2.840.10008.5.1.4.1.1.7"
_DICOMDIR_CLASS = "1.2.840.10008.1.3.10"

DERIVED_WORDS = frozenset("MPR MIP MINIP MAXIP AIP PROJECTION REFORMATTED CPR CURVED VRT SSD".split())
"""Words of ImageType that, together with DERIVED, mark computed images: other planes, projections, renderings."""

PATIENT_POSITIONS = frozenset("HFP HFS HFDR HFDL FFDR FFDL FFP FFS LFP LFS RFP RFS AFDR AFDL PFDR PFDL".split())
"""Defined terms of PatientPosition (PS3.3 C.7.3.1.1.2); other values are free text and are dropped."""

_FLOAT_PIXEL_BITS = {0x7FE00008: 32, 0x7FE00009: 64}
"""Float and Double Float Pixel Data: BitsAllocated (PS3.3 C.7.6.24, C.7.6.25)."""

_PIXEL_SPACING_MM = (1e-3, 50.0)
_POSITION_LIMIT_MM = 1e6
_STATED_LENGTHS = (
    ("slice_thickness_mm", "SliceThickness", "(0018,0050)"),
    ("stated_gap_mm", "SpacingBetweenSlices", "(0018,0088)"),
    ("stated_field_mm", "ReconstructionDiameter", "(0018,1100)"),
    ("stated_location_mm", "SliceLocation", "(0020,1041)"),
)
_LETTERS = re.compile(r"[LRAPHF]{1,3}\\[LRAPHF]{1,3}")
RESCALE_SLOPE = (1e-6, 1e6)
_RESCALE_INTERCEPT_LIMIT = 1e9


# The slices of a series share equal values, so that a tree of 100,000 files needs little memory.
_share_identity = lru_cache(1024)(SeriesIdentity)
_share_texts = lru_cache(1024)(lambda *texts: texts)


@lru_cache(256)
def _share_halves(orientation: tuple[float, ...]) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    return orientation[:3], orientation[3:]  # type: ignore[return-value]


def read_headers(
    path: Path, start: FileStart | None = None, *, force: bool = False
) -> list[SliceHeader] | OtherImage | None:
    """Read one file as `read_elements` does: a header for each frame, or None for a DICOMDIR, which only lists."""
    elements = read_elements(path, WANTED_TAGS, start, force=force)
    values = Values(elements)
    if elements.media_class == _DICOMDIR_CLASS:
        if elements.pixel_tag is None and "SOPClassUID" not in values:
            return None
        remark = "the meta header says that it is a DICOMDIR: read as the image that it holds"
        values.elements = elements = elements._replace(remarks=(*elements.remarks, remark))
    name = escape_text(path.name)
    sop_class = values.word("SOPClassUID") or elements.media_class
    known_class = "CT" if sop_class in (CT_IMAGE_STORAGE, *multiframe.ENHANCED_CT) else "unknown"
    modality = name_term(values.word("Modality").strip().upper(), MODALITIES) or known_class
    series = _share_identity(
        values.word("SeriesInstanceUID"),
        values.whole_or_none("SeriesNumber"),
        values.description(),
        modality,
        values.word("StudyInstanceUID"),
    )
    if modality == OTHER_TERM and sop_class in (CT_IMAGE_STORAGE, *multiframe.ENHANCED_CT):
        problem = f"{name}: Modality (0008,0060) is no term of the standard, expected CT in a CT image"
        return OtherImage(series, path, name, 1, "broken", problem)
    if modality != "CT":
        return OtherImage(series, path, name, 1, "other", f"modality {modality} is not CT")
    if elements.pixel_tag is None:
        raise CorruptFileError("ends before its pixel data")
    if (sop_class + ".").startswith(_SECONDARY_CAPTURE + "."):
        why = "its pixels are a picture, not measured HU"
        if "ImagePositionPatient" not in values:
            why = "without ImagePositionPatient (0020,0032): no geometry"
        return OtherImage(series, path, name, 1, "capture", f"{name}: secondary capture (SOP class {sop_class}): {why}")
    if sop_class in multiframe.ENHANCED_CT:
        return _read_frames(elements, series, path, name, force)
    try:
        frames = multiframe.count_frames(values, sop_class)
        places = multiframe.find_places(values, sop_class, frames) if frames > 1 else None
        header = _validate(values, series, path, name, frames=frames)
        remarks = check_surplus(elements, header, force=force)
        header = replace(header, warnings=_share_texts(*header.warnings, *remarks)) if remarks else header
        return [header] if places is None else list(multiframe.spread_frames(header, places))
    except ValueProblem as problem:
        return OtherImage(series, path, name, 1, "broken", f"{name}: {problem}")


def _read_frames(
    elements: DicomElements, series: SeriesIdentity, path: Path, name: str, force: bool
) -> list[SliceHeader] | OtherImage:
    """Read one header for each frame of an enhanced image, or return the first problem."""
    frames, frame_name = 1, name
    headers: list[SliceHeader] = []
    remarks: tuple[str, ...] = ()
    try:
        groups = multiframe.read_groups(path, elements)
        frames = len(groups.frames)
        for number, frame in enumerate(multiframe.split_frames(elements, groups)):
            frame_name = f"{name} frame {number + 1}" if frames > 1 else name
            if frame.problem is not None:
                raise frame.problem
            header = _validate(Values(frame.elements), series, path, frame_name, frames=frames)
            if number == 0:
                remarks = check_surplus(elements, header, force=force)
            headers.append(
                replace(
                    header,
                    frame=number,
                    concatenation=groups.concatenation,
                    phase=(*frame.phase, *header.phase),
                    warnings=_share_texts(*header.warnings, *remarks, *groups.warnings, *frame.warnings),
                )
            )
    except ValueProblem as problem:
        return OtherImage(series, path, name, frames, "broken", f"{frame_name}: {problem}")
    return headers


def _check_matrix(samples: int, photometric: str, rows: int, columns: int) -> None:
    """Refuse colour images, and images without pixels."""
    if samples != 1 or photometric not in ("MONOCHROME1", "MONOCHROME2"):
        interpretation = photometric or "nothing"
        raise ValueProblem(
            f"PhotometricInterpretation (0028,0004) is {escape_text(interpretation)} with {samples} samples: "
            "a CT slice is MONOCHROME2"
        )
    if rows == 0 or columns == 0:
        raise ValueProblem(f"Rows (0028,0010) x Columns (0028,0011) is {rows} x {columns}")


def _validate(values: Values, series: SeriesIdentity, path: Path, name: str, *, frames: int = 1) -> SliceHeader:
    elements = values.elements
    reason = describe_undecodable(elements.transfer_syntax)
    if reason:
        raise ValueProblem(reason)
    samples, photometric = values.unsigned("SamplesPerPixel", 1), values.word("PhotometricInterpretation")
    rows, columns = values.unsigned("Rows"), values.unsigned("Columns")
    _check_matrix(samples, photometric, rows, columns)
    float_pixels = elements.pixel_tag in _FLOAT_PIXEL_BITS
    allocated, stored, high_bit, signed = _validate_float_bits(values) if float_pixels else _validate_bits(values)
    (dj, di), orientation, position = _validate_geometry(values)
    slope, intercept = _validate_rescale(values)

    warnings = []
    if not series.uid:
        warnings.append("no SeriesInstanceUID: the slices of one folder are taken as one series, by SeriesNumber")
    stated = _read_stated_lengths(values, warnings)
    warnings += (*dict.fromkeys(values.warnings), *elements.remarks)
    if elements.encoding_differs:
        warnings.append("implicit and explicit VR are mixed up: parsed as found, not as the transfer syntax says")
    image_type = [word.strip() for word in values.text("ImageType").upper().split("\\")]
    words_found = sorted(DERIVED_WORDS.intersection(re.split("[^A-Z]+", " ".join(image_type))))
    derived = words_found if "DERIVED" in image_type else []
    if derived:
        warnings.append(f"derived images (ImageType has DERIVED and {' '.join(derived)}): maybe not measured HU")

    row_cosines, column_cosines = _share_halves(orientation)
    letters = values.text("PatientOrientation").upper().replace(" ", "")
    header = SliceHeader(
        series=series,
        file=path,
        name=name,
        frame=0,
        frames=frames,
        concatenation=None,
        phase=values.pairs(SLICE_PHASES),
        localizer="LOCALIZER" in image_type,
        patient_hash=hash_uid(values.text("PatientID").strip()),
        frame_of_reference=values.word("FrameOfReferenceUID"),
        transfer_syntax=elements.transfer_syntax,
        little_endian=elements.little_endian,
        rows=rows,
        columns=columns,
        bits_allocated=allocated,
        bits_stored=stored,
        high_bit=high_bit,
        signed=signed,
        photometric=photometric,
        row_cosines=row_cosines,
        column_cosines=column_cosines,
        position_mm=position,  # type: ignore[arg-type]
        position_digits=values.decimal_places("ImagePositionPatient"),  # type: ignore[arg-type]
        di_mm=di,
        dj_mm=dj,
        **stated,
        stated_letters=letters if _LETTERS.fullmatch(letters) else "",
        slope=slope,
        intercept=intercept,
        has_slope="RescaleSlope" in values,
        has_intercept="RescaleIntercept" in values,
        rescale_type=name_term(values.word("RescaleType"), RESCALE_TYPES),
        padding=values.float_padding(allocated) if float_pixels else values.padding(allocated, stored, signed),
        float_pixels=float_pixels,
        modality_lut="ModalityLUTSequence" in values,
        lossy=values.word("LossyImageCompression") == "01",
        pixel_offset=elements.pixel_offset,
        pixel_length=elements.pixel_length,
        inflate_from=elements.inflate_from,
        file_bytes=elements.file_bytes,
        warnings=_share_texts(*warnings),
        patient_position=lay if (lay := values.text("PatientPosition").upper()) in PATIENT_POSITIONS else "",
        quadruped=values.text("AnatomicalOrientationType").strip().upper() == "QUADRUPED",
        derived=tuple(derived),
        instance_number=values.whole_or_none("InstanceNumber") if frames == 1 else None,
        stated_images=values.whole_or_none("ImagesInAcquisition"),
        stated_files=values.whole_or_none("NumberOfSeriesRelatedInstances"),
    )
    _check_pixel_room(header, elements.pixel_vr)
    return header


def _read_stated_lengths(values: Values, warnings: list[str]) -> dict[str, float | None]:
    lengths: dict[str, float | None] = {}
    for field, keyword, tag in _STATED_LENGTHS:
        try:
            lengths[field] = values.decimals(keyword, 1)[0] if keyword in values else None
        except ValueProblem:
            lengths[field] = None
            warnings.append(f"{keyword} {tag} is no finite number; ignored, it plays no part in the geometry")
    return lengths


def _validate_geometry(values: Values) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Check PixelSpacing (row, column), ImageOrientationPatient and ImagePositionPatient against plausible limits."""
    spacing = values.decimals("PixelSpacing", 2)
    low, high = _PIXEL_SPACING_MM
    if not all(low <= length <= high for length in spacing):
        raise values.wrong("PixelSpacing", f"two numbers from {low:g} to {high:g} mm")
    orientation = values.decimals("ImageOrientationPatient", 6)
    if max(abs(v) for v in orientation) > 2.0:
        raise values.wrong("ImageOrientationPatient", "two unit vectors")
    position = values.decimals("ImagePositionPatient", 3)
    if max(abs(v) for v in position) > _POSITION_LIMIT_MM:
        raise values.wrong("ImagePositionPatient", f"within {_POSITION_LIMIT_MM:g} mm")
    return spacing, orientation, position


def _validate_rescale(values: Values) -> tuple[float, float]:
    """Check RescaleSlope and RescaleIntercept; 1 and 0 if they are missing, which the certificate warns of."""
    slope = values.decimals("RescaleSlope", 1)[0] if "RescaleSlope" in values else 1.0
    intercept = values.decimals("RescaleIntercept", 1)[0] if "RescaleIntercept" in values else 0.0
    if not RESCALE_SLOPE[0] <= abs(slope) <= RESCALE_SLOPE[1]:
        raise values.wrong("RescaleSlope", "a finite number other than 0")
    if abs(intercept) > _RESCALE_INTERCEPT_LIMIT:
        raise values.wrong("RescaleIntercept", f"within {_RESCALE_INTERCEPT_LIMIT:g}")
    return slope, intercept


def _validate_bits(values: Values) -> tuple[int, int, int, bool]:
    allocated = values.unsigned("BitsAllocated")
    if allocated not in (8, 16, 32):
        raise values.wrong("BitsAllocated", "8, 16 or 32")
    stored = values.unsigned("BitsStored")
    if not 1 <= stored <= allocated:
        raise values.wrong("BitsStored", f"1 to {allocated}")
    high_bit = values.unsigned("HighBit", stored - 1)
    if not stored - 1 <= high_bit < allocated:
        raise values.wrong("HighBit", f"{stored - 1} to {allocated - 1}")
    if is_encapsulated(values.elements.transfer_syntax) and high_bit != stored - 1:
        raise values.wrong("HighBit", f"{stored - 1} in a compressed image")
    representation = values.unsigned("PixelRepresentation")
    if representation not in (0, 1):
        raise values.wrong("PixelRepresentation", "0 or 1")
    return allocated, stored, high_bit, representation == 1


def _validate_float_bits(values: Values) -> tuple[int, int, int, bool]:
    """Check float pixels: all bits are used, they are signed, and the standard defines no rescale (PS3.3 C.7.6.24)."""
    bits = _FLOAT_PIXEL_BITS[values.elements.pixel_tag or 0]
    if values.unsigned("BitsAllocated") != bits:
        raise values.wrong("BitsAllocated", f"{bits} for float pixels of this width")
    if is_encapsulated(values.elements.transfer_syntax):
        raise ValueProblem("compressed transfer syntax with Float Pixel Data (7FE0,0008)")
    if _validate_rescale(values) != (1.0, 0.0):
        raise values.wrong(
            "RescaleSlope" if _validate_rescale(values)[0] != 1.0 else "RescaleIntercept",
            "none beside Float Pixel Data (7FE0,0008), which has no rescale",
        )
    return bits, bits, bits - 1, True


def _check_pixel_room(header: SliceHeader, pixel_vr: str) -> None:
    """Refuse files that cannot hold their pixels, before anything is allocated for them."""
    if is_encapsulated(header.transfer_syntax):
        if header.pixel_length != -1:
            raise ValueProblem("compressed transfer syntax, but Pixel Data (7FE0,0010) is not encapsulated")
        return
    if header.pixel_length == -1:
        raise ValueProblem("Pixel Data (7FE0,0010) has no length, but the transfer syntax is uncompressed")
    if not header.little_endian and header.bits_allocated == 8 and pixel_vr == "OW":
        raise ValueProblem("8-bit pixels as big-endian words: not supported")
    size = header.pixel_length
    if header.inflate_from < 0:
        size = min(size, max(header.file_bytes - header.pixel_offset, 0))
    if size < header.frames * header.pixel_bytes:
        frames = f"{header.frames} x " if header.frames > 1 else ""
        raise ValueProblem(
            f"truncated: {header.frames * header.pixel_bytes} bytes of pixels expected "
            f"({frames}{header.columns} x {header.rows} x {header.bits_allocated} bit), {size} found"
        )
