"""`Rendering`: a picture with its depths and its camera."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.rendering.pictures.picture_data import PictureData
from clrecon.system.arguments import explains_arguments
from clrecon.system.paths import keep_existing


@dataclass
class Rendering(PictureData):
    """A picture of a volume.

    Attributes
    ----------
    image : ndarray, shape (h, w, 4), uint8
        Red, green, blue and opacity, not premultiplied; row 0 is the top.
    depth : ndarray, shape (h, w), float32
        Distance along the ray to the first hit in mm, see ``Camera.position``; NaN where nothing is hit.
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
    """

    def __repr__(self) -> str:
        width, height = self.size
        return f"<Rendering {self.mode}, {width} x {height} pixels, camera {self.camera}>"

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

        opacity = self.image[..., 3:].astype(np.float32) / np.float32(255.0)
        behind = (255.0 * find_color(color)).astype(np.float32)
        mixed = opacity * self.image[..., :3] + (np.float32(1.0) - opacity) * behind
        image = np.full_like(self.image, 255)
        image[..., :3] = np.rint(mixed)
        return replace(self, image=image)

    @explains_arguments
    def annotated(self, *, letters: bool = False, scale_bar: bool = False, caption: str | None = None) -> Rendering:
        """Return the same picture with sides of the patient, a scale bar or a line of text.

        See ``clrecon.rendering.pictures.annotations.annotate``.
        """
        from clrecon.rendering.pictures.annotations import annotate

        image = annotate(self, letters=letters, scale_bar=scale_bar, caption=caption)
        return self if image is self.image else replace(self, image=image)

    @explains_arguments
    def save(self, path: str | os.PathLike[str], *, quality: int = 95, no_clobber: bool = False) -> int:
        """Write the picture to a file; the extension chooses the format.

        Parameters
        ----------
        path : str or path
            ``.png`` and ``.tif`` keep the opacity; for parallel pictures they state the size of a pixel as resolution.
            ``.png`` also states how the picture was made.  ``.jpg`` accepts opaque pictures only.
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
        from clrecon.rendering.pictures.image_files import write_image

        with keep_existing(no_clobber):
            return write_image(self, path, quality)

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
        from clrecon.rendering.pictures.image_files import write_floats

        with keep_existing(no_clobber):
            return write_floats(self.expected_depth if expected else self.depth, path, self.pixel_mm)

    @explains_arguments
    def save_values(self, path: str | os.PathLike[str], *, no_clobber: bool = False) -> int:
        """Write ``values`` as `save_depth` writes depths.

        Raises
        ------
        UsageError
            The mode has no values.
        """
        from clrecon.rendering.pictures.image_files import write_floats

        if self.values is None:
            having = "mip, minip, mean, drr, slice and cpr"
            raise UsageError(f"a picture of mode {self.mode} has no values: {having} have them")
        with keep_existing(no_clobber):
            return write_floats(self.values, path, self.pixel_mm)

    @explains_arguments
    def to_pyvista(self, form: str = "points", *, expected: bool = False, distance: float | None = None) -> Any:
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
        """Return the PNG bytes that a notebook shows."""
        from clrecon.rendering.pictures.image_files import encode_image

        return encode_image(self, ".png")
