"""Everything that goes to another process and back arrives as it was."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from functools import cached_property

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
from clrecon.points import PointCloud, PointStep
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
TRIANGLE = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], [[0, 0, 1.0]] * 3, {"iso_value_hu": 250.0})
LABELS = LabelMap(VOXELS > 50, AFFINE, {1: "bone"}, warnings=["doubtful"])
CAMERA = Camera.fit(Volume(VOXELS, AFFINE))
CURVE = Curve([[0, 0, 0], [1, 2, 3], [2, 2, 7.0]])
ENTRY = SeriesEntry(1, "ab", "thin", "CT", 4, [6, 5, 4], [1.0] * 3, None, 0.0, 0.0, {"min": 1.0}, False, [], [])
EMPTY = np.zeros((2, 3), np.float32)
CLOUD = PointCloud([[0, 0, 0], [1, 2, 3]], hu=[200, 300], labels=[0, -1], report={"iso_value_hu": 250.0})

VERTEBRA = Vertebra(1, "vertebra_1", 0.4, False, ["shallow disc"], True, [0.0, 1.0, 2.0], 30.0, 40.0)
PLANE = MiddlePlane(
    EMPTY, EMPTY, EMPTY.astype(np.int32), EMPTY.astype(np.int32), 1, 2, [((0.0, 1.0), (2.0, 3.0))], [0.5]
)

MESSAGES = {
    "volume": Volume(VOXELS, AFFINE, {"warnings": ["doubtful"]}),
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
    "iso choice": half_iso_value(1000.0, 40.0),
    "grid cells": GridCells([[0, -1, 2], [3, 4, 5]], "t-mc"),
    "vertebra": VERTEBRA,
    "middle plane": PLANE,
    "vertebra split": VertebraSplit(LABELS, [VERTEBRA], CURVE.points, CURVE.points, 150.0, ["a sacrum"], PLANE),
    "gate": at_most("gap", 1.0, 2.0, "mm", "a gap"),
    "quality": TRIANGLE.quality(),
    "point cloud": CLOUD,
    "point step": PointStep(CLOUD, np.array([0, 1, 0], np.uint8), ("noise",), {"eps_mm": 1.2}, ("doubtful",)),
    "clusters": Clustering(CLOUD, np.zeros(2, np.uint8), cores=np.array([True, False])),
    "nearest points": Neighbours(np.zeros((2, 1), np.int32), np.zeros((2, 1), np.float32)),
    "noise": Noise(12.5, 40, 9),
    "truth of a phantom": phantom_truth(PhantomSettings(kind="sphere", size=(16, 16), slices=16)),
    "mesh look": MeshLook(vertex_colors=np.zeros((2, 3), np.uint8), opacity=0.5),
    "point look": PointLook(radius_mm=0.5, color_by="label"),
    "figures of a label": measure_labels(Volume(VOXELS, AFFINE), LABELS)[0],
    "listing": SeriesListing([ENTRY], 1, {}, [], {"slices": 4}, RefusedInputError("no")),
}
HELD_BY_A_DEVICE = {"Device", "DeviceVolume", "Mask", "SurfaceExtractor", "VertebraInside", "VolumeRenderer"}
"""Public classes that are no messages: they own memory of a device."""


def travel(message):
    return pickle.loads(pickle.dumps(message))


def look(value, seen=None):
    """All plain values that an object holds, arrays with their type and whether they can be written."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.flags.writeable, value.tobytes()
    if isinstance(value, dict):
        return {key: look(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value), [look(entry) for entry in value]
    if isinstance(value, Exception):
        return type(value), value.args
    if not hasattr(value, "__dict__"):
        return value
    kind = type(value)
    kept = {name: each for name, each in vars(value).items() if not isinstance(vars(kind).get(name), cached_property)}
    return kind, look(kept)


@pytest.mark.parametrize("way", [travel, copy.deepcopy, copy.copy])
@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_arrives_as_it_was(name, way):
    message = MESSAGES[name]
    arrived = way(message)
    assert type(arrived) is type(message)
    assert arrived is not message
    assert look(arrived) == look(message)


def test_every_public_class_is_a_message_or_owns_a_device():
    public = {name for name in clrecon.__all__ if isinstance(getattr(clrecon, name), type)} - {"Style"}  # of all styles
    errors = {name for name in public if issubclass(getattr(clrecon, name), Exception)}
    seen = {kind.__name__ for message in MESSAGES.values() for kind in type(message).__mro__}
    assert public - errors - HELD_BY_A_DEVICE <= seen


@pytest.mark.parametrize("name", [name for name in clrecon.__all__ if name.endswith("Error") or name == "Cancelled"])
def test_errors_are_pickled_with_their_message(name):
    error = travel(getattr(clrecon, name)("what, where, and what to do"))
    assert type(error) is getattr(clrecon, name)
    assert str(error) == "what, where, and what to do"


@pytest.mark.parametrize("way", [travel, copy.deepcopy])
def test_arrays_that_cannot_be_written_stay_so_in_another_process(way):
    frozen = VOXELS.copy()
    frozen.flags.writeable = False
    volume = way(Volume(frozen, AFFINE, slice_positions=POSITIONS))
    clip, function = way(MESSAGES["clip"]), way(MESSAGES["transfer function"])
    assert volume.uneven
    for array in (volume.voxels, volume.affine, volume._inverse, volume._stack.positions, clip.planes, function.points):
        with refused(ValueError, "read-only"):
            array[0] = 7
    assert way(Volume(VOXELS, AFFINE)).voxels.flags.writeable


def test_a_deep_copy_shares_nothing_that_can_be_written():
    volume = Volume(VOXELS.copy(), AFFINE)
    copied = copy.deepcopy(volume)
    copied.voxels[0, 0, 0] = -99
    copied.report["warnings"].append("of the copy")
    assert volume.voxels[0, 0, 0] == 0
    assert volume.report["warnings"] == []


@pytest.fixture
def file(tmp_path):
    np.save(tmp_path / "voxels.npy", VOXELS)
    return tmp_path / "voxels.npy"


@pytest.mark.parametrize("kind", [Volume, LabelMap])
def test_mapped_voxels_travel_as_their_place(tmp_path, kind):
    large = np.zeros((64, 64, 64), np.uint16)
    large[5:] = np.arange(64, dtype=np.uint16)
    np.save(tmp_path / "large.npy", large)
    message = kind(np.load(tmp_path / "large.npy", mmap_mode="r")[3:60], AFFINE)
    sent = pickle.dumps(message)
    assert len(sent) < 10_000
    arrived = pickle.loads(sent)
    assert np.array_equal(arrived.voxels, large[3:60])
    assert not arrived.voxels.flags.writeable
    assert len(pickle.dumps(arrived)) < 10_000  # it is mapped again, and can travel on
    assert len(pickle.dumps(copy.deepcopy(message))) < 10_000


def test_values_written_to_a_mapping_travel(file):
    mapped = np.load(file, mmap_mode="r+")
    volume = Volume(mapped, AFFINE)
    mapped[1, 2, 3] = -77
    arrived, copied = travel(volume), copy.deepcopy(volume)
    assert arrived.voxels[1, 2, 3] == copied.voxels[1, 2, 3] == -77
    assert not arrived.voxels.flags.writeable
    copied.voxels[0, 0, 0] = 5  # in memory: the file stays as it is
    assert mapped[0, 0, 0] == 0


def test_private_mappings_travel_with_their_values(file):
    mapped = np.load(file, mmap_mode="c")
    mapped[1, 2, 3] = -77
    volume = Volume(mapped, AFFINE)
    file.unlink()
    assert travel(volume).voxels[1, 2, 3] == -77


@pytest.mark.parametrize("replaced", [False, True])
def test_a_file_that_went_before_the_message_left_is_no_matter(file, replaced):
    volume = Volume(np.load(file, mmap_mode="r"), AFFINE)
    file.unlink()
    if replaced:
        np.save(file, VOXELS + 1)
    arrived = travel(volume)
    assert np.array_equal(arrived.voxels, VOXELS)
    assert not arrived.voxels.flags.writeable


def test_a_file_that_went_on_the_way_is_said(file):
    sent = pickle.dumps(Volume(np.load(file, mmap_mode="r"), AFFINE))
    file.unlink()
    with refused(RefusedInputError, "voxels.npy"):
        pickle.loads(sent)


@pytest.mark.parametrize("values", [VOXELS + 1, VOXELS[:2]])
def test_a_file_that_was_changed_on_the_way_is_said(file, values):
    sent = pickle.dumps(Volume(np.load(file, mmap_mode="r"), AFFINE))
    np.save(file, values)
    with refused(RefusedInputError, "voxels.npy"):
        pickle.loads(sent)


THERE = """
import pickle, sys
import numpy as np
volume = pickle.loads(sys.stdin.buffer.read())
volume.report["sum"] = int(volume.voxels.sum())
assert not volume.voxels.flags.writeable
sys.stdout.buffer.write(pickle.dumps(volume))
"""


def test_a_mapped_volume_goes_to_another_process_and_back(file):
    volume = Volume(np.load(file, mmap_mode="r"), AFFINE, {"warnings": []}, POSITIONS)
    done = subprocess.run([sys.executable, "-c", THERE], input=pickle.dumps(volume), capture_output=True, check=True)
    back = pickle.loads(done.stdout)
    assert back.report == {"warnings": [], "sum": int(VOXELS.sum())}
    assert np.array_equal(back.voxels, VOXELS)
    assert np.array_equal(back.slice_origins(), volume.slice_origins())
