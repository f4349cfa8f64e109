"""Volume properties of 3D Slicer (.vp, .vp.json, presets.xml and scenes) and opacity maps of ParaView (.json).

Slicer documents its formats in its developer guide, "Volume rendering". Each function returns the names in a text, and
for each a function that makes the parameters of a `TransferFunction`. So faulty entries do no harm if they are not
wanted.
  All of them raise `RefusedInputError` with the place in the file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any
from xml.parsers import expat

import numpy as np

from clrecon.errors import RefusedInputError
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.looks.json_fields import take_color, take_list, take_number, take_object, take_text
from clrecon.rendering.looks.lighting import UNSHADED, Lighting
from clrecon.rendering.looks.piecewise import merge_curves
from clrecon.rendering.looks.vtk import curve_from_nodes, gradient_points

Entry = tuple[str, Callable[[], dict[str, Any]]]
"""A name, empty where the file has none, and the function that makes the parameters."""

GRADIENT_VOXEL_MM = 1.0
"""Voxel size for gradients: VTK's are in HU per voxel, of a size that a file does not state, so they are taken as HU
per mm."""

_LINES = (
    "interpolation", "shade", "diffuse", "ambient", "specular", "specularPower", "scalarOpacity", "gradientOpacity",
    "colorTransfer",
)  # fmt: skip


def _number(text: str, what: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise RefusedInputError(f"{what} is {text[:64]!r}, not a finite number")
    return number


def _nodes(text: str, what: str, width: int) -> Float64Array:
    """Return nodes (n, width + 2) of ``COUNT X VALUES X VALUES ...``, with VTK's midpoint and sharpness of a straight
    part.
    """
    words = text.split()
    numbers = np.array([_number(word, f"number {n + 1} of {what}") for n, word in enumerate(words)])
    if not numbers.size or numbers[0] != numbers.size - 1 or (numbers.size - 1) % width or numbers.size == 1:
        found = max(numbers.size - 1, 0)
        said = f"{numbers[0]:g}" if numbers.size else "nothing"
        raise RefusedInputError(f"{what} says {said} and has {found} numbers after it, of {width} to a point")
    rows = numbers[1:].reshape(-1, width)
    return np.column_stack([rows, np.full(len(rows), 0.5), np.zeros(len(rows))])


def _parameters(texts: Mapping[str, str], place: Callable[[str], str]) -> dict[str, Any]:
    """Make the parameters from the words that .vp lines and XML attributes share; `place` describes the place of a
    field.
    """

    def number(name: str, default: float) -> float:
        text = texts.get(name, "").strip()
        return _number(text.split()[0], place(name)) if text else default

    for name in ("scalarOpacity", "colorTransfer"):
        if not texts.get(name, "").strip():
            raise RefusedInputError(f"{place(name)} is missing")
    opacity = curve_from_nodes(place("scalarOpacity"), _nodes(texts["scalarOpacity"], place("scalarOpacity"), 2))
    colors = curve_from_nodes(place("colorTransfer"), _nodes(texts["colorTransfer"], place("colorTransfer"), 4))
    gradient = None
    if texts.get("gradientOpacity", "").strip():
        what = place("gradientOpacity")
        gradient = gradient_points(curve_from_nodes(what, _nodes(texts["gradientOpacity"], what, 2)), GRADIENT_VOXEL_MM)
    lighting = UNSHADED
    if number("shade", 0.0) != 0.0:
        # VTK's default
        lighting = Lighting(
            number("ambient", 0.1), number("diffuse", 0.7), number("specular", 0.2), number("specularPower", 10.0)
        )
    return {"points": merge_curves(colors, opacity), "gradient_opacity": gradient, "lighting": lighting}


def read_slicer_text(text: str) -> list[Entry]:
    """Read a .vp file: nine lines, of which empty ones mean the default."""
    lines = dict(zip(_LINES, text.splitlines(), strict=False))
    return [("", lambda: _parameters(lines, lambda name: f"line {_LINES.index(name) + 1} ({name})"))]


def read_slicer_xml(data: bytes) -> list[Entry]:
    """Read every ``VolumeProperty`` of presets.xml or of a .mrml scene.  A DOCTYPE is refused, because it can define
    entities.
    """
    parser = expat.ParserCreate()
    entries: list[Entry] = []

    def refuse(*_: Any) -> None:
        raise RefusedInputError(f"line {parser.CurrentLineNumber}: it has a DOCTYPE, which files of Slicer do not have")

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag in ("VolumeProperty", "VolumePropertyNode"):
            line = parser.CurrentLineNumber
            place = f"line {line} ({attributes.get('name', tag)[:64]!r})"
            entries.append(
                (attributes.get("name", ""), lambda: _parameters(attributes, lambda name: f"{place}: {name}"))
            )

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = start
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise RefusedInputError(f"line {error.lineno}: no XML: {expat.errors.messages[error.code]}") from None
    except (ValueError, LookupError) as error:  # unknown encoding
        raise RefusedInputError(f"no XML that can be read: {error}") from None
    if not entries:
        raise RefusedInputError("it has no VolumeProperty, as presets.xml of 3D Slicer has them")
    return entries


def _json_nodes(value: Any, where: str, is_color: bool) -> list[list[float]]:
    rows = []
    points = take_list(take_object(value, where, needed=["points"])["points"], f"{where}.points")
    for n, point in enumerate(points):
        place = f"{where}.points[{n}]"
        fields = take_object(point, place, needed=["x", "color" if is_color else "y"])
        row = [take_number(fields["x"], f"{place}.x")]
        row += take_color(fields["color"], f"{place}.color") if is_color else [take_number(fields["y"], f"{place}.y")]
        for name, default in (("midpoint", 0.5), ("sharpness", 0.0)):
            row.append(take_number(fields.get(name, default), f"{place}.{name}"))
        rows.append(row)
    return rows


def _json_parameters(value: Any, where: str) -> dict[str, Any]:
    components = take_object(value, where, needed=["components"])["components"]
    where = f"{where}.components[0]"
    # Voxels of CT have one component.
    fields = take_object(take_list(components, where.removesuffix("[0]"))[0], where, needed=["scalarOpacity"])
    place = f"{where}.scalarOpacity"
    opacity = curve_from_nodes(place, _json_nodes(fields["scalarOpacity"], place, False))
    if "rgbTransferFunction" in fields:
        place = f"{where}.rgbTransferFunction"
        colors = curve_from_nodes(place, _json_nodes(fields["rgbTransferFunction"], place, True), steps=True)
    else:
        place = f"{where}.grayTransferFunction"
        take_object(fields, where, needed=["grayTransferFunction"])
        positions, grey = curve_from_nodes(place, _json_nodes(fields["grayTransferFunction"], place, False))
        colors = positions, np.repeat(grey, 3, axis=1)
    gradient = None
    if "gradientOpacity" in fields and not fields.get("disableGradientOpacity", False):
        place = f"{where}.gradientOpacity"
        nodes = _json_nodes(fields["gradientOpacity"], place, False)
        gradient = gradient_points(curve_from_nodes(place, nodes), GRADIENT_VOXEL_MM)
    lighting = UNSHADED
    if fields.get("shade", False):
        light = take_object(fields.get("lighting", {}), f"{where}.lighting")
        defaults = {"ambient": 0.1, "diffuse": 0.7, "specular": 0.2, "specularPower": 10.0}
        ambient, diffuse, specular, power = (
            take_number(light.get(key, default), f"{where}.lighting.{key}") for key, default in defaults.items()
        )
        lighting = Lighting(ambient, diffuse, specular, power)
    unit = take_number(fields.get("scalarOpacityUnitDistance", 1.0), f"{where}.scalarOpacityUnitDistance")
    return {
        "points": merge_curves(colors, opacity),
        "gradient_opacity": gradient,
        "lighting": lighting,
        "unit_distance": unit,
    }


def _name(value: Any, field: str) -> str:
    name = value.get(field, "") if isinstance(value, dict) else ""
    return name if isinstance(name, str) else ""


def read_slicer_json(value: Any) -> list[Entry]:
    """Read a .vp.json file; of each property only the first component."""
    properties = take_list(value["volumeProperties"], "volumeProperties")

    def entry(n: int) -> Entry:
        return _name(properties[n], "name"), lambda: _json_parameters(properties[n], f"volumeProperties[{n}]")

    return [entry(n) for n in range(len(properties))]


def _paraview_parameters(value: Any, where: str) -> dict[str, Any]:
    fields = take_object(value, where, needed=["RGBPoints"])
    if "Points" not in fields:
        raise RefusedInputError(
            f"{where} has colours (RGBPoints) but no opacities (Points): save them with the preset in ParaView"
        )
    space = take_text(fields.get("ColorSpace", "RGB"), f"{where}.ColorSpace")
    if space != "RGB":
        raise RefusedInputError(f"{where} goes through colours in {space[:64]!r}: only RGB is read")
    curves = []
    for name, width in (("RGBPoints", 4), ("Points", 4)):
        place = f"{where}.{name}"
        numbers = [take_number(x, f"{place}[{n}]") for n, x in enumerate(take_list(fields[name], place))]
        if len(numbers) % width:
            raise RefusedInputError(f"{place} has {len(numbers)} numbers, of {width} to a point")
        rows = np.reshape(numbers, (-1, width))
        if name == "RGBPoints":
            rows = np.column_stack([rows, np.full(len(rows), 0.5), np.zeros(len(rows))])
        curves.append(curve_from_nodes(place, rows))
    return {"points": merge_curves(curves[0], curves[1])}


def read_paraview_json(value: list[Any]) -> list[Entry]:
    """Read a list of ParaView's colour maps with opacities; positions are HU."""

    def entry(n: int) -> Entry:
        return _name(value[n], "Name"), lambda: _paraview_parameters(value[n], f"map {n + 1}")

    return [entry(n) for n in range(len(take_list(value, "the file")))]
