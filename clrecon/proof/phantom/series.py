"""A phantom in files: where its slices lie in the patient, its DICOM CT series, and its label map as NRRD.

Positions are rounded to the decimal strings that a DICOM header can hold *before* the affine is taken from them,
so that voxels, written files and truth all belong to exactly the same affine.

Source: the NRRD format definition (teem.sourceforge.net/nrrd/format.html).

The series has one file for each slice, fixed dates, and UIDs derived from the settings.  Source: DICOM PS3.3 A.3 (CT
Image IOD), C.7.6.2 (Image Plane), C.8.2.1 (CT Image), PS3.10 chapter 7 (File Meta)."""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, UsageError
from clrecon.geometry import compose_affine
from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom.settings import CENTRE_LPS_MM, KINDS, PhantomSettings, make_localizer
from clrecon.proof.phantom.spine_plan import slice_directions
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from pydicom.dataset import FileDataset


def format_decimal(value: float) -> str:
    """Write a number as a DICOM decimal string: at most 16 characters, as many digits as fit."""
    if not math.isfinite(value):
        raise UsageError(f"{value} cannot be written as a decimal string")
    value = float(value) + 0.0  # no minus zero
    text = repr(value)
    if text.endswith(".0"):
        text = text[:-2]
    digits = 16
    while len(text) > 16:
        digits -= 1
        text = f"{value:.{digits}g}"
    return "0" if float(text) == 0.0 else text


@dataclass(frozen=True)
class Placement:
    """Where the slices lie: the decimal strings of the files, and the affine that these strings give.

    orientation: Row cosines, then column cosines.
    pixel_spacing: dj, di in mm.
    positions: Centre of pixel (0, 0) of every slice, LPS mm.
    slice_thickness, tilt: dk in mm and the gantry tilt in degrees.
    affine: Of an uneven stack that of even slices between the first and the last.
    places: k of each slice in the affine: 0, 1, 2 and so on, but for an uneven stack.
    """

    orientation: list[str]
    pixel_spacing: list[str]
    positions: list[list[str]]
    slice_thickness: str
    tilt: str
    affine: Float64Array
    places: Float64Array


def place_slices(settings: PhantomSettings) -> Placement:
    """Compute orientation and positions of all slices, centred on `CENTRE_LPS_MM`."""
    dj, di, dk = settings.spacing
    row, column, step = slice_directions(settings.tilt, settings.oblique, settings.prone, dk)

    orientation = [format_decimal(value) for value in (*row, *column)]
    pixel_spacing = [format_decimal(dj), format_decimal(di)]
    cosines = np.array([float(text) for text in orientation])
    i_step, j_step = cosines[:3] * float(pixel_spacing[1]), cosines[3:] * float(pixel_spacing[0])
    middle = np.array((*settings.size, settings.slices), dtype=np.float64) / 2.0 - 0.5
    first = np.array(CENTRE_LPS_MM) - middle @ np.array((i_step, j_step, step))
    places = np.arange(settings.slices, dtype=np.float64)
    if settings.uneven_mm > 0.0:  # the first and the last slice lie as in an even stack
        share = settings.uneven_mm / settings.spacing[2]
        places[1:-1] += np.random.default_rng((settings.seed, 23)).uniform(-0.5, 0.5, len(places[1:-1])) * share
    positions = [[format_decimal(value) for value in first + k * step] for k in places]
    written = np.array(positions, dtype=np.float64)
    k_step = (written[-1] - written[0]) / (settings.slices - 1) if settings.slices > 1 else step
    return Placement(
        orientation=orientation,
        pixel_spacing=pixel_spacing,
        positions=positions,
        slice_thickness=format_decimal(dk),
        tilt=format_decimal(settings.tilt),
        affine=compose_affine(i_step, j_step, k_step, written[0]),
        places=places,
    )


def write_label_map(
    path: Path, labels: NDArray[np.uint8], affine: NDArray[np.float64], names: Mapping[int, str] | None = None
) -> None:
    """Write labels where `affine` says, sheared ones too; names, in ASCII, become segments as in 3D Slicer."""

    def vector(values: NDArray[np.float64]) -> str:
        return "(" + ",".join(repr(float(value)) for value in values) + ")"

    nk, nj, ni = labels.shape
    header = (
        "NRRD0004\ntype: uint8\ndimension: 3\nspace: left-posterior-superior\n"
        f"sizes: {ni} {nj} {nk}\nspace directions: {' '.join(vector(affine[:3, axis]) for axis in range(3))}\n"
        f"kinds: domain domain domain\nencoding: gzip\nspace origin: {vector(affine[:3, 3])}\n"
    )
    for n, (number, name) in enumerate((names or {}).items()):
        header += f"Segment{n}_ID:={name}\nSegment{n}_Name:={name}\nSegment{n}_LabelValue:={number}\n"
        header += f"Segment{n}_Layer:=0\n"
    header += "\n"
    # no clock: phantoms made twice are equal byte for byte
    path.write_bytes(header.encode("ascii") + gzip.compress(labels.tobytes(), compresslevel=6, mtime=0))


RESCALE_INTERCEPT = -1024
CT_IMAGE_STORAGE = "1.2.840.10008.5.1.4.1.1.2"
_TRANSFER_SYNTAXES = {"explicit": "1.2.840.10008.1.2.1", "implicit": "1.2.840.10008.1.2"}
# No clock: phantoms made twice must be equal byte for byte.
_DATE, _TIME = "20200101", "120000"
_PHASE_SECONDS = 3


def slice_file_name(index: int) -> str:
    return f"IM{index + 1:04d}.dcm"


def _make_uid(settings: PhantomSettings, *words: str) -> str:
    from pydicom.uid import generate_uid

    described = json.dumps(settings.as_dict(), sort_keys=True)
    return str(generate_uid(entropy_srcs=["clrecon phantom", described, *words]))


def _make_headers(settings: PhantomSettings, placement: Placement, phase: int) -> Iterator[FileDataset]:
    """Yield the header of each slice of a phase, complete except for the pixels: one dataset, which changes."""
    from pydicom.uid import UID

    header = _make_header(settings, placement, phase)
    for k, position in enumerate(placement.positions):
        number = phase * settings.slices + k
        header.SOPInstanceUID = header.file_meta.MediaStorageSOPInstanceUID = UID(
            _make_uid(settings, "instance", str(number))
        )
        header.InstanceNumber, header.ImagePositionPatient = str(number + 1), position
        yield header


def _make_header(settings: PhantomSettings, placement: Placement, phase: int) -> FileDataset:
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import PYDICOM_IMPLEMENTATION_UID, UID

    study, series, frame = (_make_uid(settings, name) for name in ("study", "series", "frame of reference"))
    columns, rows = settings.size
    scanner = KINDS[settings.kind].scanner
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = UID(CT_IMAGE_STORAGE)
    meta.TransferSyntaxUID = UID(_TRANSFER_SYNTAXES[settings.transfer_syntax])
    meta.ImplementationClassUID = PYDICOM_IMPLEMENTATION_UID
    header = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    header.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
    header.SOPClassUID = UID(CT_IMAGE_STORAGE)
    header.StudyDate = header.SeriesDate = header.AcquisitionDate = header.ContentDate = _DATE
    header.StudyTime = header.SeriesTime = header.AcquisitionTime = header.ContentTime = _TIME
    header.AccessionNumber = header.ReferringPhysicianName = ""
    header.Modality, header.Manufacturer = "CT", "clrecon"
    header.StudyDescription, header.SeriesDescription = "clrecon phantom", f"phantom {settings.kind}"
    header.PatientName, header.PatientID = "PHANTOM^CLRECON", "PHANTOM"
    header.PatientBirthDate = header.PatientSex = ""
    header.PatientPosition = "HFP" if settings.prone else "HFS"
    header.KVP, header.SliceThickness = str(scanner.kvp), placement.slice_thickness
    if float(placement.tilt) != 0.0:
        header.GantryDetectorTilt = placement.tilt
    header.StudyInstanceUID, header.SeriesInstanceUID = UID(study), UID(series)
    header.FrameOfReferenceUID, header.PositionReferenceIndicator = UID(frame), ""
    header.StudyID = header.SeriesNumber = header.AcquisitionNumber = "1"
    if settings.phases > 1:
        header.AcquisitionNumber = header.TemporalPositionIdentifier = str(phase + 1)
        header.NumberOfTemporalPositions = str(settings.phases)
        header.AcquisitionTime = header.ContentTime = f"1200{_PHASE_SECONDS * phase % 60:02d}"
    header.ImageOrientationPatient = placement.orientation
    header.SamplesPerPixel, header.PhotometricInterpretation = 1, "MONOCHROME2"
    header.Rows, header.Columns = rows, columns
    header.PixelSpacing = placement.pixel_spacing
    header.BitsAllocated, header.BitsStored = 16, 16
    header.HighBit, header.PixelRepresentation = 15, 1
    header.WindowCenter, header.WindowWidth = "300", "1500"
    header.RescaleIntercept = str(RESCALE_INTERCEPT)
    header.RescaleSlope = "1"
    header.RescaleType = scanner.unit
    return header


def _check_written(path: Path, header: Any, stored: NDArray[np.int16]) -> None:
    """Read a file back and compare the attributes that place it and its pixels."""
    from pydicom import dcmread

    back = dcmread(path)
    same = (
        back.SOPInstanceUID == header.SOPInstanceUID
        and [float(v) for v in back.ImagePositionPatient] == [float(v) for v in header.ImagePositionPatient]
        and [float(v) for v in back.ImageOrientationPatient] == [float(v) for v in header.ImageOrientationPatient]
        and [float(v) for v in back.PixelSpacing] == [float(v) for v in header.PixelSpacing]
        and (back.Rows, back.Columns) == stored.shape
        and back.PixelData[: stored.nbytes] == stored.astype("<i2").tobytes()
    )
    if not same:
        raise OutputError(f"{path.name} does not read back as it was written: check the disk")


def write_series(
    folder: Path, voxels: NDArray[np.int16], settings: PhantomSettings, placement: Placement,
    progress: Progress | None = None, phase: int = 0,
) -> None:  # fmt: skip
    """Write a file for each slice that is not missing, after those of earlier phases, and read each back."""
    for k, header in enumerate(_make_headers(settings, placement, phase)):
        if k + 1 not in settings.missing:
            _write_image(folder / slice_file_name(phase * settings.slices + k), header, voxels[k])
        if progress is not None:
            progress("write", k + 1, len(voxels))
    if settings.ghosts:
        number, instance = len(voxels) + 1, _make_uid(settings, "instance", "localizer")
        localizer, view = make_localizer(header, voxels, placement.affine, number, instance)
        _write_image(folder / slice_file_name(len(voxels)), localizer, view)


def _write_image(path: Path, header: FileDataset, values: NDArray[np.int16]) -> None:
    """Write one image in HU and read it back."""
    stored = values - np.int16(RESCALE_INTERCEPT)
    header.PixelData = stored.astype("<i2").tobytes()
    header.save_as(path, enforce_file_format=True)
    _check_written(path, header, stored)
