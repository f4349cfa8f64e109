"""RT structure sets to test with, written with pydicom alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence as Items
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

STRUCTURE_SET = "1.2.840.10008.5.1.4.1.1.481.3"
Contours = Sequence[tuple[str, np.ndarray]]
"""Geometric type and points (n, 3), LPS mm, of each contour."""


def write_structures(
    path: Path,
    rois: Mapping[str, Contours],
    *,
    frame: str = "",
    numbers: Sequence[int] | None = None,
    sop_class: str = STRUCTURE_SET,
    syntax: str = ExplicitVRLittleEndian,
    counts: bool = True,
) -> Path:
    """Write ROIs by their names; `numbers` are 1, 2, ... by default."""
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.MediaStorageSOPClassUID = ds.SOPClassUID = sop_class
    ds.file_meta.MediaStorageSOPInstanceUID = ds.SOPInstanceUID = generate_uid(entropy_srcs=[path.name])
    ds.file_meta.TransferSyntaxUID = syntax
    ds.SpecificCharacterSet = "ISO_IR 192"
    ds.Modality = "RTSTRUCT"
    ds.PatientName = "Doe^Jane"
    ds.StructureSetROISequence, ds.ROIContourSequence = Items(), Items()
    for number, (name, contours) in zip(numbers or range(1, len(rois) + 1), rois.items(), strict=True):
        roi = Dataset()
        roi.ROINumber, roi.ROIName = number, name
        if frame:
            roi.ReferencedFrameOfReferenceUID = frame
        ds.StructureSetROISequence.append(roi)
        own = Dataset()
        own.ReferencedROINumber = number
        own.ContourSequence = Items()
        for kind, points in contours:
            item = Dataset()
            item.ContourGeometricType = kind
            if counts:
                item.NumberOfContourPoints = len(points)
            item.ContourData = [f"{value:.6f}"[:16] for value in np.asarray(points).ravel()]
            own.ContourSequence.append(item)
        ds.ROIContourSequence.append(own)
    ds.save_as(path, enforce_file_format=True)
    return path
