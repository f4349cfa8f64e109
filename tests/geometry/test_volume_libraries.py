"""Volumes to numpy, SimpleITK, nibabel and pyvista and back: every voxel at its place, the affine as it was."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import refused
from uneven_volume import uneven

import clrecon
from clrecon import LabelMap, OutputError, UsageError, Volume
from clrecon.errors import RefusedInputError
from clrecon.geometry import AIR_HU, compose_affine, is_left_handed

pyvista = pytest.importorskip("pyvista")
sitk = pytest.importorskip("SimpleITK")
nibabel = pytest.importorskip("nibabel")

SHAPE = (5, 4, 3)
STEPS = rotation((25.0, -40.0, 70.0)) * (0.7, 0.5, 1.25)
ORIGIN = (-120.0, 83.0, -210.5)


def placed(steps: np.ndarray, origin: tuple[float, float, float] = ORIGIN) -> np.ndarray:
    """Return the affine with the columns of `steps`, (3, 3)."""
    i, j, k = steps.T
    return compose_affine(i, j, k, origin)


AFFINES = {
    "straight": placed(np.diag((0.7, 0.5, 1.25))),
    "oblique": placed(STEPS),
    "left-handed": placed(STEPS * (1, 1, -1)),
    "left-handed, i": placed(STEPS * (-1, 1, 1)),
    "flipped": placed(np.diag((-0.7, -0.5, 1.25))),
    "sagittal": compose_affine((0, 0.7, 0), (0, 0, -0.5), (-1.25, 0, 0), ORIGIN),
}
SHEARED = placed(STEPS @ np.array([[1, 0, 0], [0, 1, 0.3], [0, 0, 1]]))
DTYPES = ("int8", "uint8", "int16", "uint16", "int32", "float32")
IJK = np.array([(i, j, k) for k in range(5) for j in range(4) for i in range(3)])
WAYS = {
    "pyvista": (Volume.to_pyvista, Volume.from_pyvista),
    "SimpleITK": (Volume.to_sitk, Volume.from_sitk),
    "nibabel": (Volume.to_nibabel, Volume.from_nibabel),
}


def numbered(affine: np.ndarray, dtype: str = "int16") -> Volume:
    return Volume(np.arange(60, dtype=dtype).reshape(SHAPE) - (0 if dtype[0] == "u" else 30), affine)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", AFFINES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_volumes_return_unchanged_from_other_libraries(way, name, dtype):
    volume = numbered(AFFINES[name], dtype)
    there, back = WAYS[way]
    made = back(there(volume))
    assert type(made) is Volume and made.dtype == volume.dtype and np.array_equal(made.voxels, volume.voxels)
    assert np.abs(made.affine - volume.affine).max() <= tolerances.FLOAT64_PLACE_MM
    assert made.report == {"warnings": []} and made.certificate is None
    assert is_left_handed(made.affine) == ("left" in name)


@pytest.mark.parametrize("name", AFFINES)
def test_simpleitk_puts_every_voxel_where_it_is(name):
    """By its own physical points, which are in LPS."""
    volume = numbered(AFFINES[name])
    image = volume.to_sitk()
    assert image.GetSize() == (3, 4, 5) and image.GetPixelIDTypeAsString() == "16-bit signed integer"
    places = [image.TransformIndexToPhysicalPoint(ijk) for ijk in IJK.tolist()]
    assert np.abs(volume.ijk_to_lps(IJK) - places).max() <= tolerances.FLOAT64_PLACE_MM
    assert [image[tuple(ijk)] for ijk in IJK.tolist()] == volume.voxels.ravel().tolist()


@pytest.mark.parametrize("name", AFFINES)
def test_nibabel_puts_every_voxel_where_it_is(name):
    """By its own affine, which leads to RAS."""
    volume = numbered(AFFINES[name])
    image = volume.to_nibabel()
    assert image.shape == (3, 4, 5) and np.shares_memory(image.dataobj, volume.voxels)
    places = nibabel.affines.apply_affine(image.affine, IJK) * (-1, -1, 1)
    assert np.abs(volume.ijk_to_lps(IJK) - places).max() <= tolerances.FLOAT64_PLACE_MM
    assert [image.dataobj[tuple(ijk)] for ijk in IJK] == volume.voxels.ravel().tolist()


@pytest.mark.parametrize("name", AFFINES)
def test_nibabel_knows_unit_frame_and_directions(name):
    volume = numbered(AFFINES[name])
    image = volume.to_nibabel()
    assert image.header.get_xyzt_units()[0] == "mm"
    assert image.header["sform_code"] == image.header["qform_code"] == 1
    assert nibabel.aff2axcodes(image.affine) == nibabel.aff2axcodes(np.diag((-1, -1, 1, 1)) @ volume.affine)


@pytest.mark.parametrize("name", AFFINES)
@pytest.mark.parametrize("extension", [".nii.gz", ".nrrd", ".mha"])
def test_a_saved_volume_is_read_alike_by_all(tmp_path, name, extension):
    volume = numbered(AFFINES[name])
    path = tmp_path / f"ct{extension}"
    assert volume.save(path) == path.stat().st_size
    read = clrecon.read_volume(path)
    itk = Volume.from_sitk(sitk.ReadImage(str(path)))
    made = [read, itk, Volume.from_nibabel(nibabel.load(path))] if "nii" in extension else [read, itk]
    for each in made:
        ijk = np.rint(volume.lps_to_ijk(each.ijk_to_lps(IJK))).astype(int)
        assert np.abs(volume.ijk_to_lps(ijk) - each.ijk_to_lps(IJK)).max() <= tolerances.NIFTI_LARGE_AFFINE_MM
        assert np.array_equal(volume.voxels[tuple(ijk.T[::-1])], each.voxels[tuple(IJK.T[::-1])])


def test_save_is_write_volume(tmp_path):
    volume = numbered(SHEARED)
    assert volume.save(tmp_path / "a.nrrd") == clrecon.write_volume(volume, tmp_path / "b.nrrd")
    assert (tmp_path / "a.nrrd").read_bytes() == (tmp_path / "b.nrrd").read_bytes()


def test_a_sheared_volume_is_resampled_to_be_saved_at_right_angles(tmp_path):
    told: list[tuple[str, int, int]] = []
    numbered(SHEARED).save(tmp_path / "a.mha", resample=0.5, progress=lambda *call: told.append(call))
    assert Volume.from_sitk(sitk.ReadImage(str(tmp_path / "a.mha"))).spacing == pytest.approx((0.5, 0.5, 0.5))
    assert {"resample", "write"} == {stage for stage, _, _ in told}


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
        numbered(SHEARED).save(tmp_path / name, **options)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["older"]


def test_numpy_takes_a_volume_as_its_voxels_without_a_copy():
    volume = numbered(AFFINES["oblique"])
    assert np.asarray(volume) is volume.voxels
    assert (volume.shape, volume.dtype) == (SHAPE, np.int16)


def test_numpy_takes_a_label_map_as_its_voxels_without_a_copy():
    labels = LabelMap(np.ones(SHAPE, np.uint8), np.eye(4))
    assert np.asarray(labels) is labels.voxels
    assert (labels.shape, labels.dtype) == (SHAPE, np.uint8)


def test_an_array_made_of_a_volume_is_a_copy():
    volume = numbered(AFFINES["oblique"])
    assert not np.shares_memory(np.array(volume), volume.voxels)
    assert not np.shares_memory(volume.__array__(copy=True), volume.voxels)


def test_numpy_takes_a_volume_as_another_type():
    volume = numbered(AFFINES["oblique"])
    wide = np.asarray(volume, dtype=np.float64)
    assert wide.dtype == np.float64 and np.array_equal(wide, volume.voxels)


@pytest.mark.skipif(np.lib.NumpyVersion(np.__version__) < "2.0.0", reason="asarray has no copy= before numpy 2")
def test_numpy_is_refused_another_type_without_a_copy():
    volume = numbered(AFFINES["oblique"])
    assert np.asarray(volume, copy=False) is volume.voxels
    with refused(ValueError, "int16", "float32"):
        np.asarray(volume, dtype="f4", copy=False)


def test_functions_of_numpy_take_a_volume():
    volume = numbered(AFFINES["oblique"])  # the numbers -30 to 29
    assert np.mean(volume) == -0.5
    assert (np.asarray(volume) > 3).sum() == 26


@pytest.mark.parametrize("way", ["pyvista", "SimpleITK"])
def test_sheared_volumes_are_resampled_only_when_asked(way):
    there, back = WAYS[way]
    with refused(UsageError, 6.84, there.__name__, "resample=True"):
        there(numbered(SHEARED))
    straight = back(there(numbered(SHEARED), resample=True))
    gap = 1.25
    assert straight.spacing == pytest.approx((0.7, 0.5, gap)) and straight.shape[0] == SHAPE[0]
    assert straight.voxels.min() == AIR_HU
    same = back(there(numbered(AFFINES["oblique"]), resample=True))
    assert np.array_equal(same.voxels, numbered(AFFINES["oblique"]).voxels)


def test_nibabel_holds_shear():
    volume = numbered(SHEARED)
    made = Volume.from_nibabel(volume.to_nibabel())
    assert np.abs(made.affine - SHEARED).max() <= tolerances.FLOAT64_PLACE_MM
    header = volume.to_nibabel().header
    assert (header["sform_code"], header["qform_code"]) == (1, 0)
    assert header["pixdim"][1:4] == pytest.approx(volume.spacing, rel=1e-6)


@pytest.mark.parametrize("way", WAYS)
def test_uneven_volumes_go_in_the_smallest_step_of_their_slices(way):
    there, back = WAYS[way]
    volume = uneven(np.zeros((6, 5, 4), np.float32))
    ramp = np.array([17.0, -11.0, 9.0])
    k, j, i = np.indices(volume.shape).reshape(3, -1)
    field = volume.ijk_to_lps(np.column_stack([i, j, k])) @ ramp
    volume = volume.with_voxels(field.reshape(volume.shape))
    with refused(UsageError, there.__name__, "resample=True", "MM"):
        there(volume)
    made = back(there(volume, resample=True))
    assert made.spacing == pytest.approx((0.5, 0.7, 0.25))  # heights 8.75 and 9.0 are the nearest
    assert made.shape[0] == 37
    points = np.array([(i, j, k) for k in range(37) for j in range(5) for i in range(4)])
    ijk = volume.lps_to_ijk(made.ijk_to_lps(points))
    within = ((ijk >= 0) & (ijk <= np.array(volume.shape_ijk) - 1)).all(axis=1)
    found = made.voxels[tuple(points.T[::-1])]
    assert within.sum() > 100
    assert np.abs(found - made.ijk_to_lps(points) @ ramp)[within].max() <= 10 * tolerances.RESAMPLED_RAMP_HU


def test_slices_too_near_for_a_grid_are_refused():
    table = np.array([(0, 0, 0), (0, 0, 1e-4), (0, 0, 100.0)])
    volume = Volume(np.zeros((3, 50, 50), np.int16), np.diag((1.0, 1.0, 50.0, 1.0)), slice_positions=table)
    with refused(RefusedInputError, 50, 1000001):
        volume.to_pyvista(resample=True)


def test_pyvista_image_in_ras_is_turned_and_a_contradiction_refused():
    volume = numbered(AFFINES["oblique"])
    image = volume.to_pyvista()
    turned = pyvista.ImageData(dimensions=image.dimensions, spacing=image.spacing)
    ras = np.diag((-1, -1, 1, 1)) @ volume.affine
    turned.SetOrigin(ras[:3, 3])
    turned.SetDirectionMatrix(*(ras[:3, :3] / image.spacing).ravel())
    turned.point_data["values"] = image["HU"]
    for space in ("ras", None):
        assert np.abs(Volume.from_pyvista(turned, space="ras").affine - volume.affine).max() <= 1e-9
        turned.field_data["SPACE"] = ["RAS"]
        assert np.abs(Volume.from_pyvista(turned, space=space).affine - volume.affine).max() <= 1e-9
    with refused(UsageError, "RAS", "LPS"):
        Volume.from_pyvista(turned, space="lps")
    with refused(UsageError, "xyz"):
        Volume.from_pyvista(image, space="xyz")


def test_parts_of_pyvista_images_lie_where_they_were():
    for name in ("oblique", "left-handed"):
        volume = numbered(AFFINES[name])
        part = volume.to_pyvista().extract_subset((1, 2, 0, 3, 2, 4))
        made = Volume.from_pyvista(part)
        ijk = np.rint(volume.lps_to_ijk(made.ijk_to_lps([(0, 0, 0), (1, 3, 2)]))).astype(int)
        assert np.abs(volume.ijk_to_lps(ijk) - made.ijk_to_lps([(0, 0, 0), (1, 3, 2)])).max() <= 1e-9
        assert [made.voxels[0, 0, 0], made.voxels[2, 3, 1]] == [volume.voxels[tuple(one[::-1])] for one in ijk]
    image = volume.to_pyvista()
    image.point_data["doubled"] = image["HU"] * 2
    assert np.array_equal(Volume.from_pyvista(image, "doubled").voxels, 2 * volume.voxels)


def test_voxels_of_pyvista_are_copied_and_lie_where_its_points_do():
    volume = numbered(AFFINES["oblique"])
    image = volume.to_pyvista()
    made = Volume.from_pyvista(image)
    image["HU"][:] = 0
    assert (volume.voxels == 0).all() and np.array_equal(made.voxels, numbered(AFFINES["oblique"]).voxels)
    image.offset = (2, -1, 7)  # indices that begin elsewhere: the first point is no longer the origin
    moved = Volume.from_pyvista(image)
    assert np.abs(moved.ijk_to_lps(IJK) - image.points).max() <= tolerances.IMAGE_POINT_MM
    assert np.abs(moved.affine - volume.affine).max() > 1.0


def test_scaled_values_of_nibabel_are_hu(tmp_path):
    stored = np.arange(60, dtype=np.int16).reshape(3, 4, 5)
    for slope, kept in ((1.0, "int16"), (4096.0, "int32"), (0.5, "float32")):
        image = nibabel.Nifti1Image(stored, np.eye(4))
        image.header.set_slope_inter(slope, -1024.0)
        path = tmp_path / f"{slope:g}.nii.gz"
        nibabel.save(image, path)  # the numbers as they are, slope and intercept in the header
        made = Volume.from_nibabel(nibabel.load(path))
        assert made.dtype == kept
        assert np.array_equal(made.voxels, (stored.T * slope - 1024.0).astype(kept))
        read = clrecon.read_volume(path)
        assert read.dtype == made.dtype and np.array_equal(read.voxels, made.voxels)
        assert np.array_equal(read.affine, made.affine)


def test_nibabel_units_are_converted_and_images_without_place_refused():
    image = numbered(AFFINES["oblique"]).to_nibabel()
    image.header.set_xyzt_units("micron")
    assert np.abs(Volume.from_nibabel(image).affine[:3] - 0.001 * AFFINES["oblique"][:3]).max() <= 1e-9
    image.header["xyzt_units"] = 7
    with refused(UsageError, "code", 7):
        Volume.from_nibabel(image)
    bare = nibabel.Nifti1Image(np.zeros((3, 4, 5), np.int16), None)
    with refused(UsageError, "affine", "sform_code"):
        Volume.from_nibabel(bare)
    other = nibabel.MGHImage(np.arange(60, dtype=np.int16).reshape(3, 4, 5), np.diag((1, 2, 3, 1)))
    assert Volume.from_nibabel(other).affine.diagonal().tolist() == [-1, -2, 3, 1]
    four = nibabel.Nifti1Image(np.zeros((3, 4, 5, 1), np.int16), np.eye(4))
    assert Volume.from_nibabel(four).shape == (5, 4, 3)


def not_a_number() -> object:
    image = numbered(AFFINES["oblique"]).to_nibabel()
    image.affine[0, 0] = np.nan
    return image


def rgb() -> object:
    return nibabel.Nifti1Image(np.zeros((3, 4, 5), [("R", "u1"), ("G", "u1"), ("B", "u1")]), np.eye(4))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Volume.from_sitk(np.zeros((2, 2, 2))), "ndarray is no SimpleITK.Image"),
        (lambda: Volume.from_sitk(sitk.Image(4, 4, sitk.sitkInt16)), "2 axes, a volume has three"),
        (lambda: Volume.from_sitk(sitk.Image([4, 4, 4, 2], sitk.sitkInt16)), r"4 axes.*image\[:, :, :, 0\]"),
        (lambda: Volume.from_sitk(sitk.Image([4, 4, 4], sitk.sitkVectorUInt8, 3)), "vector of 8-bit.*one real number"),
        (lambda: Volume.from_sitk(sitk.Image([4, 4, 4], sitk.sitkComplexFloat32)), "complex.*one real number"),
        (lambda: Volume.from_sitk(sitk.Image([4, 4, 4], sitk.sitkLabelUInt8)), "label.*one real number"),
        (lambda: Volume.from_nibabel("ct.nii"), r"str is no image of nibabel.*nibabel\.load"),
        (lambda: Volume.from_nibabel(rgb()), "colours"),
        (
            lambda: Volume.from_nibabel(nibabel.Nifti1Image(np.zeros((2, 3, 4), np.complex64), np.eye(4))),
            "complex64: a volume has one real number",
        ),
        (
            lambda: Volume.from_nibabel(nibabel.Nifti1Image(np.zeros((2, 3, 4, 5), np.int16), np.eye(4))),
            r"\(2, 3, 4, 5\).*image\.slicer\[\.\.\., 0\]",
        ),
        (lambda: Volume.from_nibabel(nibabel.Nifti1Image(np.zeros((2, 3), np.int16), np.eye(4))), "three axes"),
        (lambda: Volume.from_nibabel(not_a_number()), "NaN"),
        (lambda: Volume.from_pyvista(pyvista.Cube()), "PolyData is no pyvista.ImageData"),
        (lambda: Volume.from_pyvista(np.zeros(3)), "ndarray is no pyvista.ImageData"),
        (lambda: Volume.from_pyvista(pyvista.RectilinearGrid([0, 1, 3])), "RectilinearGrid is no"),
        (lambda: Volume.from_pyvista(pyvista.ImageData(dimensions=(2, 2, 2))), "no active scalars; it has none"),
        (lambda: Volume.from_pyvista(numbered(AFFINES["oblique"]).to_pyvista(), "ct"), "no point data 'ct'; it has HU"),
        (lambda: Volume.from_pyvista(with_data(cells=True)), r"belong to its cells.*cells_to_points"),
        (lambda: Volume.from_pyvista(with_data(cells=False)), "3 numbers a point"),
    ],
)
def test_what_is_no_volume_is_refused_in_one_line(make, words):
    with pytest.raises(UsageError, match=words) as refused:
        make()
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 250


def with_data(cells: bool) -> object:
    image = pyvista.ImageData(dimensions=(3, 3, 3))
    if cells:
        image.cell_data["HU"] = np.arange(8)
    else:
        image.point_data["RGB"] = np.zeros((27, 3), np.uint8)
    return image


@pytest.mark.parametrize(("module", "way"), [("SimpleITK", "sitk"), ("nibabel", "nibabel")])
def test_a_missing_package_is_named(monkeypatch, module, way):
    monkeypatch.setitem(sys.modules, module, None)
    volume = numbered(AFFINES["straight"])
    for call in (getattr(volume, f"to_{way}"), lambda: getattr(Volume, f"from_{way}")(None)):
        with refused(UsageError, module):
            call()
