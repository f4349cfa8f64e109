"""`load_transfer_function`: reads every kind of file with transfer functions.

Of other programs' it reads volume properties of 3D Slicer (.vp, .vp.json, presets.xml and scenes; documented in its
developer guide, "Volume rendering") and opacity maps of ParaView (.json).  Readers return the names in a text, and for
each a function that makes the parameters of a `TransferFunction`: faulty entries do no harm if they are not wanted.
JSON from unknown sources is read strictly: every refusal names the field and its place.
"""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NoReturn
from xml.parsers import expat

import numpy as np

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.looks.lighting import UNSHADED, Lighting
from clrecon.rendering.looks.piecewise import merge_curves
from clrecon.rendering.looks.transfer_function import FORMAT, VERSION, TransferFunction
from clrecon.rendering.looks.vtk import curve_from_nodes, gradient_points
from clrecon.system.arguments import explains_arguments
from clrecon.system.paths import read_regular
from clrecon.system.text import escape_text

_SIZE_LIMIT = 1_000_000
"""Bytes: presets.xml of 3D Slicer has 12 kB."""
_NAMES_LISTED = 60

_FIELDS = ("format", "version", "name", "description", "unit_distance_mm", "points", "gradient_opacity", "lighting")
_LIGHT = ("ambient", "diffuse", "specular", "specular_power", "soft_gradient", "direction")


@explains_arguments
def load_transfer_function(path: str | os.PathLike[str], name: str | None = None) -> TransferFunction:
    """Read a transfer function: clrecon's JSON, 3D Slicer's .vp, .vp.json, presets.xml and .mrml, ParaView's .json.

    The kind is told from the content.  Of Slicer's files only .vp.json keeps a unit distance; for the others it is 1
    mm, as in Slicer.  Their gradient opacity is in HU per voxel and is taken as HU per mm; where it is 1 everywhere, as
    in all presets of Slicer, it is left out.

    Parameters
    ----------
    path : path
    name : str, optional
        Name (in any case) or number (from 1) of the wanted function in a file with several.

    Returns
    -------
    TransferFunction
        With the light of the file (``UNSHADED`` where its shading is off; None where the format has no light).

    Raises
    ------
    UsageError
        The file does not exist, does not contain the name, or holds several functions and no name was given; the
        message lists the names.
    RefusedInputError
        The file is not a regular file, is larger than a megabyte, has an unknown format, or contains an error; the
        message has the file, the field and its place.
    """
    shown = repr(Path(path).name[:200])
    try:
        found_name, make = _choose_entry(_entries(_read_file(Path(path), shown)), name, shown)
        parameters = make()
        parameters["name"] = parameters.get("name", found_name)
        return TransferFunction(**parameters)
    except RefusedInputError as error:
        raise RefusedInputError(f"{shown}: {error}") from None
    except UsageError as error:
        if isinstance(error, _Choice):
            raise UsageError(str(error)) from None
        raise RefusedInputError(f"{shown}: {error}") from None


class _Choice(UsageError):
    """The caller's choice is wrong, not the file."""


def _read_file(path: Path, shown: str) -> bytes:
    try:
        status = path.stat()
    except FileNotFoundError:
        raise _Choice(f"there is no file {escape_text(str(path), 200)} with a transfer function") from None
    except (OSError, ValueError) as error:
        raise RefusedInputError(f"it cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if stat.S_ISDIR(status.st_mode):
        raise _Choice(f"{shown} is a folder: give the file with the transfer function")
    if not stat.S_ISREG(status.st_mode):
        raise RefusedInputError("it is no regular file")
    try:
        return read_regular(path, _SIZE_LIMIT)
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise RefusedInputError(f"{error.strerror}: no transfer function is") from None
        raise RefusedInputError(f"it cannot be read: {error.strerror or error}") from None


def _entries(data: bytes) -> list[Entry]:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or data.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"<"):
        return read_slicer_xml(data)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RefusedInputError(f"byte {error.start} is no UTF-8 text") from None
    start = text.lstrip()[:1]
    if start in ("{", "["):
        return _json_entries(parse_json(text))
    if start.isdigit():
        lines = dict(zip(_LINES, text.splitlines(), strict=False))
        return [("", lambda: _slicer_parameters(lines, lambda name: f"line {_LINES.index(name) + 1} ({name})"))]
    raise RefusedInputError(
        "its form is not known: JSON of clrecon, 3D Slicer's .vp, .vp.json and presets.xml, and ParaView's .json are"
    )


def _json_entries(value: Any) -> list[Entry]:
    if isinstance(value, list):
        return read_paraview_json(value)
    if "volumeProperties" in value:
        return read_slicer_json(value)
    if "format" not in value:
        raise RefusedInputError(f'it has no field "format": "{FORMAT}" and no "volumeProperties" of 3D Slicer')
    name = value.get("name", "")
    return [(name if isinstance(name, str) else "", lambda: _own_parameters(value))]


def _choose_entry(entries: list[Entry], name: str | None, shown: str) -> Entry:
    names = [entry_name or str(n) for n, (entry_name, _) in enumerate(entries, start=1)]
    listed = ", ".join(f"{entry!r}"[:66] for entry in names[:_NAMES_LISTED])
    listed += f" and {len(names) - _NAMES_LISTED} more" if len(names) > _NAMES_LISTED else ""
    if name is None:
        if len(entries) > 1:
            raise _Choice(f"{shown} has {len(entries)} transfer functions, choose one by name: {listed}")
        return entries[0]
    wanted = name.strip().casefold()
    matches = [n for n, entry in enumerate(names) if entry.casefold() == wanted]
    if not matches and wanted.isascii() and wanted.isdigit() and 1 <= int(wanted[:9]) <= len(entries):
        matches = [int(wanted[:9]) - 1]
    if len(matches) != 1:
        state = f"has {len(matches)} transfer functions" if matches else "has no transfer function"
        raise _Choice(f"{shown} {state} named {name[:64]!r}; there are: {listed}")
    return entries[matches[0]]


def _own_parameters(value: dict[str, Any]) -> dict[str, Any]:
    source = "the file"
    take_object(value, source, needed=("format", "version"))
    if value["format"] != FORMAT:
        raise RefusedInputError(f'its format is {value["format"]!r:.64}, not "{FORMAT}"')
    if value["version"] != VERSION or isinstance(value["version"], bool):
        raise RefusedInputError(f"its version is {value['version']!r:.64}: this clrecon reads version {VERSION}")
    take_object(value, source, known=_FIELDS, needed=("points",))
    parameters: dict[str, Any] = {
        "points": [_own_point(point, f"points[{n}]") for n, point in enumerate(take_list(value["points"], "points"))],
        "unit_distance": take_number(value.get("unit_distance_mm", 1.0), "unit_distance_mm"),
        "name": take_text(value.get("name", ""), "name"),
        "description": take_text(value.get("description", ""), "description"),
    }
    if value.get("gradient_opacity") is not None:
        rows = []
        for n, point in enumerate(take_list(value["gradient_opacity"], "gradient_opacity")):
            path, names = f"gradient_opacity[{n}]", ("hu_per_mm", "factor")
            fields = take_object(point, path, known=names, needed=names)
            rows.append([take_number(fields[name], f"{path}.{name}") for name in names])
        parameters["gradient_opacity"] = rows
    if value.get("lighting") is not None:
        light = dict(take_object(value["lighting"], "lighting", known=_LIGHT))
        for name in _LIGHT[:5]:
            if name in light:
                light[name] = take_number(light[name], f"lighting.{name}")
        parameters["lighting"] = Lighting(**light)
    return parameters


def _own_point(point: Any, path: str) -> tuple[float, ...]:
    names = ("hu", "color", "opacity")
    fields = take_object(point, path, known=names, needed=names)
    hu, opacity = (take_number(fields[name], f"{path}.{name}") for name in ("hu", "opacity"))
    return hu, *take_color(fields["color"], f"{path}.color"), opacity


Entry = tuple[str, Callable[[], dict[str, Any]]]
"""A name, empty where the file has none, and the function that makes the parameters."""

_GRADIENT_VOXEL_MM = 1.0
"""Voxel size for gradients: VTK's are in HU per voxel of a size that no file states; they are taken as HU per mm."""

_LINES = (
    "interpolation", "shade", "diffuse", "ambient", "specular", "specularPower", "scalarOpacity", "gradientOpacity",
    "colorTransfer",
)  # fmt: skip


def _parse_number(text: str, subject: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise RefusedInputError(f"{subject} is {text[:64]!r}, not a finite number")
    return number


def _parse_nodes(text: str, subject: str, width: int) -> Float64Array:
    """Return nodes (n, width + 2) of ``COUNT X VALUES ...``, with VTK's midpoint and sharpness of a straight part."""
    words = text.split()
    numbers = np.array([_parse_number(word, f"number {n + 1} of {subject}") for n, word in enumerate(words)])
    if not numbers.size or numbers[0] != numbers.size - 1 or (numbers.size - 1) % width or numbers.size == 1:
        count = max(numbers.size - 1, 0)
        stated = f"{numbers[0]:g}" if numbers.size else "nothing"
        raise RefusedInputError(f"{subject} says {stated} and has {count} numbers after it, of {width} to a point")
    rows = numbers[1:].reshape(-1, width)
    return np.column_stack([rows, np.full(len(rows), 0.5), np.zeros(len(rows))])


def _slicer_parameters(texts: Mapping[str, str], path: Callable[[str], str]) -> dict[str, Any]:
    """Make the parameters from the words that .vp lines and XML attributes share; `path` says where a field is."""

    def number(name: str, default: float) -> float:
        text = texts.get(name, "").strip()
        return _parse_number(text.split()[0], path(name)) if text else default

    for name in ("scalarOpacity", "colorTransfer"):
        if not texts.get(name, "").strip():
            raise RefusedInputError(f"{path(name)} is missing")
    opacity = curve_from_nodes(path("scalarOpacity"), _parse_nodes(texts["scalarOpacity"], path("scalarOpacity"), 2))
    colors = curve_from_nodes(path("colorTransfer"), _parse_nodes(texts["colorTransfer"], path("colorTransfer"), 4))
    gradient = None
    if texts.get("gradientOpacity", "").strip():
        field = path("gradientOpacity")
        gradient = gradient_points(
            curve_from_nodes(field, _parse_nodes(texts["gradientOpacity"], field, 2)), _GRADIENT_VOXEL_MM
        )
    lighting = UNSHADED
    if number("shade", 0.0) != 0.0:
        # VTK's default
        lighting = Lighting(
            number("ambient", 0.1), number("diffuse", 0.7), number("specular", 0.2), number("specularPower", 10.0)
        )
    return {"points": merge_curves(colors, opacity), "gradient_opacity": gradient, "lighting": lighting}


def read_slicer_xml(data: bytes) -> list[Entry]:
    """Read every ``VolumeProperty`` of presets.xml or of a .mrml scene; no DOCTYPE, which can define entities."""
    parser = expat.ParserCreate()
    entries: list[Entry] = []

    def refuse(*_: Any) -> None:
        raise RefusedInputError(f"line {parser.CurrentLineNumber}: it has a DOCTYPE, which files of Slicer do not have")

    def start_element(tag: str, attributes: dict[str, str]) -> None:
        if tag in ("VolumeProperty", "VolumePropertyNode"):
            path = f"line {parser.CurrentLineNumber} ({attributes.get('name', tag)[:64]!r})"
            entries.append(
                (attributes.get("name", ""), lambda: _slicer_parameters(attributes, lambda name: f"{path}: {name}"))
            )

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = start_element
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise RefusedInputError(f"line {error.lineno}: no XML: {expat.errors.messages[error.code]}") from None
    except (ValueError, LookupError) as error:  # unknown encoding
        raise RefusedInputError(f"no XML that can be read: {error}") from None
    if not entries:
        raise RefusedInputError("it has no VolumeProperty, as presets.xml of 3D Slicer has them")
    return entries


def _json_nodes(value: Any, path: str, is_color: bool) -> list[list[float]]:
    rows = []
    points = take_list(take_object(value, path, needed=["points"])["points"], f"{path}.points")
    for n, point in enumerate(points):
        entry = f"{path}.points[{n}]"
        fields = take_object(point, entry, needed=["x", "color" if is_color else "y"])
        row = [take_number(fields["x"], f"{entry}.x")]
        row += take_color(fields["color"], f"{entry}.color") if is_color else [take_number(fields["y"], f"{entry}.y")]
        for name, default in (("midpoint", 0.5), ("sharpness", 0.0)):
            row.append(take_number(fields.get(name, default), f"{entry}.{name}"))
        rows.append(row)
    return rows


def _json_parameters(value: Any, path: str) -> dict[str, Any]:
    components = take_object(value, path, needed=["components"])["components"]
    path = f"{path}.components[0]"
    # Voxels of CT have one component.
    fields = take_object(take_list(components, path.removesuffix("[0]"))[0], path, needed=["scalarOpacity"])
    entry = f"{path}.scalarOpacity"
    opacity = curve_from_nodes(entry, _json_nodes(fields["scalarOpacity"], entry, False))
    if "rgbTransferFunction" in fields:
        entry = f"{path}.rgbTransferFunction"
        colors = curve_from_nodes(entry, _json_nodes(fields["rgbTransferFunction"], entry, True), steps=True)
    else:
        entry = f"{path}.grayTransferFunction"
        take_object(fields, path, needed=["grayTransferFunction"])
        positions, grey = curve_from_nodes(entry, _json_nodes(fields["grayTransferFunction"], entry, False))
        colors = positions, np.repeat(grey, 3, axis=1)
    gradient = None
    if "gradientOpacity" in fields and not fields.get("disableGradientOpacity", False):
        entry = f"{path}.gradientOpacity"
        nodes = _json_nodes(fields["gradientOpacity"], entry, False)
        gradient = gradient_points(curve_from_nodes(entry, nodes), _GRADIENT_VOXEL_MM)
    lighting = UNSHADED
    if fields.get("shade", False):
        light = take_object(fields.get("lighting", {}), f"{path}.lighting")
        defaults = {"ambient": 0.1, "diffuse": 0.7, "specular": 0.2, "specularPower": 10.0}
        ambient, diffuse, specular, power = (
            take_number(light.get(key, default), f"{path}.lighting.{key}") for key, default in defaults.items()
        )
        lighting = Lighting(ambient, diffuse, specular, power)
    unit = take_number(fields.get("scalarOpacityUnitDistance", 1.0), f"{path}.scalarOpacityUnitDistance")
    return {
        "points": merge_curves(colors, opacity),
        "gradient_opacity": gradient,
        "lighting": lighting,
        "unit_distance": unit,
    }


def _name_of_node(value: Any, field: str) -> str:
    name = value.get(field, "") if isinstance(value, dict) else ""
    return name if isinstance(name, str) else ""


def read_slicer_json(value: Any) -> list[Entry]:
    """Read a .vp.json file; of each property only the first component."""
    name = "volumeProperties"
    return [
        (_name_of_node(node, "name"), partial(_json_parameters, node, f"{name}[{n}]"))
        for n, node in enumerate(take_list(value[name], name))
    ]


def _paraview_parameters(value: Any, path: str) -> dict[str, Any]:
    fields = take_object(value, path, needed=["RGBPoints"])
    if "Points" not in fields:
        raise RefusedInputError(
            f"{path} has colours (RGBPoints) but no opacities (Points): save them with the preset in ParaView"
        )
    space = take_text(fields.get("ColorSpace", "RGB"), f"{path}.ColorSpace")
    if space != "RGB":
        raise RefusedInputError(f"{path} goes through colours in {space[:64]!r}: only RGB is read")
    curves = []
    for name, width in (("RGBPoints", 4), ("Points", 4)):
        entry = f"{path}.{name}"
        numbers = [take_number(x, f"{entry}[{n}]") for n, x in enumerate(take_list(fields[name], entry))]
        if len(numbers) % width:
            raise RefusedInputError(f"{entry} has {len(numbers)} numbers, of {width} to a point")
        rows = np.reshape(numbers, (-1, width))
        if name == "RGBPoints":
            rows = np.column_stack([rows, np.full(len(rows), 0.5), np.zeros(len(rows))])
        curves.append(curve_from_nodes(entry, rows))
    return {"points": merge_curves(curves[0], curves[1])}


def read_paraview_json(value: list[Any]) -> list[Entry]:
    """Read a list of ParaView's colour maps with opacities; positions are HU."""
    return [
        (_name_of_node(node, "Name"), partial(_paraview_parameters, node, f"map {n}"))
        for n, node in enumerate(take_list(value, "the file"), start=1)
    ]


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    unique: dict[str, Any] = {}
    for key, value in pairs:
        if key in unique:
            raise ValueError(f"the field {key[:64]!r} is there twice")
        unique[key] = value
    return unique


def parse_json(text: str) -> Any:
    """Parse JSON strictly: no NaN, no Infinity, no field twice."""
    try:
        return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        raise RefusedInputError(f"line {error.lineno}, column {error.colno}: no JSON: {error.msg}") from None
    except ValueError as error:  # raised by the hooks above, or by a whole number of thousands of digits
        raise RefusedInputError(f"no JSON: {str(error)[:200]}") from None
    except RecursionError:
        raise RefusedInputError("no JSON that can be read: nested too deep") from None


def _show_value(value: Any) -> str:
    kinds = {dict: "an object", list: "a list", bool: "true or false", type(None): "null"}
    for kind, words in kinds.items():
        if isinstance(value, kind):
            return words
    return f"{value!r}"[:64]


def take_object(
    value: Any, path: str, known: Collection[str] | None = None, needed: Collection[str] = ()
) -> dict[str, Any]:
    """Return an object; if `known` is given, refuse other fields."""
    if not isinstance(value, dict):
        raise RefusedInputError(f"{path} is {_show_value(value)}, not an object")
    unknown = [key for key in value if known is not None and key not in known]
    if unknown:
        raise RefusedInputError(
            f"{path} has a field {unknown[0][:64]!r} that is not known: {', '.join(known or ())} are"
        )
    missing = [key for key in needed if key not in value]
    if missing:
        raise RefusedInputError(f"{path} has no field {missing[0]!r}")
    return value


def take_list(value: Any, path: str) -> list[Any]:
    if not isinstance(value, list) or not value:
        raise RefusedInputError(
            f"{path} is {'empty' if value == [] else _show_value(value)}, not a list with something in it"
        )
    return value


def take_number(value: Any, path: str) -> float:
    try:
        number = float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.nan
    if not math.isfinite(number):
        raise RefusedInputError(f"{path} is {_show_value(value)}, not a finite number")
    return number


def take_text(value: Any, path: str) -> str:
    if not isinstance(value, str):
        raise RefusedInputError(f"{path} is {_show_value(value)}, not a text")
    return value


def take_color(value: Any, path: str) -> tuple[float, float, float]:
    """Return red, green, blue from three numbers or from a text ``#rrggbb``."""
    if isinstance(value, str) and len(value) == 7 and value[0] == "#":
        try:
            digits = bytes.fromhex(value[1:])
            return digits[0] / 255, digits[1] / 255, digits[2] / 255
        except (ValueError, IndexError):
            pass
    if not isinstance(value, list) or len(value) != 3:
        raise RefusedInputError(f"{path} is {_show_value(value)}, not [red, green, blue] or '#rrggbb'")
    red, green, blue = (take_number(part, f"{path}[{n}]") for n, part in enumerate(value))
    return red, green, blue
