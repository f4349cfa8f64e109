"""Enhanced multi-frame CT files with known geometry and HU, written with pydicom, and spoiled as a test wants."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_series import ROOT, Plan, make_dataset, save_dataset
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate, encapsulate_extended
from pydicom.uid import EnhancedCTImageStorage, ExplicitVRBigEndian
from tolerances import AFFINE_MM

from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.reading import read_volume

FileChange = Callable[[Dataset], None]
SHARED = ("PlaneOrientationSequence", "PixelMeasuresSequence", "CTImageFrameTypeSequence")
TOP_LEVEL_OF_SLICES = (
    "ImageOrientationPatient ImagePositionPatient PixelSpacing SliceThickness RescaleSlope RescaleIntercept RescaleType"
).split()


def item(**values: Any) -> Dataset:
    """An item of a sequence with these elements."""
    ds = Dataset()
    for keyword, value in values.items():
        setattr(ds, keyword, value)
    return ds


def make_enhanced(
    plan: Plan, order: Sequence[int] | None = None, *, shared: Iterable[str] = SHARED, slopes: Sequence[float] = ()
) -> Dataset:
    """One enhanced file of the slices `order` (in this order in the file), from the classic ones of `plan`.

    `shared` names the macros that go into the shared groups, `slopes` gives slice k a slope of its own.
    """
    order = range(plan.shape[0]) if order is None else order
    ds = make_dataset(plan, order[0])
    ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = EnhancedCTImageStorage
    ds.ImageType = ["ORIGINAL", "PRIMARY", "VOLUME", "NONE"]
    ds.NumberOfFrames = len(order)
    orientation, spacing = ds.ImageOrientationPatient, ds.PixelSpacing
    for keyword in TOP_LEVEL_OF_SLICES:
        delattr(ds, keyword)
    ds.DimensionIndexSequence = [item(DimensionIndexPointer=0x00200032, FunctionalGroupPointer=0x00209113)]
    ds.SharedFunctionalGroupsSequence = [Dataset()]
    ds.PerFrameFunctionalGroupsSequence = [Dataset() for _ in order]
    stored = []
    for number, k in enumerate(order):
        position = [round(float(v), plan.decimals) for v in plan.position(k)]
        slope = slopes[k] if slopes else plan.slope
        macros = {
            "PlanePositionSequence": item(ImagePositionPatient=position),
            "PlaneOrientationSequence": item(ImageOrientationPatient=list(orientation)),
            "PixelMeasuresSequence": item(PixelSpacing=list(spacing), SliceThickness=5),
            "PixelValueTransformationSequence": item(
                RescaleSlope=slope, RescaleIntercept=plan.intercept, RescaleType="HU"
            ),
            "CTImageFrameTypeSequence": item(
                FrameType=["ORIGINAL", "PRIMARY", "VOLUME", "NONE"],
                PixelPresentation="MONOCHROME",
                VolumetricProperties="VOLUME",
                VolumeBasedCalculationTechnique="NONE",
            ),
            "FrameContentSequence": item(
                StackID="1", InStackPositionNumber=number + 1, DimensionIndexValues=[number + 1]
            ),
        }
        for keyword, macro in macros.items():
            groups = ds.SharedFunctionalGroupsSequence if keyword in shared else ds.PerFrameFunctionalGroupsSequence
            setattr(groups[0 if keyword in shared else number], keyword, [macro])
        stored.append(plan.stored(k))
    pixels = np.stack(stored)
    ds.PixelData = (pixels.byteswap() if plan.syntax == ExplicitVRBigEndian else pixels).tobytes()
    return ds


def write_enhanced(path: Path, plan: Plan | None = None, change: FileChange | None = None, **how: Any) -> Plan:
    """Write one enhanced file; `how` goes to `make_enhanced`."""
    plan = plan or Plan()
    ds = make_enhanced(plan, **how)
    if change is not None:
        change(ds)
    save_dataset(ds, path)
    return plan


def frame_groups(ds: Dataset, number: int) -> Dataset:
    """The groups of one frame, from 0."""
    return ds.PerFrameFunctionalGroupsSequence[number]


def make_concatenation(plan: Plan, parts: Sequence[Sequence[int]], *, say_total: bool = True) -> list[Dataset]:
    """The slices `parts[n]` in part n of one concatenation."""
    found, offset = [], 0
    for number, order in enumerate(parts, start=1):
        ds = make_enhanced(plan, order)
        ds.SOPInstanceUID = ds.file_meta.MediaStorageSOPInstanceUID = f"{ROOT}.77.{number}"
        ds.ConcatenationUID = f"{ROOT}.77"
        ds.InConcatenationNumber = number
        if say_total:
            ds.InConcatenationTotalNumber = len(parts)
        ds.ConcatenationFrameOffsetNumber = offset
        offset += len(order)
        found.append(ds)
    return found


def compress(ds: Dataset, syntax: str, *, table: str = "basic", fragments: int = 1) -> None:
    """Compress the frames; `table` is "basic", "extended" or "none", `fragments` the parts of each frame."""
    from pydicom.pixels import get_encoder

    encoder = get_encoder(syntax)
    options = {
        "rows": ds.Rows,
        "columns": ds.Columns,
        "samples_per_pixel": 1,
        "bits_allocated": ds.BitsAllocated,
        "bits_stored": ds.BitsStored,
        "pixel_representation": ds.PixelRepresentation,
        "photometric_interpretation": ds.PhotometricInterpretation,
        "number_of_frames": 1,
    }
    size = ds.Rows * ds.Columns * ds.BitsAllocated // 8
    frames = [encoder.encode(ds.PixelData[n * size : (n + 1) * size], **options) for n in range(int(ds.NumberOfFrames))]
    if table == "extended":
        ds.PixelData, ds.ExtendedOffsetTable, ds.ExtendedOffsetTableLengths = encapsulate_extended(frames)
    else:
        ds.PixelData = encapsulate(frames, fragments_per_frame=fragments, has_bot=table == "basic")
    ds["PixelData"].is_undefined_length = True
    ds["PixelData"].VR = "OB"
    ds.file_meta.TransferSyntaxUID = syntax


def real_world(slope: float, intercept: float, code: str = "[hnsf'U]") -> Dataset:
    """A mapping of stored values to the unit `code`, Hounsfield by default."""
    return item(
        RealWorldValueSlope=slope,
        RealWorldValueIntercept=intercept,
        MeasurementUnitsCodeSequence=[item(CodeValue=code, CodingSchemeDesignator="UCUM", CodeMeaning="unit")],
    )


def without_rescale(mappings: list[Dataset], *, kind: str | None = None) -> FileChange:
    """A change to real world values: in place of the rescale, or beside one of another type."""

    def change(ds: Dataset) -> None:
        for groups in ds.PerFrameFunctionalGroupsSequence:
            if kind is None:
                del groups.PixelValueTransformationSequence
            else:
                groups.PixelValueTransformationSequence[0].RescaleType = kind
            groups.RealWorldValueMappingSequence = mappings

    return change


def assert_right(volume: Volume, plan: Plan, *, hu: np.ndarray | None = None) -> None:
    """Every voxel is where `plan` wrote it, and has its value."""
    nk, nj, ni = plan.shape
    corners = np.array([(i, j, k) for i in (0, ni - 1) for j in (0, nj - 1) for k in range(nk)])
    assert np.abs(volume.ijk_to_lps(corners) - plan.truth(corners)).max() < AFFINE_MM
    assert np.array_equal(volume.voxels, plan.hu() if hu is None else hu)


def refusal(path: Path) -> str:
    """What `read_volume` says against it."""
    with pytest.raises(RefusedInputError) as caught:
        read_volume(path)
    return str(caught.value)
