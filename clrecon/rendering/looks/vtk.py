"""Transfer functions to and from VTK's volume properties, and from pyvista's colour maps and opacities."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.looks.lighting import UNSHADED, Lighting
from clrecon.rendering.looks.piecewise import merge_curves, straighten_curve
from clrecon.system.arguments import as_numbers

STEP_HU = 1e-4
"""Nodes nearer than this form a step: programs that cannot keep two nodes at one place move one by a rounding unit."""

_COLORS_A_PART = 64
"""Number of straight parts between two nodes that replace a way through a colour space other than RGB."""


def curve_from_nodes(
    title: str, nodes: Iterable[ArrayLike], *, clamped: bool = True, steps: bool = False
) -> tuple[Float64Array, Float64Array]:
    """Make a curve from VTK's nodes, each (position, values..., midpoint, sharpness).

    Nodes within `STEP_HU` form one step, of which the first and the last node are used.  Without `clamped` the function
    is 0 beyond its ends; `steps` as in `straighten_curve`.
    """
    rows = np.array(list(nodes), dtype=np.float64)
    if rows.size == 0:
        raise UsageError(f"{title} has no points")
    positions = rows[:, 0].copy()
    back = np.flatnonzero(np.diff(positions) < 0)
    if back.size:
        n = int(back[0])
        raise UsageError(f"{title} goes back from {positions[n]:g} at point {n + 1} to {positions[n + 1]:g}")
    for n in np.flatnonzero(np.diff(positions) < STEP_HU)[::-1]:
        positions[n] = positions[n + 1]
    same_as_before = np.concatenate([[False], positions[1:] == positions[:-1]])
    is_kept = ~(same_as_before & np.concatenate([same_as_before[1:], [False]]))
    rows, positions = rows[is_kept], positions[is_kept]
    positions, values = straighten_curve(positions, rows[:, 1:-2], rows[:, -2], rows[:, -1], steps)
    if not clamped:
        zero = np.zeros((1, values.shape[1]))
        starts, ends = int(np.any(values[0] != 0)), int(np.any(values[-1] != 0))
        positions = np.concatenate([positions[:1][:starts], positions, positions[-1:][:ends]])
        values = np.concatenate([zero[:starts], values, zero[:ends]])
    return positions, values


def _nodes(function: Any, width: int) -> list[list[float]]:
    rows = []
    for n in range(function.GetSize()):
        row = [0.0] * width
        function.GetNodeValue(n, row)
        rows.append(row)
    return rows


def _opacity_curve(title: str, function: Any) -> tuple[Float64Array, Float64Array]:
    return curve_from_nodes(title, _nodes(function, 4), clamped=bool(function.GetClamping()))


def _color_curve(function: Any) -> tuple[Float64Array, Float64Array]:
    """Return the colours of a vtkColorTransferFunction; ways through HSV, Lab etc. become straight parts in RGB."""
    title, nodes = "its colour function", _nodes(function, 6)
    if function.GetColorSpace() != 0:  # VTK_CTF_RGB
        positions = np.unique([node[0] for node in nodes])
        ways = [
            np.linspace(*ends, _COLORS_A_PART, endpoint=False) for ends in zip(positions, positions[1:], strict=False)
        ]
        nodes = [[x, *function.GetColor(x), 0.5, 0.0] for x in np.concatenate([*ways, positions[-1:]]).tolist()]
    if function.GetScale() != 0:  # VTK_CTF_LINEAR
        raise UsageError("its colour function is logarithmic: HU have no logarithm")
    return curve_from_nodes(title, nodes, clamped=bool(function.GetClamping()), steps=True)


def _check_voxel(voxel_mm: float) -> None:
    if not 0.0 < voxel_mm < np.inf:
        raise UsageError(f"the mean spacing of a volume is a length in mm, not {voxel_mm!r}")


def parameters_from_vtk(volume_property: Any, voxel_mm: float) -> dict[str, Any]:
    """Return the parameters of `TransferFunction` from a vtkVolumeProperty: see `TransferFunction.from_vtk`."""
    _check_voxel(voxel_mm)
    try:
        if volume_property.GetColorChannels(0) == 1:
            grey, values = _opacity_curve("its grey function", volume_property.GetGrayTransferFunction(0))
            colors = grey, np.repeat(values, 3, axis=1)
        else:
            colors = _color_curve(volume_property.GetRGBTransferFunction(0))
        opacity = _opacity_curve("its scalar opacity", volume_property.GetScalarOpacity(0))
        gradient = None
        # Asked for a missing function, VTK makes an empty or constant one.
        if not volume_property.GetDisableGradientOpacity(0):
            function = volume_property.GetGradientOpacity(0)
            gradient = gradient_points(_opacity_curve("its gradient opacity", function), voxel_mm)
        lighting = UNSHADED
        if volume_property.GetShade(0):
            lighting = Lighting(
                volume_property.GetAmbient(0),
                volume_property.GetDiffuse(0),
                volume_property.GetSpecular(0),
                volume_property.GetSpecularPower(0),
            )
        unit_distance = volume_property.GetScalarOpacityUnitDistance(0)
    except AttributeError as error:
        raise UsageError(f"this is no vtkVolumeProperty: {error}") from None
    return {
        "points": merge_curves(colors, opacity),
        "unit_distance": unit_distance,
        "gradient_opacity": gradient,
        "lighting": lighting,
    }


def gradient_points(curve: tuple[Float64Array, Float64Array], voxel_mm: float) -> Float64Array | None:
    """Return the points of a gradient opacity in HU per mm from a curve in HU per `voxel_mm`; None if it is 1."""
    positions, factors = curve
    if np.all(factors == 1.0):
        return None
    return np.column_stack([positions / voxel_mm, factors])


def _separate_steps(positions: Float64Array) -> list[float]:
    """Return positions that are all different: VTK keeps one node at a place."""
    apart = positions.copy()
    step = np.flatnonzero(positions[1:] == positions[:-1])
    apart[step] = np.nextafter(positions[step], -np.inf)
    return [float(position) for position in apart]


def property_to_vtk(function: Any, voxel_mm: float) -> Any:
    """Make a vtkVolumeProperty from a `TransferFunction`: see `TransferFunction.to_vtk`."""
    _check_voxel(voxel_mm)
    from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
    from vtkmodules.vtkRenderingCore import vtkColorTransferFunction, vtkVolumeProperty

    colors, opacity = vtkColorTransferFunction(), vtkPiecewiseFunction()
    for hu, (red, green, blue, alpha) in zip(
        _separate_steps(function.points[:, 0]), function.points[:, 1:].tolist(), strict=True
    ):
        colors.AddRGBPoint(hu, red, green, blue)
        opacity.AddPoint(hu, alpha)
    vtk_property = vtkVolumeProperty()
    vtk_property.SetColor(colors)
    vtk_property.SetScalarOpacity(opacity)
    vtk_property.SetScalarOpacityUnitDistance(function.unit_distance)
    vtk_property.SetInterpolationTypeToLinear()
    if function.gradient_opacity is None:
        vtk_property.DisableGradientOpacityOn()
    else:
        gradient = vtkPiecewiseFunction()
        places = _separate_steps(function.gradient_opacity[:, 0])
        for gradient_hu, factor in zip(places, function.gradient_opacity[:, 1].tolist(), strict=True):
            gradient.AddPoint(gradient_hu * voxel_mm, factor)
        vtk_property.SetGradientOpacity(gradient)
    lighting = Lighting() if function.lighting is None else function.lighting
    vtk_property.SetShade(lighting.shades)
    vtk_property.SetAmbient(lighting.ambient)
    vtk_property.SetDiffuse(lighting.diffuse)
    vtk_property.SetSpecular(lighting.specular)
    vtk_property.SetSpecularPower(lighting.specular_power)
    return vtk_property


def points_from_pyvista(cmap: Any, opacity: Any, clim: tuple[float, float]) -> Float64Array:
    """Return the points of `TransferFunction` from pyvista's lookup table: see `TransferFunction.from_pyvista`."""
    import pyvista

    limits = as_numbers("clim", clim)
    if limits.shape != (2,) or not (np.isfinite(limits).all() and limits[0] < limits[1]):
        raise UsageError(f"the limits of a colour map are a lower and a higher HU, not {clim!r}")
    if not isinstance(opacity, (str, float, int)):
        opacity = np.asarray(opacity, dtype=np.float64)
        if opacity.ndim != 1 or opacity.size < 2 or not np.all((opacity >= 0) & (opacity <= 1)):
            raise UsageError("opacities for a colour map are two or more numbers between 0 and 1")
    try:
        table = pyvista.LookupTable()
        table.apply_cmap(cmap, 256)
        # One opacity for each colour is used without change; it then goes up to 255.
        exact = not isinstance(opacity, (str, float, int)) and opacity.size == table.n_values
        table.apply_opacity(opacity * 255.0 if exact else opacity)
        table.scalar_range = limits.tolist()
        colors, opacities = table.to_color_tf(), table.to_opacity_tf()
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise UsageError(f"pyvista does not take this colour map or opacity: {str(error).splitlines()[0]}") from None
    return merge_curves(_color_curve(colors), _opacity_curve("the opacity", opacities))
