"""`SliceHeader`: what is known of one CT slice before its pixels are read, as the geometry and the reader take it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from clrecon.dicom.headers.concatenation import Concatenation

__all__ = ["OtherImage", "SeriesIdentity", "SliceHeader"]


@dataclass(frozen=True, slots=True)
class SeriesIdentity:
    """What a file says of its series: UID, number (None where missing), description, modality, UID of the study."""

    uid: str
    number: int | None
    description: str
    modality: str
    study: str = ""


@dataclass(frozen=True, slots=True)
class OtherImage:
    """A DICOM object that cannot be a slice, and why.

    Attributes
    ----------
    frames : int
        Functional groups of frames that it holds, 1 where it has none.
    kind : {"broken", "capture", "other"}
        A CT image with a wrong header; a secondary capture; anything that is no CT.
    problem : str
        One line; names the file and the tag where there is one.
    """

    series: SeriesIdentity
    file: Path
    name: str
    frames: int
    kind: str
    problem: str


@dataclass(frozen=True, slots=True, eq=False, repr=False)  # both would be written at every start of the program
class SliceHeader:
    """Everything that is known of one CT slice before its pixels are read. All values are validated.

    Attributes
    ----------
    file, name : Path, str
        Where it is; base name, escaped for messages, with the number of the frame (from 1) where there are several.
    frame, frames : int
        Which frame of the file it is, from 0, and how many the file holds.
    localizer : bool
        ImageType says LOCALIZER.
    concatenation : Concatenation or None
        Of which part of a concatenation it is.
    phase : tuple of (str, str)
        Keyword and value of what may tell this slice from another one at the same place: see
        `clrecon.dicom.headers.phase_tags.PHASE_KEYWORDS`; the most telling first.
    rows, columns : int
    row_cosines, column_cosines : tuple of 3 float
        ImageOrientationPatient as stored.
    position_mm : tuple of 3 float
        ImagePositionPatient, LPS mm, centre of the first voxel.
    di_mm, dj_mm : float
        Column spacing (PixelSpacing[1]) and row spacing (PixelSpacing[0]).
    slice_thickness_mm, stated_gap_mm : float or None
        SliceThickness and SpacingBetweenSlices; never used for geometry.
    padding : tuple of two numbers or None
        Lowest and highest stored value that mean "no measurement".
    float_pixels : bool
        Float or Double Float Pixel Data, which are HU without rescale.
    slope, intercept : float
        1 and 0 where the file has none, see `has_slope` and `has_intercept`.
    patient_hash : str or None
        Only to compare: it goes into no message and no report.
    pixel_offset, pixel_length, inflate_from, file_bytes : int
        See `DicomElements`.
    warnings : tuple of str
    patient_position : str
        How the patient lay in the scanner, such as HFS; empty where it is not one of `PATIENT_POSITIONS`.
    derived : tuple of str
        The `DERIVED_WORDS` of a derived image; empty for an image that was measured.
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

    @property
    def pixel_bytes(self) -> int:
        """Bytes of the uncompressed pixels of this slice."""
        return self.rows * self.columns * self.bits_allocated // 8
