"""Inputs of a view: what each file is taken for, its frame, its place, and the order in which faults are said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
from clrecon.points import PointCloud
from clrecon.viewer.model.objects import ShownLabels, wrap_inputs

pytestmark = pytest.mark.unit


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def test_each_kind_is_told_by_its_file_and_lies_in_its_place(files):
    names = ["scan.nii.gz", "lps.stl", "ras.ply", "cloud.ply", "cloud.xyz", "labels.nii.gz"]
    opened = open_inputs([files / name for name in names])
    assert [type(each.subject) for each in opened] == [Volume, Mesh, Mesh, PointCloud, PointCloud, LabelMap]
    subjects: list[Any] = [each.subject for each in opened]
    scan, lps, ras, cloud, plain, labels = subjects
    assert np.allclose(scan.affine, scenes.AFFINE, atol=1e-4)
    assert np.allclose(lps.bounds, ras.bounds, atol=1e-4)
    assert np.allclose(cloud.points, plain.points, atol=1e-3)
    assert labels.numbers == (5,) and np.allclose(labels.affine, scenes.AFFINE, atol=1e-4)
    said = [" ".join(each.said) for each in opened]
    assert "ras.ply was turned from RAS to LPS" in said[2] and "cloud.ply was turned from RAS to LPS" in said[3]
    assert "turned" not in said[1] and "taken for a label map" in said[5]
    shown = wrap_inputs(opened, ["knee"])
    assert [each.name for each in shown] == ["knee", "mesh 2", "mesh 3", "cloud 4", "cloud 5", "labels 6"]
    assert isinstance(shown[5], ShownLabels) and shown[5].within == 1 and shown[2].said == opened[2].said


def test_a_frame_is_said_by_the_caller_where_the_file_names_none(files):
    opened = open_inputs([files / "plain.xyz"], ViewSettings(mesh_space="ras"))
    assert isinstance(opened[0].subject, PointCloud)
    assert np.allclose(opened[0].subject.points[:, :2], -scenes.make_cloud().points[:, :2], atol=1e-4)
    assert "plain.xyz was turned from RAS to LPS" in opened[0].said
    (assumed,) = open_inputs([files / "plain.xyz"])
    assert any("taken as LPS" in text for text in assumed.said)


def test_label_map_of_the_settings_comes_last_and_needs_one_scan(files):
    settings = ViewSettings(scan=MeshSettings(labels=LabelChoice(files / "labels.nii.gz")))
    opened = open_inputs([files / "scan.nii.gz"], settings)
    assert [type(each.subject) for each in opened] == [Volume, LabelMap]
    with refused(UsageError, 2):
        open_inputs([files / "scan.nii.gz", files / "scan.nii.gz"], settings)
    assert [type(each.subject) for each in open_inputs([], settings)] == [LabelMap]


def test_dicom_labels_are_an_input_too(real_data):
    (opened,) = open_inputs([real_data / "seg_and_labels" / "liver.dcm"])
    assert isinstance(opened.subject, LabelMap)
    (scan,) = open_inputs([real_data / "seg_and_labels" / "enhanced_24x38x3"])
    assert isinstance(scan.subject, Volume)
    with refused(RefusedInputError, "overlap"):
        open_inputs([real_data / "seg_and_labels" / "partial_overlaps.dcm"])


def test_a_scan_is_cropped_and_masked_as_it_is_asked_for(files):
    settings = ViewSettings(scan=MeshSettings(between=(205.0, 215.0), field_of_view=15.0))
    (opened,) = open_inputs([files / "scan.nii.gz"], settings)
    assert isinstance(opened.subject, Volume) and opened.subject.shape_ijk[2] < scenes.SHAPE[0]
    assert any("is air now" in text for text in opened.said)


def test_inputs_are_told_one_by_one_meshes_before_scans(files):
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
