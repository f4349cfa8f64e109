"""NRRD label maps and 3D Slicer segmentations: frames, names, layers, and what is refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import tolerances
from label_files import OBLIQUE, make_labels, write_nrrd
from refusals import refused
from volume_files import ROTATED

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


def segment(n, name, *, value, layer=None):
    """Fields of the segment `n` of 3D Slicer."""
    fields = {f"Segment{n}_Name": name, f"Segment{n}_LabelValue": str(value), f"Segment{n}_ID": f"id{n}"}
    return fields if layer is None else {**fields, f"Segment{n}_Layer": str(layer)}


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("encoding", ["raw", "gzip"])
def test_nrrd_of_every_anatomical_frame_is_read_with_its_place_in_lps(tmp_path, space, encoding):
    voxels = make_labels()
    path = write_nrrd(tmp_path / "a.nrrd", voxels.astype(np.int16), OBLIQUE, space=space, encoding=encoding)
    labels = read_labels(path)
    assert np.array_equal(labels.voxels, voxels)
    assert np.allclose(labels.affine, OBLIQUE, atol=tolerances.DECIMAL_PLACE_MM)


@pytest.mark.parametrize("dtype", ["<i1", "<u1", "<u2", ">i2", "<i4", "<u4", "<i8", "<u8", "<f4", ">f8"])
def test_nrrd_of_whole_numbers_of_every_type_is_read(tmp_path, dtype):
    voxels = make_labels()
    assert np.array_equal(read_labels(write_nrrd(tmp_path / "a.nrrd", voxels.astype(dtype))).voxels, voxels)


def test_voxel_of_an_nrrd_lies_where_simpleitk_puts_it(tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    path = write_nrrd(tmp_path / "a.nrrd", make_labels(), ROTATED, space="right-anterior-superior")
    expected = sitk.ReadImage(str(path)).TransformIndexToPhysicalPoint((1, 2, 3))
    place = read_labels(path).affine @ (1, 2, 3, 1)
    assert np.allclose(place[:3], expected, atol=tolerances.DECIMAL_PLACE_MM)


def test_segments_of_slicer_are_found_by_their_names(tmp_path):
    fields = segment(0, "L1 vertebra", value=2)
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", make_labels(numbers=(0, 2)), **fields))
    assert labels.names == {2: "L1 vertebra"}
    assert labels.find("l1 VERTEBRA") == labels.find("L1") == 2


def test_control_characters_of_a_segment_name_are_left_out(tmp_path):
    fields = segment(0, "bad\x1b[31m", value=5)
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", make_labels(numbers=(0, 5)), **fields))
    assert labels.names[5].startswith("bad")
    assert "\x1b" not in labels.names[5]


def segments_in_two_layers(overlap: bool = False):
    """Voxels of one (3), two (1) and three (1) in two layers, and their fields; one and two may share a voxel."""
    voxels = np.zeros((3, 4, 5, 2), np.uint8)
    voxels[0, 0, :3, 0] = 1
    voxels[0, 0, 2 if overlap else 3, 1] = 1
    voxels[2, 3, 4, 1] = 2
    return voxels, {
        **segment(0, "one", value=1, layer=0),
        **segment(1, "two", value=1, layer=1),
        **segment(2, "three", value=2, layer=1),
    }


def test_segments_in_two_layers_are_read_as_one_map(tmp_path):
    voxels, fields = segments_in_two_layers()
    expected = np.zeros((3, 4, 5), int)
    expected[0, 0, :4] = 1, 1, 1, 2
    expected[2, 3, 4] = 3
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", voxels, OBLIQUE, **fields))
    assert np.array_equal(labels.voxels, expected)
    assert labels.names == {1: "one", 2: "two", 3: "three"}
    assert np.allclose(labels.affine, OBLIQUE, atol=tolerances.DECIMAL_PLACE_MM)


@pytest.fixture
def overlapping_segments(tmp_path):
    """A file with one (3 voxels), two (1, shared with one) and three (1)."""
    voxels, fields = segments_in_two_layers(overlap=True)
    return write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields)


def test_segments_that_overlap_are_refused(overlapping_segments):
    with refused(RefusedInputError, "one", "two", 1, 2):  # their numbers
        read_labels(overlapping_segments)


def test_chosen_segments_are_read_alone_beside_one_that_overlaps(overlapping_segments):
    assert read_labels(overlapping_segments, ["one"]).counts == {1: 3}
    assert read_labels(overlapping_segments, ["two", 3]).counts == {2: 1, 3: 1}


def test_chosen_segments_keep_the_voxels_that_they_share_where_all_are_read(overlapping_segments):
    assert read_all_labels(overlapping_segments, ["one"]).counts == {1: 3, 3: 1}
    assert read_all_labels(overlapping_segments, ["two", 3]).counts == {1: 2, 2: 1, 3: 1}


def test_lowest_number_keeps_the_voxels_that_segments_not_chosen_share(overlapping_segments):
    assert read_all_labels(overlapping_segments, [3]).counts == {1: 3, 3: 1}


def test_segment_that_is_not_there_is_refused_with_those_that_are(overlapping_segments):
    with refused(UsageError, "four", 1, 2, 3):
        read_labels(overlapping_segments, ["four"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"space: left-posterior-superior", b"space: scanner-xyz", "space 'scanner-xyz'"),
        (b"space: left-posterior-superior\n", b"", "does not say where it lies"),
        (b"sizes: 7 6 4", b"sizes: 7 6 4000", "cannot come from a file of"),
        (b"sizes: 7 6 4", b"sizes: 70000 60000 40000", "at most 68,719,476,736"),
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
def test_nrrd_with_an_impossible_header_is_refused(tmp_path, old, new, message):
    path = edit(write_nrrd(tmp_path / "a.nrrd", make_labels(), encoding="raw"), (old, new))
    with pytest.raises(RefusedInputError, match=message):
        read_labels(path)


@pytest.fixture
def detached_header(tmp_path):
    """A header `in/a.nhdr` whose voxels are in `in/a.raw.gz`."""
    voxels, fields = segments_in_two_layers()
    path = write_nrrd(tmp_path / "in" / "a.nhdr", voxels, **fields)
    assert {file.name for file in path.parent.iterdir()} == {"a.nhdr", "a.raw.gz"}
    return path


def test_detached_header_is_read_with_the_file_of_voxels_beside_it(detached_header):
    labels = read_labels(detached_header)
    assert labels.counts == {1: 3, 2: 1, 3: 1}
    assert np.allclose(labels.affine, OBLIQUE, atol=tolerances.DECIMAL_PLACE_MM)


@pytest.mark.parametrize(
    ("named", "words"),
    [
        pytest.param("../other.gz", "only files beside it are read", id="above"),
        pytest.param("{folder}/other.gz", "only files beside it are read", id="absolute"),
        pytest.param("link.gz", "a link to another folder: not read", id="link"),
        pytest.param("none.gz", "which is not there", id="missing"),
        pytest.param("LIST\na.raw.gz", "has its voxels in several files", id="list"),
        pytest.param("a.%03d.gz 0 3 1", "has its voxels in several files", id="numbered"),
        pytest.param("", "has its voxels in several files|corrupt NRRD header", id="nothing"),
    ],
)
def test_detached_header_that_names_voxels_elsewhere_is_refused(detached_header, tmp_path, named, words):
    (tmp_path / "other.gz").write_bytes((detached_header.parent / "a.raw.gz").read_bytes())
    (detached_header.parent / "link.gz").symlink_to(tmp_path / "other.gz")
    data_file = b"data file: " + named.format(folder=tmp_path).encode()
    detached_header.write_bytes(detached_header.read_bytes().replace(b"data file: a.raw.gz", data_file))
    with pytest.raises(RefusedInputError, match=words):
        read_labels(detached_header)


def layers_with_values_1_and_2(*segments):
    """Two layers with one voxel each: value 1 at [0, 0, 0] of the first, 2 at [1, 1, 1] of the second; and fields."""
    voxels = np.zeros((3, 4, 5, 2), np.uint8)
    voxels[0, 0, 0, 0], voxels[1, 1, 1, 1] = 1, 2
    return voxels, {key: value for fields in segments for key, value in fields.items()}


@pytest.mark.parametrize(
    ("segments", "words"),
    [
        ([segment(0, "one", value=1), segment(1, "two", value=2)], "2 layers, and 2 of its 2 segments have no Layer"),
        (
            [segment(0, "one", value=1, layer=0), segment(1, "two", value=2)],
            "2 layers, and 1 of its 2 segments have no Layer",
        ),
        (
            [segment(0, "one", value=1, layer=0), {"Segment1_Name": "two", "Segment1_Layer": "1"}],
            "1 of its 2 .* have no LabelValue",
        ),
        (
            [segment(0, "one", value=1, layer=0), segment(1, "two", value=2, layer=2)],
            "has 2 layers, and a segment is in layer 2",
        ),
        (
            [segment(0, "one", value=1, layer=0), segment(1, "two", value=2, layer=-1)],
            "has 2 layers, and a segment is in layer -1",
        ),
        ([segment(0, "one", value=1, layer="x")], "corrupt NRRD header: Layer of a segment is no number"),
        ([], "has 2 layers and does not say which segments they hold"),
    ],
)
def test_layers_whose_segments_are_not_known_are_refused(tmp_path, segments, words):
    voxels, fields = layers_with_values_1_and_2(*segments)
    with pytest.raises(RefusedInputError, match=words):
        read_labels(write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields))


def test_segments_of_value_0_and_values_of_no_segment_are_warned_of(tmp_path):
    voxels, fields = layers_with_values_1_and_2(
        segment(0, "one", value=1, layer=0), segment(1, "air", value=0, layer=1), segment(2, "x", value=3, layer=1)
    )
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields))
    assert labels.counts == {1: 1}
    assert "air" not in labels.names.values()
    assert labels.warnings == (
        "1 of 3 segments have LabelValue 0, which is no label: left out",
        "1 voxels hold values that no segment of their layer has (LabelValue): left out",
    )


def test_segments_without_layer_and_value_are_those_of_the_layers_with_a_warning(tmp_path):
    """Before 4.11 3D Slicer wrote neither layers nor values: segment n is what layer n holds."""
    voxels, fields = layers_with_values_1_and_2({"Segment0_Name": "one"}, {"Segment1_Name": "two"})
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", (voxels > 0).astype(np.uint8), **fields))
    assert labels.names == {1: "one", 2: "two"}
    assert labels.counts == {1: 1, 2: 1}
    assert labels.voxels[1, 1, 1] == 2
    assert labels.warnings == ("its 2 segments name no layer: segment n is taken from layer n",)


def test_one_segment_without_layer_and_value_is_the_whole_map_without_a_warning(tmp_path):
    layers, _ = layers_with_values_1_and_2()
    voxels = layers[..., 0].astype(np.uint8)
    labels = read_labels(write_nrrd(tmp_path / "b.seg.nrrd", voxels, Segment0_Name="x"))
    assert labels.names == {1: "x"}
    assert labels.warnings == ()


def test_segment_without_a_value_is_warned_of_and_its_name_is_not_used(tmp_path):
    fields = {**segment(0, "two", value=2), "Segment1_Name": "lost", "Segment1_ID": "x"}
    labels = read_labels(write_nrrd(tmp_path / "a.seg.nrrd", make_labels(numbers=(0, 2, 5)), **fields))
    assert labels.names == {2: "two", 5: "label_5"}
    assert labels.warnings == ("1 of 2 segments have no LabelValue: their names are not known",)


def test_nrrd_header_that_does_not_end_within_2_mb_is_refused(tmp_path):
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


def test_nrrd_is_refused_with_the_missing_package_where_there_is_no_pynrrd(tmp_path, monkeypatch):
    path = write_nrrd(tmp_path / "a.nrrd", make_labels())
    monkeypatch.setitem(sys.modules, "nrrd", None)
    with refused(UsageError, "package", "pynrrd"):
        read_labels(path)


@pytest.mark.parametrize("layers", [False, True], ids=["one map", "two layers"])
def test_progress_of_reading_an_nrrd_counts_its_slices(tmp_path, layers):
    voxels, fields = segments_in_two_layers() if layers else (make_labels((3, 4, 5)), {})
    calls: list = []
    read_labels(write_nrrd(tmp_path / "a.seg.nrrd", voxels, **fields), progress=lambda *call: calls.append(call))
    assert calls == [("read", 1, 3), ("read", 2, 3), ("read", 3, 3)]


def test_map_is_called_large_by_the_voxels_of_all_its_layers(tmp_path):
    voxels, fields = segments_in_two_layers()
    path = write_nrrd(tmp_path / "a.seg.nrrd", voxels.astype(np.int16), **fields)
    stored_bytes = 3 * 4 * 5 * 2 * 2  # two layers of 60 voxels of 16 bits
    assert is_large_map(path, most_bytes=stored_bytes - 1)
    assert not is_large_map(path, most_bytes=stored_bytes)
