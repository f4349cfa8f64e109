"""`ChangingView`: the state of a view, its camera and its parts, with every change as a step of undo.

Gestures move the camera by shares of the picture's height: x to the right, y down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from time import monotonic
from typing import Any, TypeVar

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.operators.rays.mesh_pictures import box_around
from clrecon.rendering.pictures.label_style import distinct_colors
from clrecon.rendering.views.camera import Camera, rotation_about
from clrecon.rendering.views.directions import as_point, checked_vector
from clrecon.system.arguments import DirectionName
from clrecon.system.text import unknown_name
from clrecon.viewer.model.objects import ShownObject
from clrecon.viewer.model.parts import SMALLER, FoundParts, carry_looks
from clrecon.viewer.model.state import Color, ShownPart, ViewState

_FIT_PIXELS = 1000
"""Height of the picture that a camera is fitted for; only its ratio to the width counts."""


def fit_camera(
    points: Float64Array,
    view: DirectionName | Sequence[float],
    aspect: float,
    view_angle: float | None = None,
    **up: Any,
) -> Camera:
    """Return a camera from a side of the patient so that points (n, 3) fit; `aspect` is width by height."""
    size = (max(1, round(aspect * _FIT_PIXELS)), _FIT_PIXELS)
    return Camera.fit(box_around([points]), view, view_angle=view_angle, size=size, **up)


_TURN_DEGREES = 180.0
"""By which a gesture over the height of the picture turns."""

_MOST_MM, _LEAST_MM = 1e5, 1e-2
"""Half heights between which a camera zooms: from a hundred metres to a hundredth of a millimetre."""


def turn_camera(camera: Camera, dx: float, dy: float) -> Camera:
    """Turn about the focal point as if the pointer held what is seen there, as pyvista's trackball does."""
    right, up, _ = camera.basis()
    turn = rotation_about(up, -dx * _TURN_DEGREES) @ rotation_about(right, -dy * _TURN_DEGREES)
    away = turn @ np.subtract(camera.position, camera.focal_point)
    return replace(camera, position=as_point(np.add(camera.focal_point, away)), up=as_point(turn @ up))


def roll_camera(camera: Camera, degrees: float) -> Camera:
    """Turn about the view; positive degrees turn the picture clockwise."""
    _, up, forward = camera.basis()
    return replace(camera, up=as_point(rotation_about(forward, -degrees) @ up))


def shift_camera(camera: Camera, shift: Float64Array, **changes: Any) -> Camera:
    """Return a camera that is moved by a vector, LPS mm, and changed otherwise."""
    position, focal_point = as_point(camera.position + shift), as_point(camera.focal_point + shift)
    return replace(camera, position=position, focal_point=focal_point, **changes)


def pan_camera(camera: Camera, dx: float, dy: float) -> Camera:
    """Shift what is seen by shares of the picture's height, at the focal point."""
    right, up, _ = camera.basis()
    x, y = (height_mm(camera) * share for share in checked_numbers("a shift", dx, dy))
    if max(abs(x), abs(y)) > 10.0 * _MOST_MM:
        raise UsageError(f"a shift goes {10.0 * _MOST_MM:,.0f} mm at most, not {max(abs(x), abs(y)):g} mm")
    return shift_camera(camera, y * up - x * right)


def zoom_camera(camera: Camera, factor: float, point: tuple[float, float] = (0.0, 0.0)) -> Camera:
    """Show everything `factor` times as large; what is seen at a place, in heights from the middle, stays there."""
    if not (math.isfinite(factor) and factor > 0.0):
        raise UsageError(f"the factor of a zoom is a number above 0, not {factor!r}")
    before = height_mm(camera)
    height = min(2.0 * _MOST_MM, max(2.0 * _LEAST_MM, before / factor))
    if camera.is_parallel:
        nearer = replace(camera, parallel_scale=0.5 * height)
    else:
        offset = np.subtract(camera.position, camera.focal_point) * (height / before)
        nearer = replace(camera, position=as_point(np.add(camera.focal_point, offset)))
    lost = 1.0 - before / height
    return pan_camera(nearer, point[0] * lost, point[1] * lost)


def pixel_camera(camera: Camera, size: tuple[int, int], x: float, y: float) -> Camera:
    """Return a camera whose picture of one pixel is what this one sees at a place; the first pixel is at (0.5, 0.5)."""
    right, up, forward = camera.basis()
    width, height = size
    pixel = 2.0 * camera.half_height() / height
    offset = (x - 0.5 * width) * pixel * right + (0.5 * height - y) * pixel * up
    if camera.is_parallel:
        return shift_camera(camera, offset, parallel_scale=0.5 * pixel)
    along = forward + offset
    along /= np.linalg.norm(along)
    angle = max(1e-3, math.degrees(pixel))
    return replace(camera, focal_point=as_point(camera.position + camera.distance * along), view_angle=angle)


def height_mm(camera: Camera) -> float:
    return 2.0 * camera.half_height() * (1.0 if camera.is_parallel else camera.distance)


_MOST_UNDO = 200

_SAME_GESTURE_S = 1.0
"""Changes of one kind that follow each other within this time are one step of undo."""

_GESTURES = frozenset(
    {"turn", "pan", "zoom", "roll", "iso", "window", "picture", "cross", "scroll", "opacity", "color", "move"}
)
"""First words of the kinds of changes that come many at a time."""


class ChangingView:
    """What `clrecon.viewer.model.model.ViewModel` is made of."""

    def __init__(self, objects: tuple[ShownObject, ...], state: ViewState, clock: Callable[[], float] = monotonic):
        self.objects, self.state = objects, state
        self.version = 0
        self.aspect = 1.0
        self._first_camera = state.camera
        self._clock, self._undo = clock, list[tuple[ViewState, str]]()
        self._last, self._held = ("", -math.inf), False

    @property
    def camera(self) -> Camera:
        return self.state.camera

    # Camera

    def set_aspect(self, aspect: float) -> None:
        """Tell the width of the picture by its height; the view of the start, while it stays, fits it anew."""
        if aspect == self.aspect:
            return
        self.aspect = aspect
        if self.state.camera == self._first_camera:
            corners = np.concatenate([each.corners for each in self.objects])
            self._first_camera = fit_camera(corners, "anterior", aspect)
            self.state = replace(self.state, camera=self._first_camera)
            self.version += 1

    def turn(self, dx: float, dy: float) -> None:
        """Turn as if the pointer held what is seen; half a turn over the height of the picture."""
        self._change("turn", "the turn", camera=turn_camera(self.camera, *checked_numbers("a turn", dx, dy)))

    def pan(self, dx: float, dy: float) -> None:
        """Shift what is seen by shares of the picture's height, to the right and down."""
        self._change("pan", "the shift", camera=pan_camera(self.camera, dx, dy))

    def zoom(self, factor: float, at: tuple[float, float] = (0.0, 0.0)) -> None:
        """Show everything larger by a factor; what is seen at `at` stays there, see `zoom_camera`."""
        (factor,) = checked_numbers("the factor of a zoom", factor)
        x, y = checked_numbers("the place of a zoom", *at)
        self._change("zoom", "the zoom", camera=zoom_camera(self.camera, factor, (x, y)))

    def roll(self, degrees: float) -> None:
        self._change("roll", "the roll", camera=roll_camera(self.camera, *checked_numbers("a roll", degrees)))

    def look(self, view: DirectionName | Sequence[float] = "anterior") -> None:
        """Look from a side of the patient, so that what is shown fits; see `clrecon.Camera.fit` for the sides."""
        self._change("look", f"the view {view if isinstance(view, str) else ''}".strip(), camera=self._fitted(view))

    def _fitted(self, view: DirectionName | Sequence[float]) -> Camera:
        return fit_camera(self._shown_corners(), view, self.aspect, self.camera.view_angle)

    def fit_shown(self) -> None:
        """Look along the camera's own direction, so that what is shown fits."""
        x, y, z = (-self.camera.basis().forward).tolist()
        angles = math.degrees(math.atan2(x, -y)), math.degrees(math.atan2(z, math.hypot(x, y)))
        corners, up = self._shown_corners(), self.camera.up
        self._change("look", "the view", camera=fit_camera(corners, angles, self.aspect, self.camera.view_angle, up=up))

    def set_perspective(self, on: bool) -> None:
        """Take a perspective camera, or a parallel one, with the same size at the focal point."""
        camera = self.camera
        if on == (not camera.is_parallel):
            return
        if on:
            angle = 30.0
            away = float(camera.parallel_scale or 1.0) / math.tan(math.radians(0.5 * angle))
            position = np.array(camera.focal_point) - away * camera.basis().forward
            changed = replace(camera, position=as_point(position), parallel_scale=None, view_angle=angle)
        else:
            changed = replace(camera, parallel_scale=camera.half_height() * camera.distance, view_angle=None)
        self._change("perspective", "the perspective", camera=changed)

    def toggle_perspective(self) -> None:
        self.set_perspective(self.camera.is_parallel)

    # Parts

    def show(self, key: str, visible: bool) -> None:
        part = self._part(key)
        self._change_part(part, f"the part {part.name}", visible=bool(visible))

    def only(self, key: str) -> None:
        """Show one part and hide all others; an object as a whole with all of its parts."""
        chosen = self._part(key)
        parts = []
        for part in self.state.parts:
            with_it = part.key == key or (part.object == chosen.object and (part.is_whole or chosen.is_whole))
            parts.append(replace(part, visible=with_it))
        self._change("only", f"the choice of {chosen.name}", parts=tuple(parts))

    def show_all(self) -> None:
        self._change("show all", "the choice", parts=tuple(replace(each, visible=True) for each in self.state.parts))

    def set_color(self, key: str, rgb: Sequence[float] | None) -> None:
        """Give a part a colour, three numbers from 0 to 1; None: as it looks by itself."""
        part = self._part(key)
        color: Color | None = None
        if rgb is not None:
            red, green, blue = checked_vector("a colour", rgb)
            if not (0.0 <= min(red, green, blue) and max(red, green, blue) <= 1.0):
                raise UsageError(f"a colour is red, green and blue from 0 to 1, not {red:g}, {green:g}, {blue:g}")
            color = (red, green, blue)
        if part.kind == "rest" and color is not None:
            raise UsageError(f"{part.name} keeps the colours of the mode: it can be hidden, and made translucent")
        self._change_part(part, f"the colour of {part.name}", f"color {key}", color=color)

    def color_parts(self, *, distinct: bool = True) -> None:
        """Give every part of scans a colour of its own, or none."""
        numbered = [each for each in self.state.parts if each.kind == "cluster"]
        if not numbered:
            raise UsageError("the parts of the scan are not found yet")
        table = distinct_colors(len(numbered)) if distinct else None
        colors = {each.key: None if table is None else as_point(table[place]) for place, each in enumerate(numbered)}
        parts = tuple(
            replace(each, color=colors[each.key]) if each.key in colors else each for each in self.state.parts
        )
        self._change("colors", "the colours", parts=parts)

    def toggle_colors(self) -> None:
        """Give every part of scans a colour of its own, or take the colours away."""
        self.color_parts(distinct=not any(each.color for each in self.state.parts if each.kind == "cluster"))

    @property
    def small_parts(self) -> list[ShownPart]:
        """The parts of scans that hold all components but the largest."""
        return [part for part in self.state.parts if part.kind == "cluster" and part.number == SMALLER]

    def toggle_small_parts(self) -> None:
        """Hide the small components of scans, or show them again."""
        small = self.small_parts
        if not small:
            raise UsageError("no scan has small parts: each component has a row of its own, or none is found yet")
        visible = not any(part.visible for part in small)
        parts = tuple(replace(part, visible=visible) if part in small else part for part in self.state.parts)
        self._change("small parts", "the choice of small parts", parts=parts)

    def set_opacity(self, key: str, value: float) -> None:
        """Make a part translucent: 0 to 1; at 0 it is not seen, but stays in the list as shown."""
        part = self._part(key)
        (opacity,) = checked_numbers("an opacity", value)
        if not 0.0 <= opacity <= 1.0:
            raise UsageError(f"an opacity is a number from 0 to 1, not {opacity:g}")
        self._change_part(part, f"the opacity of {part.name}", f"opacity {key}", opacity=opacity)

    def take_parts(self, batches: Sequence[FoundParts]) -> None:
        """Take the parts that were found, with the looks of those that were there; not a step of undo."""
        numbers = {each.scan for each in batches}
        parts = [each for each in self.state.parts if each.is_whole or each.object not in numbers]
        for batch in batches:
            old = [each for each in self.state.parts if each.object == batch.scan and not each.is_whole]
            fresh = carry_looks(old, batch)
            index = next(place for place, each in enumerate(parts) if each.object == batch.scan and each.is_whole)
            parts[index + 1 : index + 1] = fresh
        self.state = replace(
            self.state, parts=tuple(parts), parts_at=batches[0].iso_value, parts_voxels=batches[0].shown
        )
        self.version += 1

    # Undo

    def undo(self) -> str | None:
        """Take the last change back; returns what it was, None where there is nothing to take back."""
        if not self._undo:
            return None
        before, words = self._undo.pop()
        self.state = before
        self._last = ("", -math.inf)
        self.version += 1
        return words

    def hold(self, on: bool) -> None:
        """Say that the pointer is pressed, or released: what is dragged meanwhile is one step, however long."""
        self._held = on
        if on:
            self._last = ("", -math.inf)

    # How changes are made

    def _change(self, kind: str, words: str, **changes: Any) -> None:
        """Make a change that can be undone; those of one gesture are one step."""
        changed = replace(self.state, **changes)
        if changed == self.state:
            return
        now = self._clock()
        last_kind, last_time = self._last
        goes_on = kind.split(" ")[0] in _GESTURES and (
            last_kind.split(" ")[0] in _GESTURES
            if self._held
            else kind == last_kind and now - last_time <= _SAME_GESTURE_S
        )
        if not goes_on:
            self._undo.append((self.state, words))
            del self._undo[:-_MOST_UNDO]
        self._last = (kind, now)
        self.state = changed
        self.version += 1

    def show_state(self, state: ViewState, words: str) -> None:
        """Show another state; as one step of undo."""
        self._change("state", words, **vars(state))

    def _change_part(self, part: ShownPart, words: str, kind: str = "part", **changes: Any) -> None:
        changed = replace(part, **changes)
        parts = tuple(changed if each.key == part.key else each for each in self.state.parts)
        self._change(kind, words, parts=parts)

    def _part(self, key: str) -> ShownPart:
        part = self.state.part(key)
        if part is None:
            raise UsageError(unknown_name("part", key, [each.key for each in self.state.parts]))
        return part

    def _shown_corners(self) -> Float64Array:
        state, corners = self.state, []
        for shown in self.objects:
            whole = state.whole(shown.number)
            if whole is not None and not whole.visible:
                continue
            boxed = [part for part in state.parts_of(shown.number) if part.box is not None]
            boxes = [part.box for part in boxed if part.visible and part.box is not None]
            some = boxes and len(boxes) < len(boxed) and state.mode == "surface"
            corners.append(np.array(boxes, dtype=np.float64).reshape(-1, 3) if some else shown.corners)
        if not corners:
            corners = [each.corners for each in self.objects]
        points = np.concatenate(corners)
        if state.clip_box is not None:
            points = np.clip(points, *np.array(state.clip_box))
        return points


View = TypeVar("View", bound=ChangingView)


def copy_view(view: View) -> View:
    """Return a copy of a view for trials: its changes are none of the view's."""
    copied = copy(view)
    copied._undo = []
    return copied


def checked_numbers(subject: str, *values: Any) -> list[float]:
    numbers = []
    for value in values:
        is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
        number = float(value) if is_number else math.nan
        if not math.isfinite(number):
            raise UsageError(f"{subject} is a finite number, not {value!r:.40}")
        numbers.append(number)
    return numbers
