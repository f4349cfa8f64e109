"""`load_transfer_function`: reads every kind of file with transfer functions.

Our own form is JSON, described in docs/transfer_functions.md.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any

from clrecon.errors import RefusedInputError, UsageError
from clrecon.rendering.looks.json_fields import parse_json, take_color, take_list, take_number, take_object, take_text
from clrecon.rendering.looks.lighting import Lighting
from clrecon.rendering.looks.slicer_files import (
    Entry,
    read_paraview_json,
    read_slicer_json,
    read_slicer_text,
    read_slicer_xml,
)
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.looks.transfer_text import FORMAT, VERSION
from clrecon.system.arguments import explains_arguments
from clrecon.system.paths import read_regular
from clrecon.system.text import escape_text

SIZE_LIMIT = 1_000_000
"""Bytes: presets.xml of 3D Slicer has 12 kB."""
NAMES_LISTED = 60

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
        entries = _entries(_read(Path(path), shown))
        found_name, make = _choose(entries, name, shown)
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


def _read(path: Path, shown: str) -> bytes:
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
        return read_regular(path, SIZE_LIMIT)
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
        return read_slicer_text(text)
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


def _choose(entries: list[Entry], name: str | None, shown: str) -> Entry:
    names = [entry_name or str(n) for n, (entry_name, _) in enumerate(entries, start=1)]
    listed = ", ".join(f"{entry!r}"[:66] for entry in names[:NAMES_LISTED])
    listed += f" and {len(names) - NAMES_LISTED} more" if len(names) > NAMES_LISTED else ""
    if name is None:
        if len(entries) > 1:
            raise _Choice(f"{shown} has {len(entries)} transfer functions, choose one by name: {listed}")
        return entries[0]
    wanted = name.strip().casefold()
    found = [n for n, entry in enumerate(names) if entry.casefold() == wanted]
    if not found and wanted.isascii() and wanted.isdigit() and 1 <= int(wanted[:9]) <= len(entries):
        found = [int(wanted[:9]) - 1]
    if len(found) != 1:
        what = f"has {len(found)} transfer functions" if found else "has no transfer function"
        raise _Choice(f"{shown} {what} named {name[:64]!r}; there are: {listed}")
    return entries[found[0]]


def _own_parameters(value: dict[str, Any]) -> dict[str, Any]:
    what = "the file"
    take_object(value, what, needed=("format", "version"))
    if value["format"] != FORMAT:
        raise RefusedInputError(f'its format is {value["format"]!r:.64}, not "{FORMAT}"')
    if value["version"] != VERSION or isinstance(value["version"], bool):
        raise RefusedInputError(f"its version is {value['version']!r:.64}: this clrecon reads version {VERSION}")
    take_object(value, what, known=_FIELDS, needed=("points",))
    parameters: dict[str, Any] = {
        "points": [_own_point(point, f"points[{n}]") for n, point in enumerate(take_list(value["points"], "points"))],
        "unit_distance": take_number(value.get("unit_distance_mm", 1.0), "unit_distance_mm"),
        "name": take_text(value.get("name", ""), "name"),
        "description": take_text(value.get("description", ""), "description"),
    }
    if value.get("gradient_opacity") is not None:
        rows = []
        for n, point in enumerate(take_list(value["gradient_opacity"], "gradient_opacity")):
            place, names = f"gradient_opacity[{n}]", ("hu_per_mm", "factor")
            fields = take_object(point, place, known=names, needed=names)
            rows.append([take_number(fields[name], f"{place}.{name}") for name in names])
        parameters["gradient_opacity"] = rows
    if value.get("lighting") is not None:
        light = dict(take_object(value["lighting"], "lighting", known=_LIGHT))
        for name in _LIGHT[:5]:
            if name in light:
                light[name] = take_number(light[name], f"lighting.{name}")
        parameters["lighting"] = Lighting(**light)
    return parameters


def _own_point(point: Any, place: str) -> tuple[float, ...]:
    names = ("hu", "color", "opacity")
    fields = take_object(point, place, known=names, needed=names)
    hu, opacity = (take_number(fields[name], f"{place}.{name}") for name in ("hu", "opacity"))
    return hu, *take_color(fields["color"], f"{place}.color"), opacity
