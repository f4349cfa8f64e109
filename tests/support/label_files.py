"""Label maps to test with, and files of every kind that hold them, written by other people's libraries."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import dicom_series
import numpy as np
from numpy.typing import DTypeLike

OBLIQUE = np.array([[0.7, 0.1, 0.05, -25.0], [-0.1, 0.5, 0.2, -30.0], [0.0, 0.05, 2.5, -84.0], [0, 0, 0, 1.0]])
"""ijk to LPS mm: unequal steps, oblique and sheared."""

RAS = np.diag((-1.0, -1.0, 1.0, 1.0))

TABLE = (
    b'<?xml version="1.0"?> <CaretExtension><VolumeInformation Index="0"><LabelTable>'
    b'<Label Key="2" Red="0.0" Green="1.0" Blue="0.0" Alpha="1"><![CDATA[vertebrae_T12]]></Label>\n'
    b'<Label Key="5" Red="0.0" Green="1.0"><![CDATA[vertebrae_T1]]></Label></LabelTable></VolumeInformation>'
)


def make_labels(
    shape: Sequence[int] = (4, 6, 7), *, seed: int = 0, numbers: Sequence[int] = (0, 0, 2, 5)
) -> np.ndarray:
    """voxels[k, j, i], uint8."""
    return np.random.default_rng(seed).choice(np.array(numbers, np.uint8), shape)


def write_nifti(
    path: Path,
    voxels: np.ndarray,
    affine: np.ndarray = OBLIQUE,
    *,
    dtype: DTypeLike | None = None,
    kind: str = "Nifti1Image",
    extension: bytes | None = None,
    sform: bool = True,
    qform: bool = False,
) -> Path:
    """Write voxels[k, j, i] and an LPS affine as NIfTI, with nibabel."""
    import nibabel

    array = np.asarray(voxels if dtype is None else voxels.astype(dtype))
    image = getattr(nibabel, kind)(array.transpose(range(array.ndim)[::-1]), None, dtype=array.dtype)
    image.header.set_data_dtype(array.dtype)
    image.header.set_xyzt_units("mm")
    image.header["pixdim"][1:4] = np.linalg.norm(affine[:3, :3], axis=0)
    image.header.set_sform(RAS @ affine if sform else None, code=1 if sform else 0)
    image.header.set_qform(RAS @ affine if qform else None, code=1 if qform else 0)
    if extension is not None:
        image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, extension))
    nibabel.save(image, path)
    return path


def write_nrrd(
    path: Path,
    voxels: np.ndarray,
    affine: np.ndarray = OBLIQUE,
    *,
    space: str = "left-posterior-superior",
    **header: Any,
) -> Path:
    """Write voxels[k, j, i] (or [k, j, i, layer]) and an LPS affine as NRRD, with pynrrd."""
    import nrrd

    signs = {"left": 1, "posterior": 1, "superior": 1, "right": -1, "anterior": -1}
    turn = np.diag([signs[word] for word in space.split("-")])
    steps = (turn @ affine[:3, :3]).T
    layered = voxels.ndim == 4
    fields = {
        "space": space,
        "space directions": np.vstack([np.full((1, 3), np.nan), steps]) if layered else steps,
        "space origin": turn @ affine[:3, 3],
        "kinds": ["list"] * layered + ["domain"] * 3,
        **header,
    }
    path.parent.mkdir(exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        nrrd.write(str(path), voxels.transpose(range(voxels.ndim)[::-1]), fields)
    return path


def ct_slices(plan: dicom_series.Plan) -> list[Any]:
    """The slices of a plan as highdicom wants them."""
    slices = []
    for k in range(plan.shape[0]):
        ds = dicom_series.make_dataset(plan, k)
        ds.StudyInstanceUID = dicom_series.ROOT + ".7"
        for keyword in ("PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "StudyID", "AccessionNumber",
                        "ReferringPhysicianName", "SeriesDate", "SeriesTime"):  # fmt: skip
            setattr(ds, keyword, "")
        slices.append(ds)
    return slices


def write_seg(
    path: Path,
    segments: Sequence[tuple[str, np.ndarray]],
    ct: Sequence[Any],
    *,
    kind: str = "BINARY",
    leave_out_empty: bool = True,
    syntax: str | None = None,
) -> Path:
    """Write a DICOM SEG with highdicom.

    ct: The slices, in the order of k.
    """
    import highdicom as hd
    from pydicom.sr.codedict import codes
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    descriptions = [
        hd.seg.SegmentDescription(
            segment_number=number,
            segment_label=name,
            segmented_property_category=codes.SCT.Tissue,
            segmented_property_type=codes.SCT.Bone,
            algorithm_type=hd.seg.SegmentAlgorithmTypeValues.MANUAL,
        )
        for number, (name, _) in enumerate(segments, start=1)
    ]
    if kind == "LABELMAP":
        pixels = np.zeros(segments[0][1].shape, np.uint8)
        for number, (_, mask) in enumerate(segments, start=1):
            pixels[mask] = number
    else:
        pixels = np.stack([mask for _, mask in segments], axis=-1).astype(np.uint8)
    seg = hd.seg.Segmentation(
        source_images=ct,
        pixel_array=pixels,
        segmentation_type=kind,
        segment_descriptions=descriptions,
        series_instance_uid=generate_uid(),
        series_number=2,
        sop_instance_uid=generate_uid(),
        instance_number=1,
        manufacturer="none",
        manufacturer_model_name="none",
        software_versions="0",
        device_serial_number="0",
        omit_empty_frames=leave_out_empty,
        transfer_syntax_uid=syntax or ExplicitVRLittleEndian,
    )
    seg.save_as(path)
    return path
