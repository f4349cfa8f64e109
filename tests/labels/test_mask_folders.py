"""Folders of masks, one file a structure, and single masks: names from the files, overlaps by the order of names."""

from __future__ import annotations

import json

import dicom_series
import numpy as np
import pytest
import tolerances
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


VOXELS_A_SLICE = 6 * 7


def mask_of_slices(*ranges):
    """A mask of all voxels of slices `first` to `end` - 1, for each (first, end)."""
    voxels = np.zeros(SHAPE, np.uint8)
    for first, end in ranges:
        voxels[first:end] = 1
    return voxels


def write_masks(path, affine=OBLIQUE):
    """Masks on slices 0-1 (L3), 1-2 (aorta) and 2-3 (liver), an empty one (spleen), and what lies beside them."""
    path.mkdir()
    write_nifti(path / "vertebrae_L3.nii.gz", mask_of_slices((0, 2)), affine)
    write_nrrd(path / "aorta.seg.nrrd", mask_of_slices((1, 3)) * 255, affine)
    write_metaimage(path / "liver.mha", mask_of_slices((2, 4)).astype(np.int16), affine)
    write_nifti(path / "spleen.nii", mask_of_slices(), affine)
    (path / "statistics.json").write_text("{}")
    (path / "._aorta.nii.gz").write_bytes(b"\0\5\x16\7")
    return path


def test_each_mask_of_a_folder_is_a_label_named_by_its_file(tmp_path):
    labels = read_labels(write_masks(tmp_path / "masks"))
    assert labels.names == {1: "aorta", 2: "liver", 3: "spleen", 4: "vertebrae_L3"}
    assert labels.find("L3") == 4
    assert np.allclose(labels.affine, OBLIQUE, atol=tolerances.NIFTI_AFFINE_MM)


def test_voxels_of_two_masks_belong_to_the_first_in_alphabetical_order(tmp_path):
    labels = read_labels(write_masks(tmp_path / "masks"))
    aorta, liver, l3 = 1, 2, 4
    label_of_slice = [int(number) for number in labels.voxels[:, 0, 0]]
    assert label_of_slice == [l3, aorta, aorta, liver]
    assert labels.counts == {aorta: 2 * VOXELS_A_SLICE, liver: VOXELS_A_SLICE, l3: VOXELS_A_SLICE}


def test_empty_and_overlapping_masks_are_warned_of(tmp_path):
    """L3 and aorta share slice 1, aorta and liver slice 2: 2 x 42 voxels."""
    assert read_labels(write_masks(tmp_path / "masks")).warnings == (
        "1 of 4 masks holds no voxel: spleen",
        "the masks overlap in 84 voxels: each belongs to the first of its masks in alphabetical order, labels that were"
        " chosen before others",
    )


def replace_by_link(folder, name):
    """Move a mask out of its folder and leave a link, as git-annex does."""
    store = folder.parent / "store"
    store.mkdir(exist_ok=True)
    (folder / name).rename(store / name)
    (folder / name).symlink_to(store / name)


@pytest.fixture
def masks_with_links_out(tmp_path):
    """The folder of `write_masks`, of whose masks two are links to another folder."""
    folder = write_masks(tmp_path / "masks")
    replace_by_link(folder, "aorta.seg.nrrd")
    replace_by_link(folder, "liver.mha")
    return folder


def test_links_out_of_a_folder_of_masks_are_refused(masks_with_links_out):
    with refused(RefusedInputError, "aorta.seg.nrrd", "liver.mha", 2):  # links
        read_labels(masks_with_links_out)


def test_links_out_of_a_folder_of_masks_are_followed_on_request(masks_with_links_out, tmp_path):
    labels = read_labels(masks_with_links_out, follow_links=True)
    without_links = read_labels(write_masks(tmp_path / "without links"))
    assert np.array_equal(labels.voxels, without_links.voxels)
    assert labels.names == without_links.names


def test_folder_with_links_out_of_it_is_not_called_large(masks_with_links_out):
    assert not is_large_map(masks_with_links_out, most_bytes=1)  # which any map has more of


def test_links_between_masks_of_a_folder_are_left_out(tmp_path):
    folder = write_masks(tmp_path / "masks")
    (folder / "copy.nii.gz").symlink_to("vertebrae_L3.nii.gz")
    assert "copy" not in read_labels(folder).names.values()


def test_link_to_a_mask_that_is_missing_is_refused_by_its_name(tmp_path):
    folder = write_masks(tmp_path / "masks")
    (folder / "rib.nii.gz").symlink_to("../gone.nii.gz")
    with refused(RefusedInputError, "rib.nii.gz", 1):  # link
        read_labels(folder, follow_links=True)


def test_link_to_a_file_that_is_no_mask_is_left_out(tmp_path):
    folder = write_masks(tmp_path / "masks")
    (tmp_path / "readme.txt").write_text("text")
    (folder / "readme.txt").symlink_to("../readme.txt")
    assert "readme" not in read_labels(folder).names.values()


def test_command_names_the_option_that_follows_links_to_masks_and_reads_them_with_it(tmp_path, printed):
    dicom_series.write_series(tmp_path / "ct", dicom_series.Plan(shape=SHAPE))
    folder = write_masks(tmp_path / "masks", read_volume(tmp_path / "ct").affine)
    replace_by_link(folder, "aorta.seg.nrrd")
    command = ["stats", str(tmp_path / "ct"), "--labels", str(folder)]

    assert main(command) == RefusedInputError.exit_code
    printed().assert_error("--follow-links")

    assert main([*command, "--follow-links"]) == 0
    printed().assert_output("aorta")


def test_chosen_masks_are_read_alone_with_all_their_voxels(tmp_path):
    labels = read_labels(write_masks(tmp_path / "masks"), ["liver", "L3"])
    assert labels.names == {2: "liver", 4: "vertebrae_L3"}
    assert labels.counts == {2: 2 * VOXELS_A_SLICE, 4: 2 * VOXELS_A_SLICE}
    assert labels.warnings == ()


def test_chosen_mask_keeps_the_voxels_that_it_shares_where_all_are_read(tmp_path):
    aorta, liver, l3 = 1, 2, 4
    labels = read_all_labels(write_masks(tmp_path / "masks"), ["liver"])
    assert labels.counts == {aorta: VOXELS_A_SLICE, liver: 2 * VOXELS_A_SLICE, l3: VOXELS_A_SLICE}


@pytest.mark.parametrize(
    ("only", "facts"),
    [(["rib"], ("rib", 1, 2)), ([], ("label",)), (["spleen"], ("spleen", "masks"))],
    ids=["unknown", "none", "without a voxel"],
)
def test_choice_of_masks_that_are_not_there_is_refused(tmp_path, only, facts):
    with refused(UsageError, *facts):
        read_labels(write_masks(tmp_path / "masks"), only)


def test_folder_of_masks_is_called_large_by_the_bytes_of_its_map(tmp_path):
    folder = write_masks(tmp_path / "masks")
    stored_bytes = 4 * VOXELS_A_SLICE * 2  # of 16 bits
    assert is_large_map(folder, most_bytes=stored_bytes - 1)
    assert not is_large_map(folder, most_bytes=stored_bytes)


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
def test_folder_that_is_no_folder_of_masks_is_refused_with_the_reason(tmp_path, harm, words):
    folder = tmp_path / "masks"
    folder.mkdir()
    if harm != "empty":
        write_nifti(folder / "a.nii", mask_of_slices() if harm == "no voxel" else mask_of_slices((0, 1)))
    if harm == "several":
        write_nifti(folder / "b.nii", make_labels())
    elif harm == "moved":
        moved = OBLIQUE.copy()
        moved[0, 3] += 0.01
        write_nifti(folder / "b.nii", mask_of_slices((1, 2)), moved)
    elif harm == "shape":
        write_nifti(folder / "b.nii", mask_of_slices((1, 2))[:3])
    elif harm == "twice":
        write_nrrd(folder / "a.nrrd", mask_of_slices((1, 2)))
    elif harm == "dicom":
        dicom_series.write_series(folder, dicom_series.Plan(shape=(3, 4, 5)))
    elif harm == "cut":
        content = write_nifti(folder / "b.nii", mask_of_slices((1, 2))).read_bytes()
        (folder / "b.nii").write_bytes(content[:-20])
    with pytest.raises(RefusedInputError, match=words):
        read_labels(folder)


@pytest.mark.parametrize("value", [1, 255])
@pytest.mark.parametrize(
    ("name", "write"),
    [("liver.nii.gz", write_nifti), ("L3.seg.nrrd", write_nrrd), ("aorta.mha", write_metaimage)],
    ids=["NIfTI", "NRRD", "MetaImage"],
)
def test_single_mask_of_value_1_or_255_is_named_by_its_file(tmp_path, name, write, value):
    labels = read_labels(write(tmp_path / name, mask_of_slices((1, 2)) * np.uint8(value)))
    assert labels.names == {value: name.split(".")[0]}


def test_single_label_of_another_value_is_named_by_its_number(tmp_path):
    path = write_nifti(tmp_path / "a.nii", mask_of_slices((1, 2)) * 27)
    assert read_labels(path).names == {27: "label_27"}


def test_single_mask_with_a_label_table_is_named_by_that(tmp_path):
    table = b'<Label Key="1">spleen</Label>'
    path = write_nifti(tmp_path / "b.nii", mask_of_slices((1, 2)), extension=table)
    assert read_labels(path).names == {1: "spleen"}


@pytest.mark.release
@pytest.mark.first_device
def test_command_stats_measures_the_masks_of_a_folder_and_warns_of_overlaps(tmp_path):
    dicom_series.write_series(tmp_path / "ct", dicom_series.Plan(shape=SHAPE))
    folder = write_masks(tmp_path / "masks", read_volume(tmp_path / "ct").affine)
    report_path = tmp_path / "s.json"
    assert main(["stats", str(tmp_path / "ct"), "--labels", str(folder), "-q", "--report", str(report_path)]) == 0
    report = json.loads(report_path.read_text())
    assert [(label["name"], label["voxels"]) for label in report["labels"]] == [
        ("aorta", 2 * VOXELS_A_SLICE),
        ("liver", VOXELS_A_SLICE),
        ("vertebrae_L3", VOXELS_A_SLICE),
    ]
    overlap = f"the masks overlap in {2 * VOXELS_A_SLICE} voxels"  # slices 1 and 2
    assert any(overlap in warning for warning in report["warnings"])


@pytest.mark.release
@pytest.mark.first_device
def test_command_mesh_writes_a_file_for_each_mask_of_a_folder(tmp_path, printed):
    dicom_series.write_series(tmp_path / "ct", dicom_series.Plan(shape=SHAPE))
    folder = write_masks(tmp_path / "masks", read_volume(tmp_path / "ct").affine)
    output = ["-o", str(tmp_path / "a.stl"), "--surface", "mask", "-q"]
    assert main(["mesh", str(tmp_path / "ct"), "--labels", str(folder), *output]) == 0, printed()
    written = {path.name for path in tmp_path.glob("*.stl")}
    assert written == {"a_aorta.stl", "a_liver.stl", "a_vertebrae_L3.stl"}  # the spleen has no voxel
