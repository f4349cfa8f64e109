"""The pictures of one browser: which comes next, and each as one message.

Small ones come while something moves, sharp ones at rest, the views by turns.  A message is a line of facts as JSON,
behind its length (4 bytes, lowest first), and a JPEG.  JPEG has no opacity: the picture lies over the page's ground.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.rendering import Rendering
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.rendering.views.camera import Camera
from clrecon.viewer.session.picture_facts import VIEWS


class Asked(NamedTuple):
    view: str
    size: tuple[int, int]
    moving: bool


class Pace:
    """What is stale in one browser; `moving` from a `change` to the next `rest`."""

    def __init__(self) -> None:
        self.moving = False
        self._sizes: dict[str, tuple[int, int]] = {}
        # Both in the order in which the views are to be drawn.
        self._stale: dict[str, None] = {}
        self._coarse: dict[str, None] = {}

    def resize(self, sizes: dict[str, tuple[int, int]]) -> None:
        """Take the sizes in pixels of the views that the page shows; a new size makes a view stale."""
        for view in VIEWS:
            size = sizes.get(view)
            if size is None:
                self._sizes.pop(view, None)
                self._stale.pop(view, None)
                self._coarse.pop(view, None)
            elif size != self._sizes.get(view):
                self._sizes[view] = size
                self._stale[view] = None

    def change(self, views: Iterable[str]) -> None:
        """Note that these views show what is no longer so."""
        self.moving = True
        for view in views:
            if view in self._sizes:
                self._stale.setdefault(view)
                self._coarse.pop(view, None)

    def rest(self) -> None:
        """Note that nothing moves any more: what was drawn coarsely is drawn sharp."""
        self.moving = False

    def next(self) -> Asked | None:
        """Return what to draw now, and count it as drawn; None where everything is as it should be."""
        if self._stale:
            return self._take(next(iter(self._stale)))
        if self._coarse and not self.moving:
            return self._take(next(iter(self._coarse)))
        return None

    @property
    def is_done(self) -> bool:
        """True where nothing is left to draw."""
        return not (self._stale or self._coarse or self.moving)

    def instead(self, drawn: Asked) -> Asked | None:
        """Return what to draw in place of a picture that is being drawn: only of a sharp one that is stale again."""
        return self._take(drawn.view) if not drawn.moving and self.moving and drawn.view in self._stale else None

    def _take(self, view: str) -> Asked:
        self._stale.pop(view, None)
        self._coarse.pop(view, None)
        if self.moving:
            self._coarse[view] = None
        return Asked(view, self._sizes[view], self.moving)


_MOVING_QUALITY, _SHARP_QUALITY = 70, 92
"""Of JPEG.  Above 90 the colours are not halved: edges of labels stay where they are."""


def encode_picture(picture: Rendering, ground: tuple[int, int, int], sharp: bool, facts: dict[str, Any]) -> bytes:
    """Return the message of a picture over a ground of red, green and blue; a `sharp` one is in high quality."""
    load_pillow()
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(_lay_over(picture.image, ground)).save(
        stream, "JPEG", quality=_SHARP_QUALITY if sharp else _MOVING_QUALITY, subsampling=0 if sharp else 2
    )
    width, height = picture.size
    told = {**facts, "sharp": sharp, "size": [width, height], "camera": facts_of_camera(picture.camera)}
    head = json.dumps(told, separators=(",", ":"), allow_nan=False).encode()
    return len(head).to_bytes(4, "little") + head + stream.getvalue()


def facts_of_camera(camera: Camera | None) -> dict[str, Any] | None:
    """Return what a page needs to draw points; ``half_height`` in mm, or per mm of distance; None: no camera."""
    if camera is None:
        return None
    right, up, forward = (vector.tolist() for vector in camera.basis())
    return {
        "position": list(camera.position),
        "right": right,
        "up": up,
        "forward": forward,
        "half_height": camera.half_height(),
        "parallel": camera.is_parallel,
    }


def _lay_over(image: NDArray[np.uint8], ground: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Return (h, w, 3) of an image with opacity over a colour, in whole numbers: this runs for each moving picture."""
    opacity = image[..., 3:].astype(np.uint16)
    behind = np.array(ground, dtype=np.uint16) * (255 - opacity)
    return ((image[..., :3] * opacity + behind + 127) // 255).astype(np.uint8)
