"""Views as files: what is shown of some inputs, as JSON with places in LPS mm, and shown again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import RefusedInputError, UsageError
from clrecon.rendering.views.camera import Camera, describe_camera
from clrecon.rendering.views.directions import checked_vector
from clrecon.system.paths import read_regular
from clrecon.system.records import name_schema
from clrecon.system.text import count_of, escape_text
from clrecon.viewer.model.changes import copy_view
from clrecon.viewer.model.measures import POINTS_OF, REGIONS, Measure, checked_measure_name, measure_points
from clrecon.viewer.model.model import ViewModel, checked_slab
from clrecon.viewer.model.objects import ShownObject, ShownScan, first_parts
from clrecon.viewer.model.planes import check_plane, checked_turn
from clrecon.viewer.model.state import LEAST_ZOOM, MOST_ZOOM, ClipPlane, ShownPart, ViewState

VIEW_FORMAT = ".view.json"

_LARGEST_FILE = 16 << 20
_SCHEMA = "state"


def encode_view(state: ViewState, objects: Sequence[ShownObject]) -> bytes:
    """Return the content of a file from which `restore_view` shows the same again; no name of an input is in it."""
    facts = {
        "objects": [each.kind for each in objects],
        "grids": _describe_grids(objects),
        "mode": state.mode,
        "iso_value_hu": state.iso_value,
        "window_hu": list(state.window),
        "picture_window_hu": None if state.picture_window is None else list(state.picture_window),
        "table_shown": state.table,
        "smooth_mm": state.smooth_mm,
        "fitted": state.fitted,
        "occlusion": state.occlusion,
        "color_by": state.color_by,
        "cross_lps_mm": list(state.cross),
        "turn": None if state.turn is None else [list(row) for row in state.turn],
        "slab": {"thickness_mm": state.slab_mm, "combine": state.combine},
        "layout": state.layout,
        "compare": state.compare,
        "slices": [
            {"plane": each.plane, "zoom": each.zoom, "center_lps_mm": list(each.center)} for each in state.frames
        ],
        "parts": [_describe_look(each) for each in state.parts if not each.is_plain],
        "measures": [
            {
                "kind": each.kind,
                "name": each.name,
                "points_lps_mm": [list(point) for point in each.points],
                "thickness_mm": each.thickness_mm,
            }
            for each in state.measures
        ],
        "clips": [_describe_clip(each) for each in state.clips],
        "clip_box_lps_mm": None if state.clip_box is None else [list(corner) for corner in state.clip_box],
        "camera": describe_camera(state.camera),
    }
    return (json.dumps(name_schema(_SCHEMA, facts), indent=1) + "\n").encode("ascii")


def _describe_grids(objects: Sequence[ShownObject]) -> list[dict[str, Any]]:
    volumes = [each.volume for each in objects if isinstance(each, ShownScan)]
    return [
        {
            "shape_ijk": list(each.shape_ijk),
            "spacing_mm": np.round(each.spacing, 4).tolist(),
            "origin_lps_mm": np.round(each.affine[:3, 3], 4).tolist(),
        }
        for each in volumes
    ]


def _describe_look(part: ShownPart) -> dict[str, Any]:
    return {
        "key": part.key,
        "kind": part.kind,
        "number": part.number,
        "inside_lps_mm": None if part.inside is None else list(part.inside),
        "color": None if part.color is None else list(part.color),
        "opacity": part.opacity,
        "visible": part.visible,
    }


def _describe_clip(clip: ClipPlane) -> dict[str, Any]:
    direction: Any = clip.name if clip.name.isalpha() else list(clip.direction)
    return {"direction": direction, "share": clip.share, "flipped": clip.flipped}


def read_view(path: str | Path) -> dict[str, Any]:
    """Read the entries of a file of `encode_view`; `restore_view` checks them."""
    name = escape_text(Path(path).name)
    try:
        saved = json.loads(read_regular(path, _LARGEST_FILE))
    except FileNotFoundError:
        raise UsageError(f"there is no saved view {escape_text(str(path), 200)}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise RefusedInputError(f"{name} cannot be read as a saved view: {escape_text(str(error), 120)}") from None
    identity = name_schema(_SCHEMA, {})["schema"]
    if not isinstance(saved, dict) or saved.get("schema") != identity:
        raise RefusedInputError(
            f'{name} is no saved view: its "schema" is not {identity}; the key s of a view saves one'
        )
    return saved


def say_source(saved: Mapping[str, Any]) -> str:
    """Return of which input a saved view is, in words; one of several inputs, which have to be named, is refused."""
    try:
        kinds = _say_kinds(saved["objects"])
        grids = "".join(f" of {_say_grid(grid)}" for grid in saved.get("grids", ()))
    except (KeyError, TypeError, ValueError) as error:
        raise RefusedInputError(f"the saved view is damaged: {escape_text(str(error), 120)}") from None
    if len(saved["objects"]) != 1:
        raise UsageError(f"the saved view is of {kinds}: name these inputs too, in this order")
    return f"a {kinds}{grids}"


def _say_grid(grid: Mapping[str, Any]) -> str:
    (ni, nj, nk), spacing = grid["shape_ijk"], " x ".join(f"{mm:.4g}" for mm in grid["spacing_mm"])
    return f"{count_of(nk, 'slice')} of {ni} x {nj}, spacing {spacing} mm"


def carry_view(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a saved view of one scan, alone or with a label map, holds for scans of other patients too.

    HU, directions, shares, and the looks of the scan and its labels stay.  Components and all that lies at a place go.
    """
    try:
        if saved["objects"] not in (["scan"], ["scan", "labels"]):
            raise RefusedInputError(
                f"the saved view is of {_say_kinds(saved['objects'])}: scans of other patients are shown by a view of"
                " one scan, with or without a label map"
            )
        looks = [each for each in saved["parts"] if each["kind"] not in ("cluster", "rest")]
    except (KeyError, TypeError) as error:
        raise RefusedInputError(f"the saved view is damaged: {escape_text(str(error), 120)}") from None
    of_patient: dict[str, Any] = {
        "grids": [], "turn": None, "compare": None, "slices": [], "measures": [], "clip_box_lps_mm": None,
    }  # fmt: skip
    return {**saved, **of_patient, "parts": looks}


def restore_elsewhere(carried: Mapping[str, Any], model: ViewModel) -> None:
    """Show another scan by a view of `carry_view`, from the same direction, framed anew."""
    keys = {part.key for part in first_parts(model.objects)}  # a label may be missing
    looks = [each for each in carried["parts"] if each["key"] in keys]
    restore_view({**carried, "cross_lps_mm": model.state.cross, "parts": looks}, model)
    model.fit_shown()


def restore_view(saved: Mapping[str, Any], model: ViewModel) -> None:
    """Show what a saved view of the same inputs describes, as one step of undo; clusters are still to be found.
    A view of other inputs is a `RefusedInputError`, and so is an entry that is missing or makes no sense.
    """
    trial = copy_view(model)  # its methods check what they are given
    trial.state = replace(
        model.state, parts=tuple(first_parts(model.objects)), parts_at=None, measures=(), clips=(), clip_box=None,
        frames=(), tool=None, points=(),
    )  # fmt: skip
    try:
        _apply(saved, trial)
    except UsageError as error:
        raise RefusedInputError(f"the saved view does not fit: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        fault = f"{error} is missing" if isinstance(error, KeyError) else escape_text(str(error), 120)
        raise RefusedInputError(f"the saved view is damaged: {fault}") from None
    model.show_state(trial.state, "the saved view")


def _apply(saved: Mapping[str, Any], trial: ViewModel) -> None:
    kinds = [each.kind for each in trial.objects]
    if saved["objects"] != kinds:
        raise UsageError(f"it is of {_say_kinds(saved['objects'])}, and here are {_say_kinds(kinds)}")
    for grid, here in zip(saved.get("grids", ()), _describe_grids(trial.objects), strict=False):
        if grid != here:
            origins = " to ".join(", ".join(f"{mm:.1f}" for mm in each["origin_lps_mm"]) for each in (grid, here))
            if (same := _say_grid(here)) != _say_grid(grid):
                raise UsageError(f"it is of a scan of {_say_grid(grid)}, and here is one of {same}")
            raise UsageError(f"it is of another scan of {same}: the first voxel is moved from {origins} mm LPS")
    trial.set_mode(saved["mode"])
    low, high = saved["window_hu"]
    trial.set_window(low, high)
    if trial.scans:
        trial.set_iso(saved["iso_value_hu"])
        trial.set_table(saved["table_shown"])
        trial.set_smooth(saved.get("smooth_mm", 0.0))
        trial.set_occlusion(saved["occlusion"])
    if saved["picture_window_hu"] is not None:
        low, high = saved["picture_window_hu"]
        trial.set_window(low, high, of="picture")
    if saved["fitted"]:
        trial.check_fit()
        trial.set_fitted(True)
        trial.set_color_by(saved["color_by"])
    trial.set_cross(saved["cross_lps_mm"])
    trial.state = replace(trial.state, turn=checked_turn(saved["turn"]))
    trial.set_slab(saved["slab"]["thickness_mm"], saved["slab"]["combine"])
    trial.set_layout(saved["layout"])
    trial.set_compare(saved["compare"])
    for frame in saved["slices"]:
        check_plane(frame["plane"])
        if not LEAST_ZOOM <= frame["zoom"] <= MOST_ZOOM:
            raise UsageError(f"the zoom of a slice is {LEAST_ZOOM:g} to {MOST_ZOOM:g}, not {frame['zoom']!r:.40}")
        trial.frame_slice(frame["plane"], frame["zoom"], frame["center_lps_mm"], np.inf)
    for number, clip in enumerate(saved["clips"]):
        trial.add_clip(clip["direction"])
        trial.move_clip(number, clip["share"])
        if clip["flipped"]:
            trial.flip_clip(number)
    trial.set_clip_box(*(saved["clip_box_lps_mm"] or (None, None)))
    trial.state = replace(trial.state, measures=tuple(_read_measure(each, trial) for each in saved["measures"]))
    for look in saved["parts"]:
        _apply_look(look, trial)
    camera = saved["camera"]
    trial.state = replace(
        trial.state,
        camera=Camera(
            camera["position_lps_mm"], camera["focal_point_lps_mm"], camera["up_lps"],
            camera["view_angle_deg"], camera["parallel_scale_mm"],
        ),
    )  # fmt: skip


def _say_kinds(kinds: Sequence[str]) -> str:
    return ", ".join(kinds) or "nothing"


def _read_measure(saved: Mapping[str, Any], trial: ViewModel) -> Measure:
    kind, points = saved["kind"], [checked_vector("a point of a measure", each) for each in saved["points_lps_mm"]]
    name = checked_measure_name(saved["name"])
    if kind in REGIONS:
        return trial.measure_region(kind, points, checked_slab(saved["thickness_mm"]), name)
    if kind not in POINTS_OF or (POINTS_OF[kind] or len(points)) != len(points):
        raise UsageError(f"a measure of {len(points)} points is no {kind}")
    return measure_points(kind, points, name)


def _apply_look(look: Mapping[str, Any], trial: ViewModel) -> None:
    """Give a part its look; a cluster is put in the list, and its look is carried over when clusters are found."""
    key, number = look["key"], look["number"]
    if look["kind"] in ("cluster", "rest") and trial.state.part(key) is None:
        scan = next((each for each in trial.scans if key == f"{each.number}/{number}"), None)
        if scan is None:
            raise UsageError(f"the part {key} is of no scan")
        inside = None if look["inside_lps_mm"] is None else checked_vector("a place", look["inside_lps_mm"])
        part = ShownPart(
            key=key, name=f"part {number}", kind=look["kind"], object=scan.number, number=number, inside=inside
        )
        trial.state = replace(trial.state, parts=(*trial.state.parts, part))
    trial.show(key, look["visible"])
    trial.set_color(key, look["color"])
    trial.set_opacity(key, look["opacity"])
