"""`MeshLook` and `PointLook`: how a mesh and how the points of a cloud are shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, field
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.rendering.looks.lighting import Lighting
from clrecon.rendering.looks.window import checked_window
from clrecon.rendering.pictures import style_checks as checks
from clrecon.rendering.pictures.styles import Color, Lit, Style, style_field
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.reformation import positive_mm
from clrecon.system.arguments import WindowName, name_parameter
from clrecon.system.color_scale import ColorScale
from clrecon.system.light_dataclass import dataclass


def _vertex_colors(value: Any) -> NDArray[np.uint8]:
    given = np.asarray(value)
    is_fine = given.ndim == 2 and given.shape[1] == 3 and given.dtype.kind in "fu"
    if is_fine and given.dtype.kind == "f":
        is_fine = bool(((given >= 0.0) & (given <= 1.0)).all())
        given = np.rint(255.0 * given) if is_fine else given
    if not is_fine or (given.dtype.kind == "u" and given.dtype != np.uint8):
        raise UsageError(
            "colours of vertices have shape (n, 3), as uint8 from 0 to 255 or as floats from 0 to 1, not shape"
            f" {np.shape(value)} and type {np.asarray(value).dtype}"
        )
    return given.astype(np.uint8)


MESH_COLORS = {"thickness": "mm thick", "error": "mm of error", "distance": "mm away"}
"""Numbers at vertices that colours show, ``thickness_mm`` and so on, with the title of their scale."""


@dataclass(frozen=True)
class MeshLook(Style, Lit):
    """The triangles of a mesh, shaded; both sides of a surface are lit.

    Parameters
    ----------
    color : str or (float, float, float), optional
        See ``clrecon.rendering.looks.colors.find_color``; default: "bone".
    opacity : float
        Of each surface, above 0 and up to 1: a ray that enters and leaves a closed mesh meets two.
    flat : bool
        Every triangle is lit by its own normal.  Else the normals of the mesh are interpolated, or, where it has
        none, those of its vertices' triangles.
    vertex_colors : array_like, shape (n, 3), optional
        A colour for each vertex, interpolated between them, in place of ``color``: uint8, or floats from 0 to 1.
    color_by : {"thickness", "error", "distance"}, optional
        Colour vertices by ``mesh.values["thickness_mm"]``, ``["error_mm"]`` (see `clrecon.fit_cortex`) or
        ``["distance_mm"]``, grey where they are NaN.
    lighting : Lighting, optional
        Default: ``Lighting()``.
    clip : Clip, optional
        The part of space that is shown; what is cut is open.
    """

    _mode: ClassVar[str] = "mesh"

    color: Color | None = style_field(None, checks.color)
    _: KW_ONLY
    opacity: float = style_field(
        1.0, checks.number("the opacity of a mesh lies above 0 and up to 1, not at", lambda share: 0.0 < share <= 1.0)
    )
    flat: bool = style_field(False, partial(checks.flag, "flat"))
    vertex_colors: ArrayLike | None = field(default=None, compare=False, metadata={"check": _vertex_colors})
    color_by: Literal["thickness", "error", "distance"] | None = style_field(
        None, checks.one_of(tuple(MESH_COLORS), f"meshes are coloured by one of {', '.join(MESH_COLORS)}")
    )
    lighting: Lighting | None = style_field(None, checks.instance_of("lighting", Lighting))
    clip: Clip | None = style_field(None, checks.instance_of("clip", Clip))

    def __post_init__(self) -> None:
        super().__post_init__()
        if sum(given is not None for given in (self.color, self.vertex_colors, self.color_by)) > 1:
            raise UsageError("a mesh has one colour, a colour for each vertex, or is coloured by numbers at them")

    def find_scale(self, values: Mapping[str, NDArray[np.floating]]) -> tuple[ColorScale, NDArray[np.floating]]:
        """Return the scale of ``color_by`` for a mesh with these numbers at its vertices, and those that it shows."""
        name = f"{self.color_by}_mm"
        scale = ColorScale.spanning(values[name]) if name in values else None
        if scale is None:
            whose = (
                "coloured by distance (PLY)" if self.color_by == "distance" else "fitted to the cortex (PLY, VTP, GLB)"
            )
            raise UsageError(f"the mesh has no {name} at its vertices: one {whose} has them")
        return scale, values[name]

    def colors_at(self, values: Mapping[str, NDArray[np.floating]]) -> NDArray[np.uint8] | None:
        """Return the colours of a mesh's vertices with these numbers; None where all have one colour."""
        if self.color_by is None:
            return None if self.vertex_colors is None else np.asarray(self.vertex_colors)
        scale, shown = self.find_scale(values)
        return scale.colors(shown)


POINT_COLORS = ("hu", "label", "removed")


@dataclass(frozen=True, kw_only=True)
class PointLook(Style, Lit):
    """Points of a cloud, each a disc that faces the camera; the nearest disc hides the others.

    Points with normals are lit after Phong.  Those without are darkened where what surrounds them is nearer, which is
    called eye-dome lighting.

    Parameters
    ----------
    radius_mm : float, optional
        Of the discs, which are at least a pixel and at most 256 pixels across; default: the mean spacing of
        the points.
    color_by : {"hu", "label", "removed"}, optional
        "hu": in grey.  "label": a colour for each label or cluster, noise (-1) dark.  "removed": label 0 grey, which
        are points that are kept, and a colour for each other label, which is the reason why points were removed.
        Default: by label where there are labels, else by HU where they differ, else ``color``.
    color : str or (float, float, float), optional
        One colour for all, see ``clrecon.rendering.looks.colors.find_color``; default: "bone".
    window : (float, float) or str, optional
        HU shown as black and white; default: the 99th percentile of the points is white, the 1st dark grey.
    lighting : Lighting, optional
        Default: ``Lighting()``.
    clip : Clip, optional
        The part of space that is shown.
    """

    _mode: ClassVar[str] = "points"

    radius_mm: float | None = style_field(None, partial(positive_mm, "the radius of points"))
    color_by: Literal["hu", "label", "removed"] | None = style_field(
        None, checks.one_of(POINT_COLORS, f"points are coloured by one of {', '.join(POINT_COLORS)}")
    )
    color: Color | None = style_field(None, checks.color)
    window: Sequence[float] | WindowName | None = style_field(None, checked_window)
    lighting: Lighting | None = style_field(None, checks.instance_of("lighting", Lighting))
    clip: Clip | None = style_field(None, checks.instance_of("clip", Clip))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.color_by is not None and self.color is not None:
            raise UsageError(f"points have one colour or are coloured by {self.color_by}, not both")
        if self.window is not None and (self.color is not None or self.color_by not in (None, "hu")):
            grey = name_parameter("color_by", "hu")
            raise UsageError(f"a window says which HU are black and white: colour the points by them ({grey})")
