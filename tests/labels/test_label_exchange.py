"""Label maps handed to files and other libraries and taken back: numbers, places and names."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused

import clrecon
from clrecon import LabelMap
from clrecon.errors import OutputError, UsageError

NAMES = {1: "vertebrae_L4", 700: "vertebrae_L3", 9: "absent & <odd>"}
OBLIQUE = np.array([[0.8, 0.0, 0.6, -20.0], [0.0, -0.7, 0.0, 30.0], [-0.6, 0.0, 0.8, 5.0], [0.0, 0.0, 0.0, 1.0]])
SHEARED = OBLIQUE + np.array([[0, 0, 0, 0], [0, 0, 0.3, 0], [0, 0, 0, 0], [0, 0, 0, 0]])


def label_map_of_two_voxels(affine: np.ndarray = OBLIQUE) -> LabelMap:
    """Label 1 in voxel [0, 1, 2] and label 700 in [2, 3, 4] (k, j, i); 9 has a name and no voxel."""
    voxels = np.zeros((3, 4, 5), np.uint16)
    voxels[0, 1, 2], voxels[2, 3, 4] = 1, 700
    return LabelMap(voxels, affine, NAMES)


PLACE_OF_700 = (OBLIQUE @ [4.0, 3.0, 2.0, 1.0])[:3]


def test_voxels_of_one_label_or_several_are_those_of_their_numbers() -> None:
    labels = label_map_of_two_voxels()
    assert np.argwhere(labels.voxels_of("L3")).tolist() == [[2, 3, 4]]
    assert np.argwhere(labels.voxels_of(["L4", 700])).tolist() == [[0, 1, 2], [2, 3, 4]]


def test_voxels_of_a_label_that_is_not_in_the_map_are_refused() -> None:
    with refused(UsageError, "L1", "label"):
        label_map_of_two_voxels().voxels_of("L1")


def test_map_of_some_labels_keeps_their_numbers_names_and_places() -> None:
    labels = label_map_of_two_voxels()
    some = labels.only("L3")
    assert some.voxels.dtype == np.uint16
    assert some.counts == {700: 1}
    assert some.names == {700: "vertebrae_L3"}
    assert np.array_equal(some.affine, labels.affine)


def test_map_of_some_labels_keeps_frame_of_reference_and_warnings() -> None:
    voxels = label_map_of_two_voxels().voxels
    labels = LabelMap(voxels, OBLIQUE, NAMES, frame_of_reference_hash="f", warnings=["doubtful"])
    some = labels.only("L3")
    assert (some.frame_of_reference_hash, some.warnings) == ("f", ("doubtful",))


def test_map_is_left_as_it_is_where_some_of_its_labels_are_taken() -> None:
    labels = label_map_of_two_voxels()
    labels.only("L3")
    assert labels.counts == {1: 1, 700: 1}


@pytest.mark.parametrize("name", ["map.nii.gz", "MAP.NII"])
@pytest.mark.parametrize("affine", [OBLIQUE, SHEARED], ids=["oblique", "sheared"])
def test_saved_map_is_read_with_the_same_voxels_names_and_places(affine: np.ndarray, name: str, tmp_path: Path) -> None:
    labels = label_map_of_two_voxels(affine)
    labels.save(tmp_path / name)
    read = clrecon.read_labels(tmp_path / name)
    assert np.array_equal(read.voxels, labels.voxels)
    assert read.names == labels.names
    np.testing.assert_allclose(read.affine, affine, atol=tolerances.NIFTI_AFFINE_MM)


def test_saving_a_map_returns_the_bytes_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "map.nii.gz"
    assert label_map_of_two_voxels().save(path) == path.stat().st_size


def test_map_is_not_saved_over_a_file_with_no_clobber(tmp_path: Path) -> None:
    path = tmp_path / "map.nii.gz"
    path.write_bytes(b"other")
    with refused(OutputError, "no_clobber=True"):
        label_map_of_two_voxels().save(path, no_clobber=True)
    assert path.read_bytes() == b"other"


def test_map_is_saved_over_a_file_by_default(tmp_path: Path) -> None:
    path = tmp_path / "map.nii.gz"
    path.write_bytes(b"other")
    label_map_of_two_voxels().save(path)
    assert clrecon.read_labels(path).numbers == (1, 700)


@pytest.mark.parametrize("name", ["map.nrrd", "map", "map.nii.zip"])
def test_map_with_another_extension_than_nifti_is_refused_and_nothing_is_written(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=re.escape("a label map is written as .nii.gz or .nii, not '") + ".*" + name):
        label_map_of_two_voxels().save(tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("library", ["sitk", "nibabel", "pyvista"])
def test_map_handed_to_another_library_and_taken_back_is_the_same(library: str) -> None:
    labels = label_map_of_two_voxels()
    image = getattr(labels, f"to_{library}")()
    back = getattr(LabelMap, f"from_{library}")(image, names=NAMES)
    assert np.array_equal(back.voxels, labels.voxels)
    assert back.names == labels.names
    np.testing.assert_allclose(back.affine, labels.affine, atol=tolerances.NIFTI_AFFINE_MM)


def test_image_of_simpleitk_has_the_numbers_at_the_places_of_the_map() -> None:
    image = label_map_of_two_voxels().to_sitk()
    assert image[4, 3, 2] == 700
    place = image.TransformIndexToPhysicalPoint((4, 3, 2))
    np.testing.assert_allclose(place, PLACE_OF_700, rtol=tolerances.LABEL_FLOAT64)


@pytest.mark.parametrize("method", ["to_sitk", "to_pyvista"])
def test_sheared_map_is_refused_where_the_library_has_no_shear(method: str) -> None:
    with refused(UsageError, "to_nibabel", "degrees"):
        getattr(label_map_of_two_voxels(SHEARED), method)()


def test_grid_of_pyvista_has_the_numbers_at_the_places_of_the_map() -> None:
    image = label_map_of_two_voxels().to_pyvista()
    assert image.active_scalars_name == "label"
    (point,) = np.flatnonzero(image["label"] == 700)
    np.testing.assert_allclose(image.points[point], PLACE_OF_700, atol=tolerances.VTK_PLACE_MM)


def test_grid_of_pyvista_keeps_the_names_of_the_map() -> None:
    labels = label_map_of_two_voxels()
    assert LabelMap.from_pyvista(labels.to_pyvista()).names == labels.names


def test_names_given_beside_a_grid_of_pyvista_go_before_its_own() -> None:
    image = label_map_of_two_voxels().to_pyvista()
    assert LabelMap.from_pyvista(image, {1: "one"}).names == {1: "one", 700: "label_700"}


def test_map_without_labels_comes_back_from_pyvista_without_names() -> None:
    empty = LabelMap(np.zeros((2, 2, 2), np.uint8), np.eye(4)).to_pyvista()
    assert LabelMap.from_pyvista(empty).names == {}


def nibabel_row(values: Any) -> Any:
    import nibabel

    return nibabel.Nifti1Image(np.asarray(values).reshape(1, 1, 3), np.eye(4))


def test_whole_numbers_of_float64_are_taken_as_labels() -> None:
    assert LabelMap.from_nibabel(nibabel_row([0.0, 2.0, 65_535.0])).numbers == (2, 65_535)


@pytest.mark.parametrize(
    "values", [[0.0, 0.5, 1.0], [0.0, np.nan, 1.0], [0.0, 1.0, 1e20]], ids=["fraction", "NaN", "beyond integers"]
)
def test_values_that_are_not_whole_numbers_are_refused_as_labels(values: list[float]) -> None:
    with refused(UsageError, "float64", "labels"):
        LabelMap.from_nibabel(nibabel_row(values))


def test_negative_whole_numbers_are_refused_as_labels() -> None:
    with refused(UsageError, 0, 65535, -1):
        LabelMap.from_nibabel(nibabel_row([0.0, -1.0, 1.0]))


def test_map_resampled_to_a_volume_has_its_grid_and_the_labels_of_resample_labels() -> None:
    labels = label_map_of_two_voxels()
    volume = clrecon.Volume(np.zeros((6, 4, 5), np.int16), OBLIQUE @ np.diag([1.0, 1.0, 0.5, 1.0]))
    resampled = labels.resample(volume)
    assert np.array_equal(resampled.voxels, clrecon.resample_labels(labels, volume).voxels)
    assert np.array_equal(resampled.affine, volume.affine)
    assert resampled.names == labels.names


def test_repr_of_resampled_labels_has_shape_exactness_and_count() -> None:
    volume = clrecon.Volume(np.zeros((6, 4, 5), np.int16), OBLIQUE @ np.diag([1.0, 1.0, 0.5, 1.0]))
    resampled = clrecon.resample_labels(label_map_of_two_voxels(), volume)
    assert repr(resampled) == "ResampledLabels((6, 4, 5), exact=False, 2 labels)"


def test_map_is_not_resampled_to_uneven_slices_which_no_affine_describes() -> None:
    positions = [(OBLIQUE @ [0.0, 0.0, k, 1.0])[:3] for k in (0.0, 1.0, 2.5)]
    uneven = clrecon.Volume(np.zeros((3, 4, 5), np.int16), OBLIQUE, slice_positions=positions)
    with refused(UsageError, "slices", "volume", "clrecon.resample_labels"):
        label_map_of_two_voxels().resample(uneven)


ARRAY_OF_ONES = np.ones((3, 4, 5), np.uint8)


def volume_in_frame_f() -> clrecon.Volume:
    return clrecon.Volume(np.zeros((3, 4, 5), np.int16), SHEARED, {"frame_of_reference_hash": "f", "warnings": []})


def test_map_of_an_array_and_a_volume_has_place_and_frame_of_the_volume() -> None:
    labels = LabelMap(ARRAY_OF_ONES, volume_in_frame_f(), {1: "bone"})
    assert np.array_equal(labels.affine, SHEARED)
    assert labels.frame_of_reference_hash == "f"
    assert labels.names == {1: "bone"}


def test_map_of_an_array_and_another_map_has_its_place_and_frame_but_not_its_names() -> None:
    other = LabelMap(ARRAY_OF_ONES, volume_in_frame_f(), {1: "bone"})
    labels = LabelMap(ARRAY_OF_ONES, other)
    assert np.array_equal(labels.affine, SHEARED)
    assert labels.frame_of_reference_hash == "f"
    assert labels.names == {1: "label_1"}


def test_frame_given_with_an_array_goes_before_that_of_the_volume() -> None:
    labels = LabelMap(ARRAY_OF_ONES, volume_in_frame_f(), frame_of_reference_hash="g")
    assert labels.frame_of_reference_hash == "g"


def test_array_of_another_shape_than_its_volume_is_refused() -> None:
    with refused(UsageError, 3, 4, 5):  # the shape of the array
        LabelMap(ARRAY_OF_ONES, volume_in_frame_f()[1:])


def test_array_on_the_uneven_slices_of_a_volume_is_refused() -> None:
    uneven = clrecon.Volume(ARRAY_OF_ONES, np.eye(4), slice_positions=[(0, 0, 0), (0, 0, 1), (0, 0, 3)])
    with refused(UsageError, "slices", "volume"):
        LabelMap(ARRAY_OF_ONES, uneven)
