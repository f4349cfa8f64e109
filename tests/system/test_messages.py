"""Objects that go to another process and back by pickle arrive as they were: volumes, meshes, settings, errors."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from functools import cached_property
from operator import attrgetter

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.anatomy.iso_choice import half_iso_value
from clrecon.anatomy.noise import Noise
from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.render.settings import RenderSettings
from clrecon.labels import LabelMap
from clrecon.labels.statistics import measure_labels
from clrecon.mesh import Mesh
from clrecon.operators.points.clusters import Clustering
from clrecon.operators.points.neighbours import Neighbours
from clrecon.points.cloud import PointCloud, PointStep
from clrecon.proof.compare.mesh_cells import GridCells
from clrecon.proof.compare.methods import CompareSettings
from clrecon.proof.phantom import PhantomSettings, phantom_truth
from clrecon.reading.common.source_facts import SeriesEntry, SeriesListing
from clrecon.rendering import Lighting, Rendering, TransferFunction
from clrecon.rendering.pictures.label_style import LabelStyle
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.styles import CurveCut, PlaneCut, Projection, SlicesInSpace, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.centre_line import Curve
from clrecon.rendering.views.clip import Clip
from clrecon.spine.split import MiddlePlane, Vertebra, VertebraSplit
from clrecon.system.records import at_most

VOXELS = np.arange(4 * 5 * 6, dtype=np.int16).reshape(4, 5, 6)
AFFINE = np.array([[0.7, 0.1, 0.0, -25.0], [-0.1, 0.7, 0.2, -30.0], [0.0, 0.05, 2.5, -84.0], [0, 0, 0, 1.0]])
POSITIONS = np.array([[0, 0, 0], [0, 0, 2], [0, 0, 5], [0, 0, 9.0]])
TRIANGLE = Mesh(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], normals=[[0, 0, 1.0]] * 3, report={"iso_value_hu": 250.0}
)
LABELS = LabelMap(VOXELS > 50, AFFINE, {1: "bone"}, warnings=["doubtful"])
CAMERA = Camera.fit(Volume(VOXELS, AFFINE))
CURVE = Curve([[0, 0, 0], [1, 2, 3], [2, 2, 7.0]])
ENTRY = SeriesEntry(
    number=1, uid_hash="ab", description="thin", modality="CT", slices=4, shape_ijk=[6, 5, 4], spacing_mm=[1.0] * 3,
    affine_ijk_to_lps_mm=None, tilt_deg=0.0, grid_residual_max_mm=0.0, gap_mm={"min": 1.0}, uneven=False, warnings=[],
    problems=[],
)  # fmt: skip
EMPTY = np.zeros((2, 3), np.float32)
CLOUD = PointCloud([[0, 0, 0], [1, 2, 3]], hu=[200, 300], labels=[0, -1], report={"iso_value_hu": 250.0})

VERTEBRA = Vertebra(
    number=1, name="vertebra_1", confidence=0.4, is_confident=False, doubts=["shallow disc"], whole=True,
    centre_mm=[0.0, 1.0, 2.0], height_mm=30.0, volume_ml=40.0,
)  # fmt: skip
PLANE = MiddlePlane(
    sagittal=EMPTY, coronal=EMPTY, sagittal_labels=EMPTY.astype(np.int32), coronal_labels=EMPTY.astype(np.int32),
    canal_column=1, middle_column=2, lines=[((0.0, 1.0), (2.0, 3.0))], rows=[0.5],
)  # fmt: skip

MESSAGES = {  # whatever they contain: it is compared with itself
    "volume": Volume(VOXELS, AFFINE, report={"warnings": ["doubtful"]}),
    "uneven volume": Volume(VOXELS, AFFINE, slice_positions=POSITIONS),
    "mesh": TRIANGLE,
    "label map": LABELS,
    "label style": LabelStyle.of(LABELS),
    "camera": CAMERA,
    "clip": Clip.box((0, 0, 0), (1, 2, 3)),
    "curve": CURVE,
    "lighting": Lighting(),
    "transfer function": TransferFunction(
        [(0, 1, 1, 1, 0), (200, 1, 0.9, 0.8, 1)], gradient_opacity=[(0, 0.5), (9, 1)]
    ),
    "rendering": Rendering(np.zeros((2, 3, 4), np.uint8), EMPTY, EMPTY, CAMERA, report={"seconds": {"read": 0.5}}),
    "mesh settings": MeshSettings(iso_value=(200.0, (300.0, 400.0)), labels=None, device=0),
    "label choice": LabelChoice("labels.nii", ("bone",)),
    "render settings": RenderSettings(),
    "compare settings": CompareSettings(methods=("t-mc", "vtk-fe"), iso_value=226.0),
    "volume look": VolumeLook("skin", labels=LABELS, label_opacity={"bone": 0.5}),
    "projection": Projection("drr", clip=Clip.plane((0, 0, 0), (0, 0, 1))),
    "surface look": SurfaceLook(300, color=(1, 0, 0), shadows=True, lighting=Lighting(direction=(1, 0, 0))),
    "slices in space": SlicesInSpace([3, 1], window=(0, 100)),
    "plane cut": PlaneCut(thickness=3.0),
    "curve cut": CurveCut(CURVE, kind="stretched"),
    "phantom settings": PhantomSettings(),
    "iso choice": half_iso_value(bone_hu=1000.0, tissue_hu=40.0),
    "grid cells": GridCells([[0, -1, 2], [3, 4, 5]], "t-mc"),
    "vertebra": VERTEBRA,
    "middle plane": PLANE,
    "vertebra split": VertebraSplit(
        LABELS,
        [VERTEBRA],
        discs_mm=CURVE.points,
        disc_normals=CURVE.points,
        level_hu=150.0,
        left_out=["a sacrum"],
        plane=PLANE,
    ),
    "gate": at_most("gap", 1.0, bound=2.0, unit="mm", subject="a gap"),
    "quality": TRIANGLE.quality(),
    "point cloud": CLOUD,
    "point step": PointStep(
        CLOUD, removed=np.array([0, 1, 0], np.uint8), reasons=("noise",), facts={"eps_mm": 1.2}, warnings=("doubtful",)
    ),
    "clusters": Clustering(CLOUD, np.zeros(2, np.uint8), cores=np.array([True, False])),
    "nearest points": Neighbours(np.zeros((2, 1), np.int32), np.zeros((2, 1), np.float32)),
    "noise": Noise(hu=12.5, blocks=40, slices=9),
    "truth of a phantom": phantom_truth(PhantomSettings(kind="sphere", size=(16, 16), slices=16)),
    "mesh look": MeshLook(vertex_colors=np.zeros((2, 3), np.uint8), opacity=0.5),
    "point look": PointLook(radius_mm=0.5, color_by="label"),
    "figures of a label": measure_labels(Volume(VOXELS, AFFINE), LABELS)[0],
    "listing": SeriesListing(
        [ENTRY], chosen=1, skipped={}, warnings=[], certificate={"slices": 4}, refusal=RefusedInputError("no")
    ),
}
HELD_BY_A_DEVICE = {"Device", "DeviceVolume", "Mask", "SurfaceExtractor", "VertebraInside", "VolumeRenderer"}
"""Public classes that are no messages: they own memory of a device."""


def pickled(message):
    return pickle.loads(pickle.dumps(message))


def content_of(value):
    """All plain values that an object holds, arrays with their type and whether they can be written."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.flags.writeable, value.tobytes()
    if isinstance(value, dict):
        return {key: content_of(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value), [content_of(entry) for entry in value]
    if isinstance(value, Exception):
        return type(value), value.args
    if not hasattr(value, "__dict__"):
        return value
    kind = type(value)
    stored = {name: each for name, each in vars(value).items() if not isinstance(vars(kind).get(name), cached_property)}
    return kind, content_of(stored)


@pytest.mark.parametrize("copy_by", [pickled, copy.deepcopy, copy.copy])
@pytest.mark.parametrize("name", MESSAGES)
def test_pickled_or_copied_object_has_the_type_and_the_content_of_its_original(name, copy_by):
    message = MESSAGES[name]
    copied = copy_by(message)
    assert copied is not message
    assert type(copied) is type(message)
    assert content_of(copied) == content_of(message)


def test_every_public_class_is_pickled_in_these_tests_or_owns_memory_of_a_device():
    public = {name for name in clrecon.__all__ if isinstance(getattr(clrecon, name), type)} - {"Style"}  # of all styles
    errors = {name for name in public if issubclass(getattr(clrecon, name), Exception)}
    pickled_here = {kind.__name__ for message in MESSAGES.values() for kind in type(message).__mro__}
    assert public - errors - HELD_BY_A_DEVICE <= pickled_here


@pytest.mark.parametrize("name", [name for name in clrecon.__all__ if name.endswith("Error") or name == "Cancelled"])
def test_pickled_error_has_its_type_and_message(name):
    error = pickled(getattr(clrecon, name)("what, where, and what to do"))
    assert type(error) is getattr(clrecon, name)
    assert str(error) == "what, where, and what to do"


def read_only_volume():
    voxels = VOXELS.copy()
    voxels.flags.writeable = False
    return Volume(voxels, AFFINE, slice_positions=POSITIONS)


@pytest.mark.parametrize("copy_by", [pickled, copy.deepcopy])
@pytest.mark.parametrize(
    ("message", "array"),
    [
        (read_only_volume(), "voxels"),
        (read_only_volume(), "affine"),
        (read_only_volume(), "_inverse"),
        (read_only_volume(), "_stack.positions"),
        (MESSAGES["clip"], "planes"),
        (MESSAGES["transfer function"], "points"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_read_only_array_of_a_pickled_or_copied_object_is_read_only(message, array, copy_by):
    with refused(ValueError, "read-only"):
        attrgetter(array)(copy_by(message))[0] = 7


@pytest.mark.parametrize("copy_by", [pickled, copy.deepcopy])
def test_voxels_that_can_be_written_can_be_written_in_a_pickled_or_copied_volume(copy_by):
    assert copy_by(Volume(VOXELS, AFFINE)).voxels.flags.writeable


def test_change_of_a_deep_copy_leaves_the_voxels_and_the_report_of_its_volume():
    volume = Volume(VOXELS.copy(), AFFINE)
    copied = copy.deepcopy(volume)
    copied.voxels[0, 0, 0] = -99
    copied.report["warnings"].append("of the copy")
    assert volume.voxels[0, 0, 0] == 0
    assert volume.report["warnings"] == []


@pytest.fixture
def voxel_file(tmp_path):
    """A file of `VOXELS`, to be mapped."""
    np.save(tmp_path / "voxels.npy", VOXELS)
    return tmp_path / "voxels.npy"


LARGE = np.broadcast_to(np.arange(64, dtype=np.uint16), (64, 64, 64))
"""Voxels of 512 KiB, whose place in a file takes some hundred bytes."""


@pytest.fixture(params=[Volume, LabelMap])
def mapped_message(request, tmp_path):
    """Slices 3 to 59 of the large voxels, mapped read-only from a file."""
    np.save(tmp_path / "large.npy", LARGE)
    return request.param(np.load(tmp_path / "large.npy", mmap_mode="r")[3:60], AFFINE)


def is_sent_by_place(message):
    """Whether the pickle of a message holds the place of its voxels in a file, and not their values."""
    return len(pickle.dumps(message)) < LARGE.nbytes / 50


def test_mapped_voxels_are_sent_by_their_place_in_the_file_and_arrive_read_only(mapped_message):
    assert is_sent_by_place(mapped_message)
    arrived = pickled(mapped_message)
    assert np.array_equal(arrived.voxels, LARGE[3:60])
    assert not arrived.voxels.flags.writeable


def test_mapped_voxels_that_arrived_are_sent_on_by_their_place_in_the_file(mapped_message):
    assert is_sent_by_place(pickled(mapped_message))


def test_deep_copy_of_mapped_voxels_is_sent_by_their_place_in_the_file(mapped_message):
    assert is_sent_by_place(copy.deepcopy(mapped_message))


def test_value_written_through_a_shared_mapping_arrives_in_read_only_voxels(voxel_file):
    mapped = np.load(voxel_file, mmap_mode="r+")
    volume = Volume(mapped, AFFINE)
    mapped[1, 2, 3] = -77
    arrived = pickled(volume)
    assert arrived.voxels[1, 2, 3] == -77
    assert not arrived.voxels.flags.writeable


def test_deep_copy_of_a_shared_mapping_has_its_written_values_and_writes_none_to_the_file(voxel_file):
    mapped = np.load(voxel_file, mmap_mode="r+")
    mapped[1, 2, 3] = -77
    copied = copy.deepcopy(Volume(mapped, AFFINE))
    assert copied.voxels[1, 2, 3] == -77
    copied.voxels[0, 0, 0] = 5
    assert mapped[0, 0, 0] == 0


def test_private_mapping_is_sent_with_its_values(voxel_file):
    mapped = np.load(voxel_file, mmap_mode="c")
    mapped[1, 2, 3] = -77
    volume = Volume(mapped, AFFINE)
    voxel_file.unlink()
    assert pickled(volume).voxels[1, 2, 3] == -77


@pytest.mark.parametrize("is_replaced", [False, True])
def test_mapped_voxels_whose_file_was_removed_or_replaced_before_are_sent_with_their_values(voxel_file, is_replaced):
    volume = Volume(np.load(voxel_file, mmap_mode="r"), AFFINE)
    voxel_file.unlink()
    if is_replaced:
        np.save(voxel_file, VOXELS + 1)
    arrived = pickled(volume)
    assert np.array_equal(arrived.voxels, VOXELS)
    assert not arrived.voxels.flags.writeable


def test_message_whose_file_was_removed_on_its_way_is_refused_with_the_file(voxel_file):
    sent = pickle.dumps(Volume(np.load(voxel_file, mmap_mode="r"), AFFINE))
    voxel_file.unlink()
    with refused(RefusedInputError, "voxels.npy"):
        pickle.loads(sent)


@pytest.mark.parametrize("values", [VOXELS + 1, VOXELS[:2]], ids=["other values", "fewer values"])
def test_message_whose_file_was_changed_on_its_way_is_refused_with_the_file(voxel_file, values):
    sent = pickle.dumps(Volume(np.load(voxel_file, mmap_mode="r"), AFFINE))
    np.save(voxel_file, values)
    with refused(RefusedInputError, "voxels.npy"):
        pickle.loads(sent)


SUM_IN_ANOTHER_PROCESS = """
import pickle, sys
import numpy as np
volume = pickle.loads(sys.stdin.buffer.read())
volume.report["sum"] = int(volume.voxels.sum())
assert not volume.voxels.flags.writeable
sys.stdout.buffer.write(pickle.dumps(volume))
"""


def test_mapped_volume_comes_back_from_another_process_with_its_voxels_slices_and_report(voxel_file):
    volume = Volume(np.load(voxel_file, mmap_mode="r"), AFFINE, report={"warnings": []}, slice_positions=POSITIONS)
    command = [sys.executable, "-c", SUM_IN_ANOTHER_PROCESS]
    done = subprocess.run(command, input=pickle.dumps(volume), capture_output=True, check=True)
    back = pickle.loads(done.stdout)
    assert back.report == {"warnings": [], "sum": int(VOXELS.sum())}
    assert np.array_equal(back.voxels, VOXELS)
    assert np.array_equal(back.slice_origins(), volume.slice_origins())
