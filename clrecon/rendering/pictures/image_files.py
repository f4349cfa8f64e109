"""Files of one picture: no patient data, date or path in them; the same picture gives the same bytes."""

from __future__ import annotations

import os
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.rendering.pictures.picture_data import PictureData
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.system.arguments import name_parameter
from clrecon.system.files import replace_file
from clrecon.system.text import guess_word
from clrecon.version import package_version

IMAGE_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF", ".tiff": "TIFF"}
"""Pillow's name of the format, by extension."""

FLOAT_FORMATS = (".npy", ".tif", ".tiff")

_MOST_PER_METRE = 2**31 - 1
"""Largest number of pixels per metre in a PNG file."""


def check_image_path(path: str | os.PathLike[str]) -> str:
    """Return the extension of a picture file in lower case."""
    return _extension(path, tuple(IMAGE_FORMATS), "picture")


def write_image(rendering: PictureData, path: str | os.PathLike[str], quality: int = 95) -> int:
    """Write a picture to a file; see `Rendering.save`."""
    content = encode_image(rendering, check_image_path(path), quality)
    return _replace(path, content)


def encode_image(rendering: PictureData, extension: str, quality: int = 95) -> bytes:
    """Return the bytes of the file that `write_image` writes.

    extension: One of `IMAGE_FORMATS`.
    quality: Quality of JPEG, 1 to 100.
    """
    load_pillow()
    from PIL import Image

    kind = IMAGE_FORMATS[extension]
    picture = Image.fromarray(np.ascontiguousarray(rendering.image))
    options: dict[str, Any] = {}
    if kind == "JPEG":
        if not rendering.is_opaque:
            raise UsageError("JPEG cannot hold a transparent background: choose PNG or TIFF, or a background colour")
        if not 1 <= quality <= 100:
            raise UsageError(f"the quality of a JPEG file lies between 1 and 100, not at {quality!r}")
        picture = picture.convert("RGB")
        # No resolution: JFIF stores whole dots per inch, an error of 1 % at 0.5 mm.
        options = {"quality": quality, "subsampling": 0}
    else:
        options.update(_resolution(rendering.pixel_mm))
    if kind == "PNG":
        options["pnginfo"] = _text_chunks(rendering)
    if kind == "TIFF":
        options["compression"] = "tiff_lzw"
    stream = BytesIO()
    picture.save(stream, kind, **options)
    return stream.getvalue()


def write_floats(array: NDArray[np.float32], path: str | os.PathLike[str], pixel_mm: float | None = None) -> int:
    """Write one float32 per pixel, NaN included, to a file with an extension of `FLOAT_FORMATS`.

    array: ndarray, shape (h, w)
    pixel_mm: Side of a pixel, for the resolution of a TIFF file.

    Returns: Size of the file in bytes.
    """
    return _replace(path, encode_floats(array, check_float_path(path), pixel_mm))


def check_float_path(path: str | os.PathLike[str]) -> str:
    """Return the extension of a file of depths or values in lower case."""
    return _extension(path, FLOAT_FORMATS, "depth or value")


def encode_floats(array: NDArray[np.float32], extension: str, pixel_mm: float | None = None) -> bytes:
    """Return the bytes of the file that `write_floats` writes; `extension` is one of `FLOAT_FORMATS`."""
    floats = np.ascontiguousarray(array, dtype=np.float32)
    stream = BytesIO()
    if extension == ".npy":
        np.save(stream, floats)
    else:
        load_pillow()
        from PIL import Image

        Image.fromarray(floats).save(stream, "TIFF", **_resolution(pixel_mm))
    return stream.getvalue()


def _extension(path: str | os.PathLike[str], known: tuple[str, ...], what: str) -> str:
    try:
        extension = os.path.splitext(os.fspath(path))[1].lower()
    except TypeError as error:
        raise UsageError(f"a {what} file is named by a string or a path, not {type(path).__name__}") from error
    if extension not in known:
        found = f"the extension {extension!r}{guess_word(extension, known)}" if extension else "no extension"
        moving = what == "picture" and extension in (".gif", ".apng", ".mp4")
        if moving:
            found = f"the extension {extension!r} of moving pictures, for which there is {name_parameter('turntable')}"
        raise UsageError(f"the name of the {what} file has {found}: use one of {', '.join(known)}")
    return extension


def _replace(path: str | os.PathLike[str], content: bytes) -> int:
    def write(stream: Any) -> None:
        stream.write(content)

    return replace_file(path, write, expected_bytes=len(content))


def _resolution(pixel_mm: float | None) -> dict[str, Any]:
    """Return Pillow's option for the size of a pixel in mm; PNG stores whole pixels per metre in 32 bits."""
    if pixel_mm is None or not 1.0 <= 1000.0 / pixel_mm <= _MOST_PER_METRE:
        return {}
    return {"dpi": (25.4 / pixel_mm, 25.4 / pixel_mm)}


def _text_chunks(rendering: PictureData) -> Any:
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    text.add_text("Software", f"clrecon {package_version()}")
    text.add_text("Mode", rendering.mode)
    camera = rendering.camera
    if camera is not None:
        from clrecon.rendering.pictures.annotations import orientation_letters

        text.add_text("View", f"from {orientation_letters(-camera.basis().forward)}")
        named = {"position": camera.position, "focal point": camera.focal_point, "up": camera.up}
        lines = [f"{name} {x:.6g} {y:.6g} {z:.6g}" for name, (x, y, z) in named.items()]
        if camera.parallel_scale is not None:
            lines.append(f"parallel scale {camera.parallel_scale:.6g} mm")
        else:
            lines.append(f"view angle {camera.view_angle:.6g} degrees")
        text.add_text("Camera", f"LPS mm: {'; '.join(lines)}")
    if rendering.pixel_mm is not None:
        text.add_text("Pixel", f"{rendering.pixel_mm:.6g} mm")
    return text
