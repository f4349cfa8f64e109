"""`SliceHeader`: the facts about one CT slice before its pixels are read, for the geometry and the reader."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from clrecon.reading.dicom.parse.values import Item, ValueProblem, decode_number, decode_text, name_tag

FRAME_PHASES = (
    ("TemporalPositionIndex", 0x00209128, "L"),
    ("TemporalPositionTimeOffset", 0x0020930D, "d"),
    ("NominalPercentageOfCardiacPhase", 0x00209241, "f"),
    ("NominalCardiacTriggerDelayTime", 0x00209153, "d"),
    ("NominalPercentageOfRespiratoryPhase", 0x00209245, "f"),
    ("NominalRespiratoryTriggerDelayTime", 0x00209255, "d"),
    ("StackID", 0x00209056, ""),
    ("FrameAcquisitionNumber", 0x00209156, "H"),
)
"""Elements of functional groups that distinguish frames at the same place, the most specific first; "" marks text."""

SLICE_PHASES = (
    "TemporalPositionIdentifier",
    "TriggerTime",
    "AcquisitionNumber",
    "AcquisitionDate",
    "AcquisitionTime",
    "KVP",
    "ConvolutionKernel",
    "ImageType",
    "ContentDate",
    "ContentTime",
)
PHASE_KEYWORDS = (*(keyword for keyword, _, _ in FRAME_PHASES), *SLICE_PHASES)
"""Elements that distinguish the phases of a series, the most specific first: those of frames, then of slices."""


UID, PART, PARTS, _FIRST_FRAME = 0x00209161, 0x00209162, 0x00209163, 0x00209228
CONCATENATION_TAGS = (UID, PART, PARTS, _FIRST_FRAME)
"""The tags of ConcatenationUID, InConcatenationNumber, InConcatenationTotalNumber, ConcatenationFrameOffsetNumber."""


@dataclass(frozen=True)
class Concatenation:
    """The place of a file, from part 1, in an image of several, all of which must be there (PS3.3 C.7.6.16.1.1)."""

    uid: str
    part: int
    parts: int | None
    first_frame: int | None
    frames: int


def read_concatenation(top: Item, frames: int, little: bool) -> Concatenation | None:
    """Read the place of a file in its concatenation from its top level; None where it belongs to none."""
    uid = decode_text(top.values.get(UID, b""))
    if not uid:
        return None
    part = decode_number(top.values.get(PART, b""), "H", little)
    if not part:
        raise ValueProblem(f"{name_tag(PART)} is missing or 0, expected the place of the file in its concatenation")
    parts = decode_number(top.values.get(PARTS, b""), "H", little)
    first = decode_number(top.values.get(_FIRST_FRAME, b""), "L", little)
    return Concatenation(
        uid, int(part), None if parts is None else int(parts), None if first is None else int(first), frames
    )


@dataclass(frozen=True, slots=True)
class SeriesIdentity:
    """A series as a file names it: UID, number (None if missing), description, modality, UID of the study."""

    uid: str
    number: int | None
    description: str
    modality: str
    study: str = ""


@dataclass(frozen=True, slots=True)
class OtherImage:
    """A DICOM object that cannot be a slice, and the reason.

    frames: Number of per-frame functional groups, 1 where it has none.
    kind: "broken": a CT image with a wrong header.  "capture": a secondary capture.  "other": any other object.
    problem: One line, which names the file and, if there is one, the tag.
    """

    series: SeriesIdentity
    file: Path
    name: str
    frames: int
    kind: str
    problem: str


@dataclass(frozen=True, slots=True, eq=False, repr=False)  # both take time at every start of the program
class SliceHeader:
    """All facts about one CT slice before its pixels are read.  All values are validated.

    name: Base name of the file, escaped for messages, with the frame number (from 1) where there are several.
    frame: In the file, from 0.
    phase: Keyword and value of what can distinguish slices at the same place, in the order of `PHASE_KEYWORDS`.
    row_cosines, column_cosines: ImageOrientationPatient as stored.
    position_mm: ImagePositionPatient, LPS mm, centre of the first voxel.
    position_digits: Number of decimals of each number of ImagePositionPatient, as it was written.
    di_mm, dj_mm: Column spacing (PixelSpacing[1]) and row spacing (PixelSpacing[0]).
    slice_thickness_mm, stated_gap_mm: SliceThickness and SpacingBetweenSlices; never used for geometry.
    stated_location_mm, stated_field_mm, stated_letters: SliceLocation, ReconstructionDiameter and PatientOrientation
        ("L\\P"); only compared.
    padding: Lowest and highest stored value that mean "no measurement".
    float_pixels: Float or Double Float Pixel Data, which are HU without rescale.
    slope, intercept: 1 and 0 where the file has none, see `has_slope` and `has_intercept`.
    patient_hash: Used only for comparison, never written to messages or reports.
    pixel_offset, pixel_length, inflate_from, file_bytes: See `DicomElements`.
    patient_position: In the scanner, for example HFS; empty if it is not one of `PATIENT_POSITIONS`.
    derived: The `DERIVED_WORDS` of a derived image; empty for an image that was measured.
    instance_number: None for a frame of a multi-frame image.
    stated_images, stated_files: ImagesInAcquisition and NumberOfSeriesRelatedInstances.
    modality_lut: A table, not slope and intercept, gives the measured values.
    quadruped: AnatomicalOrientationType says that the directions are those of an animal on four legs.
    """

    series: SeriesIdentity
    file: Path
    name: str
    frame: int
    frames: int
    localizer: bool
    concatenation: Concatenation | None
    phase: tuple[tuple[str, str], ...]
    patient_hash: str | None
    frame_of_reference: str
    transfer_syntax: str
    little_endian: bool
    rows: int
    columns: int
    bits_allocated: int
    bits_stored: int
    high_bit: int
    signed: bool
    photometric: str
    row_cosines: tuple[float, float, float]
    column_cosines: tuple[float, float, float]
    position_mm: tuple[float, float, float]
    position_digits: tuple[int, int, int]
    di_mm: float
    dj_mm: float
    slice_thickness_mm: float | None
    stated_gap_mm: float | None
    slope: float
    intercept: float
    has_slope: bool
    has_intercept: bool
    rescale_type: str
    padding: tuple[float, float] | None
    float_pixels: bool
    lossy: bool
    pixel_offset: int
    pixel_length: int
    inflate_from: int
    file_bytes: int
    warnings: tuple[str, ...]
    patient_position: str = ""
    derived: tuple[str, ...] = ()
    instance_number: int | None = None
    stated_images: int | None = None
    stated_files: int | None = None
    modality_lut: bool = False
    quadruped: bool = False
    stated_location_mm: float | None = None
    stated_field_mm: float | None = None
    stated_letters: str = ""

    @property
    def pixel_bytes(self) -> int:
        return self.rows * self.columns * self.bits_allocated // 8
