"""VTP meshes: the polygons of PolyData, each a triangle; see `clrecon.exchange.clouds.read_vtp`."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.clouds.raw_cloud import RawCloud, columns_of, say_cut
from clrecon.exchange.clouds.read_vtp import Document, parse_document, read_count, read_fields, read_numbers
from clrecon.exchange.meshes.placed_shapes import PlacedShapes, Shape
from clrecon.exchange.meshes.raw_mesh import Part, RawMesh
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text


def read(path: Path) -> RawMesh:
    """Read the triangles of a VTP file; those of one number in the cell array ``PART`` are a part."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            document = parse_document(stream.read(), name)
        return _collect(document, name)
    except (OSError, ValueError, OverflowError, MemoryError, ElementTree.ParseError, zlib.error) as error:
        raise say_cut(name, error) from error


def _collect(document: Document, name: str) -> RawMesh:
    shapes, left_out = PlacedShapes(), 0
    warnings: list[str] = []
    cells: list[dict[str, NDArray[Any]]] = []
    for piece in document.root.iterfind("PolyData/Piece"):
        if read_count(piece, "NumberOfStrips"):
            raise RefusedInputError(f"{name} has triangle strips: only single triangles are read")
        count = read_count(piece, "NumberOfPolys")
        lines = {kind: read_count(piece, f"NumberOf{kind}") for kind in ("Verts", "Lines")}
        left_out += sum(lines.values())
        if count == 0:
            continue
        shape = _read_shape(document, piece, count, name, warnings)
        shapes.add(shape, np.eye(4), Part("", count))
        cells.append({} if any(lines.values()) else _cell_arrays(document, piece, count))
    if left_out:
        warnings.append(f"elements left out: {left_out:,} points and lines")
    if not cells:
        raise RefusedInputError(f"{name} has no triangles: it is no mesh, perhaps a cloud of points")
    mesh = shapes.joined()
    texts, numbers = read_fields(document)
    iso_value = numbers.get("ISO_VALUE_HU")
    number = _joined(cells, "PART", 1)
    triangles, parts = mesh.triangles, []
    if number is not None:
        # Each part's triangles are to follow one another.
        order = np.argsort(number[:, 0], kind="stable")
        triangles = triangles[order]
        parts = _parts(number[order, 0], _joined(cells, "COLOR", 3), order, texts.get("PART_NAMES", ()))
    return RawMesh(
        "VTP",
        mesh.vertices,
        triangles,
        mesh.normals,
        next(iter(texts.get("SPACE", ())), None),
        float(iso_value[0]) if iso_value is not None and iso_value.size == 1 else None,
        texts.get("CERTIFICATE", ()),
        warnings,
        parts=parts,
    )


def _read_shape(document: Document, piece: ElementTree.Element, count: int, name: str, warnings: list[str]) -> Shape:
    points = piece.find("Points/DataArray")
    arrays = {array.get("Name"): array for array in piece.iterfind("Polys/DataArray")}
    if points is None or not {"connectivity", "offsets"} <= set(arrays):
        raise ValueError("a piece without points or polygons")
    vertices = read_numbers(document, points, read_count(piece, "NumberOfPoints"), 3)
    ends = read_numbers(document, arrays["offsets"], count, 1).ravel().astype(np.int64)
    wrong = np.flatnonzero(np.diff(ends, prepend=0) != 3)
    if len(wrong):
        first = int(wrong[0])
        corners = int(ends[first] - (ends[first - 1] if first else 0))
        raise RefusedInputError(f"polygon {first:,} of {name} has {corners} corners: only triangles are read")
    triangles = read_numbers(document, arrays["connectivity"], 3 * count, 1).astype(np.int64).reshape(-1, 3)
    data = piece.find("PointData")
    active = "Normals" if data is None else data.get("Normals", "Normals")
    normals = None
    for array in piece.iterfind("PointData/DataArray"):
        if array.get("Name") == active and array.get("NumberOfComponents") == "3":
            values = read_numbers(document, array, len(vertices), 3)
            cloud = RawCloud("VTP", vertices, columns_of(values, ("nx", "ny", "nz")))
            normals = cloud.normals()
            warnings += cloud.warnings
    return Shape(vertices, triangles, normals)


def _cell_arrays(document: Document, piece: ElementTree.Element, count: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of the triangles by which ours tell their parts."""
    found = {array.get("Name"): array for array in piece.iterfind("CellData/DataArray")}
    return {
        name: read_numbers(document, found[name], count, width)
        for name, width in (("PART", 1), ("COLOR", 3))
        if name in found and (read_count(found[name], "NumberOfComponents") or 1) == width
    }


def _joined(cells: list[dict[str, NDArray[Any]]], name: str, width: int) -> NDArray[Any] | None:
    """Return an array of all pieces; None where one has it not."""
    if not all(name in own and own[name].shape[1] == width for own in cells):
        return None
    return np.concatenate([own[name] for own in cells])


def _parts(
    numbers: NDArray[Any], colors: NDArray[Any] | None, order: NDArray[np.int64], names: tuple[str, ...]
) -> list[Part]:
    parts = []
    for number, first, count in zip(*np.unique(numbers, return_index=True, return_counts=True), strict=True):
        color = None
        if colors is not None and colors.dtype == np.uint8:
            red, green, blue = (colors[order[first]] / 255.0).tolist()
            color = (red, green, blue)
        name = names[int(number)] if 0 <= number < len(names) else ""
        parts.append(Part(name, int(count), color))
    return parts
