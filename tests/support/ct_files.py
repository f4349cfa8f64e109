"""Small DICOM series, written with pydicom alone: the commands are tested on files that clrecon did not make."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, MRImageStorage

SPACING = (0.8, 1.1, 1.5)
"""(di, dj, dk) mm."""
ORIGIN = (-31.0, 17.5, 240.25)
RADIUS_MM = 9.0
INSIDE_HU, OUTSIDE_HU = 700, -1000
PATIENT = "Geheimnis^Jolanthe^Vertraulich"
PATIENT_WORDS = (*PATIENT.split("^"), "ID-471147114711", "19500102", "scan of Jolanthe", "1.2.826.0.1.47114711")
"""What names the patient of a series: words so long that no picture or figure has them by chance."""


def find_words(content: bytes | str, words: Iterable[str] = PATIENT_WORDS) -> list[str]:
    """Return the words that stand in a content; a date counts alone, not as digits of a longer number."""
    content = content.encode() if isinstance(content, str) else content

    def stands(word: str) -> bool:
        alone = rb"(?<![\d.])%s(?!\d)" if word.isdigit() else b"%s"
        return re.search(alone % re.escape(word.encode()), content) is not None

    return [word for word in words if stands(word)]


def sphere_voxels(shape_kji: tuple[int, int, int] = (17, 25, 31)) -> NDArray[np.int16]:
    """A sphere in the middle, its edge blurred over one voxel like a partial volume."""
    index = np.indices(shape_kji, dtype=np.float64)
    centre = (np.array(shape_kji) - 1) / 2
    offsets = [(index[axis] - centre[axis]) * step for axis, step in enumerate(SPACING[::-1])]
    depth = RADIUS_MM - np.sqrt(sum(offset**2 for offset in offsets))
    share = np.clip(depth + 0.5, 0.0, 1.0)
    return np.round(OUTSIDE_HU + share * (INSIDE_HU - OUTSIDE_HU)).astype(np.int16)


def write_series(
    folder: Path, voxels: NDArray[np.int16] | None = None, *, number: int = 1, modality: str = "CT"
) -> Path:
    """Write one file a slice into `folder`; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    voxels = sphere_voxels() if voxels is None else voxels
    for k, pixels in enumerate(voxels):
        dataset = _slice(pixels, k, number, modality)
        dataset.save_as(folder / f"s{number}_{k:03d}.dcm", enforce_file_format=True)
    return folder


def _slice(pixels: NDArray[np.int16], k: int, number: int, modality: str) -> Dataset:
    storage = MRImageStorage if modality == "MR" else CTImageStorage
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = storage
    meta.MediaStorageSOPInstanceUID = f"1.2.826.0.1.47114711.{number}.{k + 1}"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset = Dataset()
    dataset.file_meta = meta
    dataset.SOPClassUID, dataset.SOPInstanceUID = storage, meta.MediaStorageSOPInstanceUID
    dataset.PatientName, dataset.PatientID, dataset.PatientBirthDate = PATIENT, "ID-471147114711", "19500102"
    dataset.StudyInstanceUID, dataset.SeriesInstanceUID = "1.2.826.0.1.47114711", f"1.2.826.0.1.47114711.{number}"
    dataset.FrameOfReferenceUID = "1.2.826.0.2"
    dataset.SeriesNumber, dataset.InstanceNumber, dataset.Modality = number, k + 1, modality
    dataset.SeriesDescription = f"{number}: scan of Jolanthe"
    dataset.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
    dataset.Rows, dataset.Columns = pixels.shape
    dataset.PixelSpacing = [SPACING[1], SPACING[0]]
    dataset.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    dataset.ImagePositionPatient = [ORIGIN[0], ORIGIN[1], ORIGIN[2] + k * SPACING[2]]
    dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit, dataset.PixelRepresentation = 16, 16, 15, 1
    dataset.RescaleSlope, dataset.RescaleIntercept, dataset.RescaleType = 1, 0, "HU"
    dataset.PixelData = pixels.astype("<i2").tobytes()
    return dataset
