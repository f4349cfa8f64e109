"""`Rendering`: a picture with its depths and its camera."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.rendering.pictures.picture_data import PictureData

__all__ = ["Rendering"]


@dataclass
class Rendering(PictureData):
    """A picture of a volume.

    Attributes
    ----------
    image : ndarray, shape (h, w, 4), uint8
        Red, green, blue and opacity, not premultiplied; row 0 is the top.
    depth : ndarray, shape (h, w), float32
        Way along the ray to the first hit in mm, see `Camera.position`; NaN where nothing is hit.
    expected_depth : ndarray, shape (h, w), float32
        Mean way in mm of all that the pixel shows, weighted with what each sample adds to it; NaN where nothing is.
    camera : Camera or None
        None where the picture is no projection (curved reformations).
    values : ndarray, shape (h, w), float32, or None
        HU of each pixel, for modes that show values (mip, minip, mean, slice, cpr); NaN outside of the volume.  In drr
        the water in mm that attenuates as much as all that lies along the ray, 0 outside of the volume.
    mode : str
    report : dict
        How it was made, free of patient data.  ``"pixel_mm"`` says the side of a pixel where no camera does.
    """

    def __repr__(self) -> str:
        width, height = self.size
        return f"<Rendering {self.mode}, {width} x {height} pixels, camera {self.camera}>"

    def with_background(self, color: str | Sequence[float]) -> Rendering:
        """The same picture before a colour, opaque.

        Parameters
        ----------
        color : str or (float, float, float)
            See `clrecon.rendering.looks.colors.find_color`.

        Returns
        -------
        Rendering
            With an `image` of its own; it shares the other arrays.
        """
        from clrecon.rendering.looks.colors import find_color

        opacity = self.image[..., 3:].astype(np.float32) / np.float32(255.0)
        behind = (255.0 * find_color(color)).astype(np.float32)
        mixed = opacity * self.image[..., :3] + (np.float32(1.0) - opacity) * behind
        image = np.full_like(self.image, 255)
        image[..., :3] = np.rint(mixed)
        return replace(self, image=image)

    def annotated(self, *, letters: bool = False, scale_bar: bool = False, caption: str | None = None) -> Rendering:
        """The same picture with sides of the patient, a scale bar or a line of text drawn in.

        See `clrecon.rendering.pictures.annotations.annotate`.
        """
        from clrecon.rendering.pictures.annotations import annotate

        image = annotate(self, letters=letters, scale_bar=scale_bar, caption=caption)
        return self if image is self.image else replace(self, image=image)

    def save(self, path: str | os.PathLike[str], *, quality: int = 95) -> int:
        """Write the picture to a file whose extension says the format.

        Parameters
        ----------
        path : str or path
            ``.png`` and ``.tif`` keep the opacity and say the mm of a pixel as resolution where the picture is
            parallel; PNG also says how it was made.  ``.jpg`` takes opaque pictures alone.
        quality : int
            Of JPEG, 1 to 100.

        Returns
        -------
        int
            Size of the file in bytes.

        Raises
        ------
        UsageError
            Another extension, or opacity that the format would lose.
        OutputError
            The file cannot be written; an older one of that name is intact.
        """
        from clrecon.rendering.pictures.image_files import write_image

        return write_image(self, path, quality)

    def save_depth(self, path: str | os.PathLike[str], *, expected: bool = False) -> int:
        """Write `depth` in mm to ``.npy`` or, as float32 with NaN, to ``.tif``.

        Parameters
        ----------
        path : str or path
        expected : bool
            `expected_depth` in its place.

        Returns
        -------
        int
            Size of the file in bytes.
        """
        from clrecon.rendering.pictures.image_files import write_floats

        return write_floats(self.expected_depth if expected else self.depth, path, self.pixel_mm)

    def save_values(self, path: str | os.PathLike[str]) -> int:
        """Write `values` as `save_depth` writes depths.

        Raises
        ------
        UsageError
            The mode has none.
        """
        from clrecon.rendering.pictures.image_files import write_floats

        if self.values is None:
            having = "mip, minip, mean, drr, slice and cpr"
            raise UsageError(f"a picture of mode {self.mode} has no values: {having} have them")
        return write_floats(self.values, path, self.pixel_mm)

    def to_pyvista(self, form: str = "points", *, expected: bool = False, distance: float | None = None) -> Any:
        """Return the picture as something that a PyVista scene in LPS mm can hold beside meshes.

        Show it with ``plotter.add_mesh(data, scalars="RGBA", rgba=True, lighting=False)``, or let
        `clrecon.viewer.add_rendering` do it.  Field arrays ``SPACE`` and ``UNIT`` say what the coordinates are.

        Parameters
        ----------
        form : {"points", "plane"}
            ``"points"``: ``pyvista.PolyData`` with a point for each pixel that hits something, where its ray does,
            with point data ``RGBA``, ``depth`` (mm) and, where there are `values`, ``HU``.
            ``"plane"``: ``pyvista.ImageData`` with a cell for each pixel, across the view, with cell data ``RGBA``
            and, where there are `values`, ``HU``; seen by the picture's camera it is the picture.
        expected : bool
            Points at the expected depth, not at the first hit.
        distance : float, optional
            Of the plane from the camera, mm along the view; default: through the focal point.

        Raises
        ------
        UsageError
            The picture has no camera, or hits nothing that could be points; no such form or distance.
        """
        from clrecon.rendering.pictures.vtk import rendering_to_pyvista

        return rendering_to_pyvista(self, form, expected=expected, distance=distance)

    def _repr_png_(self) -> bytes:
        """What a notebook shows."""
        from clrecon.rendering.pictures.image_files import encode_image

        return encode_image(self, ".png")
