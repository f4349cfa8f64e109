"""Label maps handed to files and other libraries and taken back: numbers, places and names."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon import LabelMap
from clrecon.errors import OutputError, UsageError

NAMES = {1: "vertebrae_L4", 700: "vertebrae_L3", 9: "absent & <odd>"}
OBLIQUE = np.array([[0.8, 0.0, 0.6, -20.0], [0.0, -0.7, 0.0, 30.0], [-0.6, 0.0, 0.8, 5.0], [0.0, 0.0, 0.0, 1.0]])
SHEARED = OBLIQUE + np.array([[0, 0, 0, 0], [0, 0, 0.3, 0], [0, 0, 0, 0], [0, 0, 0, 0]])


def label_map(affine: np.ndarray = OBLIQUE) -> LabelMap:
    voxels = np.zeros((3, 4, 5), np.uint16)
    voxels[0, 1, 2], voxels[2, 3, 4] = 1, 700
    return LabelMap(voxels, affine, NAMES)


def test_voxels_of_labels_are_those_of_their_numbers() -> None:
    labels = label_map()
    assert np.argwhere(labels.voxels_of("L3")).tolist() == [[2, 3, 4]]
    assert np.argwhere(labels.voxels_of(["L4", 700])).tolist() == [[0, 1, 2], [2, 3, 4]]
    with refused(UsageError, "L1", "label"):
        labels.voxels_of("L1")


def test_a_map_of_some_labels_keeps_their_numbers_names_and_places() -> None:
    labels = LabelMap(label_map().voxels, OBLIQUE, NAMES, frame_of_reference_hash="f", warnings=["doubtful"])
    some = labels.only("L3")
    assert some.counts == {700: 1} and some.names == {700: "vertebrae_L3"} and some.voxels.dtype == np.uint16
    assert np.array_equal(some.affine, labels.affine)
    assert (some.frame_of_reference_hash, some.warnings) == ("f", ("doubtful",))
    assert labels.counts == {1: 1, 700: 1}


@pytest.mark.parametrize("name", ["map.nii.gz", "MAP.NII"])
@pytest.mark.parametrize("affine", [OBLIQUE, SHEARED], ids=["oblique", "sheared"])
def test_a_saved_map_is_read_as_it_was(affine: np.ndarray, name: str, tmp_path: Path) -> None:
    labels = label_map(affine)
    path = tmp_path / name
    assert labels.save(path) == path.stat().st_size
    read = clrecon.read_labels(path)
    assert np.array_equal(read.voxels, labels.voxels) and read.names == labels.names
    np.testing.assert_allclose(read.affine, affine, atol=1e-5)  # NIfTI has places as float32
    with refused(OutputError, "no_clobber=True"):
        labels.save(path, no_clobber=True)
    before = path.read_bytes()
    label_map(OBLIQUE).only(1).save(path)
    assert path.read_bytes() != before


@pytest.mark.parametrize("name", ["map.nrrd", "map", "map.nii.zip"])
def test_other_extensions_are_refused_and_nothing_is_written(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=re.escape("a label map is written as .nii.gz or .nii, not '") + ".*" + name):
        label_map().save(tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("library", ["sitk", "nibabel", "pyvista"])
def test_another_library_gives_back_what_it_got(library: str) -> None:
    labels = label_map()
    image = getattr(labels, f"to_{library}")()
    back = getattr(LabelMap, f"from_{library}")(image, names=NAMES)
    assert np.array_equal(back.voxels, labels.voxels) and back.names == labels.names
    np.testing.assert_allclose(back.affine, labels.affine, atol=1e-5)


def test_places_in_simpleitk_are_those_of_the_map() -> None:
    image = label_map().to_sitk()
    assert image[2, 1, 0] == 1
    np.testing.assert_allclose(
        image.TransformIndexToPhysicalPoint((4, 3, 2)), (OBLIQUE @ [4.0, 3.0, 2.0, 1.0])[:3], atol=1e-12
    )
    for library in ("to_sitk", "to_pyvista"):
        with refused(UsageError, "to_nibabel", "degrees"):
            getattr(label_map(SHEARED), library)()


def test_pyvista_has_numbers_places_and_names_of_the_map() -> None:
    labels = label_map()
    image = labels.to_pyvista()
    assert image.active_scalars_name == "label"
    row = int(np.flatnonzero(image["label"] == 700)[0])
    np.testing.assert_allclose(image.points[row], (OBLIQUE @ [4.0, 3.0, 2.0, 1.0])[:3], atol=1e-5)
    assert LabelMap.from_pyvista(image).names == labels.names
    assert LabelMap.from_pyvista(image, {1: "one"}).names == {1: "one", 700: "label_700"}
    empty = LabelMap(np.zeros((2, 2, 2), np.uint8), np.eye(4)).to_pyvista()
    assert LabelMap.from_pyvista(empty).names == {}


def image_of(values: Any) -> Any:
    import nibabel

    return nibabel.Nifti1Image(np.asarray(values).reshape(1, 1, 3), np.eye(4))


def test_whole_numbers_stored_as_real_ones_are_labels_and_others_are_not() -> None:
    assert LabelMap.from_nibabel(image_of(np.array([0.0, 2.0, 65_535.0]))).numbers == (2, 65_535)
    for wrong in ([0.0, 0.5, 1.0], [0.0, np.nan, 1.0], [0.0, 1.0, 1e20]):
        with refused(UsageError, "float64", "labels"):
            LabelMap.from_nibabel(image_of(np.array(wrong)))
    with refused(UsageError, 0, 65535, -1):
        LabelMap.from_nibabel(image_of(np.array([0.0, -1.0, 1.0])))


def test_a_map_on_the_grid_of_a_volume_is_what_resampling_says() -> None:
    labels = label_map()
    volume = clrecon.Volume(np.zeros((6, 4, 5), np.int16), OBLIQUE @ np.diag([1.0, 1.0, 0.5, 1.0]))
    taken = labels.resample(volume)
    assert np.array_equal(taken.voxels, clrecon.resample_labels(labels, volume).voxels)
    assert np.array_equal(taken.affine, volume.affine) and taken.names == labels.names
    assert repr(clrecon.resample_labels(labels, volume)) == "ResampledLabels((6, 4, 5), exact=False, 2 labels)"
    places = [(OBLIQUE @ [0.0, 0.0, k, 1.0])[:3] for k in (0.0, 1.0, 2.5)]
    uneven = clrecon.Volume(np.zeros((3, 4, 5), np.int16), OBLIQUE, slice_positions=places)
    with refused(UsageError, "slices", "volume", "clrecon.resample_labels"):
        labels.resample(uneven)


def test_an_array_takes_the_places_of_a_volume_or_of_another_map() -> None:
    volume = clrecon.Volume(np.zeros((3, 4, 5), np.int16), SHEARED, {"frame_of_reference_hash": "f", "warnings": []})
    array = np.ones(volume.shape, np.uint8)
    made = LabelMap(array, volume, {1: "bone"})
    again = LabelMap(array, made)
    for labels in (made, again):
        assert np.array_equal(labels.affine, SHEARED) and labels.frame_of_reference_hash == "f"
    assert made.names == {1: "bone"} and again.names == {1: "label_1"}
    assert LabelMap(array, made, frame_of_reference_hash="g").frame_of_reference_hash == "g"
    with refused(UsageError, 3, 4, 5):
        LabelMap(array, volume[1:])
    uneven = clrecon.Volume(array, np.eye(4), slice_positions=[(0, 0, 0), (0, 0, 1), (0, 0, 3)])
    with refused(UsageError, "slices", "volume"):
        LabelMap(array, uneven)
