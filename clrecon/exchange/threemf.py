"""3MF (3MF Consortium, core specification 1.2): a ZIP with the surfaces as XML, unit millimetre, no normals.

Own code because trimesh keeps the whole document in memory and needs two more libraries for it, and VTK has no 3MF. The
entries of the ZIP are dated 1980-01-01, the earliest date of the format, which `ZipFile.open` sets.

The reader takes objects of triangles and of components, placed by the build, in the unit of the model; others were seen
that drop the unit, components or transforms.  The XML is read piece by piece and declares no document type, so that it
cannot grow; what it may unpack to is bounded by the size of the file.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from array import array
from collections.abc import Callable, Sequence
from html import escape  # that of xml.sax loads all of urllib
from pathlib import Path
from typing import Any, BinaryIO
from xml.parsers import expat

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from clrecon.errors import OutputError, RefusedInputError
from clrecon.exchange.content import BONE_COLOR, Assembly, Content, check_same, parts_of, write_lines
from clrecon.exchange.raw_content import MOST_LEVELS, Part, PlacedShapes, RawMesh, Shape, read_remarks, say_cut
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text, to_hexadecimal

_PIECE_OUT = 1 << 22
_RAW = -isal_zlib.MAX_WBITS
_MODEL = "3D/3dmodel.model"
_DECLARATION = '<?xml version="1.0" encoding="UTF-8"?>\n'
_SMALL_PARTS = {
    "[Content_Types].xml": _DECLARATION
    + '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">\n'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>\n'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>\n'
    "</Types>\n",
    "_rels/.rels": _DECLARATION
    + '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">\n'
    f'<Relationship Target="/{_MODEL}" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>\n'
    "</Relationships>\n",
}
_TRIANGLE = '<triangle v1="%d" v2="%d" v3="%d"/>\n'


def _vertex(content: Content) -> str:
    number = content.number
    return f'<vertex x="{number}" y="{number}" z="{number}"/>\n'


def estimate(content: Content | Assembly) -> int:
    """Estimate the size of the file in bytes, rather too small: the XML of surfaces shrinks to a sixth or a fifth."""
    return sum(map(_unpacked, parts_of(content))) // 7


def _unpacked(content: Content) -> int:
    """Estimate the size of the XML of a mesh in bytes, a little too large."""
    digits = len(str(len(content.vertices)))
    vertex = len(_vertex(content)) + (45 if content.is_double else 27)
    return 2048 + vertex * len(content.vertices) + (len(_TRIANGLE) + 3 * digits) * len(content.triangles)


def write(stream: BinaryIO, content: Content | Assembly) -> None:
    """Write the package.  Level 1 of zlib packs to 19 %, level 2 of ISA-L to 18 % in a third of the time.

    `zipfile` has no parameter for the library that packs; if a Python names it otherwise, zlib packs.
    """
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as package:
        for name, text in _SMALL_PARTS.items():
            with package.open(name, "w") as entry:
                entry.write(text.encode("ascii"))
        parts = parts_of(content)
        # The 64-bit extension of ZIP is used only where it is needed, because some readers do not know it.
        large = sum(map(_unpacked, parts)) > zipfile.ZIP64_LIMIT
        with package.open(_MODEL, "w", force_zip64=large) as model:
            model._compressor = isal_zlib.compressobj(2, wbits=_RAW)  # type: ignore[attr-defined]
            model.write(_opening(parts).encode("ascii"))
            for number, part in enumerate(parts):
                model.write(_object(parts, number).encode("ascii"))
                write_lines(model, _vertex(part), part.vertices)
                model.write(b"</vertices>\n<triangles>\n")
                write_lines(model, _TRIANGLE, part.triangles)
                model.write(b"</triangles>\n</mesh>\n</object>\n")
            items = "".join(f'<item objectid="{_object_id(parts, number)}"/>\n' for number in range(len(parts)))
            model.write(f"</resources>\n<build>\n{items}</build>\n</model>\n".encode("ascii"))


def _has_colors(parts: Sequence[Content]) -> bool:
    return any(part.color is not None for part in parts)


def _object_id(parts: Sequence[Content], number: int) -> int:
    """Return the id of an object; 1 is that of the colours where there are any."""
    return number + 1 + _has_colors(parts)


def _object(parts: Sequence[Content], number: int) -> str:
    name = "" if parts[number].name is None else f' name="{_attribute(str(parts[number].name))}"'
    color = f' pid="1" pindex="{number}"' if _has_colors(parts) else ""
    return f'<object id="{_object_id(parts, number)}" type="model"{name}{color}>\n<mesh>\n<vertices>\n'


def _attribute(text: str) -> str:
    """Return text for an attribute, in ASCII."""
    return escape(text).encode("ascii", "xmlcharrefreplace").decode("ascii")


def _opening(parts: Sequence[Content]) -> str:
    colors = ""
    if _has_colors(parts):
        shown = [(_attribute(part.name or "bone"), to_hexadecimal(part.color or BONE_COLOR).upper()) for part in parts]
        bases = "".join(f'<base name="{name}" displaycolor="{color}"/>\n' for name, color in shown)
        colors = f'<basematerials id="1">\n{bases}</basematerials>\n'
    return (
        f'{_DECLARATION}<model unit="millimeter" xml:lang="en-US" '
        'xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">\n'
        '<metadata name="Application">clrecon</metadata>\n'
        f'<metadata name="Description">{_description(parts[0])}</metadata>\n'
        f"<resources>\n{colors}"
    )


def _description(content: Content) -> str:
    """Return the remarks and the certificate, one fact a line, with reserved characters of XML as entities."""
    remarks = content.remarks
    known = len(remarks) - len(content.certificate)
    return escape("\n".join([" ".join(remarks[:known]), *remarks[known:]]), quote=False)


def verify(path: Path, content: Content | Assembly) -> None:
    vertices = triangles = 0
    tail = b""
    try:
        with zipfile.ZipFile(path) as package, package.open(_MODEL) as model:
            model._decompressor = isal_zlib.decompressobj(_RAW)  # type: ignore[attr-defined]
            while piece := model.read(_PIECE_OUT):
                piece = tail + piece
                # Only whole lines are counted; the rest is carried over to the next piece.
                cut = piece.rfind(b"\n") + 1
                vertices += piece.count(b"<vertex ", 0, cut)
                triangles += piece.count(b"<triangle ", 0, cut)
                tail = piece[cut:]
    except (zipfile.BadZipFile, KeyError, EOFError, isal_zlib.error) as error:  # type: ignore[misc]
        raise OutputError(f"the file did not arrive on the disk as it was written: {error}") from error
    check_same("vertices", vertices, sum(len(part.vertices) for part in parts_of(content)))
    check_same("triangles", triangles, sum(len(part.triangles) for part in parts_of(content)))


_CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
_MATERIAL = "http://schemas.microsoft.com/3dmanufacturing/material/2015/02"
_MODEL_TYPE = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
_RELATIONS = "_rels/.rels"
_MM = {"micron": 0.001, "millimeter": 1.0, "centimeter": 10.0, "inch": 25.4, "foot": 304.8, "meter": 1000.0}
_UNITS = {"micron": "um", "millimeter": "mm", "centimeter": "cm", "meter": "m"}
_MOST_RATIO = 200
"""Most bytes of XML a byte of the file; models of a million equal numbers have 100."""
_SMALL = 1 << 20
_LONGEST_DESCRIPTION = 1 << 20
_PIECE_IN = 1 << 20


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


def read_mesh(path: Path) -> RawMesh:
    """Read the objects of a 3MF file that its build places; the triangles of each are a part."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream, zipfile.ZipFile(stream) as package:
            model = _read_model(package, _find_model(package, name), name)
        shapes = _place_shapes(model)
    except (
        OSError, EOFError, ValueError, LookupError, OverflowError, MemoryError, NotImplementedError, RuntimeError,
        zipfile.BadZipFile, zlib.error, expat.ExpatError,
    ) as error:  # fmt: skip
        raise say_cut(name, error) from error
    mesh = shapes.joined()
    lines = model.description.split("\n")
    remarks = read_remarks([*re.findall(r"\b(?:SPACE|ISO_VALUE_HU)=\S+", lines[0]), *lines[1:]])
    return RawMesh(
        "3MF", mesh.vertices, mesh.triangles, unit=_UNITS.get(model.unit, model.unit), parts=shapes.parts, **remarks
    )


def _find_model(package: zipfile.ZipFile, name: str) -> str:
    entries = set(package.namelist())
    targets: list[str] = []

    def start_element(tag: str, attributes: dict[str, str]) -> None:
        if tag.endswith(" Relationship") and attributes.get("Type") == _MODEL_TYPE:
            targets.append(attributes.get("Target", "").lstrip("/"))

    if _RELATIONS in entries:
        _parse_entry(package, _RELATIONS, start_element)
    model = targets[0] if targets else _MODEL
    if model not in entries:
        raise RefusedInputError(f"{name} is a zip archive without a 3D model: it is no 3MF file")
    return model


def _parse_entry(
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
        while piece := stream.read(_PIECE_IN):
            parser.Parse(piece)
    parser.Parse(b"", True)


def _read_model(package: zipfile.ZipFile, entry: str, name: str) -> _Model:
    model = _Model()
    own = _Object("", None)
    texts: list[str] | None = None
    group = model.colors.setdefault(-1, [])

    def start_element(tag: str, attributes: dict[str, str]) -> None:
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
            component = int(attributes["objectid"]), _transform(attributes.get("transform"))
            (own.components if kind == "component" else model.items).append(component)
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

    _parse_entry(package, entry, start_element, text, end)
    return model


def _begin_object(model: _Model, attributes: dict[str, str]) -> _Object:
    number = int(attributes["id"])
    if number in model.objects:
        raise ValueError(f"object {number} is there twice")
    colors = model.colors.get(int(attributes.get("pid", -1)), [])
    which = int(attributes.get("pindex", 0))
    shape = _Object(attributes.get("name", ""), colors[which] if 0 <= which < len(colors) else None)
    model.objects[number] = shape
    return shape


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


def _place_shapes(model: _Model) -> PlacedShapes:
    shapes = PlacedShapes()
    scale = np.diag([_MM[model.unit]] * 3 + [1.0])

    def add(number: int, matrix: NDArray[np.float64], name: str, level: int) -> None:
        shape = model.objects.get(number)
        if shape is None or level > MOST_LEVELS:
            raise ValueError(f"object {number} is not there" if shape is None else "objects within themselves")
        name = shape.name or name
        if shape.triangles:
            vertices = np.frombuffer(shape.vertices, np.float64).reshape(-1, 3)
            triangles = np.frombuffer(shape.triangles, np.int64).reshape(-1, 3)
            shapes.add(Shape(vertices, triangles), matrix, Part(name, len(triangles), shape.color))
        shapes.count_step()
        for child, placed in shape.components:
            add(child, matrix @ placed, name, level + 1)

    for number, matrix in model.items:
        add(number, scale @ matrix, "", 0)
    return shapes
