"""Write a phantom as a DICOM CT series: one file for each slice, fixed dates, UIDs derived from the settings.

Source: DICOM PS3.3 A.3 (CT Image IOD), C.7.6.2 (Image Plane), C.8.2.1 (CT Image), PS3.10 chapter 7 (File Meta).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError
from clrecon.phantom.ghosts import make_localizer
from clrecon.phantom.placement import Placement
from clrecon.phantom.settings import PhantomSettings
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from pydicom.dataset import FileDataset

RESCALE_INTERCEPT = -1024
CT_IMAGE_STORAGE = "1.2.840.10008.5.1.4.1.1.2"
_TRANSFER_SYNTAXES = {"explicit": "1.2.840.10008.1.2.1", "implicit": "1.2.840.10008.1.2"}
# No clock: phantoms made twice must be equal byte for byte.
_DATE, _TIME = "20200101", "120000"
_PHASE_SECONDS = 3


def slice_file_name(index: int) -> str:
    """Name of the file of slice `index`, counted from 0."""
    return f"IM{index + 1:04d}.dcm"


def _make_uid(settings: PhantomSettings, *what: str) -> str:
    from pydicom.uid import generate_uid

    described = json.dumps(settings.as_dict(), sort_keys=True)
    return str(generate_uid(entropy_srcs=["clrecon phantom", described, *what]))


def _make_headers(settings: PhantomSettings, placement: Placement, phase: int) -> Iterator[FileDataset]:
    """Yield one dataset for each slice of a phase, complete except for the pixels."""
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import PYDICOM_IMPLEMENTATION_UID, UID

    study, series, frame = (_make_uid(settings, name) for name in ("study", "series", "frame of reference"))
    columns, rows = settings.size
    for k, position in enumerate(placement.positions):
        number = phase * settings.slices + k
        instance = _make_uid(settings, "instance", str(number))
        meta = FileMetaDataset()
        meta.MediaStorageSOPClassUID = UID(CT_IMAGE_STORAGE)
        meta.MediaStorageSOPInstanceUID = UID(instance)
        meta.TransferSyntaxUID = UID(_TRANSFER_SYNTAXES[settings.transfer_syntax])
        meta.ImplementationClassUID = PYDICOM_IMPLEMENTATION_UID
        header = FileDataset(slice_file_name(number), {}, file_meta=meta, preamble=b"\0" * 128)
        header.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
        header.SOPClassUID, header.SOPInstanceUID = UID(CT_IMAGE_STORAGE), UID(instance)
        header.StudyDate = header.SeriesDate = header.AcquisitionDate = header.ContentDate = _DATE
        header.StudyTime = header.SeriesTime = header.AcquisitionTime = header.ContentTime = _TIME
        header.AccessionNumber = header.ReferringPhysicianName = ""
        header.Modality, header.Manufacturer = "CT", "clrecon"
        header.StudyDescription, header.SeriesDescription = "clrecon phantom", f"phantom {settings.kind}"
        header.PatientName, header.PatientID = "PHANTOM^CLRECON", "PHANTOM"
        header.PatientBirthDate = header.PatientSex = ""
        header.PatientPosition = "HFP" if settings.prone else "HFS"
        header.KVP, header.SliceThickness = "120", placement.slice_thickness
        if float(placement.tilt) != 0.0:
            header.GantryDetectorTilt = placement.tilt
        header.StudyInstanceUID, header.SeriesInstanceUID = UID(study), UID(series)
        header.FrameOfReferenceUID, header.PositionReferenceIndicator = UID(frame), ""
        header.StudyID, header.SeriesNumber, header.AcquisitionNumber = "1", "1", "1"
        header.InstanceNumber = str(number + 1)
        if settings.phases > 1:
            header.AcquisitionNumber = header.TemporalPositionIdentifier = str(phase + 1)
            header.NumberOfTemporalPositions = str(settings.phases)
            header.AcquisitionTime = header.ContentTime = f"1200{_PHASE_SECONDS * phase % 60:02d}"
        header.ImagePositionPatient, header.ImageOrientationPatient = position, placement.orientation
        header.SamplesPerPixel, header.PhotometricInterpretation = 1, "MONOCHROME2"
        header.Rows, header.Columns = rows, columns
        header.PixelSpacing = placement.pixel_spacing
        header.BitsAllocated, header.BitsStored, header.HighBit, header.PixelRepresentation = 16, 16, 15, 1
        header.WindowCenter, header.WindowWidth = "300", "1500"
        header.RescaleIntercept, header.RescaleSlope, header.RescaleType = str(RESCALE_INTERCEPT), "1", "HU"
        yield header


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
    folder: Path,
    voxels: NDArray[np.int16],
    settings: PhantomSettings,
    placement: Placement,
    progress: Progress | None = None,
    phase: int = 0,
) -> None:
    """Write one file for each slice that is not missing into an existing folder and read each back.

    voxels: ndarray, shape (nk, nj, ni), int16. HU, at most 32767 + `RESCALE_INTERCEPT`.
    progress: Called as ``progress("write", done, slices)``.
    phase: Number of the phase, from 0; its files follow those of the phase before.
    """
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
