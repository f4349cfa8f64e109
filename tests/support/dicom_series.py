"""Small DICOM series whose geometry and HU are known, written with pydicom alone, and then spoiled as a test wants."""

from __future__ import annotations

import copy
import hashlib
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from pydicom.dataelem import DataElement
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.filebase import DicomBytesIO
from pydicom.filewriter import write_data_element
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, ImplicitVRLittleEndian

ROOT = "1.2.826.0.1.3680043.10.1"
Change = Callable[[Dataset, int], None]


def rotation(degrees: Sequence[float]) -> np.ndarray:
    """Rotation about x, then y, then z."""
    a, b, c = np.radians(degrees)
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return z @ y @ x


@dataclass
class Plan:
    """What to write: `shape` (n, rows, columns); spacing (dj, di) as PixelSpacing has it; step along the normal in mm.

    ``truth(i, j, k)`` is in the order of ascending position along the normal, whatever order the files are in.
    """

    shape: tuple[int, int, int] = (7, 5, 6)
    pixel_spacing: tuple[float, float] = (0.7, 0.5)
    gap: float = 1.25
    tilt_deg: float = 0.0
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    origin: tuple[float, float, float] = (-12.5, 31.25, -400.0)
    offsets: dict[int, float] = field(default_factory=dict)
    leave_out: tuple[int, ...] = ()
    name: Callable[[int], str] = "slice{:03d}.dcm".format
    series: int = 1
    syntax: str = ExplicitVRLittleEndian
    decimals: int = 9
    intercept: int = -1024
    slope: int = 1
    bits_stored: int = 16
    signed: bool = True

    @property
    def directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        turned = rotation(self.angles)
        return turned[:, 0], turned[:, 1], turned[:, 2]

    def position(self, k: int) -> np.ndarray:
        _, column, normal = self.directions
        along = k * self.gap + self.offsets.get(k, 0.0)
        return np.asarray(self.origin) + along * normal + along * np.tan(np.radians(self.tilt_deg)) * column

    def truth(self, ijk: np.ndarray) -> np.ndarray:
        """LPS mm of voxel indices (n, 3), for stacks without `leave_out`."""
        row, column, _ = self.directions
        dj, di = self.pixel_spacing
        return np.array([self.position(k) + i * di * row + j * dj * column for i, j, k in ijk])

    def stored(self, k: int) -> np.ndarray:
        """Stored values of slice k; every voxel of the volume has its own."""
        _, rows, columns = self.shape
        return (900 + 40 * k + np.arange(rows * columns).reshape(rows, columns)).astype("i2" if self.signed else "u2")

    def hu(self) -> np.ndarray:
        return np.stack([self.stored(k).astype(float) * self.slope + self.intercept for k in range(self.shape[0])])


def make_dataset(plan: Plan, k: int) -> Dataset:
    """Slice k of a plan."""
    row, column, _ = plan.directions
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.TransferSyntaxUID = plan.syntax
    ds.file_meta.MediaStorageSOPClassUID = CTImageStorage
    ds.file_meta.MediaStorageSOPInstanceUID = f"{ROOT}.{plan.series}.{k + 1}"
    ds.SOPClassUID = CTImageStorage
    ds.SOPInstanceUID = f"{ROOT}.{plan.series}.{k + 1}"
    ds.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
    ds.Modality = "CT"
    ds.SeriesDescription = f"series {plan.series}"
    ds.PatientName = "SECRET^NAME"
    ds.PatientID = "SECRETID"
    ds.SeriesInstanceUID = f"{ROOT}.{plan.series}"
    ds.SeriesNumber = plan.series
    ds.InstanceNumber = 1000 - 3 * k  # lies on purpose
    ds.FrameOfReferenceUID = f"{ROOT}.99.{plan.series}"
    ds.ImageOrientationPatient = [round(float(v), plan.decimals) for v in (*row, *column)]
    ds.ImagePositionPatient = [round(float(v), plan.decimals) for v in plan.position(k)]
    ds.PixelSpacing = list(plan.pixel_spacing)
    ds.SliceThickness = 5
    ds.RescaleSlope = plan.slope
    ds.RescaleIntercept = plan.intercept
    ds.RescaleType = "HU"
    ds.SamplesPerPixel = 1
    ds.PhotometricInterpretation = "MONOCHROME2"
    _, ds.Rows, ds.Columns = plan.shape
    ds.BitsAllocated, ds.BitsStored, ds.HighBit = 16, plan.bits_stored, plan.bits_stored - 1
    ds.PixelRepresentation = int(plan.signed)
    ds.add_new(0x7FE00010, "OW", plan.stored(k).tobytes())
    return ds


PLAIN = {"AS", "CS", "DA", "DS", "FD", "FL", "IS", "LO", "OB", "OW", "PN", "SH", "SL", "SS", "TM", "UI", "UL", "US"}
"""Value representations that are written the same in every dataset of a transfer syntax, without a character set."""

REMEMBERED: dict[tuple[Any, ...], bytes] = {}
"""What pydicom wrote for an element, or for the head of a file."""


def save_dataset(ds: Dataset, path: Path) -> None:
    """Write a dataset as pydicom does, which takes 3 ms, with what it wrote for elements that came before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    elements = list(ds.values())
    meta = getattr(ds, "file_meta", FileMetaDataset())
    if not (
        set(meta.keys()) == TAGS_OF_A_HEAD
        and meta.TransferSyntaxUID in (ExplicitVRLittleEndian, ImplicitVRLittleEndian)
        and meta.MediaStorageSOPInstanceUID == ds.get("SOPInstanceUID")
        and meta.MediaStorageSOPClassUID == ds.get("SOPClassUID")
        and all(isinstance(element, DataElement) and element.VR in PLAIN for element in elements)
        and "SpecificCharacterSet" not in ds
    ):
        ds.save_as(path, enforce_file_format=True)
        return
    written = [_element_as_written(element, is_implicit(ds)) for element in sorted(elements, key=attrgetter("tag"))]
    path.write_bytes(_head_as_written(meta) + b"".join(written))


TAGS_OF_A_HEAD = {0x00020002, 0x00020003, 0x00020010}


def _head_as_written(meta: FileMetaDataset) -> bytes:
    instance = meta.MediaStorageSOPInstanceUID
    key = (meta.MediaStorageSOPClassUID, len(instance), meta.TransferSyntaxUID)
    stand_in = "2." + "7" * (len(instance) - 2)
    if key not in REMEMBERED:
        alone = Dataset()
        alone.file_meta = copy.deepcopy(meta)
        alone.file_meta.MediaStorageSOPInstanceUID = stand_in
        file = BytesIO()
        alone.save_as(file, enforce_file_format=True)
        REMEMBERED[key] = file.getvalue()
    return REMEMBERED[key].replace(stand_in.encode(), instance.encode())


def _element_as_written(element: DataElement, implicit: bool) -> bytes:
    is_of_bytes = element.VR in ("OB", "OW")
    key = (implicit, element.tag, element.VR, type(element.value), str(element.value)) if not is_of_bytes else ()
    if key not in REMEMBERED:
        file = DicomBytesIO()
        file.is_little_endian, file.is_implicit_VR = True, implicit
        write_data_element(file, element)
        if is_of_bytes:
            return file.getvalue()
        REMEMBERED[key] = file.getvalue()
    return REMEMBERED[key]


def write_series(folder: Path, plan: Plan | None = None, change: Change | None = None) -> Plan:
    """Write the series; `change(dataset, k)` spoils slice k. Text in place of decimals goes in as raw bytes."""
    plan = plan or Plan()
    for k in range(plan.shape[0]):
        if k in plan.leave_out:
            continue
        ds = make_dataset(plan, k)
        if change is not None:
            change(ds, k)
        save_dataset(ds, folder / plan.name(k))
    return plan


def set_raw(keyword: str, text: str, *, only: int | None = None) -> Change:
    """A change that puts `text` into a text element exactly as it is, past pydicom's checks."""
    from pydicom.datadict import dictionary_VR, tag_for_keyword
    from pydicom.dataelem import RawDataElement
    from pydicom.tag import Tag

    def change(ds: Dataset, k: int) -> None:
        if only is None or k == only:
            tag = Tag(tag_for_keyword(keyword))
            value = text.encode("latin-1")
            value += b" " * (len(value) % 2)
            ds[tag] = RawDataElement(tag, dictionary_VR(tag), len(value), value, 0, is_implicit(ds), True)

    return change


def is_implicit(ds: Dataset) -> bool:
    return ds.file_meta.TransferSyntaxUID == ImplicitVRLittleEndian


def hash_of(series: int) -> str:
    """The hash by which the series of a `Plan` is told."""
    return hashlib.sha256(f"{ROOT}.{series}".encode()).hexdigest()[:16]


def write_two_series(folder: Path) -> Path:
    """Series 2 of 7 slices and series 5 of 4, in files that do not tell."""
    write_series(folder, Plan(series=5, shape=(4, 5, 6), name="a{}".format))
    write_series(folder, Plan(series=2, name="sub/b{}".format))
    return folder


def set_values(*, only: int | None = None, **values: Any) -> Change:
    """A change that sets elements by keyword; None deletes."""

    def change(ds: Dataset, k: int) -> None:
        if only is None or k == only:
            for keyword, value in values.items():
                if value is None:
                    delattr(ds, keyword)
                else:
                    setattr(ds, keyword, value)

    return change


def element_bytes(keyword: str, value: bytes, *, implicit: bool = False) -> bytes:
    """A little-endian element with exactly this value, also where it is odd or no number."""
    from pydicom.datadict import dictionary_VR, tag_for_keyword

    tag = tag_for_keyword(keyword) or 0
    head = struct.pack("<HH", tag >> 16, tag & 0xFFFF)
    vr = dictionary_VR(tag)[:2].encode()  # of "US or SS" the first
    return head + (struct.pack("<L", len(value)) if implicit else vr + struct.pack("<H", len(value))) + value


def find_element(data: bytes, keyword: str, *, implicit: bool = False) -> tuple[int, int, int]:
    """First byte of an element with a short head, of its value, and of what follows."""
    head = element_bytes(keyword, b"", implicit=implicit)[: 4 if implicit else 6]
    assert data.count(head) == 1, f"{keyword} stands {data.count(head)} times in the file"
    start = data.index(head)
    length = struct.unpack_from("<L" if implicit else "<H", data, start + len(head))[0]
    return start, start + 8, start + 8 + length


def edit_value(path: Path, keyword: str, change: Callable[[bytes], bytes]) -> None:
    """Change the bytes of a value in a file, in explicit VR; its length follows."""
    data = path.read_bytes()
    start, value, end = find_element(data, keyword)
    path.write_bytes(data[:start] + element_bytes(keyword, change(data[value:end])) + data[end:])


def insert_after(path: Path, keyword: str, extra: bytes, *, implicit: bool = False) -> None:
    """Put bytes behind an element of a file."""
    data = path.read_bytes()
    _, _, end = find_element(data, keyword, implicit=implicit)
    path.write_bytes(data[:end] + extra + data[end:])
