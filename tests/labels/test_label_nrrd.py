"""NRRD label maps and 3D Slicer segmentations: frames, names, layers, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from label_files import OBLIQUE, make_labels, write_nrrd
from refusals import refused

from clrecon.errors import RefusedInputError, UsageError
from clrecon.labels import read_labels
from clrecon.labels.reader import is_large_map, read_all_labels

pytest.importorskip("nrrd")
SPACES = ["left-posterior-superior", "right-anterior-superior", "left-anterior-superior"]


def edit(path, *replacements):
    """Replace text in the header of a raw NRRD file."""
    header, gap, data = path.read_bytes().partition(b"\n\n")
    for old, new in replacements:
        assert old in header
        header = header.replace(old, new)
    path.write_bytes(header + gap + data)
    return path


def segment(n, name, value, layer=None):
    fields = {f"Segment{n}_Name": name, f"Segment{n}_LabelValue": str(value), f"Segment{n}_ID": f"id{n}"}
    return fields if layer is None else {**fields, f"Segment{n}_Layer": str(layer)}


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("encoding", ["raw", "gzip"])
def test_every_frame_becomes_lps(tmp_path, space, encoding):
    voxels = make_labels()
    labels = read_labels(write_nrrd(tmp_path / "a.nrrd", voxels.astype(np.int16), space=space, encoding=encoding))
    assert np.array_equal(labels.voxels, voxels)
    assert np.allclose(labels.affine, OBLIQUE, atol=1e-12)


@pytest.mark.parametrize("dtype", ["<i1", "<u1", "<u2", ">i2", "<i4", "<i8", "<f4", ">f8"])
def test_whole_numbers_of_every_type_are_read(tmp_path, dtype):
    voxels = make_labels()
    assert np.array_equal(read_labels(write_nrrd(tmp_path / "a.nrrd", voxels.astype(dtype))).voxels, voxels)


def test_simpleitk_agrees_on_the_place(tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    rigid = OBLIQUE.copy()
    rigid[:3, :3] = np.linalg.qr(OBLIQUE[:3, :3])[0] @ np.diag((0.7, 0.5, 2.5))
    path = write_nrrd(tmp_path / "a.nrrd", make_labels(), rigid, space="right-anterior-superior")
    image = sitk.ReadImage(str(path))
    here = read_labels(path).affine @ (1, 2, 3, 1)
    assert np.allclose(here[:3], image.TransformIndexToPhysicalPoint((1, 2, 3)), atol=1e-9)


def test_slicer_names_are_read(tmp_path):
    fields = {**segment(0, "L1 vertebra", 2), **segment(1, "bad\x1b[31m", 5)}
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", make_labels(), **fields))
    assert labels.names[2] == "L1 vertebra" and labels.find("l1 VERTEBRA") == 2 and labels.find("L1") == 2
    assert "\x1b" not in labels.names[5] and labels.names[5].startswith("bad")


def layered(overlap: bool):
    """Three segments in two layers; the first two overlap in one voxel or not at all."""
    voxels = np.zeros((3, 4, 5, 2), np.uint8)
    voxels[0, 0, :3, 0] = 1
    voxels[0, 0, 2 if overlap else 3, 1] = 1
    voxels[2, 3, 4, 1] = 2
    return voxels, {**segment(0, "one", 1, 0), **segment(1, "two", 1, 1), **segment(2, "three", 2, 1)}


def test_layers_become_one_map(tmp_path):
    voxels, fields = layered(False)
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields))
    assert labels.counts == {1: 3, 2: 1, 3: 1} and labels.names == {1: "one", 2: "two", 3: "three"}
    assert labels.voxels[0, 0, 3] == 2 and labels.voxels[2, 3, 4] == 3
    assert np.allclose(labels.affine, OBLIQUE, atol=1e-12)


def test_layers_that_overlap_are_refused_unless_one_is_chosen(tmp_path):
    voxels, fields = layered(True)
    path = write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields)
    with refused(RefusedInputError, "one", "two", 1, 2):
        read_labels(path)
    assert read_labels(path, ["one"]).counts == {1: 3}
    assert read_labels(path, ["two", 3]).counts == {2: 1, 3: 1}
    assert read_all_labels(path, ["one"]).counts == {1: 3, 3: 1}
    assert read_all_labels(path, ["two", 3]).counts == {1: 2, 2: 1, 3: 1}
    assert read_all_labels(path, [3]).counts == {1: 3, 3: 1}  # among the others the lowest number
    with refused(UsageError, "four", 1, 2, 3):
        read_labels(path, ["four"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"space: left-posterior-superior", b"space: scanner-xyz", "space 'scanner-xyz'"),
        (b"space: left-posterior-superior\n", b"", "does not say where it lies"),
        (b"sizes: 7 6 4", b"sizes: 7 6 4000", "cannot come from a file of"),
        (b"sizes: 7 6 4", b"sizes: 70000 60000 40000", "at most 4,294,967,296"),
        (b"sizes: 7 6 4", b"sizes: 7 6 -4", "at least 1 an axis"),
        (b"sizes: 7 6 4", b"sizes: 7 6 x", "corrupt NRRD header"),
        (b"dimension: 3", b"dimension: 2", "has 3 axes"),
        (b"type: uint8", b"type: block", "is not a label map: its voxels are 'block'"),
        (b"encoding: raw", b"encoding: hex", "is stored as 'hex'"),
        (b"encoding: raw", b"encoding: raw\ndata file: /etc/passwd", "only files beside it are read"),
        (b"encoding: raw", b"encoding: raw\nbyte skip: -1", "says 'byte skip'"),
        (b"encoding: raw", b"encoding: gzip", "cut or corrupt in slice 1 of 4"),
        (b"space origin: (", b"space origin: (1e999,", "cannot be placed|corrupt NRRD"),
        (b"space directions: (", b"space directions: none (", "cannot be placed|corrupt NRRD"),
    ],
)
def test_hostile_headers_are_refused(tmp_path, old, new, message):
    path = edit(write_nrrd(tmp_path / "a.nrrd", make_labels(), encoding="raw"), (old, new))
    with pytest.raises(RefusedInputError, match=message):
        read_labels(path)


def test_voxels_of_a_detached_header_are_beside_it(tmp_path):
    voxels, fields = layered(False)
    path = write_nrrd(tmp_path / "in" / "a.nhdr", voxels, **fields)
    assert {file.name for file in path.parent.iterdir()} == {"a.nhdr", "a.raw.gz"}
    labels = read_labels(path)
    assert labels.counts == {1: 3, 2: 1, 3: 1} and np.allclose(labels.affine, OBLIQUE, atol=1e-12)
    header = path.read_bytes()
    (tmp_path / "other.gz").write_bytes((path.parent / "a.raw.gz").read_bytes())
    (path.parent / "link.gz").symlink_to(tmp_path / "other.gz")
    for named, words in (
        (b"../other.gz", "only files beside it are read"),
        (str(tmp_path / "other.gz").encode(), "only files beside it are read"),
        (b"link.gz", "a link to another folder: not read"),
        (b"none.gz", "which is not there"),
        (b"LIST\na.raw.gz", "has its voxels in several files"),
        (b"a.%03d.gz 0 3 1", "has its voxels in several files"),
        (b"", "has its voxels in several files|corrupt NRRD header"),
    ):
        path.write_bytes(header.replace(b"data file: a.raw.gz", b"data file: " + named))
        with pytest.raises(RefusedInputError, match=words):
            read_labels(path)


def bare_layers(*segments):
    """Two layers with values of their own, 1 and 2, one voxel each."""
    voxels = np.zeros((3, 4, 5, 2), np.uint8)
    voxels[0, 0, 0, 0], voxels[1, 1, 1, 1] = 1, 2
    return voxels, {key: value for fields in segments for key, value in fields.items()}


@pytest.mark.parametrize(
    ("segments", "words"),
    [
        ([segment(0, "one", 1), segment(1, "two", 2)], "2 layers, and 2 of its 2 segments have no Layer"),
        ([segment(0, "one", 1, 0), segment(1, "two", 2)], "2 layers, and 1 of its 2 segments have no Layer"),
        (
            [segment(0, "one", 1, 0), {"Segment1_Name": "two", "Segment1_Layer": "1"}],
            "1 of its 2 .* have no LabelValue",
        ),
        ([segment(0, "one", 1, 0), segment(1, "two", 2, 2)], "has 2 layers, and a segment is in layer 2"),
        ([segment(0, "one", 1, 0), segment(1, "two", 2, -1)], "has 2 layers, and a segment is in layer -1"),
        ([segment(0, "one", 1, "x")], "corrupt NRRD header: Layer of a segment is no number"),
        ([], "has 2 layers and does not say which segments they hold"),
    ],
)
def test_layers_whose_segments_are_not_known_are_refused(tmp_path, segments, words):
    voxels, fields = bare_layers(*segments)
    with pytest.raises(RefusedInputError, match=words):
        read_labels(write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields))


def test_values_that_no_segment_has_are_warned_of(tmp_path):
    voxels, fields = bare_layers(segment(0, "one", 1, 0), segment(1, "air", 0, 1), segment(2, "three", 3, 1))
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields))
    assert labels.counts == {1: 1} and "air" not in labels.names.values()
    assert labels.warnings == (
        "1 of 3 segments have LabelValue 0, which is no label: left out",
        "1 voxels hold values that no segment of their layer has (LabelValue): left out",
    )


def test_segments_of_old_versions_of_slicer_are_layers(tmp_path):
    """Before 4.11 it wrote neither layers nor values: segment n is what layer n holds."""
    voxels, fields = bare_layers({"Segment0_Name": "one"}, {"Segment1_Name": "two"})
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", (voxels > 0).astype(np.uint8), **fields))
    assert labels.counts == {1: 1, 2: 1} and labels.names == {1: "one", 2: "two"} and labels.voxels[1, 1, 1] == 2
    assert labels.warnings == ("its 2 segments name no layer: segment n is taken from layer n",)
    alone = read_labels(write_nrrd(tmp_path / "b.seg.nrrd", (voxels[..., 0] > 0).astype(np.uint8), Segment0_Name="x"))
    assert alone.names == {1: "x"} and alone.warnings == ()


def test_names_that_belong_to_no_value_are_said(tmp_path):
    fields = {**segment(0, "two", 2), "Segment1_Name": "lost", "Segment1_ID": "x"}
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", make_labels(numbers=(0, 2, 5)), **fields))
    assert labels.names == {2: "two", 5: "label_5"}
    assert labels.warnings == ("1 of 2 segments have no LabelValue: their names are not known",)


def test_a_header_without_end_is_refused(tmp_path):
    (tmp_path / "a.nrrd").write_bytes(b"NRRD0004\n" + b"# x\n" * 400_000)
    with refused(RefusedInputError, "a.nrrd", "end"):
        read_labels(tmp_path / "a.nrrd")


@pytest.mark.fuzz
@pytest.mark.parametrize("encoding", ["raw", "gzip"])
def test_nrrd_map_cut_anywhere_is_refused(tmp_path, encoding):
    content = write_nrrd(tmp_path / "a.nrrd", make_labels((9, 20, 20)), encoding=encoding).read_bytes()
    for length in {*range(0, len(content), 37), len(content) - 1}:
        (tmp_path / "b.nrrd").write_bytes(content[:length])
        with refused(RefusedInputError, "b.nrrd"):
            read_labels(tmp_path / "b.nrrd")


def test_missing_pynrrd_is_named_with_its_command(tmp_path, monkeypatch):
    path = write_nrrd(tmp_path / "a.nrrd", make_labels())
    monkeypatch.setitem(__import__("sys").modules, "nrrd", None)
    with refused(UsageError, "package"):
        read_labels(path)


def test_progress_counts_slices_from_the_first_to_the_last(tmp_path):
    voxels, fields = layered(False)
    told: list = []
    read_labels(write_nrrd(tmp_path / "a.nrrd", make_labels((3, 4, 5))), progress=lambda *step: told.append(step))
    read_labels(write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields), progress=lambda *step: told.append(step))
    assert told == [("read", 1, 3), ("read", 2, 3), ("read", 3, 3)] * 2


def test_layers_count_where_a_map_is_called_large(tmp_path):
    voxels, fields = layered(False)  # 60 voxels in two layers
    path = write_nrrd(tmp_path / "a.seg.nrrd", voxels.astype(np.int16), **fields)
    for most, large in ((239, True), (240, False)):
        assert is_large_map(path, most_bytes=most) == large
