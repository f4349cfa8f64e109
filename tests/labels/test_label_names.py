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


def label_map(names=NAMES):
    return LabelMap(make_labels(numbers=(0, 2, 5, 7, 8, 11)), OBLIQUE, names)


@pytest.mark.parametrize(
    ("label", "number"),
    [
        ("T12", 2),
        ("t1", 5),
        ("vertebrae_t12", 2),
        (" 7 ", 7),
        (11, 11),
        ("label_11", 11),
        ("RIB LEFT 11", 8),
        ("12", 7),
    ],
)
def test_labels_are_found_by_number_name_and_part_of_a_name(label, number):
    if label == "12":
        with refused(UsageError, 12, "label"):
            label_map().find(label)  # a number is a number, not a part of a name
        return
    assert label_map().find(label) == number


@pytest.mark.parametrize("named", ["L3", "vertebrae_L3", "L3 vertebra", "Vertebra L03", "level l3"])
@pytest.mark.parametrize("label", ["L3", "l3", "vertebrae_L3", "Vertebra L3", "vert L03"])
def test_a_level_is_found_however_it_is_spelled(named, label):
    assert label_map({2: named, 5: "L3 body", 7: "rib_L3", 8: "vertebrae_L1", 11: "Th12"}).find(label) == 2
    assert label_map({2: "Th12", 5: "C7"}).find("vertebrae_T12") == 2


def test_a_part_of_a_vertebra_is_not_the_vertebra():
    with refused(UsageError, "vertebrae_L3", "label"):
        label_map({5: "L3 body"}).find("vertebrae_L3")


@pytest.mark.parametrize(
    ("label", "message"),
    [
        ("rib", (7, 12, 8, 11)),
        ("L5", (2, 5, 7, 12)),
        ("absent", ("absent",)),
        (99, (99,)),
        ("a\nb\x1b", ("x1b",)),
        ("", ("label",)),
    ],
)
def test_an_unknown_label_lists_what_is_there(label, message):
    with refused(UsageError, *message):
        label_map().find(label)


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
def test_suffixes_are_safe_in_file_names(name, suffix):
    assert label_suffix(name) == suffix


@pytest.mark.parametrize(
    ("names", "suffixes"),
    [
        ({1: "T12", 2: "L1"}, {1: "T12", 2: "L1"}),
        ({1: "rib a", 2: "rib/a", 3: "RIB_A"}, {1: "rib_a_1", 2: "rib_a_2", 3: "RIB_A_3"}),
        ({1: "..", 2: "!!", 3: "label_1"}, {1: "label_1", 2: "label_2", 3: "label_3"}),
    ],
)
def test_no_two_labels_get_one_file(names, suffixes):
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
def test_what_is_no_label_map_is_refused(voxels, message):
    with pytest.raises(UsageError, match=message):
        LabelMap(voxels, np.eye(4))


def test_a_mask_is_a_label_map():
    labels = LabelMap(np.eye(3, dtype=bool)[None], np.eye(4))
    assert labels.numbers == (1,) and labels.counts == {1: 3} and labels.name(1) == "label_1"
    assert repr(labels) == "LabelMap(3 x 3 x 1, spacing 1 x 1 x 1 mm, 1 labels)"


def test_files_that_are_no_label_maps_are_refused(tmp_path):
    (tmp_path / "a.nii").write_text("hello")
    with pytest.raises(
        RefusedInputError, match="is no label map that can be read: NIfTI, NRRD, MetaImage, DICOM SEG and RTSTRUCT are"
    ):
        read_labels(tmp_path / "a.nii")
    (tmp_path / "b.gz").write_bytes(b"\x1f\x8b nonsense")
    with pytest.raises(RefusedInputError, match="is no label map"):
        read_labels(tmp_path / "b.gz")
    with pytest.raises(UsageError, match="there is no label map"):
        read_labels(tmp_path / "c.nii")
    with pytest.raises(RefusedInputError, match="is a folder without masks: one NIfTI, NRRD or MetaImage file"):
        read_labels(tmp_path)
    wrong: list = [2.5]
    with pytest.raises(UsageError, match="by number or name"):
        read_labels(tmp_path / "a.nii", wrong)


@pytest.mark.parametrize("shown", ["itself", "read-only view"])
def test_a_map_knows_its_labels_whatever_becomes_of_the_array_it_was_made_from(shown):
    array = make_labels(numbers=(0, 2, 5, 7, 8, 11)).astype(np.uint8)
    given = array.view()
    given.flags.writeable = shown == "itself"
    made = LabelMap(given, OBLIQUE)
    before = dict(made.counts)
    array[:] = 3
    assert made.counts == before and 3 not in np.unique(made.voxels)
    for each in (made, pickle.loads(pickle.dumps(made))):
        with refused(ValueError, "read-only"):
            each.voxels[0, 0, 0] = 1
    array.flags.writeable = False
    assert np.shares_memory(LabelMap(array, OBLIQUE).voxels, array)


def test_one_label_or_several_are_chosen_by_number_or_name():
    labels = label_map()
    assert labels.choose(None) == labels.numbers
    assert labels.choose(2) == labels.choose("T12") == labels.choose([2, "t12"]) == (2,)
    assert labels.choose(("rib left 11", 5)) == (8, 5)
    with refused(UsageError, "label"):
        labels.choose([])
