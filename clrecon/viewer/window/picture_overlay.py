"""What lies over the picture: letters, scale, measures, the cross; it follows the camera of the picture that is shown.

Lines of measures are drawn twice: bright in space, where bone hides what lies behind it, and faint over everything.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.rendering.pictures.annotations import bar_length, edge_letters

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clrecon.rendering import Rendering
    from clrecon.rendering.views.camera import Camera

PLANE_COLORS = {"axial": (0.95, 0.42, 0.42), "coronal": (0.42, 0.85, 0.47), "sagittal": (0.45, 0.62, 1.0)}
"""Of the cross and of the frames of slices: each plane has its own."""

MEASURE_COLOR = (1.0, 0.86, 0.25)
CROSS_PIXELS = 11
MARGIN = 12
LETTER_PIXELS, LABEL_PIXELS = 17, 15
LABEL_WIDTH, LABEL_HEIGHT = 74, 22


def marked_lines(facts: Mapping[str, Any]) -> list[tuple[NDArray[np.float64], str, bool]]:
    """Return points (n, 3) in LPS mm, text and whether they are a line: all measures, and the tool's points so far.

    The text stands at the last point but for an angle, where it stands at the middle one: the points are turned round
    so that this is so.
    """
    found = []
    for measure in facts.get("measures", ()):
        points = np.array(measure["points"], dtype=np.float64).reshape(-1, 3)
        found.append((points, measure["text"], len(points) > 1))
    points = np.array([_place(point) for point in facts.get("points", ())], dtype=np.float64).reshape(-1, 3)
    if len(points):
        found.append((points, "", len(points) > 1))
    return found


def _place(point: Any) -> Any:
    return point["point"] if isinstance(point, Mapping) else point


class PictureOverlay:
    """Actors over the picture of a renderer."""

    def __init__(self, renderer: Any):
        self._renderer = renderer
        self._letters = {edge: self._text(LETTER_PIXELS) for edge in ("left", "right", "top", "bottom")}
        for edge, text in self._letters.items():
            across = {"left": "Left", "right": "Right"}.get(edge, "Centered")
            getattr(text.GetTextProperty(), f"SetJustificationTo{across}")()
            up = {"top": "Top", "bottom": "Bottom"}.get(edge, "Centered")
            getattr(text.GetTextProperty(), f"SetVerticalJustificationTo{up}")()
        self._scale_text = self._text(LABEL_PIXELS)
        self._scale = _Lines(renderer, flat=True)
        self._in_space = _Lines(renderer, flat=False)
        self._over = _Lines(renderer, flat=True)
        self._points = _Lines(renderer, flat=True, dots=True)
        self._cross = _Lines(renderer, flat=True)
        self._labels: list[Any] = []

    def show(self, rendering: Rendering, size: tuple[int, int], facts: Mapping[str, Any], *, cross: bool) -> None:
        """Lay everything out for a picture.

        rendering: With a camera.
        size: (width, height). Of the box in which it is shown, in pixels.
        facts: `ViewModel.facts`.
        cross: Mark where the slices meet.
        """
        camera = rendering.camera
        assert camera is not None
        self._show_letters(camera, size)
        self._show_scale(camera, size)
        self._show_measures(camera, size, marked_lines(facts))
        where = facts.get("cross") if cross else None
        self._cross.set(_cross_lines(camera, size, where) if where is not None else [])

    def _show_letters(self, camera: Camera, size: tuple[int, int]) -> None:
        width, height = size
        places = {
            "left": (MARGIN, height / 2),
            "right": (width - MARGIN, height / 2),
            "top": (width / 2, height - MARGIN),
            "bottom": (width / 2, MARGIN),
        }
        for edge, letters in edge_letters(camera).items():
            self._letters[edge].SetInput(letters or " ")
            self._letters[edge].SetPosition(*places[edge])

    def _show_scale(self, camera: Camera, size: tuple[int, int]) -> None:
        pixel = camera.pixel_mm(size)
        length = bar_length(pixel * size[0] * 0.7)
        pixels = length / pixel
        ends = ((MARGIN, MARGIN + 6), (MARGIN, MARGIN), (MARGIN + pixels, MARGIN), (MARGIN + pixels, MARGIN + 6))
        self._scale.set([(np.array(ends, dtype=np.float64), (1.0, 1.0, 1.0))])
        where = "" if camera.is_parallel else " (in the middle)"
        self._scale_text.SetInput(f"{length:g} mm{where}")
        self._scale_text.SetPosition(MARGIN, MARGIN + 9)

    def _show_measures(
        self, camera: Camera, size: tuple[int, int], marked: Sequence[tuple[NDArray[np.float64], str, bool]]
    ) -> None:
        lines = [(points, MEASURE_COLOR) for points, _, is_line in marked if is_line]
        self._in_space.set(lines)
        flat, dots, used = [], [], 0
        taken: list[tuple[float, float]] = []
        for points, words, is_line in marked:
            places = _viewport(camera, size, points)
            if np.isnan(places).any():
                continue
            if is_line:
                flat.append((places, MEASURE_COLOR))
            dots.append((places, MEASURE_COLOR))
            if words:
                self._label(used).SetInput(words)
                # Beside the middle of the line, where it hides neither its ends nor itself.
                x, y = places[len(places) // 2] if len(places) != 2 else places.mean(axis=0)
                x, y = min(max(x + 10, 2), size[0] - LABEL_WIDTH), min(max(y + 8, 2), size[1] - LABEL_HEIGHT)
                while any(abs(x - left) < LABEL_WIDTH and abs(y - low) < LABEL_HEIGHT for left, low in taken):
                    y -= LABEL_HEIGHT
                taken.append((x, y))
                self._label(used).SetPosition(x, y)
                self._label(used).VisibilityOn()
                used += 1
        for label in self._labels[used:]:
            label.VisibilityOff()
        self._over.set(flat, opacity=0.45)
        self._points.set(dots)

    def _label(self, number: int) -> Any:
        while len(self._labels) <= number:
            label = self._text(LABEL_PIXELS)
            label.GetTextProperty().SetColor(*MEASURE_COLOR)
            label.GetTextProperty().SetBackgroundColor(0.08, 0.08, 0.09)
            label.GetTextProperty().SetBackgroundOpacity(0.75)
            self._labels.append(label)
        return self._labels[number]

    def _text(self, pixels: int) -> Any:
        from vtkmodules.vtkRenderingCore import vtkTextActor

        text = vtkTextActor()
        text.SetTextScaleModeToNone()
        look = text.GetTextProperty()
        look.SetFontFamilyToArial()
        look.SetFontSize(pixels)
        look.SetColor(1.0, 1.0, 1.0)
        look.SetShadow(True)
        look.SetShadowOffset(1, -1)
        self._renderer.AddViewProp(text)
        return text


class _Lines:
    """Lines in colours: in pixels over everything, or in LPS mm with a place in space."""

    def __init__(self, renderer: Any, *, flat: bool, dots: bool = False):
        from vtkmodules.vtkCommonDataModel import vtkPolyData
        from vtkmodules.vtkRenderingCore import vtkActor, vtkActor2D, vtkPolyDataMapper, vtkPolyDataMapper2D

        self._data, self._dots, self._flat = vtkPolyData(), dots, flat
        self._actor = vtkActor2D() if flat else vtkActor()
        mapper = vtkPolyDataMapper2D() if flat else vtkPolyDataMapper()
        mapper.SetInputData(self._data)
        self._actor.SetMapper(mapper)
        look = self._actor.GetProperty()
        look.SetLineWidth(2.0 if flat else 3.0)
        look.SetPointSize(8.0)
        if not flat:
            look.LightingOff()
            self._actor.PickableOff()
        self._actor.VisibilityOff()
        renderer.AddViewProp(self._actor)

    def set(
        self, lines: Iterable[tuple[NDArray[np.float64], tuple[float, float, float]]], opacity: float = 1.0
    ) -> None:
        """Show lines, each with its points (n, 2) in pixels from the bottom left or (n, 3) in LPS mm, and a colour."""
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonCore import vtkPoints
        from vtkmodules.vtkCommonDataModel import vtkCellArray

        lines = list(lines)
        self._actor.SetVisibility(bool(lines))
        if not lines:
            return
        places = np.concatenate([points for points, _ in lines])
        if self._flat:
            places = np.column_stack([places, np.zeros(len(places))])
        points, cells, first = vtkPoints(), vtkCellArray(), 0
        points.SetDataTypeToDouble()
        points.SetData(numpy_to_vtk(places, deep=True))
        for own, _ in lines:
            groups = [[first + n] for n in range(len(own))] if self._dots else [range(first, first + len(own))]
            for group in groups:
                cells.InsertNextCell(len(group), list(group))
            first += len(own)
        self._data.Initialize()
        self._data.SetPoints(points)
        (self._data.SetVerts if self._dots else self._data.SetLines)(cells)
        colors = np.concatenate([np.tile(np.array([*color, opacity]) * 255.0, (len(own), 1)) for own, color in lines])
        scalars = numpy_to_vtk(colors.astype(np.uint8), deep=True)
        self._data.GetPointData().SetScalars(scalars)
        self._data.Modified()


def _viewport(camera: Camera, size: tuple[int, int], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where points appear, (n, 2) in pixels from the bottom left."""
    pixels, _ = camera.project(points, size)
    return np.column_stack([pixels[:, 0], size[1] - pixels[:, 1]])


def _cross_lines(camera: Camera, size: tuple[int, int], where: Any) -> list[Any]:
    """Return three short lines through the place where the slices meet, along the axes of the patient."""
    reach = CROSS_PIXELS * camera.pixel_mm(size)
    lines = []
    for axis, plane in enumerate(("sagittal", "coronal", "axial")):
        step = np.eye(3)[axis] * reach
        places = _viewport(camera, size, np.array([where - step, where + step]))
        if not np.isnan(places).any():
            lines.append((places, PLANE_COLORS[plane]))
    return lines
