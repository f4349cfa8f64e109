"""Saved views: what a view shows goes into a file and comes back; damaged files and those of other inputs do not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import view_scenes as scenes
from refusals import refused
from report_schemas import find_faults

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.model.saved_view import encode_view, read_view, restore_view
from clrecon.viewer.model.state import Pick, ShownPart

pytestmark = pytest.mark.unit

SCAN, MESH, LABELS = scenes.make_scan, scenes.make_mesh, scenes.make_labels


def make_model(*subjects: Any) -> ViewModel:
    """The model of a view of these objects, of a scan and a mesh by default."""
    return ViewModel(show_objects(subjects or [SCAN(), MESH()]))


def save(model: ViewModel) -> dict[str, Any]:
    """The entries of the file that the state of a model becomes."""
    return dict(json.loads(encode_view(model.state, model.objects)))


def change_camera(model: ViewModel) -> None:
    model.look("left")
    model.turn(dx=0.1, dy=0.2)
    model.set_perspective(on=True)


def add_measures(model: ViewModel) -> None:
    for tool, count in (("distance", 2), ("angle", 3), ("seed", 1)):
        model.start_tool(tool)
        for n in range(count):
            model.add_point(Pick(point=(float(n), float(n * n), 3.0)))
    model.end_tool()
    model.rename_measure(0, "height of the body")
    model.start_tool("circle")
    for x in (0.0, 4.0):
        model.add_point(Pick(point=tuple(scenes.middle(0) + (x, 0.0, 0.0))), (np.eye(3)[0], np.eye(3)[1]))
    model.end_tool()


def cut(model: ViewModel) -> None:
    model.add_clip("superior")
    model.move_clip(0, share=0.3)
    model.add_clip((1.0, 1.0, 0.0))
    model.flip_clip(1)
    model.set_clip_box(low=(-5.0, -5.0, -5.0), high=(5.0, 5.0, 5.0))


def move_slices(model: ViewModel) -> None:
    model.set_cross(scenes.middle(1))
    model.frame_slice("coronal", zoom=3.0, center=scenes.middle(1))
    model.set_window(low=-100.0, high=300.0)
    model.turn_cross("axial", degrees=30.0)
    model.set_slab(7.5, "max")
    model.set_layout("4")


def show_projection(model: ViewModel) -> None:
    model.set_mode("mip")
    model.set_window(low=0.0, high=900.0, of="picture")


def show_fit(model: ViewModel) -> None:
    model.set_iso(250.0)
    model.set_fitted(shown=True)
    model.set_color_by("thickness")


def change_looks(model: ViewModel) -> None:
    model.show("1", visible=False)
    model.set_color("2", (0.2, 0.4, 0.6))
    model.set_opacity("2", 0.5)


CHANGES = {
    "nothing": lambda model: None,
    "camera": change_camera,
    "measures": add_measures,
    "clips": cut,
    "slices": move_slices,
    "projection": show_projection,
    "fitted surface": show_fit,
    "looks of parts": change_looks,
    "smoothing": lambda model: model.set_smooth(0.9),
    "table": lambda model: model.set_table(shown=False),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_restored_view_is_the_saved_one(change: Any) -> None:
    model, other = make_model(), make_model()
    change(model)

    restore_view(save(model), other)

    assert other.state == model.state


def test_restored_labels_have_the_saved_colors() -> None:
    model, other = (make_model(SCAN(), LABELS()) for _ in range(2))
    model.set_color("2/1", (1.0, 0.0, 0.0))
    model.show("2/2", visible=False)

    restore_view(save(model), other)

    assert other.state.parts == model.state.parts


def test_restored_cluster_waits_with_its_look_for_the_clusters_to_be_found() -> None:
    model, other = make_model(), make_model()
    cluster = ShownPart(
        key="1/3", name="part 3", kind="cluster", object=1, number=3, inside=(1.0, 2.0, 3.0), color=(1.0, 0.0, 0.0)
    )
    model.state = model.state.__class__(**{**vars(model.state), "parts": (*model.state.parts, cluster)})

    restore_view(save(model), other)

    assert other.state.part("1/3") == cluster
    assert not other.parts_known


def test_restoring_is_one_step_of_undo() -> None:
    model, other = make_model(), make_model()
    cut(model)
    before = other.state

    restore_view(save(model), other)
    other.undo()

    assert other.state == before


def test_file_of_a_view_matches_its_schema() -> None:
    model = make_model()
    for change in (change_camera, add_measures, cut, move_slices, change_looks):
        change(model)

    assert find_faults(save(model)) == []


def test_view_of_other_inputs_is_refused_with_both_kinds() -> None:
    saved = save(make_model(SCAN(), MESH()))

    with refused(RefusedInputError, "mesh", "labels"):
        restore_view(saved, make_model(SCAN(), LABELS()))


CIRCLE = {"kind": "circle", "name": "a", "thickness_mm": 0}
PART = {"key": "2", "kind": "mesh", "number": 0, "inside_lps_mm": None, "color": None, "opacity": 1, "visible": 1}
CAMERA = {"up_lps": [0, 0, 1], "view_angle_deg": None, "parallel_scale_mm": 9}

DAMAGED: dict[str, tuple[dict[str, Any], str]] = {
    "mode unknown": ({"mode": "x-ray vision"}, "x-ray"),
    "iso value outside of the slider": ({"iso_value_hu": 1e9}, "1,000,000,000"),
    "iso value as text": ({"iso_value_hu": "high"}, "high"),
    "window turned round": ({"window_hu": [300, -100]}, "black"),
    "window of one number": ({"window_hu": [300]}, "damaged"),
    "cross of two numbers": ({"cross_lps_mm": [1, 2]}, "cross"),
    "zoom of a slice below its least": (
        {"slices": [{"plane": "axial", "zoom": 0, "center_lps_mm": [0, 0, 0]}]},
        "zoom",
    ),
    "plane unknown": ({"slices": [{"plane": "oblique", "zoom": 1, "center_lps_mm": [0, 0, 0]}]}, "oblique"),
    "turn that is none": ({"turn": [[1, 0, 0], [0, 2, 0], [0, 0, 1]]}, "rotation"),
    "slab of an unknown kind": ({"slab": {"thickness_mm": 5, "combine": "median"}}, "median"),
    "slab of a metre": ({"slab": {"thickness_mm": 1000, "combine": "mean"}}, "thick"),
    "layout unknown": ({"layout": "9"}, "layout"),
    "clip beyond its ends": ({"clips": [{"direction": "left", "share": 2, "flipped": False}]}, "place"),
    "clip without a share": ({"clips": [{"direction": "left", "flipped": False}]}, "share"),
    "measure of one point": (
        {"measures": [{"kind": "distance", "name": "a", "points_lps_mm": [[0, 0, 0]]}]},
        "distance",
    ),
    "measure of an unknown kind": ({"measures": [{"kind": "area", "name": "a", "points_lps_mm": []}]}, "area"),
    "circle of two radii": ({"measures": [{**CIRCLE, "points_lps_mm": [[0, 0, 0], [5, 0, 0], [0, 6, 0]]}]}, "middle"),
    "part of no object": ({"parts": [{**PART, "key": "7"}]}, "part"),
    "opacity above 1": ({"parts": [{**PART, "opacity": 2}]}, "opacity"),
    "camera in its focal point": (
        {"camera": {**CAMERA, "position_lps_mm": [0, 0, 0], "focal_point_lps_mm": [0, 0, 0]}},
        "focal",
    ),
    "camera missing": ({"camera": None}, "damaged"),
    "clips that are no list": ({"clips": 3}, "damaged"),
}


MOVED = scenes.AFFINE.copy()
MOVED[0, 3] += 3.0

OTHERS = {
    "fewer slices": (scenes.make_scan().voxels[2:], scenes.AFFINE, 20),
    "another place": (scenes.make_scan().voxels, MOVED, -57.0),
}


@pytest.mark.parametrize(("voxels", "affine", "fact"), OTHERS.values(), ids=OTHERS)
def test_view_of_another_scan_is_refused_with_what_tells_them_apart(voxels: Any, affine: Any, fact: float) -> None:
    other = make_model(Volume(voxels, affine), MESH())

    with refused(RefusedInputError, 22, fact):
        restore_view(save(make_model()), other)


@pytest.mark.parametrize(("entries", "fact"), DAMAGED.values(), ids=DAMAGED)
def test_damaged_view_is_refused_and_changes_nothing(entries: dict[str, Any], fact: str) -> None:
    model = make_model()
    saved, before = {**save(model), **entries}, model.state

    with refused(RefusedInputError, "view", fact):
        restore_view(saved, model)

    assert model.state is before


FILES = {
    "no JSON": "camera",
    "another schema": '{"schema": "clrecon-mesh-1"}',
    "a list": "[]",
    "deeply nested": "[" * 100_000,
}


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_file_that_is_no_saved_view_is_refused_by_name(text: str, tmp_path: Path) -> None:
    path = tmp_path / "shown.view.json"
    path.write_text(text)

    with refused(RefusedInputError, "shown.view.json"):
        read_view(path)


def test_missing_file_of_a_view_is_refused_by_name(tmp_path: Path) -> None:
    with refused(UsageError, "gone.view.json"):
        read_view(tmp_path / "gone.view.json")
