"""Damaged series: header elements that lie about places or values, what becomes of each, and the table of the page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from dicom_series import Plan
from value_series import SHAPE, make_body, make_table, radius_from

STACK = Plan(shape=(12, 16, 18))


def position(k: int) -> list[float]:
    """Where slice k of `STACK` lies, LPS mm."""
    return [float(value) for value in STACK.position(k)]


@dataclass
class Place:
    """A damage, and what becomes of it.

    `result` is one of `RESULTS`; each of `values` is a value, None for a missing element, or a function of the slice.
    The pictures of a `body` show a patient, of others numbers that tell voxels apart.
    """

    result: str
    gates: set[str]
    words: str
    values: dict[str, Any]
    body: bool = False


RESULTS = {
    "exact": "read, positions exact",
    "as stated": "read, positions as stated",
    "silent": "**read, positions as stated, not noticed**",
    "refused": "refused",
}


def exact(gates: str = "", words: str = "", /, **values: Any) -> Place:
    """A damage that is read with exact positions; failed gates, a word of the message, elements."""
    return Place("exact", set(gates.split()), words, values)


def as_stated(gates: str, words: str, /, **values: Any) -> Place:
    """A damage that is read as stated and noticed by gates."""
    return Place("as stated", set(gates.split()), words, values)


def silent(why: str, /, **values: Any) -> Place:
    """A damage that is read as stated and that nothing can notice, and why."""
    return Place("silent", set(), why, values)


def refused(words: str, /, **values: Any) -> Place:
    """A damage for which the series is refused."""
    return Place("refused", set(), words, values)


def seen(words: str, /, **values: Any) -> Place:
    """A damage of places that the pictures of a patient show."""
    return Place("as stated", {"shown_places"}, words, values, body=True)


def swap(a: int, b: int) -> Any:
    """Positions of which those of slices a and b are exchanged."""

    def swapped(k: int) -> Any:
        return position(b if k == a else a if k == b else k)

    return swapped


DOUBLED = {"ImagePositionPatient": lambda k: [2 * value for value in position(k)]}
IN_CM = {"ImagePositionPatient": lambda k: [value / 10 for value in position(k)]}
LOCATION = {"SliceLocation": lambda k: -position(k)[2]}
LETTERS = {"PatientOrientation": ["L", "P"]}


def make_patient() -> np.ndarray:
    """A round body that turns and grows along 12 slices of 72 x 96 pixels, a bone in it, HU without noise."""
    k, j, i = np.mgrid[:12, :72, :96].astype(float)
    turn = k / 4.0
    body = np.hypot((j - 36.0) / (24.0 + k), (i - 46.0) / (34.0 + k))
    bone = np.hypot(j - 36.0 - 12.0 * np.sin(turn), i - 46.0 - 16.0 * np.cos(turn))
    return np.rint(np.clip(400.0 * (1.0 - body), -1000.0, 50.0) + np.clip(1000.0 - 100.0 * bone, 0.0, 800.0))


def at_one(k: int, *, odd: Any, usual: Any) -> Any:
    """A value of slice k, and the usual one of all others."""
    return lambda slice_number: odd if slice_number == k else usual


PLACES = {
    "position missing": refused("ImagePositionPatient (0020,0032) is missing", ImagePositionPatient=None),
    "position missing in one slice": refused(
        "slice005.dcm: ImagePositionPatient (0020,0032) is missing",
        ImagePositionPatient=lambda k: None if k == 5 else position(k),
    ),
    "position of two numbers": refused("expected 3 finite numbers", ImagePositionPatient=lambda k: position(k)[:2]),
    "position of another slice": refused(
        "duplicate slices with different pixels at 1 place", ImagePositionPatient=lambda k: position(4 if k == 5 else k)
    ),
    "one position for all": refused("all 12 images lie in one plane", ImagePositionPatient=position(0)),
    "position with x and z exchanged": refused(
        "all 12 images lie in one plane", ImagePositionPatient=lambda k: position(k)[::-1]
    ),
    "position of one slice 0.6 mm off": as_stated(
        "grid_residual",
        "slices are unevenly spaced",
        ImagePositionPatient=lambda k: [*position(k)[:2], position(k)[2] + 0.6 * (k == 5)],
    ),
    "position of one slice 3 mm aside": as_stated(
        "grid_residual",
        "slices are shifted sideways",
        ImagePositionPatient=lambda k: [position(k)[0] + 3 * (k == 5), *position(k)[1:]],
    ),
    "positions in micrometres": as_stated(
        "plausible_spacing gap_thickness complete_series",
        "spacings that no scanner has",
        ImagePositionPatient=lambda k: [1000 * value for value in position(k)],
    ),
    "positions doubled": as_stated("stated_places", "ImagePositionPatient by 2.5 mm", **DOUBLED, **LOCATION),
    "positions doubled, no other element states positions": silent(
        "no SliceLocation, no SpacingBetweenSlices", **DOUBLED
    ),
    "positions in cm": as_stated("stated_places", "ImagePositionPatient by 0.125 mm", **IN_CM, **LOCATION),
    "positions in cm, no other element states positions": silent("slices may overlap by any amount", **IN_CM),
    "position with the wrong sign along the slices": silent(
        "all headers fit the mirrored patient: SliceLocation has no direction",
        ImagePositionPatient=lambda k: [*position(k)[:2], -position(k)[2]],
        **LOCATION,
    ),
    "positions of two slices exchanged": seen(
        "slices 6 and 7 of 12 seem to lie in each other's place", ImagePositionPatient=swap(5, 6)
    ),
    "positions of two distant slices exchanged": seen(
        "slices 4 and 9 of 12 seem to lie in each other's place", ImagePositionPatient=swap(3, 8)
    ),
    "orientation missing": refused("ImageOrientationPatient (0020,0037) is missing", ImageOrientationPatient=None),
    "orientation of three numbers": refused("expected 6 finite numbers", ImageOrientationPatient=[1, 0, 0]),
    "orientation doubled": refused("off unit length or right angle", ImageOrientationPatient=[2, 0, 0, 0, 2, 0]),
    "orientation of parallel directions": refused(
        "off unit length or right angle", ImageOrientationPatient=[1, 0, 0, 1, 0, 0]
    ),
    "orientation of zeros": refused("off unit length or right angle", ImageOrientationPatient=[0] * 6),
    "orientation of one slice differs": refused(
        "1 slice missing between", ImageOrientationPatient=at_one(5, odd=[0, 1, 0, 0, 0, -1], usual=[1, 0, 0, 0, 1, 0])
    ),
    "orientation of another plane": refused(
        "all 12 images lie in one plane", ImageOrientationPatient=[0, 1, 0, 0, 0, -1]
    ),
    "orientation with the wrong sign of rows": as_stated(
        "stated_places", "PatientOrientation says L\\P", ImageOrientationPatient=[-1, 0, 0, 0, 1, 0], **LETTERS
    ),
    "orientation with the wrong sign of rows, no PatientOrientation": silent(
        "images viewed from the head are equally valid", ImageOrientationPatient=[-1, 0, 0, 0, 1, 0]
    ),
    "orientation with rows and columns exchanged": as_stated(
        "stated_places", "by ImageOrientationPatient it is P\\L", ImageOrientationPatient=[0, 1, 0, 1, 0, 0], **LETTERS
    ),
    "orientation with rows and columns exchanged, no PatientOrientation": silent(
        "a patient may lie on the side", ImageOrientationPatient=[0, 1, 0, 1, 0, 0]
    ),
    "pixel spacing missing": refused("PixelSpacing (0028,0030) is missing", PixelSpacing=None),
    "pixel spacing of one number": refused("expected 2 finite numbers", PixelSpacing=[0.7]),
    "pixel spacing below 0": refused("expected two numbers from 0.001 to 50 mm", PixelSpacing=[-0.7, 0.5]),
    "pixel spacing 0": refused("expected two numbers from 0.001 to 50 mm", PixelSpacing=[0, 0.5]),
    "pixel spacing in metres": refused("expected two numbers from 0.001 to 50 mm", PixelSpacing=[0.0007, 0.0005]),
    "pixel spacing of one slice doubled": refused(
        "PixelSpacing differs within the series", PixelSpacing=at_one(5, odd=[1.4, 1.0], usual=[0.7, 0.5])
    ),
    "pixel spacing doubled": as_stated(
        "stated_places", "ReconstructionDiameter says 11.2 mm", PixelSpacing=[1.4, 1.0], ReconstructionDiameter=11.2
    ),
    "pixel spacing doubled, no ReconstructionDiameter": silent(
        "no other element states the width", PixelSpacing=[1.4, 1]
    ),
    "pixel spacing doubled, image cut out of a larger one": silent(
        "the image still fits into the ReconstructionDiameter", PixelSpacing=[1.4, 1.0], ReconstructionDiameter=358.4
    ),
    "pixel spacing in cm": as_stated(
        "stated_places", "5,120 pixels of 0.07 mm", PixelSpacing=[0.07, 0.05], ReconstructionDiameter=358.4
    ),
    "pixel spacing in cm, no ReconstructionDiameter": silent(
        "high-resolution scanners have such pixels", PixelSpacing=[0.07, 0.05]
    ),
    "pixel spacing of rows and columns exchanged": silent(
        "all other elements are the same for both sides", PixelSpacing=[0.5, 0.7], ReconstructionDiameter=358.4
    ),
    "thickness missing": exact(SliceThickness=None),
    "thickness 0": exact(SliceThickness=0),
    "thickness below 0": exact(SliceThickness=-1.25),
    "thickness of one slice differs": exact(
        "", "SliceThickness differs along the stack", SliceThickness=at_one(5, odd=5, usual=1.25)
    ),
    "thickness half the gap, instance numbers in steps": exact(
        "complete_series gap_thickness", "slices missing according to the numbers", SliceThickness=0.625
    ),
    "stated gap doubled": exact("stated_gap", "SpacingBetweenSlices says 2.5 mm", SpacingBetweenSlices=2.5),
    "stated gap halved": exact("stated_gap", "SpacingBetweenSlices says 0.625 mm", SpacingBetweenSlices=0.625),
    "stated gap below 0": exact("stated_gap", "SpacingBetweenSlices says -1.25 mm", SpacingBetweenSlices=-1.25),
    "stated gap 0": exact("stated_gap", "SpacingBetweenSlices says 0 mm", SpacingBetweenSlices=0),
    "stated gap in cm": exact("stated_gap", "SpacingBetweenSlices says 0.125 mm", SpacingBetweenSlices=0.125),
    "instance numbers missing": exact(InstanceNumber=None),
    "one instance number for all": exact(InstanceNumber=1),
    "instance numbers below 0": exact(InstanceNumber=lambda k: -k),
    "instance numbers in another order": exact(InstanceNumber=lambda k: 5 * k % 12 + 1),
    "instance numbers from 11": exact(
        "complete_series", "InstanceNumber begins with 11", InstanceNumber=lambda k: k + 11
    ),
    "frame of reference missing": exact(FrameOfReferenceUID=None),
    "two frames of reference": refused(
        "FrameOfReferenceUID differ within the series", FrameOfReferenceUID=lambda k: f"1.2.3.{k // 6}"
    ),
    "rows missing": refused("Rows (0028,0010) is missing", Rows=None),
    "columns missing": refused("Columns (0028,0011) is missing", Columns=None),
    "rows 0": refused("Rows (0028,0010) x Columns (0028,0011) is 0 x 18", Rows=0),
    "rows doubled": refused("truncated: 1152 bytes of pixels expected", Rows=32),
    "rows halved": refused("more pixels than the header says", Rows=8),
    "rows of one slice halved": refused("slice005.dcm: Pixel Data has 576 bytes", Rows=at_one(5, odd=8, usual=16)),
    "rows and columns exchanged": seen("Rows and Columns seem to be swapped", Rows=96, Columns=72),
    "SeriesInstanceUID missing": exact("", "no SeriesInstanceUID", SeriesInstanceUID=None),
    "a series for each slice": refused(
        "a single slice cannot make a volume: 12 series of one slice each", SeriesInstanceUID=lambda k: f"1.2.3.{k + 1}"
    ),
    "two series alternate": refused("2 CT series have 6 slices each", SeriesInstanceUID=lambda k: f"1.2.3.{k % 2 + 1}"),
    "acquisitions alternate": refused(
        "2 phases whose slices lie between each other", AcquisitionNumber=lambda k: k % 2 + 1
    ),
    "an acquisition for each slice": exact(AcquisitionNumber=lambda k: k + 1),
    "more images stated": exact("complete_series", "ImagesInAcquisition says 24", ImagesInAcquisition=24),
    "fewer images stated": exact(ImagesInAcquisition=6),
    "more files stated": exact(
        "complete_series", "NumberOfSeriesRelatedInstances says 24", NumberOfSeriesRelatedInstances=24
    ),
    "files stated below 0": exact(NumberOfSeriesRelatedInstances=-3),
    "one SOPInstanceUID for all": exact(SOPInstanceUID="1.2.3"),
    "another PatientPosition": exact(PatientPosition="FFP"),
}


LUT = {"ModalityLUTSequence": make_table()}
TWELVE = Plan(shape=SHAPE, bits_stored=12, signed=False)


@dataclass
class Row:
    """A damage, the gates that fail of it, and words that name it."""

    values: dict[str, Any]
    gates: set[str]
    words: str
    plan: Plan | None = None
    hu: np.ndarray | None = None


def stated(gates: str, words: str, *, plan: Plan | None = None, hu: np.ndarray | None = None, **values: Any) -> Row:
    """A damage of values that is read as stated; failed gates, and a word of the message."""
    return Row(values, set(gates.split()), words, plan=plan, hu=hu)


def make_padded() -> np.ndarray:
    """The body in a round field of view, padded with the stored value -2000."""
    return np.where(radius_from() > 46, -3024.0, make_body())


UNDECLARED, MASKED = "padding that the files do not declare", "voxels with the HU of tissue"


VALUES: dict[str, Row] = {
    "slope missing": stated("hu_known", "no RescaleSlope", RescaleSlope=None),
    "slope doubled": stated("hu_scale", "rescale slope seems to be wrong", RescaleSlope=2),
    "slope halved": stated("hu_scale", "rescale slope seems to be wrong", RescaleSlope=0.5),
    "slope with the wrong sign": stated("plausible_hu hu_scale", "RescaleSlope -1", RescaleSlope=-1),
    "slope and intercept of another scale": stated(
        "hu_scale", "rescale slope seems to be wrong", RescaleSlope=7, RescaleIntercept=-7168
    ),
    "slope of 1000": stated("plausible_hu", "RescaleSlope 1000", RescaleSlope=1000),
    "slope of 0.0001": stated("plausible_hu", "RescaleSlope 0.0001", RescaleSlope=0.0001),
    "intercept missing": stated("hu_known hu_scale", "intercept seems to be missing", RescaleIntercept=None),
    "intercept 0": stated("hu_scale", "intercept seems to be missing", RescaleIntercept=0),
    "intercept doubled": stated("hu_scale", "applied twice", RescaleIntercept=-2048),
    "intercept with the wrong sign": stated("hu_scale plausible_hu", "lowest voxel 1024 HU", RescaleIntercept=1024),
    "intercept off by 324": stated("hu_scale", "HU too high", RescaleIntercept=-700),
    "intercept off by -324": stated("hu_scale", "HU too low", RescaleIntercept=-1348),
    "intercept divided by ten": stated("hu_scale", "soft tissue near 9", RescaleIntercept=-102.4),
    "RescaleType of other values": stated("hu_known", "RescaleType is 'OD'", RescaleType="OD"),
    "Modality LUT instead of a slope": stated(
        "hu_known hu_scale", "Modality LUT Sequence (0028,3000)", RescaleSlope=None, **LUT, RescaleIntercept=None
    ),
    "Modality LUT beside the slope": stated("hu_known", "Modality LUT Sequence (0028,3000)", **LUT),
    "signed values declared unsigned": stated(
        "stored_sign", "seem to be signed", plan=Plan(shape=SHAPE, intercept=0), PixelRepresentation=0
    ),
    "unsigned values declared signed": stated("stored_sign", "dense bone or metal", plan=TWELVE, PixelRepresentation=1),
    "padding value missing": stated("", UNDECLARED, hu=make_padded()),
    "padding value doubled": stated("", UNDECLARED, hu=make_padded(), PixelPaddingValue=-4000),
    "padding value with the wrong sign": stated("", UNDECLARED, hu=make_padded(), PixelPaddingValue=2000),
    "padding value of muscle": stated("", MASKED, PixelPaddingValue=1074),
    "padding value of bone": stated("", MASKED, PixelPaddingValue=1274),
    "padding range limit in tissue": stated(
        "", MASKED, hu=make_padded(), PixelPaddingValue=-2000, PixelPaddingRangeLimit=980
    ),
    "padding range limit with the wrong sign": stated(
        "padding_share one_volume", MASKED, hu=make_padded(), PixelPaddingValue=-2000, PixelPaddingRangeLimit=2000
    ),
    "too few stored bits": stated("stored_bits", "beyond the 11 stored bits", plan=TWELVE, BitsStored=11, HighBit=10),
}


def list_damages() -> list[str]:
    """Return the lines of the table in docs/certificate.md: damages of places, then those of values."""
    lines = ["| damage | result | gates that fail | message, or why not noticed |", "|---|---|---|---|"]
    for name, place in PLACES.items():
        lines.append(_line(name, RESULTS[place.result], place.gates, place.words))
    for name, row in VALUES.items():
        lines.append(_line(name, "read, values as stated", row.gates, row.words))
    return lines


def _line(name: str, result: str, gates: set[str], words: str) -> str:
    return f"| {name} | {result} | {', '.join(f'`{gate}`' for gate in sorted(gates))} | {words} |"
