"""Volumes to numpy, SimpleITK, nibabel and pyvista and back: every voxel at its place, the affine as it was."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import assert_one_line, refused
from uneven_volume import uneven

import clrecon
from clrecon import LabelMap, OutputError, UsageError, Volume
from clrecon.errors import RefusedInputError
from clrecon.geometry import AIR_HU, compose_affine, is_left_handed
from clrecon.geometry.resample import MOST_VOXELS

pyvista = pytest.importorskip("pyvista")
sitk = pytest.importorskip("SimpleITK")
nibabel = pytest.importorskip("nibabel")

SHAPE = (5, 4, 3)
STEPS = rotation((25.0, -40.0, 70.0)) * (0.7, 0.5, 1.25)
ORIGIN = (-120.0, 83.0, -210.5)


def affine_of_steps(steps: np.ndarray, origin: tuple[float, float, float] = ORIGIN) -> np.ndarray:
    """Return the affine with the columns of `steps`, (3, 3)."""
    i, j, k = steps.T
    return compose_affine(i, j, k, origin)


AFFINES = {
    "straight": affine_of_steps(np.diag((0.7, 0.5, 1.25))),
    "oblique": affine_of_steps(STEPS),
    "left-handed": affine_of_steps(STEPS * (1, 1, -1)),
    "left-handed, i": affine_of_steps(STEPS * (-1, 1, 1)),
    "flipped": affine_of_steps(np.diag((-0.7, -0.5, 1.25))),
    "sagittal": compose_affine(i_step=(0, 0.7, 0), j_step=(0, 0, -0.5), k_step=(-1.25, 0, 0), origin=ORIGIN),
}
SHEARED = affine_of_steps(STEPS @ np.array([[1, 0, 0], [0, 1, 0.3], [0, 0, 1]]))
SHEAR_DEG = 6.84
"""Each slice is moved by 0.3 of a row of 0.5 mm for 1.25 mm of height."""
DTYPES = ("int8", "uint8", "int16", "uint16", "int32", "float32")
IJK = np.array([(i, j, k) for k in range(5) for j in range(4) for i in range(3)])
WAYS = {
    "pyvista": (Volume.to_pyvista, Volume.from_pyvista),
    "SimpleITK": (Volume.to_sitk, Volume.from_sitk),
    "nibabel": (Volume.to_nibabel, Volume.from_nibabel),
}


def numbered_volume(affine: np.ndarray, dtype: str = "int16") -> Volume:
    """Voxels with the numbers 0 to 59, or -30 to 29 in types with a sign."""
    return Volume(np.arange(60, dtype=dtype).reshape(SHAPE) - (0 if dtype[0] == "u" else 30), affine)


to_every_library = pytest.mark.parametrize("library", WAYS)
of_every_affine = pytest.mark.parametrize("name", AFFINES)


@to_every_library
@of_every_affine
@pytest.mark.parametrize("dtype", DTYPES)
def test_voxels_type_and_affine_of_a_volume_return_unchanged_from_other_libraries(library, name, dtype):
    volume = numbered_volume(AFFINES[name], dtype)
    convert, convert_back = WAYS[library]
    returned = convert_back(convert(volume))
    assert type(returned) is Volume
    assert returned.dtype == volume.dtype
    assert np.array_equal(returned.voxels, volume.voxels)
    assert np.abs(returned.affine - volume.affine).max() <= tolerances.FLOAT64_PLACE_MM


@to_every_library
def test_a_volume_from_another_library_has_an_empty_report_and_no_certificate(library):
    convert, convert_back = WAYS[library]
    returned = convert_back(convert(numbered_volume(AFFINES["oblique"])))
    assert returned.report == {"warnings": []}
    assert returned.certificate is None


@of_every_affine
def test_the_affines_of_these_tests_are_left_handed_as_they_say(name):
    assert is_left_handed(AFFINES[name]) == ("left" in name)


@of_every_affine
def test_each_voxel_of_an_image_of_simpleitk_lies_at_its_lps_point_with_its_value(name):
    volume = numbered_volume(AFFINES[name])
    image = volume.to_sitk()
    points = [image.TransformIndexToPhysicalPoint(ijk) for ijk in IJK.tolist()]
    assert np.abs(volume.ijk_to_lps(IJK) - points).max() <= tolerances.FLOAT64_PLACE_MM
    assert [image[tuple(ijk)] for ijk in IJK.tolist()] == volume.voxels.ravel().tolist()


def test_an_image_of_simpleitk_has_the_size_and_type_of_its_volume():
    image = numbered_volume(AFFINES["oblique"]).to_sitk()
    assert image.GetSize() == SHAPE[::-1]
    assert image.GetPixelIDTypeAsString() == "16-bit signed integer"


@of_every_affine
def test_each_voxel_of_an_image_of_nibabel_lies_at_its_ras_point_with_its_value(name):
    volume = numbered_volume(AFFINES[name])
    image = volume.to_nibabel()
    points_ras = nibabel.affines.apply_affine(image.affine, IJK)
    assert np.abs(volume.ijk_to_lps(IJK) * (-1, -1, 1) - points_ras).max() <= tolerances.FLOAT64_PLACE_MM
    assert [image.dataobj[tuple(ijk)] for ijk in IJK] == volume.voxels.ravel().tolist()


def test_an_image_of_nibabel_shares_the_memory_of_its_volume_with_axes_reversed():
    volume = numbered_volume(AFFINES["oblique"])
    image = volume.to_nibabel()
    assert image.shape == SHAPE[::-1]
    assert np.shares_memory(image.dataobj, volume.voxels)


@of_every_affine
def test_nibabel_knows_unit_scanner_frame_and_directions(name):
    volume = numbered_volume(AFFINES[name])
    image = volume.to_nibabel()
    scanner_coordinates = 1
    assert image.header.get_xyzt_units()[0] == "mm"
    assert image.header["sform_code"] == image.header["qform_code"] == scanner_coordinates
    ras_affine = np.diag((-1, -1, 1, 1)) @ volume.affine
    assert nibabel.aff2axcodes(image.affine) == nibabel.aff2axcodes(ras_affine)


def assert_same_voxels_at_same_places(volume: Volume, other: Volume) -> None:
    """Axes may be in another order."""
    points = other.ijk_to_lps(IJK)
    ijk = np.rint(volume.lps_to_ijk(points)).astype(int)
    assert np.abs(volume.ijk_to_lps(ijk) - points).max() <= tolerances.NIFTI_LARGE_AFFINE_MM
    assert np.array_equal(volume.voxels[tuple(ijk.T[::-1])], other.voxels[tuple(IJK.T[::-1])])


@of_every_affine
@pytest.mark.parametrize("extension", [".nii.gz", ".nrrd", ".mha"])
def test_clrecon_and_simpleitk_read_each_voxel_of_a_saved_volume_in_place(tmp_path, name, extension):
    volume = numbered_volume(AFFINES[name])
    path = tmp_path / f"ct{extension}"
    volume.save(path)
    assert_same_voxels_at_same_places(volume, clrecon.read_volume(path))
    assert_same_voxels_at_same_places(volume, Volume.from_sitk(sitk.ReadImage(str(path))))


@of_every_affine
def test_nibabel_reads_each_voxel_of_a_saved_nifti_in_place(tmp_path, name):
    volume = numbered_volume(AFFINES[name])
    volume.save(tmp_path / "ct.nii.gz")
    assert_same_voxels_at_same_places(volume, Volume.from_nibabel(nibabel.load(tmp_path / "ct.nii.gz")))


@pytest.mark.parametrize("extension", [".nii.gz", ".nrrd", ".mha"])
def test_saving_a_volume_returns_the_bytes_of_its_file(tmp_path, extension):
    path = tmp_path / f"ct{extension}"
    assert numbered_volume(AFFINES["oblique"]).save(path) == path.stat().st_size


def test_a_volume_saves_the_file_that_write_volume_writes(tmp_path):
    volume = numbered_volume(SHEARED)
    volume.save(tmp_path / "a.nrrd")
    clrecon.write_volume(volume, tmp_path / "b.nrrd")
    assert (tmp_path / "a.nrrd").read_bytes() == (tmp_path / "b.nrrd").read_bytes()


def test_a_sheared_volume_is_resampled_to_be_saved_at_right_angles(tmp_path):
    numbered_volume(SHEARED).save(tmp_path / "a.mha", resample=0.5)
    assert Volume.from_sitk(sitk.ReadImage(str(tmp_path / "a.mha"))).spacing == pytest.approx((0.5, 0.5, 0.5))


def test_saving_a_resampled_volume_tells_both_stages(tmp_path):
    stages = set()
    numbered_volume(SHEARED).save(
        tmp_path / "a.mha", resample=0.5, progress=lambda stage, done, total: stages.add(stage)
    )
    assert stages == {"resample", "write"}


@pytest.mark.parametrize(
    ("name", "options", "kind", "facts"),
    [
        ("a.mha", {}, UsageError, ("angles", "resample")),
        ("a.stl", {}, UsageError, (".nrrd",)),
        ("older.nrrd", {"no_clobber": True}, OutputError, ("older.nrrd", "exists")),
    ],
    ids=["sheared", "no name of volumes", "exists"],
)
def test_a_volume_that_cannot_be_saved_is_refused(tmp_path, name, options, kind, facts):
    (tmp_path / "older.nrrd").write_text("older")
    with refused(kind, *facts):
        numbered_volume(SHEARED).save(tmp_path / name, **options)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["older"]


def test_numpy_takes_a_volume_as_its_voxels_without_a_copy():
    volume = numbered_volume(AFFINES["oblique"])
    assert np.asarray(volume) is volume.voxels
    assert (volume.shape, volume.dtype) == (SHAPE, np.int16)


def test_numpy_takes_a_label_map_as_its_voxels_without_a_copy():
    labels = LabelMap(np.ones(SHAPE, np.uint8), np.eye(4))
    assert np.asarray(labels) is labels.voxels
    assert (labels.shape, labels.dtype) == (SHAPE, np.uint8)


def test_an_array_made_of_a_volume_is_a_copy():
    volume = numbered_volume(AFFINES["oblique"])
    assert not np.shares_memory(np.array(volume), volume.voxels)
    assert not np.shares_memory(volume.__array__(copy=True), volume.voxels)


def test_numpy_takes_a_volume_as_another_type():
    volume = numbered_volume(AFFINES["oblique"])
    wide = np.asarray(volume, dtype=np.float64)
    assert wide.dtype == np.float64
    assert np.array_equal(wide, volume.voxels)


@pytest.mark.skipif(np.lib.NumpyVersion(np.__version__) < "2.0.0", reason="asarray has no copy= before numpy 2")
def test_numpy_is_refused_another_type_without_a_copy():
    volume = numbered_volume(AFFINES["oblique"])
    assert np.asarray(volume, copy=False) is volume.voxels
    with refused(ValueError, "int16", "float32"):
        np.asarray(volume, dtype="f4", copy=False)


def test_functions_of_numpy_take_a_volume():
    volume = numbered_volume(AFFINES["oblique"])  # the numbers -30 to 29
    assert np.mean(volume) == -0.5
    assert np.asarray(volume).max() == 29


to_libraries_of_right_angles = pytest.mark.parametrize("library", ["pyvista", "SimpleITK"])


@to_libraries_of_right_angles
def test_a_sheared_volume_is_refused_with_its_angle_where_resampling_was_not_asked_for(library):
    convert, _ = WAYS[library]
    with refused(UsageError, SHEAR_DEG, convert.__name__, "resample=True"):
        convert(numbered_volume(SHEARED))


@to_libraries_of_right_angles
def test_a_sheared_volume_that_is_resampled_keeps_its_spacing_and_slices_and_has_air_around(library):
    convert, convert_back = WAYS[library]
    straight = convert_back(convert(numbered_volume(SHEARED), resample=True))
    assert straight.spacing == pytest.approx((0.7, 0.5, 1.25))
    assert straight.shape[0] == SHAPE[0]
    assert straight.voxels.min() == AIR_HU


@to_libraries_of_right_angles
def test_a_volume_at_right_angles_keeps_its_voxels_where_resampling_is_allowed(library):
    convert, convert_back = WAYS[library]
    volume = numbered_volume(AFFINES["oblique"])
    assert np.array_equal(convert_back(convert(volume, resample=True)).voxels, volume.voxels)


def test_shear_returns_unchanged_from_nibabel():
    returned = Volume.from_nibabel(numbered_volume(SHEARED).to_nibabel())
    assert np.abs(returned.affine - SHEARED).max() <= tolerances.FLOAT64_PLACE_MM


def test_an_image_of_nibabel_with_shear_has_a_matrix_but_no_quaternion():
    volume = numbered_volume(SHEARED)
    header = volume.to_nibabel().header
    assert (header["sform_code"], header["qform_code"]) == (1, 0)
    assert header["pixdim"][1:4] == pytest.approx(volume.spacing, rel=tolerances.FLOAT32_SHARE)


RAMP_A_MM = np.array([17.0, -11.0, 9.0])


@pytest.fixture(scope="module")
def uneven_ramp() -> Volume:
    """6 uneven slices, the smallest step 0.25 mm, whose values rise evenly in space."""
    volume = uneven(np.zeros((6, 5, 4), np.float32))
    k, j, i = np.indices(volume.shape).reshape(3, -1)
    values = volume.ijk_to_lps(np.column_stack([i, j, k])) @ RAMP_A_MM
    return volume.with_voxels(values.reshape(volume.shape))


@to_every_library
def test_an_uneven_volume_is_refused_where_resampling_was_not_asked_for(library, uneven_ramp):
    convert, _ = WAYS[library]
    with refused(UsageError, convert.__name__, "resample=True", "MM"):
        convert(uneven_ramp)


@to_every_library
def test_an_uneven_volume_is_resampled_to_its_smallest_step(library, uneven_ramp):
    convert, convert_back = WAYS[library]
    even = convert_back(convert(uneven_ramp, resample=True))
    assert even.spacing == pytest.approx((0.5, 0.7, 0.25))
    assert even.shape[0] == 1 + 9.0 / 0.25  # the slices reach over 9 mm


@to_every_library
def test_a_ramp_in_uneven_slices_is_the_ramp_once_resampled(library, uneven_ramp):
    convert, convert_back = WAYS[library]
    even = convert_back(convert(uneven_ramp, resample=True))
    k, j, i = np.indices(even.shape).reshape(3, -1)
    points = even.ijk_to_lps(np.column_stack([i, j, k]))
    ijk = uneven_ramp.lps_to_ijk(points)
    is_within = ((ijk >= 0) & (ijk <= np.array(uneven_ramp.shape_ijk) - 1)).all(axis=1)
    assert is_within.sum() > 200  # 420 of 1,184 voxels were measured
    error = np.abs(even.voxels.ravel() - points @ RAMP_A_MM)[is_within]
    assert error.max() <= 10 * tolerances.RESAMPLED_RAMP_HU  # values of some thousand HU


def test_resampling_slices_too_near_for_a_grid_is_refused_with_their_number():
    table = np.array([(0, 0, 0), (0, 0, 1e-4), (0, 0, 100.0)])  # over 100 mm, in steps of 1e-4 mm
    volume = Volume(np.zeros((3, 50, 50), np.int16), np.diag((1.0, 1.0, 50.0, 1.0)), slice_positions=table)
    assert 50 * 50 * (100 / 1e-4 + 1) > MOST_VOXELS
    with refused(RefusedInputError, 50, 100 / 1e-4 + 1):
        volume.to_pyvista(resample=True)


@pytest.fixture
def image_in_ras():
    """An image of pyvista of the oblique volume, in RAS without a name of its frame."""
    volume = numbered_volume(AFFINES["oblique"])
    image = volume.to_pyvista()
    in_ras = pyvista.ImageData(dimensions=image.dimensions, spacing=image.spacing)
    affine = np.diag((-1, -1, 1, 1)) @ volume.affine
    in_ras.SetOrigin(affine[:3, 3])
    in_ras.SetDirectionMatrix(*(affine[:3, :3] / image.spacing).ravel())
    in_ras.point_data["values"] = image["HU"]
    return in_ras


@pytest.mark.parametrize(
    ("space", "named_in_data"),
    [("ras", False), ("ras", True), (None, True)],
    ids=["by the caller", "by both", "in the data"],
)
def test_an_image_of_pyvista_in_ras_becomes_a_volume_in_lps(image_in_ras, named_in_data, space):
    if named_in_data:
        image_in_ras.field_data["SPACE"] = ["RAS"]
    volume = Volume.from_pyvista(image_in_ras, space=space)
    assert np.abs(volume.affine - AFFINES["oblique"]).max() <= tolerances.FLOAT64_PLACE_MM


def test_a_plain_image_of_vtk_becomes_the_volume_that_its_copy_in_pyvista_becomes():
    from vtkmodules.vtkCommonDataModel import vtkImageData

    volume = numbered_volume(AFFINES["oblique"])
    plain = vtkImageData()
    plain.DeepCopy(volume.to_pyvista())

    back = Volume.from_pyvista(plain)

    assert np.array_equal(back.voxels, volume.voxels)
    assert np.abs(back.affine - volume.affine).max() <= tolerances.FLOAT64_PLACE_MM


def test_an_image_of_pyvista_whose_frame_contradicts_the_caller_is_refused(image_in_ras):
    image_in_ras.field_data["SPACE"] = ["RAS"]
    with refused(UsageError, "RAS", "LPS"):
        Volume.from_pyvista(image_in_ras, space="lps")


def test_an_image_of_pyvista_in_an_unknown_frame_is_refused(image_in_ras):
    with refused(UsageError, "xyz"):
        Volume.from_pyvista(image_in_ras, space="xyz")


@pytest.mark.parametrize("name", ["oblique", "left-handed"])
def test_first_and_last_voxel_of_a_part_of_an_image_of_pyvista_lie_where_they_did(name):
    volume = numbered_volume(AFFINES[name])
    part = Volume.from_pyvista(volume.to_pyvista().extract_subset((1, 2, 0, 3, 2, 4)))
    first, last = (0, 0, 0), (1, 3, 2)
    points = part.ijk_to_lps([first, last])
    ijk = np.rint(volume.lps_to_ijk(points)).astype(int)
    assert np.abs(volume.ijk_to_lps(ijk) - points).max() <= tolerances.FLOAT64_PLACE_MM
    expected = [volume.voxels[k, j, i] for i, j, k in ijk]
    assert [part.voxels[k, j, i] for i, j, k in (first, last)] == expected


def test_named_point_data_of_an_image_of_pyvista_become_the_voxels():
    volume = numbered_volume(AFFINES["oblique"])
    image = volume.to_pyvista()
    image.point_data["doubled"] = image["HU"] * 2
    assert np.array_equal(Volume.from_pyvista(image, "doubled").voxels, 2 * volume.voxels)


def test_a_volume_from_pyvista_has_voxels_of_its_own():
    image = numbered_volume(AFFINES["oblique"]).to_pyvista()
    volume = Volume.from_pyvista(image)
    image["HU"][:] = 0
    assert np.array_equal(volume.voxels, numbered_volume(AFFINES["oblique"]).voxels)


def test_voxels_of_an_image_of_pyvista_whose_indices_begin_elsewhere_lie_where_its_points_do():
    image = numbered_volume(AFFINES["oblique"]).to_pyvista()
    image.offset = (2, -1, 7)  # the first point is no longer the origin
    volume = Volume.from_pyvista(image)
    assert np.abs(volume.ijk_to_lps(IJK) - image.points).max() <= tolerances.IMAGE_POINT_MM
    assert np.abs(volume.affine - AFFINES["oblique"]).max() > 1.0


@pytest.fixture(params=[(1.0, "int16"), (4096.0, "int32"), (0.5, "float32")], ids=lambda param: f"slope {param[0]:g}")
def scaled_nifti(request, tmp_path):
    """A NIfTI file of the numbers 0 to 59 with slope and an intercept of -1024, its HU, and their smallest type."""
    slope, dtype = request.param
    stored = np.arange(60, dtype=np.int16).reshape(3, 4, 5)
    image = nibabel.Nifti1Image(stored, np.eye(4))
    image.header.set_slope_inter(slope, -1024.0)
    path = tmp_path / "scaled.nii.gz"
    nibabel.save(image, path)  # the numbers as they are, slope and intercept in the header
    return path, (stored.T * slope - 1024.0).astype(dtype)


def test_scaled_values_of_an_image_of_nibabel_are_hu_in_the_smallest_type(scaled_nifti):
    path, hu = scaled_nifti
    volume = Volume.from_nibabel(nibabel.load(path))
    assert volume.dtype == hu.dtype
    assert np.array_equal(volume.voxels, hu)


def test_a_scaled_nifti_is_read_as_by_way_of_nibabel(scaled_nifti):
    path, _ = scaled_nifti
    volume, read = Volume.from_nibabel(nibabel.load(path)), clrecon.read_volume(path)
    assert read.dtype == volume.dtype
    assert np.array_equal(read.voxels, volume.voxels)
    assert np.array_equal(read.affine, volume.affine)


def test_an_image_of_nibabel_in_micrometres_becomes_a_volume_in_mm():
    image = numbered_volume(AFFINES["oblique"]).to_nibabel()
    image.header.set_xyzt_units("micron")
    affine = Volume.from_nibabel(image).affine
    mm_a_micrometre = 0.001
    assert np.abs(affine[:3] - mm_a_micrometre * AFFINES["oblique"][:3]).max() <= tolerances.FLOAT64_PLACE_MM


def test_an_image_of_nibabel_in_an_unknown_unit_is_refused():
    image = numbered_volume(AFFINES["oblique"]).to_nibabel()
    image.header["xyzt_units"] = 7
    with refused(UsageError, "code", 7):
        Volume.from_nibabel(image)


def test_an_image_of_nibabel_without_an_affine_is_refused():
    with refused(UsageError, "affine", "sform_code"):
        Volume.from_nibabel(nibabel.Nifti1Image(np.zeros((3, 4, 5), np.int16), None))


def test_an_image_of_another_format_of_nibabel_becomes_a_volume_in_lps():
    image = nibabel.MGHImage(np.arange(60, dtype=np.int16).reshape(3, 4, 5), np.diag((1, 2, 3, 1)))
    assert Volume.from_nibabel(image).affine.diagonal().tolist() == [-1, -2, 3, 1]


def test_a_fourth_axis_of_one_is_left_out_of_an_image_of_nibabel():
    image = nibabel.Nifti1Image(np.zeros((3, 4, 5, 1), np.int16), np.eye(4))
    assert Volume.from_nibabel(image).shape == (5, 4, 3)


def image_with_nan_in_its_affine() -> object:
    image = numbered_volume(AFFINES["oblique"]).to_nibabel()
    image.affine[0, 0] = np.nan
    return image


def image_of_colours() -> object:
    return nibabel.Nifti1Image(np.zeros((3, 4, 5), [("R", "u1"), ("G", "u1"), ("B", "u1")]), np.eye(4))


@pytest.mark.parametrize(
    ("convert", "words"),
    [
        (lambda: Volume.from_sitk(np.zeros((2, 2, 2))), "ndarray is no SimpleITK.Image"),
        (lambda: Volume.from_sitk(sitk.Image(4, 4, sitk.sitkInt16)), "2 axes, a volume has three"),
        (lambda: Volume.from_sitk(sitk.Image([4, 4, 4, 2], sitk.sitkInt16)), r"4 axes.*image\[:, :, :, 0\]"),
        (lambda: Volume.from_sitk(sitk.Image([4, 4, 4], sitk.sitkVectorUInt8, 3)), "vector of 8-bit.*one real number"),
        (lambda: Volume.from_sitk(sitk.Image([4, 4, 4], sitk.sitkComplexFloat32)), "complex.*one real number"),
        (lambda: Volume.from_sitk(sitk.Image([4, 4, 4], sitk.sitkLabelUInt8)), "label.*one real number"),
        (lambda: Volume.from_nibabel("ct.nii"), r"str is no image of nibabel.*nibabel\.load"),
        (lambda: Volume.from_nibabel(image_of_colours()), "colours"),
        (
            lambda: Volume.from_nibabel(nibabel.Nifti1Image(np.zeros((2, 3, 4), np.complex64), np.eye(4))),
            "complex64: a volume has one real number",
        ),
        (
            lambda: Volume.from_nibabel(nibabel.Nifti1Image(np.zeros((2, 3, 4, 5), np.int16), np.eye(4))),
            r"\(2, 3, 4, 5\).*image\.slicer\[\.\.\., 0\]",
        ),
        (lambda: Volume.from_nibabel(nibabel.Nifti1Image(np.zeros((2, 3), np.int16), np.eye(4))), "three axes"),
        (lambda: Volume.from_nibabel(image_with_nan_in_its_affine()), "NaN"),
        (lambda: Volume.from_pyvista(pyvista.Cube()), "PolyData is no pyvista.ImageData"),
        (lambda: Volume.from_pyvista(np.zeros(3)), "ndarray is no pyvista.ImageData"),
        (lambda: Volume.from_pyvista(pyvista.RectilinearGrid([0, 1, 3])), "RectilinearGrid is no"),
        (lambda: Volume.from_pyvista(pyvista.ImageData(dimensions=(2, 2, 2))), "no active scalars; it has none"),
        (
            lambda: Volume.from_pyvista(numbered_volume(AFFINES["oblique"]).to_pyvista(), "ct"),
            "no point data 'ct'; it has HU",
        ),
        (lambda: Volume.from_pyvista(with_data(cells=True)), r"belong to its cells.*cells_to_points"),
        (lambda: Volume.from_pyvista(with_data(cells=False)), "3 numbers a point"),
    ],
    ids=[
        "array for SimpleITK",
        "two axes of SimpleITK",
        "four axes of SimpleITK",
        "vectors",
        "complex numbers",
        "labels of SimpleITK",
        "path for nibabel",
        "colours",
        "complex numbers of nibabel",
        "four axes of nibabel",
        "two axes of nibabel",
        "affine of NaN",
        "surface of pyvista",
        "array for pyvista",
        "uneven grid of pyvista",
        "image without data",
        "image without the named data",
        "data of cells",
        "three numbers a point",
    ],
)
def test_images_that_hold_no_volume_are_refused_in_one_short_line(convert, words):
    with pytest.raises(UsageError, match=words) as caught:
        convert()
    assert_one_line(caught.value, letters=250)


def with_data(cells: bool) -> object:
    image = pyvista.ImageData(dimensions=(3, 3, 3))
    if cells:
        image.cell_data["HU"] = np.arange(8)
    else:
        image.point_data["RGB"] = np.zeros((27, 3), np.uint8)
    return image


@pytest.mark.parametrize(("module", "name"), [("SimpleITK", "sitk"), ("nibabel", "nibabel")])
def test_a_missing_package_is_named_on_the_way_to_it_and_back(monkeypatch, module, name):
    monkeypatch.setitem(sys.modules, module, None)
    with refused(UsageError, module):
        getattr(numbered_volume(AFFINES["straight"]), f"to_{name}")()
    with refused(UsageError, module):
        getattr(Volume, f"from_{name}")(None)
