"""Large trees of small CT files, made fast: a folder per series; every file has its own position and identifiers."""

from __future__ import annotations

import io
from pathlib import Path

_SERIES, _SLICE = 77_777_777, 55_555_555
"""Numbers in the template that are replaced in every file; eight digits each, so that no length changes."""
GAP_MM = 1.5


def _make_template() -> bytes:
    import numpy as np
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian

    root = "1.2.826.0.1.3680043.10.1"
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.SOPClassUID = CTImageStorage
    ds.SOPInstanceUID = f"{root}.{_SERIES}.{_SLICE}"
    ds.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
    ds.StudyDate = ds.SeriesDate = ds.AcquisitionDate = ds.ContentDate = "20200101"
    ds.AcquisitionTime = ds.ContentTime = "120000"
    ds.Modality, ds.Manufacturer, ds.SeriesDescription = "CT", "clrecon", f"series {_SERIES}"
    ds.PatientID, ds.PatientName = f"{_SERIES}", "Nobody"
    ds.KVP, ds.SliceThickness, ds.ConvolutionKernel = "120", "2", "B30f"
    ds.StudyInstanceUID, ds.SeriesInstanceUID = f"{root}.1.{_SERIES}", f"{root}.2.{_SERIES}"
    ds.FrameOfReferenceUID = f"{root}.3.{_SERIES}"
    ds.SeriesNumber, ds.AcquisitionNumber, ds.InstanceNumber = f"{_SERIES}", "1", f"{_SLICE}"
    ds.ImagePositionPatient, ds.ImageOrientationPatient = ["-100", "-100", f"{_SLICE}"], [1, 0, 0, 0, 1, 0]
    ds.SliceLocation, ds.PixelSpacing = f"{_SLICE}", [0.7, 0.7]
    ds.SamplesPerPixel, ds.PhotometricInterpretation = 1, "MONOCHROME2"
    ds.Rows = ds.Columns = 8
    ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.PixelRepresentation = 16, 12, 11, 0
    ds.RescaleIntercept, ds.RescaleSlope, ds.RescaleType = "-1024", "1", "HU"
    ds.PixelData = np.arange(64, dtype=np.uint16).tobytes()
    file = io.BytesIO()
    ds.save_as(file, enforce_file_format=True)
    return file.getvalue()


def write_tree(folder: Path, series: int, slices: int) -> int:
    """Write `series` folders of `slices` files each; returns the number of files."""
    template = _make_template()
    for number in range(series):
        own = template.replace(b"%d" % _SERIES, b"%08d" % (10_000_000 + number))
        place = folder / f"{number // 100:04d}" / f"{number:08d}"
        place.mkdir(parents=True)
        for k in range(slices):
            # The digits stand for UIDs, a number and positions in mm.
            data = own.replace(b"%d" % _SLICE, b"%08d" % (10_000_000 + k))
            data = data.replace(b"-100\\-100\\%08d" % (10_000_000 + k), b"-100\\-100\\%08.2f" % (k * GAP_MM))
            (place / f"{k:05d}").write_bytes(data)
    return series * slices
