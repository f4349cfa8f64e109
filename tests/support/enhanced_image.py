"""A `Plan` as one Enhanced CT image: geometry and rescale stand in the functional groups of the frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dicom_series import ROOT, Plan, make_dataset, save_dataset
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence as Items
from pydicom.tag import Tag
from pydicom.uid import EnhancedCTImageStorage

MOVED = (
    "ImagePositionPatient ImageOrientationPatient PixelSpacing SliceThickness RescaleSlope RescaleIntercept RescaleType"
).split()


def _item(**values: object) -> Items:
    ds = Dataset()
    for keyword, value in values.items():
        setattr(ds, keyword, value)
    return Items([ds])


def make_enhanced(plan: Plan, *, order: Sequence[int] | None = None, slopes: Sequence[int] = (1,)) -> Dataset:
    """Frames in `order` (of k along the normal); slope of slice k is ``slopes[k % len(slopes)]``."""
    order = range(plan.shape[0]) if order is None else order
    frames = [make_dataset(plan, k) for k in order]
    ds = make_dataset(plan, 0)
    for keyword in MOVED:
        delattr(ds, keyword)
    ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = EnhancedCTImageStorage
    ds.ImageType = ["ORIGINAL", "PRIMARY", "VOLUME", "NONE"]
    ds.StudyInstanceUID, ds.StudyID, ds.AccessionNumber = f"{ROOT}.77", "1", "1"
    ds.StudyDate = ds.ContentDate = "20200101"
    ds.StudyTime = ds.ContentTime = "120000"
    ds.AcquisitionDateTime, ds.InstanceNumber, ds.Manufacturer = "20200101120000", 1, "PHANTOM"
    ds.PatientPosition, ds.NumberOfFrames = "HFS", len(frames)
    ds.PixelPresentation, ds.VolumetricProperties, ds.VolumeBasedCalculationTechnique = "MONOCHROME", "VOLUME", "NONE"
    ds.BurnedInAnnotation, ds.LossyImageCompression, ds.PresentationLUTShape = "NO", "00", "IDENTITY"
    ds.DimensionOrganizationSequence = _item(DimensionOrganizationUID=f"{ROOT}.55")
    ds.DimensionIndexSequence = _item(
        DimensionOrganizationUID=f"{ROOT}.55",
        DimensionIndexPointer=Tag(0x00209057),  # In-Stack Position Number
        FunctionalGroupPointer=Tag(0x00209111),  # Frame Content Sequence
    )
    shared = Dataset()
    spacing = [float(length) for length in plan.pixel_spacing]
    shared.PixelMeasuresSequence = _item(PixelSpacing=spacing, SliceThickness=plan.gap)
    shared.PlaneOrientationSequence = _item(ImageOrientationPatient=frames[0].ImageOrientationPatient)
    ds.SharedFunctionalGroupsSequence = Items([shared])
    groups = []
    for k, frame in zip(order, frames, strict=True):
        group = Dataset()
        group.FrameContentSequence = _item(
            StackID="1", InStackPositionNumber=k + 1, DimensionIndexValues=[k + 1], FrameAcquisitionNumber=1
        )
        group.PlanePositionSequence = _item(ImagePositionPatient=frame.ImagePositionPatient)
        group.CTImageFrameTypeSequence = _item(FrameType=["ORIGINAL", "PRIMARY", "VOLUME", "NONE"])
        group.PixelValueTransformationSequence = _item(
            RescaleSlope=slopes[k % len(slopes)], RescaleIntercept=plan.intercept, RescaleType="HU"
        )
        groups.append(group)
    ds.PerFrameFunctionalGroupsSequence = Items(groups)
    ds.PixelData = b"".join(plan.stored(k).tobytes() for k in order)
    return ds


def save_enhanced(
    path: Path, plan: Plan, *, order: Sequence[int] | None = None, slopes: Sequence[int] | None = None
) -> None:
    """Write one enhanced image of a plan; see `make_enhanced`."""
    save_dataset(make_enhanced(plan, order=order, slopes=slopes or tuple(getattr(plan, "slopes", (1,)))), path)
