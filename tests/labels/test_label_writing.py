"""Label maps as NIfTI and DICOM SEG: what is written is read back the same, by clrecon and by other readers."""

from __future__ import annotations

import dicom_series
import numpy as np
import pydicom
import pytest
import tolerances
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


def make_labels_on(volume, numbers=(0, 0, 2, 5, 300)):
    """Return a map of random labels on the voxels of `volume`; its first and last slice are empty."""
    voxels = np.random.default_rng(4).choice(numbers, volume.voxels.shape).astype(np.uint16)
    voxels[[0, -1]] = 0
    return LabelMap(voxels, volume.affine, {n: name for n, name in NAMES.items() if n in numbers})


def write_segmentation(path, labels, scan):
    """Write labels as a DICOM SEG of the slices of a scan."""
    path.write_bytes(encode_segmentation(labels, list_slices(scan, Selection())))
    return path


def read_slices(scan):
    return [pydicom.dcmread(path) for path, _, _ in list_slices(scan, Selection())]


@pytest.fixture(params=PLANS)
def scan(request, tmp_path):
    """A folder with a CT series."""

    def add_study(ds, k):
        ds.StudyInstanceUID, ds.StudyDate, ds.PatientBirthDate, ds.AccessionNumber = "1.2.7", "20190304", "1950", "A"

    dicom_series.write_series(tmp_path / "ct", PLANS[request.param], add_study)
    return tmp_path / "ct"


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_labels_written_as_nifti_are_read_back_the_same(scan, tmp_path, name):
    pytest.importorskip("nibabel")
    labels = make_labels_on(read_volume(scan))
    (tmp_path / name).write_bytes(encode_nifti(labels, packed=name.endswith(".gz")))

    back = read_labels(tmp_path / name)

    assert back.voxels.dtype == labels.voxels.dtype
    assert np.array_equal(back.voxels, labels.voxels)
    assert np.allclose(back.affine, labels.affine, atol=tolerances.LABEL_NIFTI_MM)
    assert back.names == labels.names
    assert back.warnings == ()


@pytest.mark.parametrize("packed", [False, True], ids=["nii", "nii.gz"])
@pytest.mark.parametrize("scan", ["oblique"], indirect=True)
def test_labels_encoded_twice_give_the_same_bytes_of_nifti(scan, packed):
    labels = make_labels_on(read_volume(scan))
    assert encode_nifti(labels, packed=packed) == encode_nifti(labels, packed=packed)


@pytest.mark.parametrize("scan", ["oblique"], indirect=True)  # ITK has no shear, and refuses one
def test_simpleitk_reads_voxels_and_places_of_a_written_nifti(scan, tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    labels = make_labels_on(read_volume(scan))
    (tmp_path / "a.nii.gz").write_bytes(encode_nifti(labels, packed=True))

    image = sitk.ReadImage(str(tmp_path / "a.nii.gz"))

    assert np.array_equal(sitk.GetArrayFromImage(image), labels.voxels)
    index = (3, 2, 5)  # i, j, k of any voxel
    place = image.TransformIndexToPhysicalPoint(index)
    assert np.allclose(place, labels.ijk_to_lps([index])[0], atol=tolerances.LABEL_NIFTI_MM)


def test_written_segmentation_lies_on_its_scan(scan, tmp_path):
    volume = read_volume(scan)
    labels = make_labels_on(volume)

    back = read_labels(write_segmentation(tmp_path / "a.dcm", labels, scan))

    on_scan = resample_labels(back, volume)
    assert on_scan.exact
    assert np.array_equal(on_scan.voxels, labels.voxels)
    assert back.names == labels.names


@pytest.mark.parametrize("scan", ["oblique"], indirect=True)
def test_written_segmentation_has_the_frame_of_reference_of_its_scan(scan, tmp_path):
    volume = read_volume(scan)
    back = read_labels(write_segmentation(tmp_path / "a.dcm", make_labels_on(volume), scan))
    assert back.frame_of_reference_hash is not None
    assert back.frame_of_reference_hash == volume.report["frame_of_reference_hash"]


@pytest.mark.parametrize("scan", ["oblique"], indirect=True)
def test_labels_encoded_twice_give_the_same_bytes_of_a_segmentation(scan):
    labels, slices = make_labels_on(read_volume(scan)), list_slices(scan, Selection())
    assert encode_segmentation(labels, slices) == encode_segmentation(labels, slices)


@pytest.mark.parametrize("scan", ["oblique"], indirect=True)
def test_written_segmentation_has_one_bit_for_each_pixel(scan, tmp_path):
    segmentation = pydicom.dcmread(write_segmentation(tmp_path / "a.dcm", make_labels_on(read_volume(scan)), scan))
    assert (segmentation.BitsAllocated, segmentation.BitsStored, segmentation.HighBit) == (1, 1, 0)


def test_written_segmentation_references_study_frame_and_series_of_its_scan(scan, tmp_path):
    labels = make_labels_on(read_volume(scan))
    segmentation = pydicom.dcmread(write_segmentation(tmp_path / "a.dcm", labels, scan))
    slices = read_slices(scan)
    assert segmentation.StudyInstanceUID == slices[0].StudyInstanceUID
    assert segmentation.FrameOfReferenceUID == slices[0].FrameOfReferenceUID
    (series,) = segmentation.ReferencedSeriesSequence
    assert series.SeriesInstanceUID == slices[0].SeriesInstanceUID != segmentation.SeriesInstanceUID
    referenced = [instance.ReferencedSOPInstanceUID for instance in series.ReferencedInstanceSequence]
    assert referenced == [one.SOPInstanceUID for one in slices]


def test_each_frame_of_a_written_segmentation_lies_on_the_slice_that_it_references(scan, tmp_path):
    labels = make_labels_on(read_volume(scan))
    segmentation = pydicom.dcmread(write_segmentation(tmp_path / "a.dcm", labels, scan))
    slices = read_slices(scan)
    assert segmentation.NumberOfFrames == len(segmentation.PerFrameFunctionalGroupsSequence) > 0
    for group in segmentation.PerFrameFunctionalGroupsSequence:
        _, slice_number = group.FrameContentSequence[0].DimensionIndexValues  # segment and slice, both counted from 1
        k = slice_number - 1
        (source,) = group.DerivationImageSequence[0].SourceImageSequence
        assert source.ReferencedSOPInstanceUID == slices[k].SOPInstanceUID
        position = np.array(group.PlanePositionSequence[0].ImagePositionPatient, float)
        assert np.allclose(position, np.array(slices[k].ImagePositionPatient, float), atol=tolerances.DICOM_PLACE_MM)


@pytest.mark.parametrize("scan", ["oblique"], indirect=True)
def test_written_segmentation_has_no_name_nor_date_of_the_patient(scan, tmp_path):
    labels = make_labels_on(read_volume(scan))
    segmentation = pydicom.dcmread(write_segmentation(tmp_path / "a.dcm", labels, scan))
    first = read_slices(scan)[0]
    for keyword in ("PatientName", "PatientID", "PatientBirthDate", "StudyDate", "AccessionNumber"):
        assert str(first[keyword].value) != ""
        assert str(segmentation[keyword].value or "") == ""


def test_highdicom_reads_names_and_voxels_of_a_written_segmentation(scan, tmp_path):
    highdicom = pytest.importorskip("highdicom")
    labels = make_labels_on(read_volume(scan))

    segmentation = highdicom.seg.segread(write_segmentation(tmp_path / "a.dcm", labels, scan))

    numbers = list(segmentation.segment_numbers)
    assert {n: segmentation.get_segment_description(n).segment_label for n in numbers} == NAMES
    slices = [one.SOPInstanceUID for one in read_slices(scan)]
    pixels = segmentation.get_pixels_by_source_instance(slices, assert_missing_frames_are_empty=True)
    for channel, number in enumerate(NAMES):
        assert np.array_equal(pixels[..., channel] > 0, labels.voxels == number)


@pytest.mark.parametrize("scan", ["oblique"], indirect=True)
def test_segmentation_of_7_slices_is_not_written_for_6(scan):
    labels = make_labels_on(read_volume(scan))
    with refused(RefusedInputError, "slices", 7, 6):
        encode_segmentation(labels, list_slices(scan, Selection())[:-1])


@pytest.mark.parametrize("scan", ["oblique"], indirect=True)
def test_segmentation_is_not_written_for_a_slice_without_a_study(scan):
    labels = make_labels_on(read_volume(scan))
    slices = list_slices(scan, Selection())
    path, _, _ = slices[2]  # any
    dataset = pydicom.dcmread(path)
    del dataset.StudyInstanceUID
    dataset.save_as(path)
    with refused(RefusedInputError, "StudyInstanceUID", "DICOM"):
        encode_segmentation(labels, slices)
