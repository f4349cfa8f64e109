"""Styles refuse what cannot be when they are made, and names and keywords come to the style that they ask for."""

from __future__ import annotations

import copy
import pickle
import re
from collections.abc import Callable
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
    PresetSheet,
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
LONGEST_REFUSAL = 400  # characters, some four lines of a terminal
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
OCCLUDED: Wrong = {"ambient_occlusion": [(1.5, "from 0 to 1, not 1.5"), (-0.1, "occlusion"), (TWO, "occlusion")]}
WRONG: dict[type[Style], Wrong] = {
    VolumeLook: {
        **LABELLED,
        **OCCLUDED,
        "transfer_function": [("bones", "unknown rendering preset 'bones'"), ([(0, 1, 1, 1, 1)], "not list")],
        "jitter": [("no", "jitter is True or False, not 'no'"), (1, "jitter")],
        "smooth_light": [(-1.0, "a length in mm from 0 to 20, not -1"), (21.0, "smoothing"), (np.nan, "smoothing")],
    },
    Projection: {
        **RAYS,
        "kind": [("max", "one of mip, minip, mean, drr, not 'max'"), (TWO, "projection")],
        "window": [((5, 5), "window"), ((np.nan, 5), "window"), ((1, 2, 3), "window")],
        "keep_air": [("no", "keep_air is True or False, not 'no'"), (1, "keep_air")],
    },
    PresetSheet: {**RAYS},
    SurfaceLook: {
        **LABELLED,
        **OCCLUDED,
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


def test_table_of_wrong_values_has_every_style() -> None:
    assert {mode.style for mode in MODES.values()} == set(WRONG)


@pytest.mark.parametrize("style", WRONG)
def test_table_of_wrong_values_has_every_field_of_a_style(style: type[Style]) -> None:
    assert {own.name for own in fields(style)} == set(WRONG[style])


@pytest.mark.parametrize("style", WRONG)
def test_every_field_of_a_style_has_a_check(style: type[Style]) -> None:
    assert [own.name for own in fields(style) if "check" not in own.metadata] == []


@pytest.mark.parametrize(("style", "name", "value", "says"), EVERY_WRONG)
def test_impossible_value_is_refused_in_one_short_line_when_a_style_is_made(
    style: type[Style], name: str, value: Any, says: str
) -> None:
    with pytest.raises(UsageError) as error:
        style(**{name: value})

    said = str(error.value)
    assert says in said
    assert "\n" not in said
    assert len(said) < LONGEST_REFUSAL


@pytest.mark.parametrize(("style", "name", "value", "says"), EVERY_WRONG)
def test_impossible_value_is_refused_in_the_same_words_when_a_style_is_replaced(
    style: type[Style], name: str, value: Any, says: str
) -> None:
    with pytest.raises(UsageError) as making:
        style(**{name: value})
    with pytest.raises(UsageError) as replacing:
        replace(style(), **{name: value})

    assert replacing.value.args == making.value.args


def clipped_where_it_can_be(style: type[Style]) -> Style:
    """A style, with a clip box if styles of its kind have one."""
    options: dict[str, Any] = {"clip": Clip.box((0, 0, 0), (9, 9, 9))} if "clip" in WRONG[style] else {}
    return style(**options)


@pytest.mark.parametrize("style", WRONG)
def test_style_does_not_change(style: type[Style]) -> None:
    made = clipped_where_it_can_be(style)

    with refused(FrozenInstanceError, fields(style)[0].name):
        setattr(made, fields(style)[0].name, None)


COPIES: dict[str, Callable[[Style], Style]] = {
    "pickled": lambda made: pickle.loads(pickle.dumps(made)),
    "copied": copy.deepcopy,
    "replaced": replace,
}


@pytest.mark.parametrize("style", WRONG)
@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
def test_copy_of_a_style_equals_it(style: type[Style], copied: Callable[[Style], Style]) -> None:
    made = clipped_where_it_can_be(style)

    other = copied(made)

    assert type(other) is style
    assert other == made


EXCLUDED: dict[str, tuple[Callable[[], Style], list[Any]]] = {
    "a window and a function": (
        lambda: SlicesInSpace(window=(0, 9), transfer_function=GLASS), ["window", "function"],
    ),
    "an angle of a stretched curve": (
        lambda: CurveCut(LINE, kind="stretched", angle=5.0), ["angle", "pictures", 5.0],
    ),
    "a colour and a quantity": (lambda: PointLook(color="red", color_by="hu"), ["colour", "coloured"]),
    "a window and a colour": (lambda: PointLook(window=(0, 1), color="red"), ["colour", "points", "color_by"]),
    "a window and labels": (lambda: PointLook(window=(0, 1), color_by="label"), ["colour", "points", "color_by"]),
    "a label twice": (lambda: VolumeLook(labels=LABELS, label_colors={"L2": "red", 2: "blue"}), ["L2", 2]),
    "an unknown label": (lambda: SurfaceLook(labels=LABELS, label_opacity={"L9": 0.5}), ["L9", "L2"]),
}  # fmt: skip


@pytest.mark.parametrize(("make", "says"), EXCLUDED.values(), ids=EXCLUDED)
def test_fields_of_a_style_that_exclude_each_other_are_refused(make: Callable[[], Style], says: list[Any]) -> None:
    with refused(UsageError, *says):
        make()


def test_window_becomes_two_floats() -> None:
    assert Projection(window=[np.float32(-100), 300]).window == (-100.0, 300.0)


def test_slices_become_ascending_whole_numbers() -> None:
    assert SlicesInSpace(np.array([7, 3])).slices == (3, 7)


def test_iso_value_becomes_a_float() -> None:
    assert isinstance(SurfaceLook(300).iso_value, float)


def test_switch_of_numpy_becomes_a_bool() -> None:
    assert SurfaceLook(shadows=np.bool_(False)).shadows is False


def test_points_of_a_curve_become_a_line_of_their_length() -> None:
    style = CurveCut(LINE)

    assert style.curve.length == pytest.approx(9.0)  # type: ignore[union-attr]  # LINE runs from z = 0 to 9 mm


def test_volume_without_a_function_is_drawn_as_bone() -> None:
    style = VolumeLook()

    assert style.function is find_preset("bone").transfer_function
    assert style.light == find_preset("bone").lighting


def test_volume_of_a_function_is_drawn_with_it_in_the_light_of_surfaces() -> None:
    style = VolumeLook(GLASS)

    assert style.function is GLASS
    assert style.light == SurfaceLook().light == Lighting()


def test_lighting_of_a_volume_takes_the_place_of_that_of_its_preset() -> None:
    assert VolumeLook(lighting=Lighting(ambient=1.0)).light == Lighting(ambient=1.0)


def test_volume_without_labels_has_no_label_style() -> None:
    assert VolumeLook().label_style is None


def test_opacity_of_a_label_is_that_asked_for_and_of_the_others_one() -> None:
    style = SurfaceLook(labels=LABELS, label_colors={}, label_opacity={"L1": 0.25}).label_style

    assert style is not None
    assert style.table[:, 3].tolist() == [1.0, 0.25, 1.0]  # the background, L1 and L2


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


@pytest.mark.parametrize(("look", "expected"), ASKED.values(), ids=ASKED)
def test_names_and_keywords_come_to_the_style_that_they_ask_for(look: dict[str, Any], expected: Style) -> None:
    made = make_style(**look)

    assert made == expected
    assert made.mode == expected.mode


REFUSED_LOOKS: dict[str, tuple[dict[str, Any], str]] = {
    "unknown mode": (
        {"mode": "xray"},
        "unknown mode 'xray': use one of dvr, mip, minip, mean, drr, surface, slices, slice, cpr",
    ),
    "mode of numbers": ({"mode": TWO}, "unknown mode array"),
    "misspelt option": ({"zooom": 2}, "a picture has no option 'zooom': it is one of "),
    "option of another call": ({"letters": True}, "a picture has no option 'letters'"),
    "option of another mode": (
        {"mode": "mean", "shadows": True},
        "shadows does not apply to mode mean, only to surface",
    ),
    "window of a volume": (
        {"window": (0, 1)},
        "does not apply to mode dvr, only to mip, minip, mean, drr, slices, slice, cpr",
    ),
    "clip of a slice": ({"mode": "slice", "clip": Clip()}, "only to dvr, mip, minip, mean, drr, surface, slices"),
    "function of a surface": (
        {"mode": "surface", "transfer_function": GLASS},
        "only to dvr, mip, minip, mean, drr, slices",
    ),
    "preset of a surface": ({"mode": "surface", "preset": "bone"}, "preset does not apply to mode surface"),
    "lighting of a slice": ({"mode": "slice", "lighting": Lighting()}, "lighting does not apply to mode slice"),
    "name of a field": ({"mode": "mip", "kind": "mean"}, "kind"),
    "unknown preset": ({"preset": "bones"}, "unknown rendering preset 'bones'"),
    "preset and function": (
        {"preset": "bone", "transfer_function": GLASS},
        "has a preset (bone) or a transfer function, not both",
    ),
}


@pytest.mark.parametrize(("look", "says"), REFUSED_LOOKS.values(), ids=REFUSED_LOOKS)
def test_names_and_keywords_that_cannot_be_are_refused(look: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError) as error:
        make_style(**look)
    assert says in str(error.value)


def test_style_is_found_as_it_is() -> None:
    style = SurfaceLook()

    assert find_style(style, {}) is style


def test_style_is_found_by_the_name_of_its_mode_and_keywords() -> None:
    assert find_style("mip", {"window": (1, 2)}) == Projection(window=(1.0, 2.0))


def test_style_is_found_by_its_keywords_alone() -> None:
    assert find_style(None, {"mode": "mip"}) == Projection()


def test_keywords_beside_a_style_are_refused() -> None:
    with refused(UsageError, "color", "preset"):
        find_style(SurfaceLook(), {"color": "red", "preset": "bone"})


def test_mode_beside_another_mode_is_refused() -> None:
    with refused(UsageError, "mip", "dvr"):
        find_style("mip", {"mode": "dvr"})


def test_kind_of_a_curve_has_the_keyword_cpr() -> None:
    assert keywords_of("cpr")["cpr"] == "kind"


@pytest.mark.parametrize("mode", MODES)
def test_keywords_of_a_mode_are_the_fields_of_its_style(mode: str) -> None:
    assert set(keywords_of(mode).values()) == {own.name for own in fields(MODES[mode].style)}


def test_keyword_of_no_mode_is_refused_with_those_that_are_known() -> None:
    with refused(UsageError, "clip_box", "mode"):
        check_known("cpr", "clip", "clip_box")


def parts_of_type(annotation: object) -> set[str]:
    """The alternatives of a type as it is written, beside None."""
    written = str(getattr(annotation, "__forward_arg__", annotation))
    flat = re.sub(r"Literal\[(.*?)\]", r"\1", written).replace(",", "|")
    return {part.strip() for part in flat.split("|")} - {"None"}


def test_typed_keywords_of_render_are_those_of_all_styles_with_the_types_of_their_fields() -> None:
    asked: dict[str, set[str]] = {}
    for mode in MODES.values():
        for own in fields(mode.style):
            asked.setdefault(own.metadata.get("keyword", own.name), set()).update(parts_of_type(own.type))

    of_every_mode = {"mode": {"ModeName"}, "preset": {"PresetName"}}
    assert {name: parts_of_type(each) for name, each in Look.__annotations__.items()} == asked | of_every_mode


NAMES: dict[str, tuple[Any, set[str]]] = {
    "modes": (ModeName, set(MODES)),
    "presets": (PresetName, set(PRESETS)),
    "windows": (WindowName, set(WINDOWS)),
    "views": (ViewName, {*DIRECTIONS, *PLANES}),
}


@pytest.mark.parametrize(("typed", "known"), NAMES.values(), ids=NAMES)
def test_typed_names_are_those_that_are_known(typed: Any, known: set[str]) -> None:
    assert set(get_args(typed)) == known
