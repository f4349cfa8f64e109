"""Styles refuse what cannot be when they are made, and names and keywords come to the style that they ask for."""

from __future__ import annotations

import copy
import pickle
import re
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any, get_args

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.labels import LabelMap
from clrecon.rendering import Lighting, TransferFunction, find_preset
from clrecon.rendering.looks.presets import PRESETS
from clrecon.rendering.looks.window import WINDOWS
from clrecon.rendering.pictures.modes import MODES, Look, check_known, find_style, keywords_of, make_style
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.styles import (
    CurveCut,
    PlaneCut,
    Projection,
    SlicesInSpace,
    Style,
    SurfaceLook,
    VolumeLook,
)
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.directions import DIRECTIONS
from clrecon.rendering.views.reformation import PLANES
from clrecon.system.arguments import ModeName, PresetName, ViewName, WindowName

GLASS = TransferFunction([(0, 1, 1, 1, 0.1), (500, 1, 1, 1, 0.4)])
LABELS = LabelMap(np.array([[[0, 1], [2, 2]]], np.uint8), np.eye(4), {1: "L1", 2: "L2"})
TWO = np.array([1.0, 2.0])
LINE = [(0.0, 0.0, 0.0), (0.0, 0.0, 9.0)]

Wrong = dict[str, list[tuple[Any, str | None]]]
RAYS: Wrong = {
    "ray_step": [
        (0.0, "ray step"),
        (-1.0, "above 0, not -1"),
        (np.nan, "nan"),
        ("fine", "'fine'"),
        (10**400, "ray step"),
    ],
    "clip": [([(0, 0, 1, 0)], "the clip of a picture is a Clip or None, not list")],
}
DRAWN: Wrong = {
    "labels": [("labels.nii", "the labels of a picture is a LabelMap or None, not str")],
    "label_colors": [({1: "red"}, "give the labels too"), ("red", "colours of labels are a mapping")],
    "label_opacity": [({1: 0.5}, "give the labels too"), (0.5, "opacities of labels are a mapping")],
}
LABELLED: Wrong = {**RAYS, **DRAWN, "lighting": [("head", "the lighting of a picture is a Lighting or None, not str")]}
CUTS: Wrong = {
    **DRAWN,
    "thickness": [(-1.0, "thickness of a slice"), (np.inf, "thickness"), (None, "thickness"), ("5 mm", "'5 mm'")],
    "combine": [("sum", "mean, max, min, not 'sum'"), (TWO, "combined by"), (None, "combined by")],
    "window": [((5, 5), "a window is its lowest and highest HU"), (100, "window")],
    "pixel_mm": [(0.0, "the size of a pixel is a length in mm"), ("1", None)],
}
WRONG: dict[type[Style], Wrong] = {
    VolumeLook: {
        **LABELLED,
        "transfer_function": [("bones", "unknown rendering preset 'bones'"), ([(0, 1, 1, 1, 1)], "not list")],
        "jitter": [("no", "jitter is True or False, not 'no'"), (1, "jitter")],
    },
    Projection: {
        **RAYS,
        "kind": [("max", "one of mip, minip, mean, drr, not 'max'"), (TWO, "projection")],
        "window": [((5, 5), "window"), ((np.nan, 5), "window"), ((1, 2, 3), "window")],
        "keep_air": [("no", "keep_air is True or False, not 'no'"), (1, "keep_air")],
    },
    SurfaceLook: {
        **LABELLED,
        "iso_value": [(np.nan, "iso value is nan"), ("bone", "a number of HU"), (1e300, "beyond"), (None, "iso value")],
        "color": [("octarine", "unknown colour 'octarine'"), (TWO, "colour")],
        "shadows": [(True, "a light that stands still"), (TWO, "shadows is True or False")],
        "depth_cue": [(1.5, "from 0 to 1, not 1.5"), (-0.1, "depth cue"), (TWO, "depth cue")],
    },
    SlicesInSpace: {
        "slices": [(0, "every 0th slice"), ([], "whole numbers"), ([0.5], "whole numbers"), ([1, 1], "twice"),
                   ("all", "whole numbers"), (True, "whole numbers")],
        "opacity": [(0.0, "opacity of a slice"), (1.5, "not at 1.5")],
        "window": [((5, 5), "window")],
        "transfer_function": [("bone", "not str")],
        "lowest_hu": [("air", "lowest HU"), (np.nan, "lowest HU")],
        "clip": RAYS["clip"],
    },
    PointLook: {
        "radius_mm": [(0.0, "the radius of points is a length in mm"), (np.nan, "radius"), (TWO, "radius")],
        "color_by": [("depth", "one of hu, label, removed, not 'depth'"), (TWO, "coloured by")],
        "color": [("octarine", "unknown colour 'octarine'"), (TWO, "colour")],
        "window": [((5, 5), "window")],
        "lighting": LABELLED["lighting"],
        "clip": RAYS["clip"],
    },
    MeshLook: {
        "color": [("octarine", "unknown colour 'octarine'"), (TWO, "colour")],
        "opacity": [(0.0, "opacity of a mesh"), (1.5, "not at 1.5"), (np.nan, "opacity"), ("all", "opacity")],
        "flat": [("no", "flat is True or False, not 'no'"), (1, "flat")],
        "color_by": [("hu", "one of thickness, error, distance, not 'hu'"), (TWO, "coloured by")],
        "vertex_colors": [(TWO, "colours of vertices"), ([[2.0, 0.0, 0.0]], "floats from 0 to 1"), ("red", "shape")],
        "lighting": LABELLED["lighting"],
        "clip": RAYS["clip"],
    },
    PlaneCut: {
        **CUTS,
        "offset_mm": [(np.nan, "offset of a slice"), (np.inf, "offset"), (TWO, "offset")],
        "sheet": [(0, "a number of slices, or their distance"), ("many", "not 'many'"), (TWO, "contact sheet")],
        "slices": [(0, "every 0th slice"), ("all", "whole numbers")],
    },
    CurveCut: {
        **CUTS,
        "curve": [("auto", "'spine' to look for it"), ([(0, 0, 0)], "two different points"), (3, "shape")],
        "kind": [("bent", "straightened or stretched, not 'bent'"), (TWO, "straightened or stretched")],
        "angle": [(np.inf, "angle of a straightened picture"), ("left", "angle")],
        "width_mm": [(-1.0, "the width of the picture is a length in mm")],
    },
}  # fmt: skip
EVERY_WRONG = [
    pytest.param(style, name, value, says, id=f"{style.__name__}-{name}-{number}")
    for style, wrong in WRONG.items()
    for name, values in wrong.items()
    for number, (value, says) in enumerate(values)
    if says is not None
]


def test_every_field_of_every_style_is_tried() -> None:
    assert {mode.style for mode in MODES.values()} == set(WRONG)
    for style, wrong in WRONG.items():
        assert {own.name for own in fields(style)} == set(wrong)
        assert {own.name for own in fields(style) if "check" not in own.metadata} == set()


@pytest.mark.parametrize(("style", "name", "value", "says"), EVERY_WRONG)
def test_impossible_values_are_refused_when_a_style_is_made(
    style: type[Style], name: str, value: Any, says: str
) -> None:
    with pytest.raises(UsageError) as error:
        style(**{name: value})
    assert says in str(error.value)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400
    with pytest.raises(UsageError):
        replace(style(), **{name: value})


@pytest.mark.parametrize("style", WRONG)
def test_styles_do_not_change_and_travel(style: type[Style]) -> None:
    options: dict[str, Any] = {"clip": Clip.box((0, 0, 0), (9, 9, 9))} if "clip" in WRONG[style] else {}
    made = style(**options)
    with pytest.raises(FrozenInstanceError):
        setattr(made, fields(style)[0].name, None)
    for other in (pickle.loads(pickle.dumps(made)), copy.deepcopy(made), replace(made)):
        assert type(other) is style and other == made


def test_fields_of_a_style_that_exclude_each_other_are_refused() -> None:
    with refused(UsageError, "window", "function"):
        SlicesInSpace(window=(0, 9), transfer_function=GLASS)
    with refused(UsageError, "angle", "pictures", 5.0):
        CurveCut(LINE, kind="stretched", angle=5.0)
    with refused(UsageError, "colour", "coloured"):
        PointLook(color="red", color_by="hu")
    for look in ({"color": "red"}, {"color_by": "label"}):
        with refused(UsageError, "colour", "points", "color_by"):
            PointLook(window=(0, 1), **look)
    with refused(UsageError, "L2", 2):
        VolumeLook(labels=LABELS, label_colors={"L2": "red", 2: "blue"})
    with refused(UsageError, "L9", "L2"):
        SurfaceLook(labels=LABELS, label_opacity={"L9": 0.5})


def test_fields_are_brought_to_one_form() -> None:
    assert Projection(window=[np.float32(-100), 300]).window == (-100.0, 300.0)
    assert SlicesInSpace(np.array([7, 3])).slices == (3, 7)
    assert SurfaceLook(300).iso_value == 300.0
    assert SurfaceLook(shadows=np.bool_(False)).shadows is False
    assert CurveCut(LINE).curve.length == pytest.approx(9.0)  # type: ignore[union-attr]


def test_style_resolves_function_light_and_labels() -> None:
    assert VolumeLook().function is find_preset("bone").transfer_function
    assert VolumeLook(GLASS).function is GLASS
    assert VolumeLook().light == find_preset("bone").lighting
    assert VolumeLook(GLASS).light == SurfaceLook().light == Lighting()
    assert VolumeLook(lighting=Lighting(ambient=1.0)).light.ambient == 1.0
    assert VolumeLook().label_style is None
    style = SurfaceLook(labels=LABELS, label_colors={}, label_opacity={"L1": 0.25}).label_style
    assert style is not None and style.table[:, 3].tolist() == [1.0, 0.25, 1.0]


ASKED: dict[str, tuple[dict[str, Any], Style]] = {
    "nothing": ({}, VolumeLook()),
    "a preset": ({"preset": "skin"}, VolumeLook("skin")),
    "a function": ({"transfer_function": GLASS}, VolumeLook(GLASS)),
    "jitter": ({"jitter": True, "ray_step": 0.5}, VolumeLook(jitter=True, ray_step=0.5)),
    "a preset of another mode": ({"preset": "x-ray"}, Projection("drr")),
    "its window": ({"preset": "mip"}, Projection("mip", window=(0.0, 1000.0))),
    "another mode for it": ({"preset": "mip", "mode": "dvr"}, VolumeLook("mip")),
    "its window in a plane": ({"preset": "mip", "mode": "slice"}, PlaneCut(window=(0.0, 1000.0))),
    "its window in mm of water": ({"preset": "mip", "mode": "drr"}, Projection("drr")),
    "another window": ({"preset": "mip", "window": (1, 2)}, Projection("mip", window=(1.0, 2.0))),
    "its colours in slices": (
        {"preset": "skin", "mode": "slices"},
        SlicesInSpace(transfer_function=find_preset("skin").transfer_function),
    ),
    "a window in slices": ({"preset": "skin", "mode": "slices", "window": (1, 2)}, SlicesInSpace(window=(1.0, 2.0))),
    "an iso value": ({"iso_value": 0}, SurfaceLook(0.0)),
    "a surface": ({"mode": "surface", "color": "red", "depth_cue": 0.0}, SurfaceLook(color="red", depth_cue=0.0)),
    "slices": ({"mode": "slices", "slices": 4, "slice_opacity": 1.0}, SlicesInSpace(4, opacity=1.0)),
    "a plane": ({"mode": "slice", "offset_mm": 2.0, "combine": "max"}, PlaneCut(offset_mm=2.0, combine="max")),
    "a sheet": ({"sheet": "5mm"}, PlaneCut(sheet="5 mm")),
    "slices of a sheet": ({"mode": "slice", "slices": 4}, PlaneCut(sheet=20, slices=4)),
    "a kind of curve": ({"mode": "cpr", "cpr": "stretched"}, CurveCut(kind="stretched")),
    "a curve": ({"curve": "spine"}, CurveCut()),
    "points": ({"mode": "points", "window": (0, 9)}, PointLook(window=(0.0, 9.0))),
    "a radius of points": ({"radius_mm": 2}, PointLook(radius_mm=2.0)),
    "a colour of points": ({"color_by": "label"}, PointLook(color_by="label")),
    "the look of a series": (
        {"mode": "mean", "transfer_function": GLASS, "lighting": Lighting(), "shadows": False, "labels": None},
        Projection("mean"),
    ),
}


@pytest.mark.parametrize("name", ASKED)
def test_names_and_keywords_come_to_a_style(name: str) -> None:
    look, expected = ASKED[name]
    assert make_style(**look) == expected
    assert make_style(**look).mode == expected.mode


@pytest.mark.parametrize(
    ("look", "says"),
    [
        ({"mode": "xray"}, "unknown mode 'xray': use one of dvr, mip, minip, mean, drr, surface, slices, slice, cpr"),
        ({"mode": TWO}, "unknown mode array"),
        ({"zooom": 2}, "a picture has no option 'zooom': it is one of "),
        ({"letters": True}, "a picture has no option 'letters'"),
        ({"mode": "mean", "shadows": True}, "shadows does not apply to mode mean, only to surface"),
        ({"window": (0, 1)}, "does not apply to mode dvr, only to mip, minip, mean, drr, slices, slice, cpr"),
        ({"mode": "slice", "clip": Clip()}, "only to dvr, mip, minip, mean, drr, surface, slices"),
        ({"mode": "surface", "transfer_function": GLASS}, "only to dvr, mip, minip, mean, drr, slices"),
        ({"mode": "surface", "preset": "bone"}, "preset does not apply to mode surface"),
        ({"mode": "slice", "lighting": Lighting()}, "lighting does not apply to mode slice"),
        ({"mode": "mip", "kind": "mean"}, "kind"),
        ({"preset": "bones"}, "unknown rendering preset 'bones'"),
        ({"preset": "bone", "transfer_function": GLASS}, "has a preset (bone) or a transfer function, not both"),
    ],
)  # fmt: skip
def test_names_and_keywords_that_cannot_be_are_refused(look: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError) as error:
        make_style(**look)
    assert says in str(error.value)


def test_style_is_found_by_object_or_name_and_takes_no_other_keywords() -> None:
    style = SurfaceLook()
    assert find_style(style, {}) is style
    assert find_style("mip", {"window": (1, 2)}) == Projection(window=(1.0, 2.0))
    assert find_style(None, {"mode": "mip"}) == Projection()
    with refused(UsageError, "color", "preset"):
        find_style(style, {"color": "red", "preset": "bone"})
    with refused(UsageError, "mip", "dvr"):
        find_style("mip", {"mode": "dvr"})


def test_keywords_of_pictures_are_fields_of_their_styles() -> None:
    assert keywords_of("cpr")["cpr"] == "kind"
    for mode, kind in MODES.items():
        assert set(keywords_of(mode).values()) == {own.name for own in fields(kind.style)}
    check_known("mip", "values")
    with refused(UsageError, "clip_box", "mode"):
        check_known("cpr", "clip", "clip_box")


def test_the_typed_keywords_of_render_are_those_of_all_styles_with_the_types_of_their_fields():
    def parts(annotation: str) -> set[str]:
        return {part.strip() for part in re.sub(r"Literal\[(.*?)\]", r"\1", annotation).replace(",", "|").split("|")}

    typed = {name: parts(str(getattr(each, "__forward_arg__", each))) for name, each in Look.__annotations__.items()}
    fields_of: dict[str, set[str]] = {}
    for mode in MODES.values():
        for own in fields(mode.style):
            fields_of.setdefault(own.metadata.get("keyword", own.name), set()).update(parts(str(own.type)))
    beside = {"mode": {"ModeName", "None"}, "preset": {"PresetName", "None"}}
    assert {name: each | {"None"} for name, each in typed.items()} == {
        name: each | {"None"} for name, each in (fields_of | beside).items()
    }
    assert get_args(ModeName) == tuple(MODES) and get_args(PresetName) == tuple(PRESETS)
    assert get_args(WindowName) == tuple(WINDOWS) and {*DIRECTIONS, *PLANES} == set(get_args(ViewName))
