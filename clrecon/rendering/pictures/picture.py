"""`Rendering`: a picture with depths and camera, its merging with a scene, and its files, without patient data."""

from __future__ import annotations

import base64
import os
from collections.abc import Callable, Sequence
from html import escape
from io import BytesIO
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import UsageError
from clrecon.rendering.pictures.annotations import Bar, Drawing, PictureData, Text
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.system.arguments import explains_arguments, name_parameter, number_or_nan
from clrecon.system.files import replace_file
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.paths import find_extension, keep_existing
from clrecon.version import package_version

Depths = tuple[NDArray[np.float32], NDArray[np.float32]]
"""First and expected depths, (h, w) mm."""

_NO_DEPTHS: Depths = (np.empty((0, 0), np.float32), np.empty((0, 0), np.float32))


@dataclass
class Rendering(PictureData):
    """A picture of a volume.

    Attributes
    ----------
    image : ndarray, shape (h, w, 4), uint8
        Red, green, blue and opacity, not premultiplied; row 0 is the top.
    depth : ndarray, shape (h, w), float32
        Distance along the ray to the first hit in mm, see ``Camera.position``; NaN where nothing is hit.  A graphics
        card may keep both depths until one of them is asked for: if the card fails before, this is a `DeviceError`.
    expected_depth : ndarray, shape (h, w), float32
        Mean distance in mm of all samples of the pixel, weighted with what each adds to the pixel; NaN in empty pixels.
    camera : Camera or None
        None for curved reformations, which no camera sees.
    values : ndarray, shape (h, w), float32, or None
        HU of each pixel in the modes mip, minip, mean, slice and cpr; NaN outside of the volume.  In drr the thickness
        of water in mm that attenuates as much as the ray's path through the volume; 0 outside of the volume.  None in
        other modes.
    mode : str
    report : dict
        How the picture was made, without patient data.  ``"pixel_mm"`` is the side of a pixel if there is no camera.
    drawing : Drawing or None
        What `annotated` wrote on the picture, which SVG files have as text and bars.
    """

    def __repr__(self) -> str:
        width, height = self.size
        return f"Rendering({self.mode}, {width} x {height} pixels)"

    @classmethod
    def with_late_depths(cls, read_depths: Callable[[], Depths], image: NDArray[np.uint8], *more: Any) -> Rendering:
        """Return a picture that calls ``read_depths`` when a depth is asked for; ``more`` begins with the camera.

        It gives ``depth`` and ``expected_depth``, every time the same, and an error of its device.
        """
        picture = cls(image, *_NO_DEPTHS, *more)
        del picture.depth, picture.expected_depth
        vars(picture)["_read_depths"] = read_depths
        return picture

    def __getattr__(self, name: str) -> Any:
        """Read the depths at their first use; one that was set in the meantime stays."""
        if name not in ("depth", "expected_depth") or "_read_depths" not in vars(self):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        for field, depths in zip(("depth", "expected_depth"), vars(self)["_read_depths"](), strict=True):
            vars(self).setdefault(field, depths)
        return vars(self)[name]

    def __getstate__(self) -> dict[str, object]:
        _ = self.depth, self.expected_depth  # read them: buffers stay with their process
        return super().__getstate__()

    _UNSENT = ("_read_depths",)

    def _with(self, **changes: Any) -> Rendering:
        """Return the picture with other values of fields; what is still on the device stays there."""
        picture = object.__new__(type(self))
        vars(picture).update(vars(self) | changes)
        return picture

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """Return ``image``, for numpy and for ``matplotlib.pyplot.imshow(rendering)``."""
        array = self.image if dtype is None else self.image.astype(dtype, copy=False)
        return array.copy() if copy else array

    def world_points(self, *, expected: bool = False) -> NDArray[np.float64]:
        """Return the place in the patient that each pixel shows, LPS mm.

        Parameters
        ----------
        expected : bool
            At the expected depth, not at the first hit.

        Returns
        -------
        ndarray, shape (h, w, 3), float64
            NaN where nothing is hit.

        Raises
        ------
        UsageError
            The picture has no camera.
        """
        if self.camera is None:
            raise UsageError("this picture is no projection (its camera is None): its pixels have no depth")
        origins, directions = self.camera.rays(self.size)
        depth = self.expected_depth if expected else self.depth
        return np.asarray(origins + depth[..., None].astype(np.float64) * directions)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, lower and upper edge in mm: ``plt.imshow(cut.values, "gray", extent=cut.extent)``.

        Where a side of the picture runs along an axis of the patient these are its LPS coordinates (of an axial slice x
        and y, of a coronal one x and z), else mm from the middle.  A `UsageError` where pixels have no one size in mm.
        """
        if self.camera is None or self.pixel_mm is None:
            raise UsageError("this picture has no axes in mm: its camera is None or not parallel")
        ends: list[float] = []
        for direction, pixels in zip(self.camera.basis(), self.size, strict=False):
            axis = int(np.argmax(np.abs(direction)))
            along = abs(abs(direction[axis]) - 1.0) < 1e-9
            middle, sign = (self.camera.focal_point[axis], float(np.sign(direction[axis]))) if along else (0.0, 1.0)
            ends += [middle - sign * 0.5 * pixels * self.pixel_mm, middle + sign * 0.5 * pixels * self.pixel_mm]
        left, right, lower, upper = ends
        return left, right, lower, upper

    def show(self) -> None:
        """Open the picture in the system's own viewer, through Pillow; notebooks show it by themselves."""
        load_pillow()
        from PIL import Image

        Image.fromarray(self.image).show()

    @explains_arguments
    def with_background(self, color: str | Sequence[float]) -> Rendering:
        """Return the same picture, opaque, in front of a colour.

        Parameters
        ----------
        color : str or (float, float, float)
            See ``clrecon.rendering.looks.colors.find_color``.

        Returns
        -------
        Rendering
            A picture with its own ``image``; the other arrays are shared.
        """
        from clrecon.rendering.looks.colors import find_color

        if self.drawing is not None:
            below = self._with(image=self.drawing.ground, drawing=None).with_background(color).image
            drawing = Drawing(below, self.drawing.marks)
            return self._with(drawing=None).with_background(color)._with(drawing=drawing)
        behind = (255.0 * find_color(color)).astype(np.float32)
        alone = np.array([*np.rint(behind), 255], np.uint8).view(np.uint32)
        opacity = self.image[..., 3]
        pixels = np.ascontiguousarray(self.image).view(np.uint32)[..., 0]
        image = np.where(opacity == 0, alone, pixels).view(np.uint8).reshape(self.image.shape)
        mixed = (opacity > 0) & (opacity < 255)
        share = self.image[mixed, 3:].astype(np.float32) / np.float32(255.0)
        image[mixed, :3] = np.rint(share * self.image[mixed, :3] + (np.float32(1.0) - share) * behind)
        image[..., 3] = 255
        return self._with(image=image)

    @explains_arguments
    def annotated(
        self, *, letters: bool = False, scale_bar: bool = False, caption: str | None = None, dpi: float | None = None
    ) -> Rendering:
        """Return the same picture with sides, a scale bar or a line, see ``clrecon.rendering.pictures.annotations``.

        Parameters
        ----------
        letters, scale_bar : bool
        caption : str, optional
        dpi : float, optional
            Pixels per inch of the printed figure: text is 8 points high, and files of the picture have this resolution.
            Default: text of a share of the picture.
        """
        from clrecon.rendering.pictures.annotations import annotate

        resolution = None if dpi is None else checked_dpi(dpi)
        image, drawing = annotate(self, letters=letters, scale_bar=scale_bar, caption=caption, dpi=resolution)
        if resolution is not None:
            return self._with(image=image, drawing=drawing, report={**self.report, "dpi": resolution})
        return self if image is self.image else self._with(image=image, drawing=drawing)

    @explains_arguments
    def save(self, path: str | os.PathLike[str], *, quality: int = 95, no_clobber: bool = False) -> int:
        """Write the picture to a file; the extension chooses the format.

        Parameters
        ----------
        path : str or path
            ``.png`` and ``.tif`` keep the opacity; for parallel pictures they state the size of a pixel as resolution.
            ``.png`` also states how the picture was made.  ``.jpg`` accepts opaque pictures only.  ``.svg`` has the
            picture as PNG, and what `annotated` wrote on it as text and bars, which stay sharp and can be edited.
        quality : int
            Quality of JPEG, 1 to 100.
        no_clobber : bool
            True: a file of that name stays and is an `OutputError`.

        Returns
        -------
        int
            Size of the file in bytes.

        Raises
        ------
        UsageError
            The extension is unknown, or the format cannot store the opacity of the picture.
        OutputError
            The file cannot be written; an older file of that name is intact.
        """
        with keep_existing(keep=no_clobber):
            return _replace_image(path, encode_image(self, check_image_path(path, has_vectors=True), quality))

    @explains_arguments
    def save_depth(self, path: str | os.PathLike[str], *, expected: bool = False, no_clobber: bool = False) -> int:
        """Write ``depth`` in mm to ``.npy`` or, as float32 with NaN, to ``.tif``.

        Parameters
        ----------
        path : str or path
        expected : bool
            Write ``expected_depth`` instead.
        no_clobber : bool
            As in `save`.

        Returns
        -------
        int
            Size of the file in bytes.
        """
        with keep_existing(keep=no_clobber):
            return write_floats(self.expected_depth if expected else self.depth, path, self.pixel_mm)

    @explains_arguments
    def save_values(self, path: str | os.PathLike[str], *, no_clobber: bool = False) -> int:
        """Write ``values`` as `save_depth` writes depths.

        Raises
        ------
        UsageError
            The mode has no values.
        """
        if self.values is None:
            having = "mip, minip, mean, drr, slice and cpr"
            raise UsageError(f"a picture of mode {self.mode} has no values: {having} have them")
        with keep_existing(keep=no_clobber):
            return write_floats(self.values, path, self.pixel_mm)

    @explains_arguments
    def to_pyvista(
        self, form: Literal["points", "plane"] = "points", *, expected: bool = False, distance: float | None = None
    ) -> Any:
        """Return the picture as a PyVista data set in LPS mm, for a scene with meshes.

        Show it with ``plotter.add_mesh(data, scalars="RGBA", rgba=True, lighting=False)``, or let
        ``clrecon.viewer.add_rendering`` do it.  Field arrays ``SPACE`` and ``UNIT`` name the space and its unit.

        Parameters
        ----------
        form : {"points", "plane"}
            ``"points"``: ``pyvista.PolyData`` with a point at each hit of a ray.  Point data: ``RGBA``, ``depth`` (mm)
            and, if there are ``values``, ``HU``.
            ``"plane"``: ``pyvista.ImageData`` across the view with a cell for each pixel.  Cell data: ``RGBA`` and, if
            there are ``values``, ``HU``.  From the picture's camera the plane looks like the picture.
        expected : bool
            Points at the expected depth, not at the first hit.
        distance : float, optional
            Distance of the plane from the camera, mm along the view; default: through the focal point.

        Raises
        ------
        UsageError
            The picture has no camera, there are no hits to make points of, or the form or distance is invalid.
        """
        from clrecon.rendering.pictures.vtk import rendering_to_pyvista

        return rendering_to_pyvista(self, form, expected=expected, distance=distance)

    def _repr_png_(self) -> bytes:
        return encode_image(self, ".png")


def merge_layers(rendering: Rendering, colors: NDArray[np.uint8], depth: NDArray[np.floating]) -> Rendering:
    """Merge a picture and a scene from the same camera: the nearer one covers the farther one.

    Each pixel of the picture is one layer at its expected depth.  A mesh within translucent tissue is therefore drawn
    wholly before or wholly behind the tissue.

    rendering: With a transparent background.
    colors: ndarray, shape (h, w, 4), uint8. The scene, not premultiplied; row 0 is the top.
    depth: ndarray, shape (h, w). mm; NaN where the scene is empty.
    Returns: Both depths include the scene; `values` is None.
    """
    width, height = rendering.size
    if colors.shape != (height, width, 4) or depth.shape != (height, width):
        raise UsageError(
            f"the picture has {width} x {height} pixels, the scene {colors.shape} colours and {depth.shape} depths"
        )
    nothing = np.isnan(rendering.expected_depth)
    if (rendering.image[nothing, 3] == 255).any():  # little opacity without a depth: not yet a background
        raise UsageError("this picture has a coloured background, which hides the scene: use background='transparent'")
    of_picture = np.where(nothing, np.inf, rendering.expected_depth)
    of_scene = np.where(colors[..., 3] > 0, np.nan_to_num(depth, nan=np.inf), np.inf)
    scene_first = of_scene < of_picture
    image, shares = _blend_pictures(
        np.where(scene_first[..., None], colors, rendering.image),
        np.where(scene_first[..., None], rendering.image, colors),
    )
    front, back = np.minimum(of_scene, of_picture), np.maximum(of_scene, of_picture)
    return replace(
        rendering,
        image=image,
        depth=_finite(np.fmin(rendering.depth, of_scene)),
        expected_depth=_finite(_mean_way(shares, front, back)),
        values=None,
        report={**rendering.report, "merged_with_scene": True},
        drawing=None,
    )


def _blend_pictures(front: NDArray[np.uint8], back: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Blend one picture over another, both not premultiplied; also return their weights (2, h, w), 0 to 1."""
    opacity = front[..., 3] / 255.0
    shares = np.stack([opacity, (1.0 - opacity) * back[..., 3] / 255.0])
    sums = shares[0, ..., None] * front[..., :3] + shares[1, ..., None] * back[..., :3]
    total = shares.sum(axis=0)
    image = np.empty_like(front)
    image[..., :3] = np.rint(sums / np.maximum(total, 1e-9)[..., None])
    image[..., 3] = np.rint(255.0 * total)
    return image, shares


def _mean_way(
    shares: NDArray[np.float64], front: NDArray[np.floating], back: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Mean of two depths, weighted with the share of each layer; infinite where both layers are empty."""
    ways = np.stack([front, back])
    weighted = (shares * np.where(np.isinf(ways), 0.0, ways)).sum(axis=0)
    return np.where(np.isinf(front), np.inf, weighted / np.maximum(shares.sum(axis=0), 1e-9))


def _finite(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.where(np.isinf(depth), np.nan, depth).astype(np.float32)


IMAGE_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF", ".tiff": "TIFF"}

_FLOAT_FORMATS = (".npy", ".tif", ".tiff")

_MOST_PER_METRE = 2**31 - 1
"""Largest number of pixels per metre in a PNG file."""


_VECTOR_FORMAT = ".svg"
"""Extension of files that hold annotations as text and bars."""

_LEAST_DPI, _MOST_DPI = 36.0, 4800.0
"""Resolutions of figures: below the first, text of 8 points has 4 pixels; printers end at the second."""


def checked_dpi(dpi: Any) -> float:
    """Return a resolution in pixels per inch, or refuse it."""
    value = number_or_nan(dpi)
    if not _LEAST_DPI <= value <= _MOST_DPI:
        raise UsageError(f"a figure has {_LEAST_DPI:g} to {_MOST_DPI:,.0f} pixels per inch, not {dpi!r:.60}")
    return value


def check_image_path(path: str | os.PathLike[str], *, has_vectors: bool = False) -> str:
    """Return the extension of a picture file in lower case; `has_vectors`: SVG too."""
    moves = str(path).lower().endswith((".gif", ".apng", ".mp4", ".webm"))
    hint = f" of animations, for which there is {name_parameter('turntable')}" if moves else ""
    return find_extension(path, (*IMAGE_FORMATS, _VECTOR_FORMAT) if has_vectors else IMAGE_FORMATS, "picture", hint)


def encode_image(rendering: PictureData, extension: str, quality: int = 95) -> bytes:
    """Return the bytes of a file of `IMAGE_FORMATS` or `_VECTOR_FORMAT`; the quality of JPEG is 1 to 100."""
    if extension == _VECTOR_FORMAT:
        return _encode_svg(rendering)
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
        # Not that of the pixels in mm: JFIF stores whole dots per inch, an error of 1 % at 0.5 mm.
        options = {"quality": quality, "subsampling": 0}
    dpi = rendering.report.get("dpi")
    if dpi is not None:
        options["dpi"] = (dpi, dpi)
    elif kind != "JPEG":
        options.update(_resolution(rendering.pixel_mm))
    if kind == "PNG":
        options["pnginfo"] = _text_chunks(rendering)
    if kind == "TIFF":
        options["compression"] = "tiff_lzw"
    stream = BytesIO()
    picture.save(stream, kind, **options)
    return stream.getvalue()


def write_floats(array: NDArray[np.float32], path: str | os.PathLike[str], pixel_mm: float | None = None) -> int:
    """Write float32 pixels (h, w), NaN included, to a file with an extension of `_FLOAT_FORMATS`; return its bytes."""
    return _replace_image(path, encode_floats(array, check_float_path(path), pixel_mm))


def check_float_path(path: str | os.PathLike[str]) -> str:
    return find_extension(path, _FLOAT_FORMATS, "depth or value")


def encode_floats(array: NDArray[np.float32], extension: str, pixel_mm: float | None = None) -> bytes:
    """Return the bytes of the file that `write_floats` writes; `extension` is one of `_FLOAT_FORMATS`."""
    floats = np.ascontiguousarray(array, dtype=np.float32)
    stream = BytesIO()
    if extension == ".npy":
        np.save(stream, floats)
    else:
        load_pillow()
        from PIL import Image

        Image.fromarray(floats).save(stream, "TIFF", **_resolution(pixel_mm))
    return stream.getvalue()


def _replace_image(path: str | os.PathLike[str], content: bytes) -> int:
    return replace_file(path, lambda stream: stream.write(content), expected_bytes=len(content))


def _resolution(pixel_mm: float | None) -> dict[str, Any]:
    """Return Pillow's option for the size of a pixel in mm; PNG stores whole pixels per metre in 32 bits."""
    if pixel_mm is None or not 1.0 <= 1000.0 / pixel_mm <= _MOST_PER_METRE:
        return {}
    return {"dpi": (25.4 / pixel_mm, 25.4 / pixel_mm)}


def _describe_origin(rendering: PictureData) -> dict[str, str]:
    """Return how a picture was made, as files say it by keywords."""
    facts = {"Software": f"clrecon {package_version()}", "Mode": rendering.mode}
    camera = rendering.camera
    if camera is not None:
        from clrecon.rendering.pictures.annotations import orientation_letters

        facts["View"] = f"from {orientation_letters(-camera.basis().forward)}"
        named = {"position": camera.position, "focal point": camera.focal_point, "up": camera.up}
        lines = [f"{name} {x:.6g} {y:.6g} {z:.6g}" for name, (x, y, z) in named.items()]
        if camera.parallel_scale is not None:
            lines.append(f"parallel scale {camera.parallel_scale:.6g} mm")
        else:
            lines.append(f"view angle {camera.view_angle:.6g} degrees")
        facts["Camera"] = f"LPS mm: {'; '.join(lines)}"
    if rendering.pixel_mm is not None:
        facts["Pixel"] = f"{rendering.pixel_mm:.6g} mm"
    return facts


def _text_chunks(rendering: PictureData) -> Any:
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    for keyword, value in _describe_origin(rendering).items():
        text.add_text(keyword, value)
    return text


_SVG_ALIGN = {"l": "start", "m": "middle", "r": "end"}

_SVG_FONTS = "Helvetica, Arial, 'Liberation Sans', sans-serif"
"""Journals ask for the first; the others look alike where it is missing."""


def _encode_svg(rendering: PictureData) -> bytes:
    """Return an SVG file: the picture as PNG, and what was written on it as text and bars over it.

    With a resolution its lengths are those of the printed figure, else a pixel is a pixel of the screen.
    """
    drawing = rendering.drawing or Drawing(rendering.image)
    picture = base64.b64encode(encode_image(replace(rendering, image=drawing.ground), ".png")).decode("ascii")
    height, width = drawing.ground.shape[:2]
    dpi = rendering.report.get("dpi")
    unit, side = ("", 1.0) if dpi is None else ("mm", 25.4 / dpi)
    origin = "; ".join(f"{keyword}: {value}" for keyword, value in _describe_origin(rendering).items())
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
        f' width="{width * side:.6g}{unit}" height="{height * side:.6g}{unit}" viewBox="0 0 {width} {height}">',
        f"<desc>{escape(origin)}</desc>",
        f'<image width="{width}" height="{height}" xlink:href="data:image/png;base64,{picture}"/>',
        f'<g font-family="{_SVG_FONTS}" paint-order="stroke" stroke-linejoin="round">',
        *map(_draw_mark, drawing.marks),
        "</g>",
        "</svg>",
        "",
    ]
    return "\n".join(lines).encode()


def _draw_mark(mark: Text | Bar) -> str:
    """Return a text or bar as an element of SVG; half of its stroke lies below what is filled."""
    pen = f'fill="{mark.fill}"'
    if mark.outline is not None:
        pen += f' stroke="{mark.outline}" stroke-width="{2.0 * mark.stroke:g}"'
    if isinstance(mark, Bar):
        geometry = f'x="{mark.left:g}" y="{mark.top:g}" width="{mark.width:.6g}" height="{mark.height:g}"'
        return f"<rect {geometry} {pen}/>"
    geometry = f'x="{mark.x:g}" y="{mark.y:g}" font-size="{mark.size:.6g}" text-anchor="{_SVG_ALIGN[mark.align]}"'
    return f"<text {geometry} {pen}>{escape(mark.text)}</text>"
