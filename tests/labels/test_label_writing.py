"""Label maps as NIfTI and DICOM SEG: what is written is read back the same, by clrecon and by other readers."""

from __future__ import annotations

import dicom_series
import numpy as np
import pydicom
import pytest
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.labels import LabelMap, read_labels, resample_labels
from clrecon.labels.label_map import encode_nifti
from clrecon.labels.write_segmentation import encode_segmentation
from clrecon.reading import Selection, read_volume
from clrecon.reading.dicom.reader import list_slices

PLANS = {
    "oblique": dicom_series.Plan(shape=(7, 6, 9), angles=(10, -20, 35), gap=1.25),
    "tilted": dicom_series.Plan(shape=(7, 6, 9), tilt_deg=12.0, gap=1.25),
}
NAMES = {2: "T12", 5: "L1 <body> & arch", 300: "wei\u00df"}


def labels_of(volume, numbers=(0, 0, 2, 5, 300)):
    voxels = np.random.default_rng(4).choice(numbers, volume.voxels.shape).astype(np.uint16)
    voxels[[0, -1]] = 0
    return LabelMap(voxels, volume.affine, {n: name for n, name in NAMES.items() if n in numbers})


@pytest.fixture(params=PLANS)
def scan(request, tmp_path):
    dicom_series.write_series(
        tmp_path / "ct", PLANS[request.param], lambda ds, k: setattr(ds, "StudyInstanceUID", "1.2.7")
    )
    return tmp_path / "ct"


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_nifti_is_read_back_the_same(scan, tmp_path, name):
    pytest.importorskip("nibabel")
    labels = labels_of(read_volume(scan))
    content = encode_nifti(labels, packed=name.endswith(".gz"))
    assert content == encode_nifti(labels, packed=name.endswith(".gz"))
    (tmp_path / name).write_bytes(content)
    back = read_labels(tmp_path / name)
    assert np.array_equal(back.voxels, labels.voxels) and back.voxels.dtype == labels.voxels.dtype
    assert np.allclose(back.affine, labels.affine, atol=1e-4)
    assert back.names == labels.names and back.warnings == ()


@pytest.mark.parametrize("scan", ["oblique"], indirect=True)  # ITK has no shear, and refuses one
def test_another_reader_of_nifti_sees_the_same(scan, tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    labels = labels_of(read_volume(scan))
    (tmp_path / "a.nii.gz").write_bytes(encode_nifti(labels, packed=True))
    image = sitk.ReadImage(str(tmp_path / "a.nii.gz"))
    assert np.array_equal(sitk.GetArrayFromImage(image), labels.voxels)
    corner = image.TransformIndexToPhysicalPoint([3, 2, 5])
    assert np.allclose(corner, labels.ijk_to_lps([(3, 2, 5)])[0], atol=1e-4)


def test_a_segmentation_lies_on_its_scan(scan, tmp_path):
    volume = read_volume(scan)
    labels = labels_of(volume)
    content = encode_segmentation(labels, list_slices(scan, Selection()))
    assert content == encode_segmentation(labels, list_slices(scan, Selection()))
    (tmp_path / "a.dcm").write_bytes(content)
    back = read_labels(tmp_path / "a.dcm")
    assert back.names == labels.names
    taken = resample_labels(back, volume)
    assert taken.exact
    assert np.array_equal(taken.voxels, labels.voxels)
    frame = volume.report["frame_of_reference_hash"]
    assert frame is not None and back.frame_of_reference_hash == frame


def test_a_segmentation_references_its_slices_and_names_nobody(scan, tmp_path):
    labels = labels_of(read_volume(scan))
    (tmp_path / "a.dcm").write_bytes(encode_segmentation(labels, list_slices(scan, Selection())))
    seg, slices = (
        pydicom.dcmread(tmp_path / "a.dcm"),
        [pydicom.dcmread(path) for path, _, _ in list_slices(scan, Selection())],
    )
    assert seg.StudyInstanceUID == slices[0].StudyInstanceUID
    assert seg.FrameOfReferenceUID == slices[0].FrameOfReferenceUID
    (series,) = seg.ReferencedSeriesSequence
    assert series.SeriesInstanceUID == slices[0].SeriesInstanceUID != seg.SeriesInstanceUID
    assert [one.ReferencedSOPInstanceUID for one in series.ReferencedInstanceSequence] == [
        one.SOPInstanceUID for one in slices
    ]
    for group in seg.PerFrameFunctionalGroupsSequence:
        k = group.FrameContentSequence[0].DimensionIndexValues[1] - 1
        (source,) = group.DerivationImageSequence[0].SourceImageSequence
        assert source.ReferencedSOPInstanceUID == slices[k].SOPInstanceUID
        place = [float(value) for value in group.PlanePositionSequence[0].ImagePositionPatient]
        assert np.allclose(place, [float(value) for value in slices[k].ImagePositionPatient], atol=1e-6)
    for keyword in ("PatientName", "PatientID", "PatientBirthDate", "StudyDate", "AccessionNumber"):
        assert str(seg[keyword].value or "") == ""


def test_highdicom_reads_the_segmentation(scan, tmp_path):
    highdicom = pytest.importorskip("highdicom")
    labels = labels_of(read_volume(scan))
    (tmp_path / "a.dcm").write_bytes(encode_segmentation(labels, list_slices(scan, Selection())))
    seg = highdicom.seg.segread(tmp_path / "a.dcm")
    assert list(seg.segment_numbers) == sorted(NAMES)
    assert [seg.get_segment_description(n).segment_label for n in seg.segment_numbers] == list(NAMES.values())
    uids = [pydicom.dcmread(path).SOPInstanceUID for path, _, _ in list_slices(scan, Selection())]
    pixels = seg.get_pixels_by_source_instance(uids, assert_missing_frames_are_empty=True)
    for place, number in enumerate(sorted(NAMES)):
        assert np.array_equal(pixels[..., place] > 0, labels.voxels == number)


def test_what_a_segmentation_cannot_be_made_of_is_refused(scan, tmp_path):
    labels = labels_of(read_volume(scan))
    slices = list_slices(scan, Selection())
    with refused(RefusedInputError, "slices", 7, 6):
        encode_segmentation(labels, slices[:-1])
    dataset = pydicom.dcmread(slices[2][0])
    del dataset.StudyInstanceUID
    dataset.save_as(slices[2][0])
    with refused(RefusedInputError, "StudyInstanceUID", "DICOM"):
        encode_segmentation(labels, slices)
