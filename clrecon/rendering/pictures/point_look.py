"""`PointLook`: how the points of a cloud are shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

from clrecon.errors import UsageError
from clrecon.rendering.looks.lighting import Lighting
from clrecon.rendering.looks.window import checked_window
from clrecon.rendering.pictures import style_checks as checks
from clrecon.rendering.pictures.styles import Style, style_field
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.plane import positive_mm
from clrecon.system.arguments import name_parameter

POINT_COLORS = ("hu", "label", "removed")


@dataclass(frozen=True, kw_only=True)
class PointLook(Style):
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
    color_by: str | None = style_field(
        None, checks.one_of(POINT_COLORS, f"points are coloured by one of {', '.join(POINT_COLORS)}")
    )
    color: str | Sequence[float] | None = style_field(None, checks.color)
    window: Sequence[float] | str | None = style_field(None, checked_window)
    lighting: Lighting | None = style_field(None, checks.instance_of("lighting", Lighting))
    clip: Clip | None = style_field(None, checks.instance_of("clip", Clip))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.color_by is not None and self.color is not None:
            raise UsageError(f"points have one colour or are coloured by {self.color_by}, not both")
        if self.window is not None and (self.color is not None or self.color_by not in (None, "hu")):
            grey = name_parameter("color_by", "hu")
            raise UsageError(f"a window says which HU are black and white: colour the points by them ({grey})")

    @property
    def light(self) -> Lighting:
        """The lighting that is used."""
        return self.lighting or Lighting()
