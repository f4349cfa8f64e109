"""Volumes from NIfTI, NRRD and MetaImage: every value and every place as the file has it, whatever it is stored as."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import tolerances
from dicom_series import Plan, write_series
from label_files import OBLIQUE, RAS, write_nifti, write_nrrd
from refusals import refused
from variants import daily
from volume_files import LEFT_HANDED, ROTATED, WRITERS, make_ct, write_metaimage

import clrecon
from clrecon.errors import RefusedInputError
from clrecon.geometry import AIR_HU

nibabel = pytest.importorskip("nibabel")
pytest.importorskip("nrrd")
sitk = pytest.importorskip("SimpleITK")
AFFINES = {"oblique and sheared": OBLIQUE, "oblique": ROTATED, "left-handed": LEFT_HANDED}
TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"]


def affine_bound(name: str) -> float:
    """NIfTI-1 keeps 24 bits of each entry."""
    return tolerances.NIFTI_AFFINE_MM if name in ("a.nii", "a.nii.gz", "a.hdr") else tolerances.AFFINE_MM


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("place", AFFINES)
def test_values_and_places_are_those_of_the_file(tmp_path, name, place):
    voxels = make_ct()
    volume = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels, AFFINES[place]))
    assert volume.voxels.dtype == np.int16 and np.array_equal(volume.voxels, voxels)
    assert np.abs(volume.affine - AFFINES[place]).max() <= affine_bound(name)
    assert volume.report["hu_range"] == [voxels.min(), voxels.max()]
    assert volume.report["warnings"][0].startswith("not DICOM") and len(volume.report["warnings"]) == 1


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("order", daily(1, "<>"))
@pytest.mark.parametrize("stored", TYPES)
def test_whole_numbers_are_whole_hu_whatever_they_are_stored_as(tmp_path, name, order, stored):
    low, high = {"u1": (0, 256), "i1": (-128, 128)}.get(stored, (0 if stored[0] == "u" else -1024, 3000))
    voxels = make_ct(low=low, high=high)
    volume = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels.astype(order + stored), OBLIQUE))
    assert volume.voxels.dtype == np.int16 and np.array_equal(volume.voxels, voxels)


@pytest.mark.parametrize("kind", ["Nifti1", "Nifti2"])
@pytest.mark.parametrize("stored", [">i2", ">f4"])
def test_big_endian_nifti_is_read(tmp_path, kind, stored):
    header = getattr(nibabel, f"{kind}Header")(endianness=">")
    header.set_data_dtype(stored)
    image = getattr(nibabel, f"{kind}Image")(make_ct().transpose(2, 1, 0).astype(stored), RAS @ OBLIQUE, header)
    nibabel.save(image, tmp_path / "a.nii")
    assert (tmp_path / "a.nii").read_bytes()[:2] == b"\0\0"
    assert np.array_equal(clrecon.read_volume(tmp_path / "a.nii").voxels, make_ct())


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("stored", ["f4", "f8"])
def test_fractions_stay_fractions(tmp_path, name, stored):
    voxels = make_ct().astype(stored) + np.random.default_rng(1).random((4, 6, 7)).astype(stored)
    volume = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels, OBLIQUE))
    assert volume.voxels.dtype == np.float32 and np.array_equal(volume.voxels, voxels.astype(np.float32))


@pytest.mark.parametrize("place", [0, 2, 3])
@pytest.mark.parametrize(("value", "dtype"), [(40_000.0, "i4"), (-3.0e6, "i4"), (12.25, "f4"), (1e12, "f4")])
def test_one_slice_that_asks_for_more_widens_the_volume(tmp_path, place, value, dtype):
    voxels = make_ct().astype(np.float64)
    voxels[place, 3, 2] = value
    volume = clrecon.read_volume(write_nifti(tmp_path / "a.nii.gz", voxels))
    assert volume.voxels.dtype == dtype and np.array_equal(volume.voxels, voxels.astype(dtype))


@pytest.mark.parametrize("name", WRITERS)
def test_grid_volumes_equal_those_of_other_libraries(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct(), ROTATED)
    volume = clrecon.read_volume(path)
    if name != "two.nii":  # SimpleITK does not read NIfTI-2
        image = sitk.ReadImage(str(path))
        assert np.array_equal(volume.voxels, sitk.GetArrayFromImage(image))
        points = np.array([[0, 0, 0], [6, 0, 0], [0, 5, 0], [0, 0, 3], [3, 2, 1]])
        theirs = [image.TransformIndexToPhysicalPoint(tuple(map(int, point))) for point in points]
        assert np.abs(volume.ijk_to_lps(points) - theirs).max() <= affine_bound(name)
    if ".nii" in name or ".hdr" in name:
        other = nibabel.load(path)
        assert np.array_equal(volume.voxels, np.asarray(other.dataobj).transpose(2, 1, 0))
        assert np.allclose(volume.affine, RAS @ other.affine, rtol=0, atol=affine_bound(name))


@pytest.mark.parametrize("name", ["a.mha", "packed.mha", "a.mhd", "packed.mhd"])
def test_simpleitk_agrees_on_a_sheared_metaimage(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct(), LEFT_HANDED)
    volume, image = clrecon.read_volume(path), sitk.ReadImage(str(path))
    assert np.array_equal(volume.voxels, sitk.GetArrayFromImage(image))
    for point in ((0, 0, 0), (6, 5, 3)):
        there = image.TransformIndexToPhysicalPoint(point)
        assert np.abs(volume.ijk_to_lps([point])[0] - there).max() <= tolerances.AFFINE_MM


def test_a_packed_metaimage_needs_no_size_of_its_data(tmp_path):
    path = write_metaimage(tmp_path / "a.mha", make_ct(), packed=True, CompressedDataSize=None)
    assert np.array_equal(clrecon.read_volume(path).voxels, make_ct())  # SimpleITK returns what was in memory


@pytest.mark.parametrize("name", ["s.nii.gz", "s.nrrd", "s.nhdr", "s.mha", "s.mhd"])
def test_dicom_series_converted_by_simpleitk_is_the_same_volume(tmp_path, name):
    plan = Plan(shape=(7, 5, 6), angles=(20.0, -10.0, 5.0), gap=2.5)
    write_series(tmp_path / "ct", plan)
    files = sorted(map(str, (tmp_path / "ct").iterdir()))
    truth = clrecon.read_volume(tmp_path / "ct")
    image = sitk.ReadImage(files)
    sitk.WriteImage(image, str(tmp_path / name), useCompression=True)
    volume = clrecon.read_volume(tmp_path / name)
    assert np.array_equal(volume.voxels, truth.voxels) and volume.voxels.dtype == truth.voxels.dtype
    bound = tolerances.NIFTI_LARGE_AFFINE_MM if name == "s.nii.gz" else tolerances.AFFINE_MM
    assert np.abs(volume.affine - truth.affine).max() <= bound


@pytest.mark.parametrize(("slope", "intercept"), [(1.0, -1024.0), (2.0, 0.0), (-1.0, 5.0), (0.1, -3.7), (1.0, 0.5)])
@pytest.mark.parametrize("stored", ["i2", "u2", "f4"])
def test_slope_and_intercept_are_those_of_nibabel(tmp_path, slope, intercept, stored):
    path = write_nifti(tmp_path / "a.nii", make_ct(low=0).astype(stored))
    content = bytearray(path.read_bytes())
    content[112:120] = np.array([slope, intercept], "<f4").tobytes()
    path.write_bytes(content)
    volume = clrecon.read_volume(path)
    truth = nibabel.load(path).get_fdata(dtype=np.float64).transpose(2, 1, 0)
    whole = bool((truth == np.rint(truth)).all())
    assert volume.voxels.dtype == (np.int16 if whole else np.float32)
    assert np.array_equal(volume.voxels, truth.astype(volume.voxels.dtype))
    assert volume.report["rescale"] == {
        "slope": [float(np.float32(slope))] * 2, "intercept": [float(np.float32(intercept))] * 2, "type": None
    }  # fmt: skip


def test_nan_is_air_and_said(tmp_path):
    voxels = make_ct(low=-500).astype(np.float32)
    voxels[0] = np.nan
    voxels[2, 0, 0] = np.nan
    volume = clrecon.read_volume(write_nifti(tmp_path / "a.nii.gz", voxels))
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, np.where(np.isnan(voxels), AIR_HU, voxels))
    assert volume.report["padding_share"] == 43 / 168 and volume.report["hu_range"][0] == AIR_HU
    assert "43 voxels (25.60 %) are NaN: -1024 HU, air, is taken for them" in volume.report["warnings"]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.inf, "slice 3 of 4 holds infinity"),
        (-np.inf, "slice 3 of 4 holds infinity"),
        (1e300, "slice 3 of 4 goes from .* beyond float32"),
    ],
)
@pytest.mark.parametrize("hole", [False, True])
def test_values_that_are_no_ct_numbers_are_refused(tmp_path, value, message, hole):
    voxels = make_ct().astype(np.float64) + 0.5
    voxels[2, 1, 1] = value
    if hole:
        voxels[2, 0] = np.nan
    with pytest.raises(RefusedInputError, match=message):
        clrecon.read_volume(write_nrrd(tmp_path / "a.nrrd", voxels))


def test_large_whole_numbers_are_refused_too(tmp_path):
    """As numbers with a part: they were infinite voxels."""
    voxels = make_ct().astype(np.float64)
    voxels[2, 1, 1] = 1e300
    with refused(RefusedInputError, "float32", 3, 4):
        clrecon.read_volume(write_nrrd(tmp_path / "a.nrrd", voxels))


def test_nothing_but_nan_and_integers_beyond_32_bits_are_refused(tmp_path):
    with refused(RefusedInputError, "NaN", "voxels"):
        clrecon.read_volume(write_nrrd(tmp_path / "a.nrrd", np.full((2, 3, 4), np.nan)))
    voxels = make_ct().astype(np.int64)
    voxels[1, 0, 0] = 2**40
    with refused(RefusedInputError, 2, 4, 32):
        clrecon.read_volume(write_metaimage(tmp_path / "a.mha", voxels))


NOISE = np.random.default_rng(2).random((4, 6, 7))


@pytest.mark.parametrize(
    ("voxels", "warning"),
    [
        (make_ct(), None),
        (make_ct(low=-200, high=-20), None),
        (make_ct(low=0, high=4000) + 0.5, "none is below 0: not HU, or HU with an offset"),
        (make_ct((8, 20, 20), low=0, high=4000), "none is below 0: not HU, or HU with an offset"),
        (NOISE, "normalised, not HU"),
        (2 * NOISE - 1, "normalised, not HU"),
        (make_ct(low=0, high=118), "looks like a label map"),
        ((make_ct() > 0).astype(np.uint8), "run from 0 to 1 in 2 different whole numbers: this looks like a label map"),
        (np.minimum(make_ct((5, 40, 40), high=9000), 3071), "3071 HU, the ceiling of 12 bits"),
    ],
)
def test_values_that_are_hardly_hu_are_doubted(tmp_path, voxels, warning):
    warnings = clrecon.read_volume(write_nifti(tmp_path / "a.nii.gz", voxels)).report["warnings"][1:]
    assert (warnings == []) if warning is None else (len(warnings) == 1 and warning in warnings[0])


@pytest.mark.parametrize("name", WRITERS)
def test_labels_of_the_same_kind_of_file_lie_on_their_volume_exactly(tmp_path, name):
    from clrecon.labels import resample_labels

    voxels = make_ct()
    (tmp_path / "labels").mkdir()
    volume = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels, OBLIQUE))
    labels = clrecon.read_labels(WRITERS[name](tmp_path / "labels" / name, (voxels > 200).astype(np.uint8), OBLIQUE))
    taken = resample_labels(labels, volume)
    assert np.array_equal(labels.affine, volume.affine)
    assert taken.exact and np.array_equal(taken.voxels, voxels > 200)


@pytest.mark.parametrize("name", daily(2, ["a.nii.gz", "gzip.nrrd", "packed.mha", "a.mha"]))
@pytest.mark.parametrize("kind", daily(1, ["whole", "fractions", "a fraction at the end"]))
def test_grid_file_is_read_in_the_memory_of_two_volumes(tmp_path, name, kind):
    voxels = np.repeat(make_ct((50, 150, 100)), 3, axis=2).astype(np.float32)
    if kind == "fractions":
        voxels += 0.25
    if kind == "a fraction at the end":
        voxels[-1, -1, -1] += 0.25
    path = WRITERS[name](tmp_path / name, voxels, OBLIQUE)
    clrecon.read_volume(path)  # libraries are loaded
    tracemalloc.start()
    volume = clrecon.read_volume(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 2 * volume.voxels.nbytes


def test_a_surface_is_the_same_from_every_kind_of_file(tmp_path, device):
    from scipy.spatial import cKDTree

    from clrecon.proof.phantom import PhantomSettings, write_phantom

    settings = PhantomSettings(kind="torus", size=(48, 44), slices=20, spacing=(0.7, 0.5, 2.5), tilt=12.0)
    write_phantom(tmp_path / "ct", settings)
    volume = clrecon.read_volume(tmp_path / "ct")
    truth = clrecon.extract_isosurface(volume, 250, device=device)
    assert truth.vertex_count > 500
    for name, write in WRITERS.items():
        for stored in (volume.voxels, volume.voxels.astype(np.float64)):
            other = clrecon.read_volume(write(tmp_path / name, stored, volume.affine))
            mesh = clrecon.extract_isosurface(other, 250, device=device)
            assert np.array_equal(mesh.triangles, truth.triangles), name
            assert np.abs(mesh.vertices - truth.vertices).max() <= tolerances.FRAME_MM, name
    turned = volume.affine @ np.array([[0, -1.0, 0, 47], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    swapped = volume.voxels.transpose(1, 2, 0)[:, ::-1]  # what was i runs down the rows, from the other end
    mesh = clrecon.extract_isosurface(
        clrecon.read_volume(write_nrrd(tmp_path / "t.nrrd", swapped, turned)), 250, device=device
    )
    assert cKDTree(truth.vertices).query(mesh.vertices)[0].max() <= tolerances.FRAME_MM
    assert mesh.vertex_count == truth.vertex_count


def test_real_volumes_are_what_nibabel_and_simpleitk_read(real_data):
    for name in ("example_ct.nii.gz", "ct_thorax_1p5mm_cropped.nii.gz"):
        path = real_data / "thoracolumbar_labels" / name
        volume, image, other = clrecon.read_volume(path), sitk.ReadImage(str(path)), nibabel.load(path)
        assert np.array_equal(volume.voxels, sitk.GetArrayFromImage(image))
        assert np.array_equal(volume.voxels, np.asarray(other.dataobj).transpose(2, 1, 0))
        assert np.allclose(volume.affine, RAS @ other.affine, rtol=0, atol=tolerances.NIFTI_AFFINE_MM)
        assert volume.report["warnings"][1:] == []
    labels = clrecon.read_volume(real_data / "thoracolumbar_labels" / "ct_2mm_labels.nii.gz")
    assert "looks like a label map" in labels.report["warnings"][-1]


def test_real_labels_lie_on_their_nifti_ct(real_data):
    from clrecon.labels import resample_labels

    folder = real_data / "thoracolumbar_labels"
    labels = clrecon.read_labels(folder / "spine_report" / "totalseg.nii.gz")
    volume = clrecon.read_volume(folder / "example_ct.nii.gz")
    assert resample_labels(labels, volume).exact


@pytest.mark.release
def test_a_real_series_through_each_format_is_the_same_volume(real_data, tmp_path):
    truth = clrecon.read_volume(real_data / "thoracolumbar_labels" / "ct_2mm_jpeg2000")
    for name in ("a.nii.gz", "gzip.nrrd", "packed.mha", "a.mhd"):
        volume = clrecon.read_volume(WRITERS[name](tmp_path / name, truth.voxels, truth.affine))
        assert np.array_equal(volume.voxels, truth.voxels) and volume.voxels.dtype == truth.voxels.dtype
        assert np.abs(volume.affine - truth.affine).max() <= tolerances.NIFTI_LARGE_AFFINE_MM
