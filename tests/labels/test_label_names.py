"""Labels found by what people call them, and names that are safe in file names."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from label_files import OBLIQUE, make_labels
from refusals import refused

from clrecon.errors import RefusedInputError, UsageError
from clrecon.labels import LabelMap, file_suffixes, label_suffix, read_labels

NAMES = {2: "vertebrae_T12", 5: "vertebrae_T1", 7: "rib left 12", 8: "rib left 11", 9: "absent"}


def map_with_names(names=NAMES):
    """A map of the labels 2, 5, 7, 8 and 11, each with voxels."""
    return LabelMap(make_labels(numbers=(0, 2, 5, 7, 8, 11)), OBLIQUE, names)


@pytest.mark.parametrize(
    ("label", "number"),
    [("T12", 2), ("t1", 5), ("vertebrae_t12", 2), (" 7 ", 7), (11, 11), ("label_11", 11), ("RIB LEFT 11", 8)],
)
def test_labels_are_found_by_number_name_and_part_of_a_name(label, number):
    assert map_with_names().find(label) == number


def test_number_is_not_found_as_a_part_of_a_name():
    with refused(UsageError, 12, "label"):
        map_with_names().find("12")  # of "vertebrae_T12" and "rib left 12"


@pytest.mark.parametrize("named", ["L3", "vertebrae_L3", "L3 vertebra", "Vertebra L03", "level l3"])
@pytest.mark.parametrize("label", ["L3", "l3", "vertebrae_L3", "Vertebra L3", "vert L03"])
def test_vertebra_is_found_however_its_level_is_spelled(named, label):
    others = {5: "L3 body", 7: "rib_L3", 8: "vertebrae_L1", 11: "Th12"}
    assert map_with_names({2: named, **others}).find(label) == 2


def test_thoracic_vertebra_named_th12_is_found_as_t12():
    assert map_with_names({2: "Th12", 5: "C7"}).find("vertebrae_T12") == 2


def test_body_of_a_vertebra_is_not_found_as_the_vertebra():
    with refused(UsageError, "vertebrae_L3", "label"):
        map_with_names({5: "L3 body"}).find("vertebrae_L3")


@pytest.mark.parametrize(
    ("label", "facts"),
    [
        pytest.param("rib", (7, 12, 8, 11), id="part of two names"),  # 7 rib left 12 and 8 rib left 11
        pytest.param("L5", (2, 5, 7, 12), id="level that is not there"),  # 2, 5, 7 rib left 12
        pytest.param("absent", ("absent",), id="name without a voxel"),
        pytest.param(99, (99,), id="number that is not there"),
        pytest.param("a\nb\x1b", ("x1b",), id="control characters"),
        pytest.param("", ("label",), id="empty"),
    ],
)
def test_label_that_no_or_several_labels_fit_is_refused_with_what_is_there(label, facts):
    with refused(UsageError, *facts):
        map_with_names().find(label)


@pytest.mark.parametrize(
    ("name", "suffix"),
    [
        ("vertebrae_T12", "vertebrae_T12"),
        ("L1 body", "L1_body"),
        ("../../etc/passwd", "etc_passwd"),
        ("..", "label"),
        ("", "label"),
        ("-rf", "rf"),
        ("a\0b\nc\x1b[31m", "a_b_c_31m"),
        ("Wirbelkörper", "Wirbelk_rper"),
        ("\u202egnp.exe", "gnp.exe"),
        ("x" * 300, "x" * 40),
        ("C:\\NUL", "C_NUL"),
    ],
)
def test_suffix_of_a_label_is_safe_in_a_file_name(name, suffix):
    assert label_suffix(name) == suffix


@pytest.mark.parametrize(
    ("names", "suffixes"),
    [
        pytest.param({1: "T12", 2: "L1"}, {1: "T12", 2: "L1"}, id="different"),
        pytest.param(
            {1: "rib a", 2: "rib/a", 3: "RIB_A"}, {1: "rib_a_1", 2: "rib_a_2", 3: "RIB_A_3"}, id="equal but for case"
        ),
        pytest.param(
            {1: "..", 2: "!!", 3: "label_1"}, {1: "label_1", 2: "label_2", 3: "label_3"}, id="without a letter"
        ),
    ],
)
def test_labels_whose_suffixes_would_be_equal_get_their_numbers_too(names, suffixes):
    assert file_suffixes(names) == suffixes


@pytest.mark.parametrize(
    ("voxels", "message"),
    [
        (np.zeros((3, 4)), "three axes"),
        (np.zeros((0, 3, 4), int), "is empty"),
        (np.zeros((2, 3, 4)), "whole numbers, these are float64"),
        (np.full((2, 3, 4), -1), "these from -1"),
        (np.full((2, 3, 4), 65_536), "these from 65,536"),
        ([[1], [2, 3]], "array of whole numbers"),
    ],
)
def test_array_that_is_no_label_map_is_refused(voxels, message):
    with pytest.raises(UsageError, match=message):
        LabelMap(voxels, np.eye(4))


def test_mask_is_taken_as_a_map_of_label_1():
    labels = LabelMap(np.eye(3, dtype=bool)[None], np.eye(4))
    assert labels.numbers == (1,)
    assert labels.counts == {1: 3}
    assert labels.name(1) == "label_1"


def test_repr_of_a_map_has_its_size_spacing_and_number_of_labels():
    labels = LabelMap(np.eye(3, dtype=bool)[None], np.eye(4))
    assert repr(labels) == "LabelMap(3 x 3 x 1, spacing 1 x 1 x 1 mm, 1 labels)"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.nii", b"hello", "is no label map that can be read: NIfTI, NRRD, MetaImage, DICOM SEG and RTSTRUCT are"),
        ("b.gz", b"\x1f\x8b nonsense", "is no label map"),
    ],
    ids=["text", "not gzip"],
)
def test_file_that_is_no_label_map_is_refused(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RefusedInputError, match=words):
        read_labels(tmp_path / name)


def test_label_map_that_is_missing_is_refused(tmp_path):
    with refused(UsageError, "c.nii", "label"):
        read_labels(tmp_path / "c.nii")


def test_empty_folder_is_refused_as_a_folder_of_masks(tmp_path):
    with refused(RefusedInputError, "folder", "masks", "NIfTI"):
        read_labels(tmp_path)


def test_fraction_is_refused_as_a_label(tmp_path):
    labels: list = [2.5]
    with refused(UsageError, "number", "name"):
        read_labels(tmp_path / "a.nii", labels)


@pytest.mark.parametrize("given", ["itself", "read-only view"])
def test_map_keeps_its_labels_when_the_array_it_was_made_from_changes(given):
    array = make_labels(numbers=(0, 2, 5, 7, 8, 11)).astype(np.uint8)
    view = array.view()
    view.flags.writeable = given == "itself"
    labels = LabelMap(view, OBLIQUE)
    before = dict(labels.counts)
    array[:] = 3
    assert labels.counts == before
    assert 3 not in np.unique(labels.voxels)


@pytest.mark.parametrize("pickled", [False, True])
def test_voxels_of_a_map_cannot_be_changed(pickled):
    labels = LabelMap(make_labels(), OBLIQUE)
    if pickled:
        labels = pickle.loads(pickle.dumps(labels))
    with refused(ValueError, "read-only"):
        labels.voxels[0, 0, 0] = 1


def test_map_of_a_read_only_array_is_not_a_copy():
    array = make_labels().astype(np.uint8)
    array.flags.writeable = False
    assert np.shares_memory(LabelMap(array, OBLIQUE).voxels, array)


def test_one_label_or_several_are_chosen_by_number_or_name():
    labels = map_with_names()
    assert labels.choose(2) == labels.choose("T12") == labels.choose([2, "t12"]) == (2,)
    assert labels.choose(("rib left 11", 5)) == (8, 5)


def test_all_labels_are_chosen_by_none():
    labels = map_with_names()
    assert labels.choose(None) == labels.numbers


def test_choice_of_no_label_is_refused():
    with refused(UsageError, "label"):
        map_with_names().choose([])
