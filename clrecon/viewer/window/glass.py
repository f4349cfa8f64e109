"""`Glass`: a window of VTK with a renderer for each box of a layout, of which only those that changed are drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.viewer.window.layout import Box, Layout
from clrecon.viewer.window.picture_actor import image_data

if TYPE_CHECKING:
    from clrecon.system.display import Display

COVER = "cover"
"""Name of what lies over the picture."""

BETWEEN = (0.10, 0.11, 0.12)
"""Colour of the gaps between the boxes."""

PICTURE_BACK = (0.055, 0.06, 0.07)
"""Colour behind the picture."""


class Glass:
    """A window in which boxes show pictures.

    display: What was found by the probe.
    """

    def __init__(self, title: str, layout: Layout, display: Display):
        import vtkmodules.vtkInteractionStyle
        import vtkmodules.vtkRenderingFreeType
        import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  these are the factories of what the core names
        from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkRenderWindowInteractor

        self.window = vtkRenderWindow()
        self.window.SetWindowName(title)
        self.window.SetSize(*layout.size)
        # Many samples a pixel take most of the time where the processor draws, and pictures need none.
        self.window.SetMultiSamples(0)
        self._back = vtkRenderer()
        self._back.SetBackground(*BETWEEN)
        self.window.AddRenderer(self._back)
        self._make: Callable[[], Any] = vtkRenderer
        self._renderers: dict[str, Any] = {}
        self._textures: dict[str, Any] = {}
        self._dirty: set[str] = set()
        self._covered = self._closed = False
        self.layout = layout
        self.is_software = display.is_software
        self.interactor = vtkRenderWindowInteractor()
        self.interactor.SetRenderWindow(self.window)
        no_style: Any = None
        self.interactor.SetInteractorStyle(no_style)
        self.arrange(layout)

    def arrange(self, layout: Layout) -> None:
        """Lay the boxes out anew; those that are no more are hidden."""
        self.layout = layout
        for name, box in layout.boxes.items():
            self.renderer(name).SetViewport(*box.viewport(layout.size))
        self._dirty = {"", *self._renderers}

    def renderer(self, name: str) -> Any:
        """Return the renderer of a box."""
        made = self._renderers.get(name)
        if made is None:
            made = self._renderers[name] = self._make()
            made.SetBackground(*(PICTURE_BACK if name == "picture" else (0.0, 0.0, 0.0)))
            made.GetCullers().RemoveAllItems()  # a picture is drawn wherever its rectangle lies
            self.window.AddRenderer(made)
        return made

    def show(self, name: str, image: NDArray[np.uint8]) -> None:
        """Fill a box with an opaque image (h, w, 4)."""
        from vtkmodules.vtkRenderingCore import vtkTexture

        texture = self._textures.get(name)
        if texture is None:
            texture = self._textures[name] = vtkTexture()
            texture.SetColorModeToDirectScalars()
            texture.InterpolateOff()
            texture.RepeatOff()
            self.renderer(name).SetBackgroundTexture(texture)
            self.renderer(name).TexturedBackgroundOn()
        texture.SetInputData(image_data(np.ascontiguousarray(image[::-1])))
        self._dirty.add(name)

    def cover(self, image: NDArray[np.uint8] | None) -> None:
        """Lay an image over the picture; None takes it away."""
        self._covered = image is not None
        if image is not None:
            self.renderer(COVER).SetViewport(*self.box("picture").viewport(self.layout.size))
            self.show(COVER, image)
        self._dirty.add("picture")

    def touch(self, name: str) -> None:
        """Draw a box anew at the next `draw`."""
        self._dirty.add(name)

    def touch_all(self) -> None:
        """Draw everything anew at the next `draw`: the window was covered."""
        self._dirty = {"", *self._renderers}

    def draw(self) -> bool:
        """Draw what changed; the other boxes keep what they show.  Returns whether there was anything."""
        if not self._dirty:
            return False
        self._back.SetDraw("" in self._dirty)
        for name, renderer in self._renderers.items():
            here = self._covered if name == COVER else name in self.layout.boxes
            hidden = self._covered and name == "picture"
            renderer.SetDraw(name in self._dirty and here and not hidden)
        self._dirty.clear()
        self.window.Render()
        return True

    def box(self, name: str) -> Box:
        """Return a box of the layout, an empty one where there is no room for it."""
        return self.layout.boxes.get(name, Box(0, 0, 0, 0))

    def place(self) -> tuple[int, int]:
        """Return the pointer's place in pixels from the top left."""
        x, y = self.interactor.GetEventPosition()
        return x, self.layout.size[1] - 1 - y

    def close(self) -> None:
        """Close the window; again does nothing."""
        if not self._closed:
            self._closed = True
            self.interactor.TerminateApp()
            self.window.Finalize()
