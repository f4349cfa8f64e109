"""Folders of masks, one file a structure, and single masks: names from the files, overlaps by the order of names."""

from __future__ import annotations

import json

import dicom_series
import numpy as np
import pytest
from label_files import OBLIQUE, make_labels, write_nifti, write_nrrd
from refusals import refused
from volume_files import write_metaimage

from clrecon.cli.main import main
from clrecon.errors import RefusedInputError, UsageError
from clrecon.labels import read_labels
from clrecon.labels.reader import is_large_map, read_all_labels
from clrecon.reading import read_volume

pytestmark = pytest.mark.unit
SHAPE = (4, 6, 7)


def mask(*boxes):
    voxels = np.zeros(SHAPE, np.uint8)
    for low, high in boxes:
        voxels[low:high] = 1
    return voxels


def write_folder(path, affine=OBLIQUE):
    """Three structures that share a slice each, one that is absent, and what lies beside them."""
    path.mkdir()
    write_nifti(path / "vertebrae_L3.nii.gz", mask((0, 2)), affine)
    write_nrrd(path / "aorta.seg.nrrd", mask((1, 3)) * 255, affine)
    write_metaimage(path / "liver.mha", mask((2, 4)).astype(np.int16), affine)
    write_nifti(path / "spleen.nii", mask(), affine)
    (path / "statistics.json").write_text("{}")
    (path / "._aorta.nii.gz").write_bytes(b"\0\5\x16\7")
    return path


def test_each_file_is_a_label_with_its_name(tmp_path):
    labels = read_labels(write_folder(tmp_path / "masks"))
    assert labels.names == {1: "aorta", 2: "liver", 3: "spleen", 4: "vertebrae_L3"}
    assert [int(number) for number in labels.voxels[:, 0, 0]] == [4, 1, 1, 2]
    assert labels.counts == {1: 84, 2: 42, 4: 42} and labels.find("L3") == 4
    assert np.allclose(labels.affine, OBLIQUE, atol=1e-5)
    assert labels.warnings == (
        "1 of 4 masks holds no voxel: spleen",
        "the masks overlap in 84 voxels: each belongs to the first of its masks in alphabetical order, labels that were"
        " chosen before others",
    )


def link_out(folder, name):
    """Move a mask out of its folder and leave a link, as git-annex does."""
    store = folder.parent / "store"
    store.mkdir(exist_ok=True)
    (folder / name).rename(store / name)
    (folder / name).symlink_to(store / name)


def test_masks_that_are_links_out_of_the_folder_are_followed_on_request_alone(tmp_path):
    whole = read_labels(write_folder(tmp_path / "whole"))
    folder = write_folder(tmp_path / "masks")
    link_out(folder, "aorta.seg.nrrd")
    link_out(folder, "liver.mha")
    with refused(RefusedInputError, "aorta.seg.nrrd", "liver.mha", 2):
        read_labels(folder)
    assert not is_large_map(folder)
    labels = read_labels(folder, follow_links=True)
    assert np.array_equal(labels.voxels, whole.voxels) and labels.names == whole.names


def test_links_inside_of_the_folder_are_left_out_and_lost_ones_are_told(tmp_path):
    folder = write_folder(tmp_path / "masks")
    (folder / "copy.nii.gz").symlink_to("vertebrae_L3.nii.gz")
    assert "copy" not in read_labels(folder).names.values()
    (folder / "rib.nii.gz").symlink_to("../gone.nii.gz")
    with refused(RefusedInputError, "rib.nii.gz", 1):
        read_labels(folder, follow_links=True)
    (folder / "rib.nii.gz").unlink()
    (tmp_path / "readme.txt").write_text("text")
    (folder / "readme.txt").symlink_to("../readme.txt")
    assert read_labels(folder).counts == {1: 84, 2: 42, 4: 42}


def test_commands_follow_links_to_masks_on_request(tmp_path, printed):
    dicom_series.write_series(tmp_path / "ct", dicom_series.Plan(shape=SHAPE))
    folder = write_folder(tmp_path / "masks", read_volume(tmp_path / "ct").affine)
    link_out(folder, "aorta.seg.nrrd")
    command = ["stats", str(tmp_path / "ct"), "--labels", str(folder)]
    assert main(command) == 4
    printed().assert_error("--follow-links")
    assert main([*command, "--follow-links"]) == 0
    printed().assert_output("aorta")


def test_chosen_masks_win_overlaps_and_unknown_ones_are_refused(tmp_path):
    folder = write_folder(tmp_path / "masks")
    alone = read_labels(folder, ["liver", "L3"])
    assert alone.counts == {2: 84, 4: 84} and alone.names == {2: "liver", 4: "vertebrae_L3"} and alone.warnings == ()
    assert read_all_labels(folder, ["liver"]).counts == {1: 42, 2: 84, 4: 42}
    with refused(UsageError, "rib", 1, 2):
        read_labels(folder, ["rib"])
    with refused(UsageError, "label"):
        read_labels(folder, [])
    with refused(UsageError, "spleen", "masks"):
        read_labels(folder, ["spleen"])


def test_a_folder_says_whether_it_is_large(tmp_path):
    folder = write_folder(tmp_path / "masks")
    for most, large in ((335, True), (336, False)):  # 168 voxels of 16 bits
        assert is_large_map(folder, most_bytes=most) == large


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        ("empty", "masks is a folder without masks: one NIfTI, NRRD or MetaImage file a structure is read"),
        ("several", r"b.nii holds several labels, 2 and 5: a folder of masks has one file a structure"),
        ("moved", r"a.nii and b.nii lie on two grids: 7 x 6 x 4 and 7 x 6 x 4 voxels, up to 0.01 mm apart"),
        ("shape", r"a.nii and b.nii lie on two grids: 7 x 6 x 4 and 7 x 6 x 3 voxels; the masks of one folder"),
        ("twice", r"masks has two masks of one name: a.nii and a.nrrd"),
        ("dicom", r"masks is a folder with DICOM files: of a DICOM SEG or RTSTRUCT give the file"),
        ("cut", "b.nii is cut: it ends in slice 4 of 4, 20 bytes before its end"),
        ("no voxel", r"masks is empty: no voxel has a label"),
    ],
)
def test_folders_that_are_no_masks_are_refused(tmp_path, harm, words):
    folder = tmp_path / "masks"
    folder.mkdir()
    if harm != "empty":
        write_nifti(folder / "a.nii", mask() if harm == "no voxel" else mask((0, 1)))
    if harm == "several":
        write_nifti(folder / "b.nii", make_labels())
    elif harm == "moved":
        moved = OBLIQUE.copy()
        moved[0, 3] += 0.01
        write_nifti(folder / "b.nii", mask((1, 2)), moved)
    elif harm == "shape":
        write_nifti(folder / "b.nii", mask((1, 2))[:3])
    elif harm == "twice":
        write_nrrd(folder / "a.nrrd", mask((1, 2)))
    elif harm == "dicom":
        dicom_series.write_series(folder, dicom_series.Plan(shape=(3, 4, 5)))
    elif harm == "cut":
        content = write_nifti(folder / "b.nii", mask((1, 2))).read_bytes()
        (folder / "b.nii").write_bytes(content[:-20])
    with pytest.raises(RefusedInputError, match=words):
        read_labels(folder)


def test_one_mask_is_named_by_its_file(tmp_path):
    for name, write in (("liver.nii.gz", write_nifti), ("L3.seg.nrrd", write_nrrd), ("aorta.mha", write_metaimage)):
        for value in (1, 255):
            labels = read_labels(write(tmp_path / name, mask((1, 2)) * np.uint8(value)))
            assert labels.names == {value: name.split(".")[0]}
    assert read_labels(write_nifti(tmp_path / "a.nii", mask((1, 2)) * 27)).names == {27: "label_27"}
    table = b'<Label Key="1">spleen</Label>'
    assert read_labels(write_nifti(tmp_path / "b.nii", mask((1, 2)), extension=table)).names == {1: "spleen"}


@pytest.mark.release
@pytest.mark.first_device
def test_commands_take_a_folder(tmp_path, printed):
    dicom_series.write_series(tmp_path / "ct", dicom_series.Plan(shape=(4, 6, 7)))
    folder = write_folder(tmp_path / "masks", read_volume(tmp_path / "ct").affine)
    words = ["--labels", str(folder), "-q", "--report", str(tmp_path / "s.json")]
    assert main(["stats", str(tmp_path / "ct"), *words]) == 0, printed()
    report = json.loads((tmp_path / "s.json").read_text())
    assert [(one["name"], one["voxels"]) for one in report["labels"]] == [
        ("aorta", 84),
        ("liver", 42),
        ("vertebrae_L3", 42),
    ]
    assert any("the masks overlap in 84 voxels" in warning for warning in report["warnings"])
    mesh = ["mesh", str(tmp_path / "ct"), "-o", str(tmp_path / "a.stl"), "--surface", "mask", *words]
    assert main(mesh) == 0, printed()
    assert (tmp_path / "a_vertebrae_L3.stl").exists()
