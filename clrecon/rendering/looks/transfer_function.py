"""`TransferFunction`: the colour and opacity that each HU has in a picture; docs/transfer_functions.md has its text."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.looks.lighting import Lighting
from clrecon.rendering.looks.piecewise import check_ascending, check_share, evaluate_curve
from clrecon.system.arguments import as_numbers, explains_arguments, number_or_nan
from clrecon.system.base_classes import Message
from clrecon.system.files import replace_file
from clrecon.system.paths import keep_existing

_UNIT_LIMIT_MM = 1e9
"""Largest unit distance; its inverse is the smallest.  float32 holds all that a ray step computes from them."""

_HU_LIMIT = 1e6
"""Largest HU, far beyond any scale of CT values; float32 still distinguishes whole HU there."""

_END_STEP_HU = 1.0
"""How far `TransferFunction.range_hu` extends beyond a step at its end, so that both sides of it are included."""

COLUMNS = ("red", "green", "blue", "opacity")


def _checked_rows(title: str, form: str, rows: ArrayLike, width: int) -> Float64Array:
    try:
        array = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{title} is made of points {form}, each of {width} numbers: these are not") from None
    if array.ndim != 2 or array.shape[0] < 1 or array.shape[1] != width:
        raise UsageError(f"{title} is made of points {form}, not of an array of shape {array.shape}")
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        row, column = bad[0]
        names = form.strip("()").split(", ")
        raise UsageError(f"point {row + 1} of {title}: {names[column]} is {array[row, column]}, not a finite number")
    array.setflags(write=False)
    return array


class TransferFunction(Message):
    """Colour and opacity by HU, linear between points and constant beyond the first and the last.

    It is immutable: `scaled` and `shifted` return new ones.  Two are equal when they give the same picture, even if
    their names differ.

    Parameters
    ----------
    points : sequence of (hu, red, green, blue, opacity)
        At least one.  HU ascends; two points at one HU are a step, where the second counts from that HU on.  Colours
        and opacity 0 to 1.
    unit_distance : float
        Distance in mm for which the opacities of the points hold (VTK's ScalarOpacityUnitDistance): over d mm the
        opacity is ``1 - (1 - opacity) ** (d / unit_distance)``.
    gradient_opacity : sequence of (HU per mm, factor), optional
        Factor on the opacity by magnitude of the gradient, 0 to 1, linear between points, with steps as above (Levoy
        1988, "Display of surfaces from volume data").
    lighting : Lighting, optional
        The light that it was made for; None: the picture's own.
    name, description : str

    Raises
    ------
    UsageError
        There are no points; points are not five finite numbers each; HU descend, exceed a million, or are shared by
        more than two points; colours or opacities are outside 0..1; the unit distance is not positive; or the gradient
        opacity has a fault of these kinds.  The message names the point, counted from 1.
    """

    def __init__(
        self,
        points: ArrayLike,
        *,
        unit_distance: float = 1.0,
        gradient_opacity: ArrayLike | Sequence[tuple[float, float]] | None = None,
        lighting: Lighting | None = None,
        name: str = "",
        description: str = "",
    ):
        self._points = self._check_points(points)
        self._gradient_opacity = None if gradient_opacity is None else self._check_gradient(gradient_opacity)
        self._unit_distance = number_or_nan(unit_distance)
        if not 1.0 / _UNIT_LIMIT_MM <= self._unit_distance <= _UNIT_LIMIT_MM:
            raise UsageError(
                "the unit distance of a transfer function is a length in mm, above 0 and at most"
                f" {_UNIT_LIMIT_MM:g}, not {unit_distance!r}"
            )
        if not (lighting is None or isinstance(lighting, Lighting)):
            raise UsageError(f"the lighting of a transfer function is a Lighting or None, not {lighting!r}")
        if not (isinstance(name, str) and isinstance(description, str)):
            raise UsageError("name and description of a transfer function are text")
        self._lighting, self._name = lighting, name
        self._description = description

    @staticmethod
    def _check_points(rows: ArrayLike) -> Float64Array:
        title = "the transfer function"
        points = _checked_rows(title, "(hu, red, green, blue, opacity)", rows, 5)
        hu = points[:, 0]
        if np.abs(hu).max() > _HU_LIMIT:
            n = int(np.abs(hu).argmax())
            raise UsageError(f"point {n + 1} of {title} lies at {hu[n]:g} HU, beyond a million")
        check_ascending(title, "HU", hu)
        for n, column in np.argwhere((points[:, 1:] < 0) | (points[:, 1:] > 1))[:1]:
            advice = ": divide numbers up to 255 by 255" if points[:, 1:].max() > 1 else ""
            check_share(f"{COLUMNS[column]}", points[n, column + 1], n, advice)
        return points

    @staticmethod
    def _check_gradient(rows: ArrayLike) -> Float64Array:
        title = "the gradient opacity"
        points = _checked_rows(title, "(HU per mm, factor)", rows, 2)
        if points[:, 0].min() < 0 or points[:, 0].max() > _HU_LIMIT:
            raise UsageError(f"{title} goes from 0 to at most a million HU per mm")
        check_ascending(title, "HU per mm", points[:, 0])
        for n in np.flatnonzero((points[:, 1] < 0) | (points[:, 1] > 1))[:1]:
            check_share(f"the factor of {title}", points[n, 1], int(n))
        return points

    @property
    def points(self) -> Float64Array:
        """HU, red, green, blue and opacity of each point (n, 5), float64, read-only."""
        return self._points

    @property
    def unit_distance(self) -> float:
        """Distance in mm for which the opacities hold."""
        return self._unit_distance

    @property
    def gradient_opacity(self) -> Float64Array | None:
        """HU per mm and factor of each point (m, 2), float64, read-only; None without gradient opacity."""
        return self._gradient_opacity

    @property
    def lighting(self) -> Lighting | None:
        """The light that it was made for, or None."""
        return self._lighting

    @property
    def name(self) -> str:
        """Its name; may be empty."""
        return self._name

    @property
    def description(self) -> str:
        """One line about what it shows; may be empty."""
        return self._description

    @property
    def range_hu(self) -> tuple[float, float]:
        """HU beyond which the function is constant, the lower first: ``_END_STEP_HU`` more where it ends in a step."""
        hu = self._points[:, 0]
        low, high = float(hu[0]), float(hu[-1])
        alone = hu.size == 1
        return (
            low - _END_STEP_HU if alone or hu[1] == low else low,
            high + _END_STEP_HU if alone or hu[-2] == high else high,
        )

    def __call__(self, hu: ArrayLike) -> Float64Array:
        """Return red, green, blue and opacity (..., 4), float64, at HU values (...,); at a step those of its second
        point.
        """
        return evaluate_curve(self._points[:, 0], self._points[:, 1:], np.asarray(hu, dtype=np.float64))

    @explains_arguments
    def table(self, low: float, high: float, nodes: int) -> NDArray[np.float32]:
        """Return red, green, blue, opacity (nodes, 4), float32, at ``nodes`` evenly spaced HU from low to high, both
        included.

        Raises
        ------
        UsageError
            There are fewer than two nodes, or ``low`` and ``high`` are not finite or descend.
        """
        return self(_table_nodes(low, high, nodes)).astype(np.float32)

    def gradient_factor(self, magnitude: ArrayLike) -> Float64Array:
        """Return the factor on the opacity (...,), float64, at magnitudes of the gradient (...,) in HU per mm; 1
        without one.
        """
        magnitudes = as_numbers("magnitude", magnitude)
        if self._gradient_opacity is None:
            return np.ones(magnitudes.shape)
        return evaluate_curve(self._gradient_opacity[:, 0], self._gradient_opacity[:, 1:], magnitudes)[..., 0]

    @explains_arguments
    def gradient_table(self, high: float, nodes: int) -> NDArray[np.float32]:
        """Return `gradient_factor` (nodes,), float32, at ``nodes`` even magnitudes from 0 to ``high`` HU per mm.

        Raises
        ------
        UsageError
            As in `table`.
        """
        return self.gradient_factor(_table_nodes(0.0, high, nodes)).astype(np.float32)

    def changed(self, **changes: Any) -> TransferFunction:
        """Return a copy with other parameters, named as in the constructor."""
        arguments = {name: getattr(self, name) for name in ("points", "unit_distance", "gradient_opacity", "lighting")}
        return TransferFunction(**{**arguments, "name": self._name, "description": self._description, **changes})

    @explains_arguments
    def scaled(self, opacity: float) -> TransferFunction:
        """Return a copy with every opacity multiplied by ``opacity``, at most 1.

        Raises
        ------
        UsageError
            The factor is negative or not finite.
        """
        if not 0.0 <= opacity < np.inf:
            raise UsageError(f"the factor on opacities is 0 or more, not {opacity!r}")
        points = self._points.copy()
        points[:, 4] = np.minimum(points[:, 4] * opacity, 1.0)
        return self.changed(points=points)

    @explains_arguments
    def shifted(self, hu: float) -> TransferFunction:
        """Return a copy with every point moved up by ``hu``.

        Raises
        ------
        UsageError
            A point would be beyond a million HU.
        """
        points = self._points.copy()
        points[:, 0] += hu
        return self.changed(points=points)

    @classmethod
    @explains_arguments
    def from_window(cls, low: float, high: float, **parameters: Any) -> TransferFunction:
        """Return a window for projections: grey from black at ``low`` HU to white at ``high`` HU, opacity from 0 to 1.

        Parameters
        ----------
        low, high : float
            HU.  A ``low`` above ``high`` makes the lowest HU white (and opaque).
        **parameters
            Further parameters of `TransferFunction`.

        Raises
        ------
        UsageError
            ``low`` and ``high`` are equal or not finite.
        """
        if low == high:
            raise UsageError(f"a window needs two different HU, not {low:g} twice")
        ends = ((low, 0.0), (high, 1.0))
        return cls([(hu, grey, grey, grey, grey) for hu, grey in sorted(ends)], **parameters)

    @classmethod
    @explains_arguments
    def from_pyvista(
        cls, cmap: Any, opacity: Any, clim: tuple[float, float], *, unit_distance: float = 1.0, **parameters: Any
    ) -> TransferFunction:
        """Return the function that ``pyvista.Plotter.add_volume`` makes of a colour map, an opacity and limits in HU.

        Parameters
        ----------
        cmap : str, list of str or matplotlib colour map
            As pyvista takes it.
        opacity : str, float or sequence of float
            ``"linear"``, ``"sigmoid"``, ``"geom"``, ... with or without ``"_r"``, one opacity for all, or opacities
            0 to 1 spread evenly over the limits.
        clim : (float, float)
            HU of the first and of the last colour.
        unit_distance : float
            mm; pyvista's ``opacity_unit_distance``, whose default there depends on the size of the volume.
        **parameters
            Further parameters of `TransferFunction`.

        Raises
        ------
        UsageError
            pyvista does not know the colour map or the opacity.
        """
        from clrecon.rendering.looks.vtk import points_from_pyvista

        return cls(points_from_pyvista(cmap, opacity, clim), unit_distance=unit_distance, **parameters)

    @classmethod
    @explains_arguments
    def from_vtk(cls, volume_property: Any, *, voxel_mm: float = 1.0, **parameters: Any) -> TransferFunction:
        """Return the function of the first component of a vtkVolumeProperty (or pyvista's): colours, opacities, light.

        Parameters
        ----------
        volume_property : vtkVolumeProperty or pyvista.VolumeProperty
        voxel_mm : float
            Length in mm of VTK's unit of gradients: the mean of the three spacings of its volume.
        **parameters
            Further parameters of `TransferFunction`.

        Raises
        ------
        UsageError
            It has no colours or opacities, or some are out of range.
        """
        from clrecon.rendering.looks.vtk import parameters_from_vtk

        return cls(**{**parameters_from_vtk(volume_property, voxel_mm), **parameters})

    @explains_arguments
    def to_vtk(self, *, voxel_mm: float = 1.0) -> Any:
        """Return a vtkVolumeProperty: colours, opacities, unit distance, light (`Lighting()` where it has none).

        It cannot hold a light with a direction or one that fades with the gradient.  ``voxel_mm`` as in `from_vtk`.
        """
        from clrecon.rendering.looks.vtk import property_to_vtk

        return property_to_vtk(self, voxel_mm)

    @explains_arguments
    def save(self, path: str | os.PathLike[str], *, no_clobber: bool = False) -> None:
        """Write it as JSON, as docs/transfer_functions.md says; `load_transfer_function` reads it.

        With ``no_clobber`` a file of that name stays and is an error.

        Raises
        ------
        OutputError
            The file cannot be written; an older file of that name is intact.
        """
        names = {"name": self.name, "description": self.description}
        head: dict[str, Any] = {key: text for key, text in names.items() if text}
        head["unit_distance_mm"] = self.unit_distance
        if self.lighting is not None:
            head["lighting"] = {key: value for key, value in asdict(self.lighting).items() if value is not None}
        gradient = None if self.gradient_opacity is None else self.gradient_opacity.tolist()
        text = transfer_text(head, self.points.tolist(), gradient).encode("utf-8")
        with keep_existing(keep=no_clobber):
            replace_file(path, lambda stream: stream.write(text))

    def _key(self) -> tuple[Any, ...]:
        gradient = None if self._gradient_opacity is None else self._gradient_opacity.tolist()
        return self._points.tolist(), gradient, self._unit_distance, self._lighting

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, TransferFunction) else NotImplemented

    def __hash__(self) -> int:
        return hash((self._points.tobytes(), self._unit_distance, self._lighting))

    def __repr__(self) -> str:
        low, high = self._points[0, 0], self._points[-1, 0]
        name = f"{self._name!r}, " if self._name else ""
        return f"TransferFunction({name}{len(self._points)} points from {low:g} to {high:g} HU)"


def _table_nodes(low: float, high: float, nodes: int) -> Float64Array:
    if not (nodes >= 2 and np.isfinite([low, high]).all() and low <= high):
        raise UsageError(
            f"a table has two nodes or more from a lower to a higher value, not {nodes} of {low} to {high}"
        )
    return np.linspace(low, high, nodes, dtype=np.float64)


FORMAT = "clrecon transfer function"
VERSION = 1


def transfer_text(
    head: Mapping[str, Any], points: Sequence[Sequence[float]], gradient_opacity: Sequence[Sequence[float]] | None
) -> str:
    """Return a transfer function as text, its `head` first; reading it gives the same function, bit for bit."""
    first = {"format": FORMAT, "version": VERSION, **head}
    fields = [f'  "{key}": {json.dumps(value)}' for key, value in first.items()]
    fields.append(_rows_text("points", [{"hu": row[0], "color": row[1:4], "opacity": row[4]} for row in points]))
    if gradient_opacity is not None:
        rows = [{"hu_per_mm": place, "factor": factor} for place, factor in gradient_opacity]
        fields.append(_rows_text("gradient_opacity", rows))
    return "{\n" + ",\n".join(fields) + "\n}\n"


def _rows_text(name: str, rows: Sequence[Mapping[str, Any]]) -> str:
    return f'  "{name}": [\n' + ",\n".join(f"    {json.dumps(row)}" for row in rows) + "\n  ]"
