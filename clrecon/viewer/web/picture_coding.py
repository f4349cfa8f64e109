"""A picture as one message to a browser: a line of facts as JSON, and a JPEG.

The message begins with the length of the facts, 4 bytes, lowest first.  JPEG has no opacity: the picture lies over the
colour of the page's ground.
"""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.rendering import Rendering
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.rendering.views.camera import Camera

MOVING_QUALITY, SHARP_QUALITY = 70, 92
"""Of JPEG.  Above 90 the colours are not halved: edges of labels stay where they are."""


def encode_picture(picture: Rendering, ground: tuple[int, int, int], sharp: bool, facts: dict[str, Any]) -> bytes:
    """Return the message of a picture.

    ground: Red, green and blue of the page's ground, 0 to 255.
    sharp: At rest: in high quality.
    facts: What else the page is to know of it; size and camera are added.
    """
    load_pillow()
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(_lay_over(picture.image, ground)).save(
        stream,
        "JPEG",
        quality=SHARP_QUALITY if sharp else MOVING_QUALITY,
        subsampling=0 if sharp else 2,
    )
    width, height = picture.size
    told = {**facts, "sharp": sharp, "size": [width, height], "camera": describe_camera(picture.camera)}
    head = json.dumps(told, separators=(",", ":"), allow_nan=False).encode()
    return len(head).to_bytes(4, "little") + head + stream.getvalue()


def describe_camera(camera: Camera | None) -> dict[str, Any] | None:
    """Return what a page needs to draw points of the patient over a picture; None for a picture without a camera.

    ``half_height`` is that of the picture in mm, of a perspective one in mm per mm of distance along the view.
    """
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
