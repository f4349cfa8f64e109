"""Meshes for an archive: Encapsulated STL, which names the patient and the study of the scan, and its slices.

Source: DICOM PS3.3 A.85.1 (Encapsulated STL), C.24.2 (encapsulated document), C.35.1 (manufacturing 3D model), CID 7061
(title), 7063 (unit), 7064 (usage).
"""

from __future__ import annotations

import hashlib
import os
from datetime import datetime
from io import BytesIO
from typing import Any, NamedTuple

from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.reading.common.selection import Selection
from clrecon.reading.dicom.reader import list_slices

_MODEL_CLASS = "1.2.840.10008.5.1.4.1.1.104.3"
ROOT = "2.25."
IMPLEMENTATION = f"{ROOT}226127114137317107413166301416404110851"
_UIDS = ("StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID", "SOPClassUID", "SOPInstanceUID")
_PATIENT = ("PatientName", "PatientID", "PatientBirthDate", "PatientSex")
_STUDY = ("StudyDate", "StudyTime", "StudyID", "AccessionNumber", "ReferringPhysicianName")
_MORE = ("IssuerOfPatientID", "StudyDescription", "SpecificCharacterSet")
_SERIES_NUMBER = 400
_MOST_BYTES = (1 << 32) - 2


class Origin(NamedTuple):
    """Where a result comes from: a header of the scan with the patient, and the UIDs of its slices with their class."""

    header: Any
    instances: dict[str, str]


def read_origin(path: str | os.PathLike[str], selection: Selection) -> Origin:
    """Read who and what a scan is, of the slices that a selection names; other formats than DICOM do not say it."""
    from pydicom import dcmread

    try:
        slices = list_slices(path, selection)
    except NoDicomError:
        raise UsageError("an archive stores what belongs to a scan in DICOM, and this input is none") from None
    tags = [*_UIDS, *_PATIENT, *_STUDY, *_MORE]
    files = {file: None for file, _, _ in slices}
    headers = [dcmread(file, stop_before_pixels=True, specific_tags=tags, force=True) for file in files]
    missing = [keyword for keyword in _UIDS if not all(header.get(keyword) for header in headers)]
    if missing:
        raise RefusedInputError(f"the scan has no {missing[0]}, by which an archive knows what belongs to it")
    return Origin(headers[0], {str(header.SOPInstanceUID): str(header.SOPClassUID) for header in headers})


def encode_model(stl: bytes, origin: Origin, title: str, *, is_modified: bool) -> tuple[str, bytes]:
    """Return the UID, the same for the same mesh of a scan, and the bytes of an Encapsulated STL."""
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian

    if len(stl) > _MOST_BYTES:
        raise RefusedInputError(f"a mesh of {len(stl):,} bytes is too large for DICOM: {_MOST_BYTES:,} fit")
    digest = hashlib.sha256(stl + str(origin.header.SeriesInstanceUID).encode()).hexdigest()
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.TransferSyntaxUID = _MODEL_CLASS, ExplicitVRLittleEndian
    meta.MediaStorageSOPInstanceUID = _make_uid(digest, "instance")
    meta.ImplementationClassUID = IMPLEMENTATION
    model = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    model.SOPClassUID, model.SOPInstanceUID = _MODEL_CLASS, meta.MediaStorageSOPInstanceUID
    _describe_origin(model, origin)
    model.Modality, model.SeriesInstanceUID = "M3D", _make_uid(digest, "series")
    model.SeriesNumber, model.InstanceNumber = _SERIES_NUMBER, 1
    model.Manufacturer = model.ManufacturerModelName = "clrecon"
    model.DeviceSerialNumber, model.SoftwareVersions = "0", "clrecon"
    now = datetime.now()
    model.ContentDate, model.ContentTime = now.strftime("%Y%m%d"), now.strftime("%H%M%S")
    model.AcquisitionDateTime = ""
    model.BurnedInAnnotation, model.RecognizableVisualFeatures = "NO", "YES"  # the skin may show a face
    model.DocumentTitle = model.SeriesDescription = title[:64]
    model.ConceptNameCodeSequence = [_code("85040-4", "CT 3D CAM model", "LN")]
    model.MeasurementUnitsCodeSequence = [_code("mm", "mm", "UCUM")]
    model.ModelModification, model.ModelMirroring = "YES" if is_modified else "NO", "NO"
    model.ModelUsageCodeSequence = [_code("129012", "Educational Intent", "DCM")]
    model.MIMETypeOfEncapsulatedDocument = "model/stl"
    model.EncapsulatedDocumentLength = len(stl)
    model.EncapsulatedDocument = stl + bytes(len(stl) % 2)
    stream = BytesIO()
    model.save_as(stream, enforce_file_format=True)
    return str(model.SOPInstanceUID), stream.getvalue()


def copy_patient(target: Any, origin: Origin) -> None:
    for keyword in (*_PATIENT, *_STUDY):
        setattr(target, keyword, origin.header.get(keyword, ""))
    for keyword in _MORE:
        if keyword in origin.header:
            setattr(target, keyword, origin.header.get(keyword))


def _describe_origin(model: Any, origin: Origin) -> None:
    """Copy patient, study and frame of reference, and refer to the slices."""
    copy_patient(model, origin)
    model.StudyInstanceUID = origin.header.StudyInstanceUID
    model.FrameOfReferenceUID = origin.header.FrameOfReferenceUID
    model.PositionReferenceIndicator = ""
    sources = [
        make_item(ReferencedSOPClassUID=kind, ReferencedSOPInstanceUID=uid) for uid, kind in origin.instances.items()
    ]
    series = make_item(SeriesInstanceUID=origin.header.SeriesInstanceUID, ReferencedInstanceSequence=sources)
    model.ReferencedSeriesSequence = [series]
    purpose = _code("121324", "Source image", "DCM")
    model.SourceInstanceSequence = [
        make_item(**{own.keyword: own.value for own in source}, PurposeOfReferenceCodeSequence=[purpose])
        for source in sources
    ]


def _make_uid(digest: str, role: str) -> str:
    return ROOT + str(int(hashlib.sha256(f"{digest}{role}".encode()).hexdigest()[:32], 16))


def make_item(**values: Any) -> Any:
    from pydicom import Dataset

    item = Dataset()
    for keyword, value in values.items():
        setattr(item, keyword, value)
    return item


def _code(value: str, meaning: str, scheme: str) -> Any:
    return make_item(CodeValue=value, CodingSchemeDesignator=scheme, CodeMeaning=meaning)
