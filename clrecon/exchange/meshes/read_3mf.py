"""3MF of any program: objects of triangles and of components, placed by the build, in the unit of the model.

Own code because readers were seen that drop the unit, components or transforms.  The XML is read piece by piece and
declares no document type, so that it cannot grow; what it may unpack to is bounded by the size of the file.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.clouds.raw_cloud import read_remarks, say_cut
from clrecon.exchange.meshes.placed_shapes import MOST_LEVELS, PlacedShapes, Shape
from clrecon.exchange.meshes.raw_mesh import Part, RawMesh
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text

_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_MATERIAL = "http://schemas.microsoft.com/3dmanufacturing/material/2015/02"
_MODEL_TYPE = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_USUAL_MODEL = "3D/3dmodel.model"
_RELATIONS = "_rels/.rels"
_MM = {"micron": 0.001, "millimeter": 1.0, "centimeter": 10.0, "inch": 25.4, "foot": 304.8, "meter": 1000.0}
_UNITS = {"micron": "um", "millimeter": "mm", "centimeter": "cm", "meter": "m"}
_MOST_RATIO = 200
"""Most bytes of XML a byte of the file; models of a million equal numbers have 100."""
_SMALL = 1 << 20
_LONGEST_DESCRIPTION = 1 << 20
_PIECE = 1 << 20


@dataclass
class _Object:
    name: str
    color: tuple[float, float, float] | None
    vertices: array[float] = field(default_factory=lambda: array("d"))
    triangles: array[int] = field(default_factory=lambda: array("q"))
    components: list[tuple[int, NDArray[np.float64]]] = field(default_factory=list)


@dataclass
class _Model:
    unit: str = "millimeter"
    description: str = ""
    objects: dict[int, _Object] = field(default_factory=dict)
    items: list[tuple[int, NDArray[np.float64]]] = field(default_factory=list)
    colors: dict[int, list[tuple[float, float, float]]] = field(default_factory=dict)


def read(path: Path) -> RawMesh:
    """Read the objects of a 3MF file that its build places; the triangles of each are a part."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream, zipfile.ZipFile(stream) as package:
            model = _read_model(package, _find_model(package, name), name)
        shapes = _place(model)
    except (
        OSError, EOFError, ValueError, KeyError, OverflowError, MemoryError, NotImplementedError, RuntimeError,
        zipfile.BadZipFile, zlib.error, expat.ExpatError,
    ) as error:  # fmt: skip
        raise say_cut(name, error) from error
    mesh = shapes.joined()
    lines = model.description.split("\n")
    said = read_remarks([*re.findall(r"\b(?:SPACE|ISO_VALUE_HU)=\S+", lines[0]), *lines[1:]])
    return RawMesh(
        "3MF", mesh.vertices, mesh.triangles, unit=_UNITS.get(model.unit, model.unit), parts=shapes.parts, **said
    )


def _find_model(package: zipfile.ZipFile, name: str) -> str:
    """Return the entry of the model: that which the package names, else the usual one."""
    entries = set(package.namelist())
    targets: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag.endswith(" Relationship") and attributes.get("Type") == _MODEL_TYPE:
            targets.append(attributes.get("Target", "").lstrip("/"))

    if _RELATIONS in entries:
        _parse(package, _RELATIONS, start)
    model = targets[0] if targets else _USUAL_MODEL
    if model not in entries:
        raise RefusedInputError(f"{name} is a zip archive without a 3D model: it is no 3MF file")
    return model


def _parse(
    package: zipfile.ZipFile,
    entry: str,
    start: Callable[[str, dict[str, str]], None],
    text: Callable[[str], None] | None = None,
    end: Callable[[str], None] | None = None,
) -> None:
    """Read an entry as XML; tags are "NAMESPACE NAME"."""
    info = package.getinfo(entry)
    most = _MOST_RATIO * info.compress_size + _SMALL
    if info.file_size > most:
        raise ValueError(f"{info.file_size:,} bytes of XML cannot come from {info.compress_size:,} bytes")
    parser = expat.ParserCreate(namespace_separator=" ")

    def refuse(*_: Any) -> None:
        raise ValueError("it declares a document type, which 3MF has not")

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = start
    parser.CharacterDataHandler = text
    parser.EndElementHandler = end
    with package.open(info) as stream:
        _feed(parser, stream)


def _feed(parser: Any, stream: IO[bytes]) -> None:
    while piece := stream.read(_PIECE):
        parser.Parse(piece)
    parser.Parse(b"", True)


def _read_model(package: zipfile.ZipFile, entry: str, name: str) -> _Model:
    model = _Model()
    own = _Object("", None)
    texts: list[str] | None = None
    group = model.colors.setdefault(-1, [])

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal own, texts, group
        space, _, kind = tag.rpartition(" ")
        if space == _MATERIAL:
            if kind == "colorgroup":
                group = model.colors.setdefault(int(attributes["id"]), [])
            elif kind == "color":
                group.append(_color(attributes["color"]))
        elif space != _CORE:
            return
        elif kind == "vertex":
            own.vertices.extend((float(attributes["x"]), float(attributes["y"]), float(attributes["z"])))
        elif kind == "triangle":
            own.triangles.extend((int(attributes["v1"]), int(attributes["v2"]), int(attributes["v3"])))
        elif kind == "object":
            own = _begin_object(model, attributes)
        elif kind in ("component", "item"):
            if any(attribute.endswith(" path") for attribute in attributes):
                raise RefusedInputError(f"{name} has objects in further files of its package: they are not read")
            place = int(attributes["objectid"]), _transform(attributes.get("transform"))
            (own.components if kind == "component" else model.items).append(place)
        elif kind == "basematerials":
            group = model.colors.setdefault(int(attributes["id"]), [])
        elif kind == "base":
            group.append(_color(attributes["displaycolor"]))
        elif kind == "model":
            model.unit = attributes.get("unit", model.unit)
            if model.unit not in _MM:
                raise ValueError(f"the unit '{escape_text(model.unit)}'")
        elif kind == "metadata" and attributes.get("name") == "Description":
            texts = []

    def text(piece: str) -> None:
        if texts is not None and sum(map(len, texts)) < _LONGEST_DESCRIPTION:
            texts.append(piece)

    def end(tag: str) -> None:
        nonlocal texts
        if texts is not None:
            model.description, texts = "".join(texts), None

    _parse(package, entry, start, text, end)
    return model


def _begin_object(model: _Model, attributes: dict[str, str]) -> _Object:
    number = int(attributes["id"])
    if number in model.objects:
        raise ValueError(f"object {number} is there twice")
    colors = model.colors.get(int(attributes.get("pid", -1)), [])
    which = int(attributes.get("pindex", 0))
    own = _Object(attributes.get("name", ""), colors[which] if 0 <= which < len(colors) else None)
    model.objects[number] = own
    return own


def _color(text: str) -> tuple[float, float, float]:
    if not re.fullmatch(r"#[0-9A-Fa-f]{6}(?:[0-9A-Fa-f]{2})?", text):
        raise ValueError(f"the colour '{escape_text(text)}'")
    red, green, blue = (int(text[place : place + 2], 16) / 255.0 for place in (1, 3, 5))
    return red, green, blue


def _transform(text: str | None) -> NDArray[np.float64]:
    """Return a transform as a matrix for columns; 3MF writes that for rows."""
    matrix = np.eye(4)
    if text is not None:
        numbers = np.array(text.split(), dtype=np.float64)
        if numbers.size != 12:
            raise ValueError(f"a transform of {numbers.size} numbers")
        matrix[:3] = numbers.reshape(4, 3).T
    return matrix


def _place(model: _Model) -> PlacedShapes:
    shapes = PlacedShapes()
    scale = np.diag([_MM[model.unit]] * 3 + [1.0])

    def add(number: int, matrix: NDArray[np.float64], name: str, level: int) -> None:
        own = model.objects.get(number)
        if own is None or level > MOST_LEVELS:
            raise ValueError(f"object {number} is not there" if own is None else "objects within themselves")
        name = own.name or name
        if own.triangles:
            vertices = np.frombuffer(own.vertices, np.float64).reshape(-1, 3)
            triangles = np.frombuffer(own.triangles, np.int64).reshape(-1, 3)
            shapes.add(Shape(vertices, triangles), matrix, Part(name, len(triangles), own.color))
        shapes.count_step()
        for child, placed in own.components:
            add(child, matrix @ placed, name, level + 1)

    for number, matrix in model.items:
        add(number, scale @ matrix, "", 0)
    return shapes
