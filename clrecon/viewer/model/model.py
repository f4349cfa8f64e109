"""`ViewModel`: the state of one view, and every change of it; no toolkit, no drawing, no thread."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from time import monotonic
from typing import Any, TypeVar

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry import frame_from_lps
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.looks.presets import DEFAULT_PRESET
from clrecon.rendering.looks.window import BONE_WINDOW
from clrecon.rendering.pictures.annotations import edge_letters
from clrecon.rendering.pictures.styles import DEFAULT_ISO_VALUE
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.directions import as_point, checked_vector, default_view, shows_slices
from clrecon.rendering.views.reformation import PLANES
from clrecon.system.arguments import DirectionName, Space
from clrecon.system.text import format_hu, unknown_name
from clrecon.viewer.model.changes import ChangingView, checked_numbers, fit_camera, height_mm
from clrecon.viewer.model.measures import (
    POINTS_OF,
    REGIONS,
    TOOLS,
    Measure,
    Point,
    checked_measure_name,
    free_measure_name,
    measure_points,
)
from clrecon.viewer.model.objects import (
    ShownLabels,
    ShownObject,
    ShownScan,
    ViewMode,
    find_iso_range,
    find_modes,
    first_parts,
)
from clrecon.viewer.model.planes import (
    check_plane,
    describe_slice,
    find_forward,
    move_to_layer,
    near_layers,
    turn_cross,
)
from clrecon.viewer.model.regions import measure_region, place_region
from clrecon.viewer.model.state import (
    COMBINATIONS,
    FIT_COLORS,
    LAYOUTS,
    Box,
    ClipPlane,
    Pick,
    SliceFrame,
    ViewState,
    clip_direction,
)

_Item = TypeVar("_Item")

_SLAB_MM, _MOST_SLAB_MM = 10.0, 100.0
"""Thickness of slices that a key makes thick, and the most."""

_MOST_SMOOTH_MM = 20.0

_FLAT = 0.1
"""Share of the next longer side of what is shown below which the shortest makes it flat."""

_BOX_SHARE = 0.5
"""Of what there is along each axis, in a clip box about the cross."""


class ViewModel(ChangingView):
    """The state of one view: every change is a method, and can be undone.  `ViewSession` locks it.

    space: {"lps", "ras"}. Frame in which places are said; everything in here is LPS mm.
    iso_value: HU; default: 200, or the nearest value that the slider has.
    version: Grows with each change.
    aspect: Width of the picture by its height, for views that fit.
    iso_range: HU at the ends of the slider.
    """

    def __init__(
        self,
        objects: Sequence[ShownObject],
        *,
        space: Space = "lps",
        iso_value: float | None = None,
        clock: Callable[[], float] = monotonic,
    ) -> None:
        if not objects:
            raise UsageError("there is nothing to show")
        self.space, self.signs = space, np.diag(frame_from_lps(space))
        scans = [each for each in objects if isinstance(each, ShownScan)]
        self.iso_range = find_iso_range(scans)
        low, high = self.iso_range
        corners = np.concatenate([each.corners for each in objects])
        sliced = scans[0].corners if scans else corners
        middle = 0.5 * (sliced.min(axis=0) + sliced.max(axis=0))
        if scans:
            middle = scans[0].volume.ijk_to_lps(near_layers(scans[0].volume, middle))
        only_labels = not scans and any(isinstance(each, ShownLabels) for each in objects)
        first = ViewState(
            camera=fit_camera(corners, _first_side(np.ptp(corners, axis=0)), 1.0),
            mode="labels" if only_labels else "surface",
            iso_value=min(high, max(low, DEFAULT_ISO_VALUE)) if iso_value is None else iso_value,
            window=BONE_WINDOW,
            cross=as_point(middle),
            parts=tuple(first_parts(objects)),
        )
        super().__init__(tuple(objects), first, clock)

    # What there is

    @property
    def scans(self) -> list[ShownScan]:
        return [each for each in self.objects if isinstance(each, ShownScan)]

    @property
    def label_maps(self) -> list[ShownLabels]:
        return [each for each in self.objects if isinstance(each, ShownLabels)]

    @property
    def modes(self) -> dict[str, ViewMode]:
        """The modes that mean something for these objects, by name."""
        every = find_modes()
        if self.scans:
            return {name: mode for name, mode in every.items() if name != "labels" or self.label_maps}
        return {"labels": every["labels"]} if self.label_maps else {"surface": every["surface"]}

    # What is shown of scans

    def begin_with_bone(self, *, bare: bool) -> None:
        """Begin with the bone by volume rendering, `bare` without the table; no step of undo leads before this."""
        self.state = replace(self.state, mode=DEFAULT_PRESET, table=not bare)

    def set_iso(self, hu: float) -> None:
        (value,) = checked_numbers("the iso value", hu)
        low, high = self.iso_range
        if not self.scans:
            raise UsageError("there is no scan: nothing has an iso value")
        if not low <= value <= high:
            raise UsageError(
                f"the iso value runs from {format_hu(low)} to {format_hu(high)} HU here, not to {format_hu(value)}"
            )
        self._change("iso", f"the iso value {format_hu(self.state.iso_value)} HU", iso_value=value)

    def step_iso(self, by: float) -> None:
        """Move the iso value by HU, to the end of the slider at most."""
        (step,) = checked_numbers("a step of the iso value", by)
        low, high = self.iso_range
        self.set_iso(min(max(self.state.iso_value + step, low), high))

    def set_mode(self, name: str) -> None:
        """Show a mode; slices that are edge-on as the camera stands are looked at as `clrecon.render` does."""
        if name not in self.modes:
            raise UsageError(unknown_name("mode", name, self.modes))
        self._change("mode", f"the mode {self.state.mode}", **self._fields_of(name))

    def state_in(self, name: str) -> ViewState:
        """Return the state as it would be after `set_mode`, without what takes a small picture too long."""
        return replace(self.state, occlusion=False, **self._fields_of(name))

    def _fields_of(self, mode: str) -> dict[str, Any]:
        camera = self.camera
        if self._is_edge_on(self.modes[mode]):
            camera = self._fitted(default_view("slices", self.scans[0].volume))
        return {"mode": mode, "picture_window": None, "camera": camera}

    def _is_edge_on(self, mode: ViewMode) -> bool:
        """Tell whether slices in space would not be seen: the camera looks along them."""
        return mode.kind == "slices" and not shows_slices(self.camera.basis().forward, self.scans[0].volume)

    def step_mode(self, steps: int) -> None:
        """Go to a mode further down the list, behind the last one to the first."""
        names = list(self.modes)
        self.set_mode(names[(names.index(self.state.mode) + steps) % len(names)])

    def set_window(self, low: float, high: float, of: str = "slices") -> None:
        """Set the HU that are black and white, of the three slices or of the projection ("picture")."""
        low, high = checked_numbers("a window", low, high)
        if not low < high:
            raise UsageError(f"a window runs from black to white, the lower HU first, not from {low:g} to {high:g}")
        if of == "picture":
            mode = self.modes[self.state.mode]
            if mode.kind not in ("projection", "slices"):
                raise UsageError(f"the mode {self.state.mode} has no window: mip, minip, drr and slices have one")
            self._change("picture window", "the window", picture_window=(low, high))
        elif of == "slices":
            self._change("window", "the window", window=(low, high))
        else:
            raise UsageError(unknown_name("window", of, ("slices", "picture")))

    def set_occlusion(self, on: bool) -> None:
        """Darken hollows of scans, or light everything alike."""
        if not self.scans:
            raise UsageError("there is no scan: hollows of scans alone are darkened")
        self._change("occlusion", "the light in hollows", occlusion=bool(on))

    def toggle_occlusion(self) -> None:
        self.set_occlusion(not self.state.occlusion)

    def set_table(self, shown: bool) -> None:
        """Show the table and the blankets, or the body alone."""
        if not self.scans:
            raise UsageError("there is no scan: there is no table to take away")
        self._change("table", "the table", table=bool(shown))

    def set_smooth(self, mm: float) -> None:
        """Show scans smoothed by a Gaussian of this standard deviation in mm; 0: as they were read."""
        (sigma,) = checked_numbers("the smoothing of scans", mm)
        if not self.scans:
            raise UsageError("there is no scan: scans alone are smoothed")
        if not 0.0 <= sigma <= _MOST_SMOOTH_MM:
            raise UsageError(f"scans are smoothed by 0 to {_MOST_SMOOTH_MM:g} mm, not {sigma:g} mm")
        self._change("smooth", "the smoothing" if sigma else "the scan without its noise", smooth_mm=sigma)

    def check_fit(self) -> None:
        """Refuse to show a surface fitted to the bone where there is none."""
        if not self.scans:
            raise UsageError("there is no scan: a surface is fitted to the bone in the HU of one")
        if self.modes[self.state.mode].kind != "surface":
            raise UsageError(f"the mode {self.state.mode} shows no surface to fit to the bone: take the mode surface")

    def set_fitted(self, shown: bool) -> None:
        """Show the surfaces of scans where they were fitted to the bone, or at the iso value."""
        words = "the surface fitted to the bone" if self.state.fitted else "the surface at the iso value"
        self._change("fitted", words, fitted=bool(shown), color_by=self.state.color_by if shown else None)

    def set_color_by(self, name: str | None) -> None:
        """Colour fitted surfaces by a number of `FIT_COLORS`; None: as parts look by themselves."""
        if name is not None and name not in FIT_COLORS:
            raise UsageError(unknown_name("colour of a fitted surface", name, FIT_COLORS))
        if name is not None and not self.state.fitted:
            raise UsageError(f"the {name} is that of a fitted surface: show the surface fitted to the bone first")
        self._change("shade", "the colours of the fitted surface", color_by=name)

    def step_color_by(self) -> None:
        """Go to the next number that colours fitted surfaces, behind the last one to none."""
        names = (None, *FIT_COLORS)
        self.set_color_by(names[(names.index(self.state.color_by) + 1) % len(names)])

    def scroll(self, plane: str, steps: float) -> None:
        """Move the cross by layers of the first scan, to the middle of one; positive steps go away from the eye."""
        (count,) = checked_numbers("steps", steps)
        turn = self.state.turn
        moved = np.clip(move_to_layer(self.scans, check_plane(plane), self.state.cross, count, turn), *self._span())
        self._change(f"scroll {plane}", "the slice", cross=as_point(moved))

    def set_cross(self, point: Sequence[float]) -> None:
        """Move the cross to a place, LPS mm; outside of everything it goes to the nearest place within."""
        point_in_box = np.clip(checked_vector("the cross", point), *self._span())
        self._change("cross", "the place of the slices", cross=as_point(point_in_box))

    def frame_slice(self, plane: str, zoom: float, center: Sequence[float], beside: Float64Array | float = 0.0) -> None:
        """Show a slice so many times as large as it fits, about a place (LPS mm) so many mm beside the scan at most."""
        (factor,) = checked_numbers("the zoom of a slice", zoom)
        low, high = self._span()
        point = np.clip(checked_vector("the middle of a slice", center), low - beside, high + beside)
        frame = SliceFrame(plane=plane, zoom=factor, center=as_point(point))
        others = tuple(each for each in self.state.frames if each.plane != plane)
        self._change(f"zoom {plane}", f"the zoom of the {plane} slice", frames=(*others, frame))

    def fit_slices(self) -> None:
        """Show the slices as they fit."""
        self._change("fit", "the fit of the slices", frames=())

    def turn_cross(self, plane: str, degrees: float) -> None:
        """Turn the cross on a slice clockwise: the other two slices go with it."""
        (angle,) = checked_numbers("the turn of the slices", degrees)
        turn = turn_cross(self.state.turn, check_plane(plane), math.remainder(angle, 360.0))
        self._change(f"turn {plane}", "the turn of the slices", turn=turn)

    def straighten(self) -> None:
        """Let the slices lie along the axes of the patient again."""
        self._change("straighten", "the straight slices", turn=None)

    def set_slab(self, thickness: float, combine: str | None = None) -> None:
        """Show slices of so many mm, 0 for planes: the mean, the most or the least of what is in them."""
        mm = checked_slab(thickness)
        how = self.state.combine if combine is None else combine
        if how not in COMBINATIONS:
            raise UsageError(unknown_name("thick slice", how, COMBINATIONS))
        self._change("slab", "the thickness of the slices", slab_mm=mm, combine=how)

    def step_slab(self) -> None:
        """Go from planes to thick slices, first their mean, then the most, and back."""
        steps = ((0.0, "mean"), (_SLAB_MM, "mean"), (_SLAB_MM, "max"))
        state = self.state
        shown = (_SLAB_MM if state.slab_mm else 0.0, state.combine)
        self.set_slab(*steps[(steps.index(shown) + 1) % len(steps) if shown in steps else 0])

    def set_layout(self, name: str) -> None:
        """Lay the views out in one of the ways of `LAYOUTS`."""
        if name not in LAYOUTS:
            raise UsageError(unknown_name("layout", name, LAYOUTS))
        self._change("layout", "the layout", layout=name)

    @property
    def is_comparable(self) -> bool:
        """True where there are two inputs and more beside label maps."""
        return len(self.objects) - len(self.label_maps) > 1

    def set_compare(self, share: float | None) -> None:
        """Show the first input left of a line, the others right of it; the line is at a share of the width, None: no
        line, all inputs together."""
        if share is None:
            self._change("compare", "the comparison", compare=None)
            return
        if not self.is_comparable:
            raise UsageError("there is one input: a comparison needs two scans or meshes")
        (value,) = checked_numbers("the line of a comparison", share)
        if not 0.0 <= value <= 1.0:
            raise UsageError(f"the line of a comparison lies at a share of the width from 0 to 1, not at {value:g}")
        words = "the comparison" if self.state.compare is None else "the line of the comparison"
        self._change("compare" if self.state.compare is None else "move compare", words, compare=value)

    def toggle_compare(self) -> None:
        """Compare with the line in the middle, or show all inputs together."""
        self.set_compare(0.5 if self.state.compare is None else None)

    def step_layout(self) -> None:
        self.set_layout(LAYOUTS[(LAYOUTS.index(self.state.layout) + 1) % len(LAYOUTS)])

    # Tools

    def start_tool(self, name: str) -> None:
        """Let the next points be those of a tool; points of an unfinished measure are dropped."""
        if name not in TOOLS:
            raise UsageError(unknown_name("tool", name, TOOLS))
        self._change("tool", f"the tool {name}", tool=name, points=())

    def add_point(self, pick: Pick, axes: tuple[Float64Array, Float64Array] | None = None) -> Measure | None:
        """Add a point to the tool; returns the measure that it completes.

        axes: Directions to the right and up of the slice that was clicked in; None: it was the picture.
        """
        tool = self.state.tool
        if tool is None:
            raise UsageError(f"no tool takes points: start one of {', '.join(TOOLS)} first")
        if tool in REGIONS and axes is None:
            raise UsageError(f"a {tool} is drawn on a slice: click in one")
        points = (*self.state.points, pick)
        if len(points) != POINTS_OF[tool]:
            self._change("point", "the point", points=points)
            return None
        places = [each.point for each in points]
        if axes is not None and tool in REGIONS:
            measure = self.measure_region(tool, place_region(tool, places[0], places[1], *axes), self.state.slab_mm)
        else:
            measure = self._measured(tool, places)
        self._change("point", f"the {tool}", points=(), measures=(*self.state.measures, measure))
        return measure

    def add_curve(self, points: Sequence[Point], word: str) -> None:
        """Add a curve through places that were found, such as along the spine."""
        measure = measure_points("curve", points, free_measure_name(word, self.state.measures))
        self._change("point", f"the curve {measure.name}", measures=(*self.state.measures, measure))

    def add_seed(self, pick: Pick) -> None:
        """Keep a place as a seed, whatever tool is used."""
        measure = self._measured("seed", [pick.point])
        self._change("point", "the seed", measures=(*self.state.measures, measure))

    def end_tool(self) -> Measure | None:
        """Put the tool away; the points of a curve become a measure, other unfinished points are dropped."""
        tool, points = self.state.tool, [each.point for each in self.state.points]
        if tool is None:
            return None
        measure = self._measured(tool, points) if tool == "curve" and len(points) > 1 else None
        measures = self.state.measures if measure is None else (*self.state.measures, measure)
        self._change("end tool", f"the end of the {tool}", tool=None, points=(), measures=measures)
        return measure

    def measure_region(self, kind: str, points: Sequence[Point], thickness_mm: float, name: str = "") -> Measure:
        """Measure a circle or box in the first scan, whatever of it is shown."""
        if not self.scans:
            raise UsageError(f"there is no scan: a {kind} measures the HU of one")
        called = name or free_measure_name(kind, self.state.measures)
        return measure_region(self.scans[0].volume, kind, points, called, thickness_mm)

    def _measured(self, tool: str, points: Sequence[Point]) -> Measure:
        return measure_points(tool, points, free_measure_name(tool, self.state.measures))

    def rename_measure(self, n: int, name: str) -> None:
        """Give the measure of number n (from 0) a name."""
        measures, short = list(self.state.measures), checked_measure_name(name)
        measure = _numbered("measure", measures, n)
        measures[n] = replace(measure, name=short)
        self._change("rename", f"the name {short}", measures=tuple(measures))

    def remove_measure(self, n: int) -> None:
        measures = self.state.measures
        name = _numbered("measure", measures, n).name
        self._change("remove measure", f"the removal of {name}", measures=(*measures[:n], *measures[n + 1 :]))

    def clear_measures(self) -> None:
        self._change("clear measures", "the measures", measures=(), points=())

    # Clips

    def add_clip(self, direction: str | Sequence[float]) -> None:
        """Cut half way along a direction: "view" (to the camera), a side or LPS; what is there is taken away."""
        if direction == "view":
            direction = (-self.camera.basis().forward).tolist()
        towards, name = clip_direction(direction)
        heights = np.concatenate([each.corners for each in self.objects]) @ np.array(towards)
        plane = ClipPlane(direction=towards, name=name, low=float(heights.min()), high=float(heights.max()), share=0.5)
        self._change("clips", "the clip plane", clips=(*self.state.clips, plane))

    def move_clip(self, n: int, share: float) -> None:
        """Move the plane of number n (from 0): 0 at the one end of what is shown, 1 at the other."""
        plane = self._clip(n)
        (value,) = checked_numbers("the place of a clip plane", share)
        if not 0.0 <= value <= 1.0:
            raise UsageError(f"the place of a clip plane is a share from 0 to 1, not {value:g}")
        self._set_clip(n, replace(plane, share=value), f"move clip {n}")

    def flip_clip(self, n: int) -> None:
        """Take the other side of the plane of number n away."""
        plane = self._clip(n)
        self._set_clip(n, replace(plane, flipped=not plane.flipped), "flip")

    def remove_clip(self, n: int) -> None:
        self._clip(n)
        self._change("clips", "the clip plane", clips=(*self.state.clips[:n], *self.state.clips[n + 1 :]))

    def set_clip_box(self, low: Sequence[float] | None, high: Sequence[float] | None) -> None:
        """Show what lies in a box along the axes of the patient, LPS mm; None: no box."""
        box: Box | None = None
        if low is not None and high is not None:
            box = checked_vector("the corner of a clip box", low), checked_vector("the corner of a clip box", high)
            Clip.box(*box)
        elif not (low is None and high is None):
            raise UsageError("a clip box has two corners, or none")
        self._change("clip box", "the clip box", clip_box=box)

    def toggle_clip_box(self) -> None:
        """Show a box about the cross, half of what there is along each axis; or take the box away."""
        if self.state.clip_box is not None:
            self.set_clip_box(None, None)
            return
        low, high = self._span(self.objects)
        half = 0.5 * _BOX_SHARE * (high - low)
        middle = np.clip(np.array(self.state.cross), low + half, high - half)
        self.set_clip_box((middle - half).tolist(), (middle + half).tolist())

    # What panels show

    def facts(self) -> dict[str, Any]:
        """Return all that panels show, for JSON; places are in `space`, those for other commands in LPS."""
        state = self.state
        mode = self.modes[state.mode]
        notes = []
        hidden = [each.name for each in self.objects if each.kind != "labels"][1:]
        together = state.compare is None  # otherwise inputs have pictures of their own
        if together and not mode.joins and hidden:
            notes.append(f"a picture of mode {mode.name} shows one scan alone: {', '.join(hidden)} left out")
        elif together and mode.kind in ("volume", "slices") and len(self.scans) > 1:
            others = ", ".join(each.name for each in self.scans[1:])
            notes.append(f"one scan is shown in mode {mode.name}, {others} by the surface")
        if state.smooth_mm:
            notes.append(
                f"scans are smoothed by {state.smooth_mm:g} mm; HU and measures are those of the scans as read"
            )
        if self._is_edge_on(mode):
            notes.append("slices are hardly seen along their planes: turn the picture")
        return {
            "version": self.version,
            "space": self.space.upper(),
            "objects": [
                {"number": each.number, "name": each.name, "kind": each.kind, "said": list(each.said)}
                for each in self.objects
            ],
            "bounds": [[round(float(value), 3) for value in corner] for corner in self._span(self.objects)],
            "modes": [{"name": each.name, "words": each.words, "dark": each.is_dark} for each in self.modes.values()],
            "mode": state.mode,
            "iso": {"hu": state.iso_value, "low": self.iso_range[0], "high": self.iso_range[1]} if self.scans else None,
            "window": list(state.window),
            "picture_window": list(state.picture_window or mode.window or ()) or None,
            "table": state.table,
            "smooth_mm": state.smooth_mm,
            "fitted": state.fitted if self.scans and mode.kind == "surface" else None,
            "occlusion": state.occlusion,
            "color_by": state.color_by,
            "cross": [round(value, 3) for value in state.cross],
            "slices": {plane: describe_slice(self.scans, plane, state.cross, state.turn) for plane in PLANES},
            "forward": {plane: find_forward(plane, state.turn).tolist() for plane in PLANES},
            "turned": state.turn is not None,
            "slab": {"mm": state.slab_mm, "combine": state.combine},
            "layout": state.layout,
            "comparable": self.is_comparable,
            "compare": state.compare,
            "cross_text": self.say_place(state.cross),
            "parts": [each.describe() for each in state.parts],
            "parts_known": self.parts_known,
            "small_parts": any(part.visible for part in self.small_parts) if self.small_parts else None,
            "tool": state.tool,
            "points": [each.describe() for each in state.points],
            "measures": [
                {
                    **each.describe(),
                    "text": self.say_place(each.points[0]) if each.kind == "seed" else each.text,
                    "outline": np.round(each.outline, 3).tolist(),
                }
                for each in state.measures
            ],
            "clips": [each.describe() for each in state.clips],
            "clip_box": None if state.clip_box is None else [list(corner) for corner in state.clip_box],
            "letters": edge_letters(state.camera),
            "camera": {
                "position": list(state.camera.position),
                "focal_point": list(state.camera.focal_point),
                "up": list(state.camera.up),
                "parallel": state.camera.is_parallel,
                "height_mm": height_mm(state.camera),
            },
            "undo": self._undo[-1][1] if self._undo else None,
            "notes": notes,
        }

    @property
    def parts_known(self) -> bool:
        """True where the parts of the scans are those of the iso value and the table as they are now."""
        state = self.state
        divided = [each.within for each in self.label_maps]
        is_new = state.parts_at == state.iso_value and state.parts_voxels == state.voxels
        return is_new or all(each.number in divided for each in self.scans)

    def say_place(self, point: Sequence[float]) -> str:
        """Return a place, LPS mm, as words in `space`."""
        values_shown = self.signs * np.array(point) + 0.0
        return f"{', '.join(f'{value:.1f}' for value in values_shown)} mm {self.space.upper()}"

    def _set_clip(self, n: int, plane: ClipPlane, kind: str) -> None:
        clips = (*self.state.clips[:n], plane, *self.state.clips[n + 1 :])
        self._change(kind, "the clip plane", clips=clips)

    def _clip(self, n: int) -> ClipPlane:
        return _numbered("clip plane", self.state.clips, n)

    def _span(self, objects: Sequence[ShownObject] = ()) -> tuple[Float64Array, Float64Array]:
        """Return the lowest and highest corner of the box around objects; by default the scans, if there are any."""
        corners = np.concatenate([each.corners for each in objects or self.scans or self.objects])
        return corners.min(axis=0), corners.max(axis=0)


def _first_side(extent: Float64Array) -> DirectionName:
    """Return the side from which a view begins: the front, or the face of slices so few that they are a line."""
    least, next_least, _ = np.sort(extent)
    faces: tuple[DirectionName, ...] = ("left", "anterior", "inferior")
    return faces[int(np.argmin(extent))] if least < _FLAT * next_least else "anterior"


def checked_slab(thickness: Any) -> float:
    (mm,) = checked_numbers("the thickness of the slices", thickness)
    if not 0.0 <= mm <= _MOST_SLAB_MM:
        raise UsageError(f"slices are 0 to {_MOST_SLAB_MM:g} mm thick, not {mm:g} mm")
    return mm


def _numbered(noun: str, items: Sequence[_Item], n: int) -> _Item:
    if isinstance(n, bool) or not isinstance(n, int) or not 0 <= n < len(items):
        raise UsageError(f"there is no {noun} {n!r}: there are {len(items)}, numbered from 0")
    return items[n]
