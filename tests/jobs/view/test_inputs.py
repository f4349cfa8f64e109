"""Inputs of a view: what each file is taken for, its frame, its place, and the order in which faults are said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import view_scenes as scenes
from refusals import refused

from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.view import ViewSettings
from clrecon.jobs.view.inputs import open_inputs
from clrecon.labels import LabelMap
from clrecon.mesh import Mesh
from clrecon.points.cloud import PointCloud
from clrecon.viewer.model.objects import ShownLabels, wrap_inputs

pytestmark = pytest.mark.unit


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a scan, a mesh and a cloud in LPS and RAS each, a map of label 5, and a cloud without a frame."""
    folder = tmp_path_factory.mktemp("inputs")
    scenes.make_scan().save(folder / "scan.nii.gz")
    scenes.make_mesh().save(folder / "lps.stl")
    scenes.make_mesh().save(folder / "ras.ply", "ras")
    scenes.make_cloud().save(folder / "cloud.ply", "ras")
    scenes.make_cloud().save(folder / "cloud.xyz")
    labels = scenes.make_labels()
    Volume(np.where(labels.voxels == 1, 0, 5).astype(np.int16), labels.affine).save(folder / "labels.nii.gz")
    np.savetxt(folder / "plain.xyz", scenes.make_cloud().points)
    return folder


def test_kind_of_an_input_of_a_view_follows_from_its_file(files):
    names = ["scan.nii.gz", "lps.stl", "ras.ply", "cloud.ply", "cloud.xyz", "labels.nii.gz"]
    opened = open_inputs([files / name for name in names])
    kinds = [type(each.subject) for each in opened]
    assert kinds == [Volume, Mesh, Mesh, PointCloud, PointCloud, LabelMap]


def test_scan_and_label_map_of_a_view_lie_at_the_place_of_their_files(files):
    scan, labels = (opened.subject for opened in open_inputs([files / "scan.nii.gz", files / "labels.nii.gz"]))
    assert isinstance(scan, Volume) and isinstance(labels, LabelMap)
    assert np.allclose(scan.affine, scenes.AFFINE, atol=1e-4)  # mm; NIfTI has float32
    assert np.allclose(labels.affine, scenes.AFFINE, atol=1e-4)
    assert labels.numbers == (5,)


def test_volume_of_few_integers_is_taken_for_a_label_map_with_a_remark(files):
    (labels,) = open_inputs([files / "labels.nii.gz"])
    assert "taken for a label map" in " ".join(labels.said)


def points_of(subject):
    """Points of a cloud or vertices of a mesh, in the order of their places."""
    points = subject.points if isinstance(subject, PointCloud) else subject.vertices
    return points[np.lexsort(np.rint(points.T))]


@pytest.mark.parametrize(
    ("in_lps", "in_ras"), [("lps.stl", "ras.ply"), ("cloud.xyz", "cloud.ply")], ids=["mesh", "cloud"]
)
def test_input_of_a_view_in_ras_is_turned_to_lps_with_a_remark(files, in_lps, in_ras):
    lps, ras = open_inputs([files / in_lps, files / in_ras])
    assert np.allclose(points_of(lps.subject), points_of(ras.subject), atol=1e-3)
    assert f"{in_ras} was turned from RAS to LPS" in " ".join(ras.said)
    assert "turned" not in " ".join(lps.said)


def test_inputs_of_a_view_have_given_names_or_kind_and_number(files):
    shown = wrap_inputs(
        open_inputs([files / "scan.nii.gz", files / "ras.ply", files / "labels.nii.gz"]), names=["knee"]
    )
    assert [each.name for each in shown] == ["knee", "mesh 2", "labels 3"]


def test_label_map_of_a_view_is_shown_within_the_first_scan_with_its_remarks(files):
    scan, label_map = open_inputs([files / "scan.nii.gz", files / "labels.nii.gz"])
    _, labels = wrap_inputs([scan, label_map])
    assert isinstance(labels, ShownLabels) and labels.within == 1
    assert labels.said == label_map.said


def test_cloud_that_names_no_frame_is_read_in_the_given_one(files):
    (opened,) = open_inputs([files / "plain.xyz"], ViewSettings(mesh_space="ras"))

    assert isinstance(opened.subject, PointCloud)
    assert np.allclose(opened.subject.points[:, :2], -scenes.make_cloud().points[:, :2], atol=1e-4)  # float32, mm
    assert "plain.xyz was turned from RAS to LPS" in opened.said


def test_cloud_that_names_no_frame_is_taken_as_lps_with_a_remark(files):
    (opened,) = open_inputs([files / "plain.xyz"])
    assert any("taken as LPS" in text for text in opened.said)


@pytest.fixture
def settings_with_labels(files):
    """Settings that name the label map."""
    return ViewSettings(scan=MeshSettings(labels=LabelChoice(files / "labels.nii.gz")))


def test_label_map_of_the_settings_is_the_last_input_of_a_view(files, settings_with_labels):
    opened = open_inputs([files / "scan.nii.gz"], settings_with_labels)
    assert [type(each.subject) for each in opened] == [Volume, LabelMap]


def test_label_map_of_the_settings_may_be_the_only_input_of_a_view(settings_with_labels):
    assert [type(each.subject) for each in open_inputs([], settings_with_labels)] == [LabelMap]


def test_label_map_of_the_settings_is_refused_for_two_scans(files, settings_with_labels):
    with refused(UsageError, 2):  # scans
        open_inputs([files / "scan.nii.gz", files / "scan.nii.gz"], settings_with_labels)


@pytest.mark.parametrize(
    ("name", "kind"), [("liver.dcm", LabelMap), ("enhanced_24x38x3", Volume)], ids=["segmentation", "scan"]
)
def test_dicom_segmentation_or_scan_of_real_data_is_an_input_of_a_view(real_data, name, kind):
    (opened,) = open_inputs([real_data / "seg_and_labels" / name])
    assert isinstance(opened.subject, kind)


def test_dicom_segmentation_with_overlapping_labels_is_refused_by_a_view(real_data):
    with refused(RefusedInputError, "overlap"):
        open_inputs([real_data / "seg_and_labels" / "partial_overlaps.dcm"])


def test_scan_of_a_view_is_cropped_and_masked_as_its_settings_say(files):
    settings = ViewSettings(scan=MeshSettings(between=(205.0, 215.0), field_of_view=15.0))
    (opened,) = open_inputs([files / "scan.nii.gz"], settings)
    assert isinstance(opened.subject, Volume) and opened.subject.shape_ijk[2] < scenes.SHAPE[0]
    assert any("is air now" in text for text in opened.said)


def test_inputs_of_a_view_are_ready_one_by_one_meshes_before_scans(files):
    told = []
    open_inputs([files / "scan.nii.gz", files / "lps.stl"], ready=lambda each: told.append(type(each.subject)))
    assert told == [Mesh, Volume]


@pytest.mark.parametrize(
    ("names", "error", "words"),
    [
        ([], UsageError, "nothing to show"),
        (["gone.stl"], UsageError, "no file of that name"),
        (["gone.xyz"], UsageError, "no file of that name"),
        (["gone"], NoDicomError, "gone"),
        (["text.stl"], RefusedInputError, "text.stl"),
        (["text.ply"], RefusedInputError, "end_header"),
        (["scan.nii.gz", "text.stl"], RefusedInputError, "text.stl"),
        (["cloud.pcd"], UsageError, "convert"),
    ],
)
def test_inputs_of_a_view_that_cannot_be_read_are_refused(files, names, error, words):
    for name in ("text.stl", "text.ply", "cloud.pcd"):
        (files / name).write_text("no such thing")
    with pytest.raises(error, match=words):
        open_inputs([files / name for name in names])
