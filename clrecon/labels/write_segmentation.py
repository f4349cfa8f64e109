"""Label maps as DICOM SEG: binary segments that reference the slices of their scan, for 3D Slicer and archives.

A SEG belongs to the study and the frame of reference of its scan, so it holds their UIDs and those of the slices.  It
holds no name, identifier or date of the patient, unless it is made for an archive: those elements are empty, and dates
that must be there are 1970.

Source: DICOM PS3.3 A.51 and C.8.20 (Segmentation), C.7.6.16 (multi-frame functional groups), CID 7150 (categories).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import RefusedInputError
from clrecon.labels.label_map import LabelMap
from clrecon.reading.dicom.storing import IMPLEMENTATION, ROOT, Origin, copy_patient, make_item
from clrecon.version import package_version

SourceSlice = tuple[Path, int, int]
"""File of a slice of the scan, its frame there from 0, and how many frames the file has."""

_SEGMENTATION_CLASS = "1.2.840.10008.5.1.4.1.1.66.4"
_KEPT = ("StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID", "SOPClassUID", "SOPInstanceUID")
_DATE, _TIME = "19700101", "000000"


def encode_segmentation(labels: LabelMap, slices: Sequence[SourceSlice], *, label: str = "VERTEBRAE") -> bytes:
    """Return the bytes of the file; the same labels, on the grid of the scan, and slices give the same bytes.

    `label` is the content label: upper case letters, digits and underscores, at most 16.
    """
    return _write_bytes(_make_segmentation(labels, slices, label, None))


def encode_identified(labels: LabelMap, slices: Sequence[SourceSlice], origin: Origin) -> tuple[str, bytes]:
    """Return the UID and the bytes of a SEG for an archive, which names the patient and the study."""
    seg = _make_segmentation(labels, slices, "VERTEBRAE", origin)
    return str(seg.SOPInstanceUID), _write_bytes(seg)


def _write_bytes(seg: Any) -> bytes:
    stream = BytesIO()
    seg.save_as(stream, enforce_file_format=True)
    return stream.getvalue()


def _make_segmentation(labels: LabelMap, slices: Sequence[SourceSlice], label: str, origin: Origin | None) -> Any:
    from pydicom.sequence import Sequence as Items

    sources = _read_sources(slices)
    nk, rows, columns = labels.voxels.shape
    if len(sources) != nk:
        raise RefusedInputError(f"the label map has {nk} slices and the scan {len(sources)}: they are not one grid")
    first = sources[0][0]
    numbers = labels.numbers
    frames = [(number, k) for number in numbers for k in range(nk) if (labels.voxels[k] == number).any()]
    digest = hashlib.sha256(labels.voxels.tobytes() + first["SeriesInstanceUID"].encode() + repr(labels.names).encode())
    if origin is not None:  # the file without a patient is another
        digest.update(str(origin.header.get("PatientID", "")).encode() + b"stored")

    def make_uid(role: str) -> str:
        return ROOT + str(int.from_bytes(hashlib.sha256(digest.digest() + role.encode()).digest()[:16], "big"))

    seg = _describe_series(make_uid, first)
    if origin is not None:
        copy_patient(seg, origin)
    seg.ContentLabel = label
    seg.Rows, seg.Columns = rows, columns
    seg.NumberOfFrames = len(frames)
    seg.SegmentSequence = Items([_segment(number, labels.name(number)) for number in numbers])
    seg.ReferencedSeriesSequence = Items([_references(sources)])
    organization = make_uid("dimensions")
    seg.DimensionOrganizationSequence = Items([make_item(DimensionOrganizationUID=organization)])
    seg.DimensionIndexSequence = Items(_dimensions(organization))
    seg.SharedFunctionalGroupsSequence = Items([_shared(labels)])
    seg.PerFrameFunctionalGroupsSequence = Items([_frame(labels, numbers, number, k, sources) for number, k in frames])
    bits = np.concatenate([(labels.voxels[k] == number).ravel() for number, k in frames])
    packed = np.packbits(bits, bitorder="little").tobytes()
    seg.PixelData = packed + b"\0" * (len(packed) % 2)
    seg["PixelData"].VR = "OB"
    return seg


def _describe_series(make_uid: Callable[[str], str], first: dict[str, str]) -> Any:
    """Return the elements that do not depend on the labels; `first` has the UIDs of a slice of the scan."""
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = _SEGMENTATION_CLASS, make_uid("instance")
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.ImplementationClassUID = IMPLEMENTATION
    seg = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
    seg.SOPClassUID, seg.SOPInstanceUID = _SEGMENTATION_CLASS, meta.MediaStorageSOPInstanceUID
    for empty in ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "StudyID"):
        setattr(seg, empty, "")
    seg.AccessionNumber = seg.ReferringPhysicianName = seg.PositionReferenceIndicator = ""
    seg.StudyInstanceUID, seg.FrameOfReferenceUID = first["StudyInstanceUID"], first["FrameOfReferenceUID"]
    seg.SeriesInstanceUID = make_uid("series")
    seg.SeriesNumber, seg.InstanceNumber = "300", "1"
    seg.SeriesDescription, seg.Modality = "vertebrae, first guess", "SEG"
    seg.Manufacturer, seg.ManufacturerModelName = "clrecon", "clrecon"
    seg.DeviceSerialNumber, seg.SoftwareVersions = "0", package_version()
    seg.ContentDate = seg.SeriesDate = _DATE
    seg.ContentTime = seg.SeriesTime = _TIME
    seg.ContentDescription = seg.ContentCreatorName = ""
    seg.ImageType = ["DERIVED", "PRIMARY"]
    seg.SamplesPerPixel = 1
    seg.PhotometricInterpretation = "MONOCHROME2"
    seg.PixelRepresentation = 0
    seg.BitsAllocated = seg.BitsStored = 1
    seg.HighBit = 0
    seg.LossyImageCompression, seg.SegmentationType = "00", "BINARY"
    seg.SegmentsOverlap = "NO"
    return seg


def _dimensions(organization: str) -> list[Any]:
    """Return the order of the frames: by segment, then by place."""
    return [
        make_item(
            DimensionOrganizationUID=organization,
            DimensionIndexPointer=pointer,
            FunctionalGroupPointer=group,
            DimensionDescriptionLabel=name,
        )
        for pointer, group, name in (
            (0x0062000B, 0x0062000A, "Segment Number"),
            (0x00200032, 0x00209113, "Image Position Patient"),
        )
    ]


def _read_sources(slices: Sequence[SourceSlice]) -> list[tuple[dict[str, str], int, int]]:
    """Return the UIDs of each slice's file, its frame and the number of frames."""
    from pydicom import dcmread

    known: dict[Path, dict[str, str]] = {}
    for path, _, _ in slices:
        if path not in known:
            header = dcmread(path, stop_before_pixels=True, specific_tags=list(_KEPT), force=True)
            known[path] = {keyword: str(header.get(keyword, "")) for keyword in _KEPT}
            missing = [keyword for keyword, uid in known[path].items() if not uid]
            if missing:
                raise RefusedInputError(
                    f"the scan has no {missing[0]}, which a DICOM SEG has to name: write the label map as .nii.gz"
                )
    return [(known[path], frame, frames) for path, frame, frames in slices]


def _code(value: str, meaning: str, scheme: str = "SCT") -> list[Any]:
    return [make_item(CodeValue=value, CodingSchemeDesignator=scheme, CodeMeaning=meaning)]


def _segment(number: int, name: str) -> Any:
    return make_item(
        SegmentNumber=number,
        SegmentLabel=name[:64],
        SegmentAlgorithmType="AUTOMATIC",
        SegmentAlgorithmName="clrecon vertebrae",
        SegmentedPropertyCategoryCodeSequence=_code("123037004", "Anatomical Structure"),
        SegmentedPropertyTypeCodeSequence=_code("51282000", "Vertebra"),
    )


def _references(sources: Sequence[tuple[dict[str, str], int, int]]) -> Any:
    files = {uids["SOPInstanceUID"]: uids["SOPClassUID"] for uids, _, _ in sources}
    return make_item(
        SeriesInstanceUID=sources[0][0]["SeriesInstanceUID"],
        ReferencedInstanceSequence=[
            make_item(ReferencedSOPClassUID=kind, ReferencedSOPInstanceUID=uid) for uid, kind in files.items()
        ],
    )


def _decimals(values: Any) -> list[Any]:
    from pydicom.valuerep import DSfloat

    return [DSfloat(float(value), auto_format=True) for value in values]


def _shared(labels: LabelMap) -> Any:
    di, dj, _ = labels.spacing
    row, column = labels.affine[:3, 0] / di, labels.affine[:3, 1] / dj
    gap = _decimals([abs(float(np.cross(row, column) @ labels.affine[:3, 2]))])[0]
    measures = make_item(PixelSpacing=_decimals((dj, di)), SliceThickness=gap, SpacingBetweenSlices=gap)
    return make_item(
        PixelMeasuresSequence=[measures],
        PlaneOrientationSequence=[make_item(ImageOrientationPatient=_decimals([*row, *column]))],
    )


def _frame(
    labels: LabelMap, numbers: Sequence[int], number: int, k: int, sources: Sequence[tuple[dict[str, str], int, int]]
) -> Any:
    uids, frame, frames = sources[k]
    source = make_item(ReferencedSOPClassUID=uids["SOPClassUID"], ReferencedSOPInstanceUID=uids["SOPInstanceUID"])
    source.SpatialLocationsPreserved = "YES"
    if frames > 1:
        source.ReferencedFrameNumber = frame + 1
    source.PurposeOfReferenceCodeSequence = _code("121322", "Source image for image processing operation", "DCM")
    derivation = make_item(SourceImageSequence=[source], DerivationCodeSequence=_code("113076", "Segmentation", "DCM"))
    return make_item(
        FrameContentSequence=[make_item(DimensionIndexValues=[list(numbers).index(number) + 1, k + 1])],
        PlanePositionSequence=[make_item(ImagePositionPatient=_decimals(labels.ijk_to_lps([(0, 0, k)])[0]))],
        SegmentIdentificationSequence=[make_item(ReferencedSegmentNumber=number)],
        DerivationImageSequence=[derivation],
    )
