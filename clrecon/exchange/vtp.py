"""VTP, the XML PolyData of VTK: raw binary data after the XML, with 64-bit headers.

The writer is own code because VTK leaves a truncated file on a full disk, or makes a copy of it in memory.  The field
arrays ``SPACE``, ``UNIT``, ``ISO_VALUE_HU``, ``AFFINE_IJK_TO_LPS_MM`` (16 numbers, row by row) and ``CERTIFICATE`` (one
text for each fact) tell what the coordinates are; 3D Slicer reads ``SPACE``.

The readers take files of any program, see `clrecon.exchange.vtk_xml`; of meshes each polygon is a triangle.  Several
pieces become one cloud.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, TypeVar
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError, UsageError
from clrecon.exchange import vtk_xml
from clrecon.exchange.content import BONE_COLOR, Assembly, Content, PointContent, refuse_file
from clrecon.exchange.raw_content import Part, PlacedShapes, RawCloud, RawMesh, Shape, columns_of, numbers_of, say_cut
from clrecon.exchange.vtk_xml import Document
from clrecon.system.light_dataclass import replace
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text


def make_polydata(
    vertices: NDArray[np.floating],
    triangles: NDArray[np.uint32] | None,
    normals: NDArray[np.float32] | None,
    hu: NDArray[np.float32] | None = None,
    labels: NDArray[np.int32] | None = None,
    values: Mapping[str, NDArray[np.float32]] = MappingProxyType({}),
) -> Any:
    """Build a ``vtkPolyData`` that shares the memory of the arrays, which are C-contiguous.

    VTK counts in signed integers: indices are seen as int32 without a copy below 2**31 vertices and are copied to int64
    above.

    triangles: Every index below n; None: a cloud, each point a cell of its own, without which nothing of it is drawn.
    normals: They become the active normals, named ``Normals``.
    hu, labels: The point arrays ``HU``, which becomes the active scalars, and ``label``.
    values: Further point arrays by name, (n,) each.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    corners = 1 if triangles is None else 3
    count = len(vertices) if triangles is None else len(triangles)
    small = max(len(vertices), corners * count + 1) < 2**31
    if triangles is None:
        indices: NDArray[Any] = np.arange(count, dtype=np.int32 if small else np.int64)
    else:
        indices = triangles.view(np.int32) if small else triangles.astype(np.int64)
    offsets = np.arange(0, indices.size + 1, corners, dtype=indices.dtype)
    cells = vtkCellArray()
    cells.SetData(numpy_to_vtk(offsets), numpy_to_vtk(indices.reshape(-1)))
    points = vtkPoints()
    points.SetData(numpy_to_vtk(vertices))
    polydata = vtkPolyData()
    polydata.SetPoints(points)
    if triangles is None:
        polydata.SetVerts(cells)
    else:
        polydata.SetPolys(cells)
    data = polydata.GetPointData()
    add_arrays(data, {"Normals": normals, "HU": hu, "label": labels} | dict(values))
    if normals is not None:
        data.SetActiveNormals("Normals")
    if hu is not None:
        data.SetActiveScalars("HU")
    return polydata


def add_arrays(data: Any, arrays: Mapping[str, NDArray[Any] | None]) -> None:
    """Add arrays to the data of points or cells by name, sharing their memory."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    for name, numbers in arrays.items():
        if numbers is not None:
            array = numpy_to_vtk(numbers)
            array.SetName(name)
            data.AddArray(array)


_END = b"</VTKFile>"


def wrap_cloud(
    points: NDArray[np.floating],
    normals: NDArray[np.float32] | None,
    hu: NDArray[np.float32] | None,
    labels: NDArray[np.int32] | None,
) -> Any:
    """``pyvista.PolyData`` in LPS mm that shares the memory of the arrays; see `PointCloud.to_pyvista`."""
    import pyvista

    polydata = pyvista.wrap(make_polydata(points, None, normals, hu, labels))
    polydata.field_data["SPACE"], polydata.field_data["UNIT"] = ["LPS"], ["mm"]
    return polydata


def unwrap_cloud(polydata: Any) -> tuple[dict[str, NDArray[Any] | None], str | None]:
    """Arrays of a ``pyvista.PolyData`` by their names in a cloud, and the frame that it names."""
    import pyvista

    wrapped = pyvista.wrap(polydata) if hasattr(polydata, "GetPolys") else polydata
    if not isinstance(wrapped, pyvista.PolyData):
        raise UsageError(f"a {type(polydata).__name__} is no pyvista.PolyData")
    arrays: dict[str, NDArray[Any] | None] = {"points": np.array(wrapped.points)}
    for name, theirs in {"normals": "Normals", "hu": "HU", "labels": "label"}.items():
        arrays[name] = np.array(wrapped.point_data[theirs]) if theirs in wrapped.point_data else None
    named = wrapped.field_data["SPACE"][0] if "SPACE" in wrapped.field_data else None
    return arrays, None if named is None else str(named)


def _join_meshes(content: PointContent | Assembly) -> PointContent:
    """Return the meshes of a file as one, with the facts of the first; a cloud or a single mesh stays as it is."""
    if not isinstance(content, Assembly):
        return content
    parts = content.parts
    begins = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    normals = [part.normals for part in parts if part.normals is not None]
    return replace(
        parts[0],
        vertices=np.concatenate([part.vertices for part in parts]),
        triangles=np.concatenate([part.triangles + np.uint32(at) for part, at in zip(parts, begins, strict=True)]),
        normals=np.concatenate(normals) if len(normals) == len(parts) else None,
        values=_common([part.values for part in parts]),
        face_values=_common([part.face_values for part in parts]),
    )


def _common(pieces: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Join the arrays that all pieces have, with as many components each."""
    forms = [{name: values.shape[1:] for name, values in own.items()} for own in pieces]
    names = [name for name, form in forms[0].items() if all(own.get(name) == form for own in forms)]
    return {name: np.concatenate([own[name] for own in pieces]) for name in names}


def estimate(content: PointContent | Assembly) -> int:
    """Return the size of the data in bytes, without the XML: the indices and an offset for each triangle or point."""
    if isinstance(content, Assembly):
        return sum(estimate(part) + 7 * len(part.triangles) for part in content.parts)
    arrays = [content.vertices, content.normals, content.hu, content.labels, *content.values.values()]
    cells = 8 * len(content.vertices)
    if isinstance(content, Content):
        arrays += content.face_values.values()
        cells = 16 * len(content.triangles)
    return sum(array.nbytes for array in arrays if array is not None) + cells


def write(stream: BinaryIO, content: PointContent | Assembly) -> None:
    """Write the surface or cloud with its field arrays.

    Each triangle of several meshes has the number of its mesh, from 0 on, in the cell array ``PART``, and its colour in
    ``COLOR``; the field array ``PART_NAMES`` has the names in this order.
    """
    parts = content.parts if isinstance(content, Assembly) else []
    content = _join_meshes(content)
    faces = content.triangles if isinstance(content, Content) else None
    corners = np.arange(len(content.vertices))[:, None] if faces is None else faces
    whole = np.int32 if max(len(content.vertices), corners.size) < 2**31 else np.int64
    ends = np.arange(corners.shape[1], corners.size + 1, corners.shape[1])
    cells = {"Verts": 0, "Lines": 0, "Strips": 0, "Polys": 0} | {"Verts" if faces is None else "Polys": len(corners)}
    counts = {f"NumberOf{kind}": str(count) for kind, count in {"Points": len(content.vertices), **cells}.items()}
    point_arrays = {"Normals": content.normals, "HU": content.hu, "label": content.labels}
    active = {"Scalars": "HU", "Normals": "Normals"}
    of_faces = content.face_values if isinstance(content, Content) else {}
    sections: list[tuple[str, dict[str, str], dict[str, Any]]] = [
        (
            "PointData",
            {kind: name for kind, name in active.items() if point_arrays[name] is not None},
            {**point_arrays, **content.values},
        ),
        ("CellData", {}, {**of_faces, **_numbers_of_parts(parts)}),
        ("Points", {}, {"Points": content.vertices}),
    ]
    for kind, count in cells.items():
        pair = {"connectivity": corners.reshape(-1), "offsets": ends}
        sections.append((kind, {}, {name: np.asarray(all_of if count else [], whole) for name, all_of in pair.items()}))

    about = {"type": "PolyData", "version": "1.0", "byte_order": "LittleEndian", "header_type": "UInt64"}
    root = ElementTree.Element("VTKFile", about)
    surface = ElementTree.SubElement(root, "PolyData")
    field, blocks = ElementTree.SubElement(surface, "FieldData"), list[NDArray[Any]]()
    for name, facts in _facts(content, parts).items():
        _append(blocks, field, name, facts, is_row=True)
    piece = ElementTree.SubElement(surface, "Piece", counts)
    for tag, attributes, arrays in sections:
        section = ElementTree.SubElement(piece, tag, attributes)
        for name, numbers in arrays.items():
            if numbers is not None:
                _append(blocks, section, name, numbers)
    xml = ElementTree.tostring(root, "us-ascii", xml_declaration=True).removesuffix(_END)
    stream.write(xml + b'<AppendedData encoding="raw">_')
    for block in blocks:
        stream.write(block.nbytes.to_bytes(8, "little"))
        stream.write(block.reshape(-1).view(np.uint8).data)
    stream.write(b"</AppendedData>" + _END)


def _append(
    blocks: list[NDArray[Any]], parent: ElementTree.Element, name: str, values: Any, *, is_row: bool = False
) -> None:
    """Name an array in the XML, with its place after it; `is_row`: its texts or its numbers, those of one row."""
    offset = str(sum(8 + block.nbytes for block in blocks))
    attributes = {"Name": name, "format": "appended", "offset": offset}
    if is_row and isinstance(values[0], str):
        block = np.frombuffer(b"".join(text.encode() + b"\0" for text in values), np.uint8)
        ElementTree.SubElement(parent, "Array", {"type": "String", "NumberOfTuples": str(len(values)), **attributes})
    else:
        numbers = np.asarray(values)
        block = np.ascontiguousarray(numbers, numbers.dtype.newbyteorder("<"))
        kind = {"i": "Int", "u": "UInt", "f": "Float"}[numbers.dtype.kind] + str(8 * numbers.itemsize)
        width = numbers.size if is_row else math.prod(numbers.shape[1:])
        attributes |= {"type": kind, "NumberOfComponents": str(width)} | ({"NumberOfTuples": "1"} if is_row else {})
        ElementTree.SubElement(parent, "DataArray", attributes)
    blocks.append(block)


def _numbers_of_parts(parts: Sequence[Content]) -> dict[str, NDArray[Any]]:
    if not parts:
        return {}
    counts = [len(part.triangles) for part in parts]
    colors = np.array([BONE_COLOR if part.color is None else part.color for part in parts])
    return {
        "PART": np.repeat(np.arange(len(parts), dtype=np.int32), counts),
        "COLOR": np.repeat(np.rint(255.0 * colors).astype(np.uint8), counts, axis=0),
    }


def _facts(content: PointContent, parts: Sequence[Content]) -> dict[str, Any]:
    """Return the field arrays by name: texts, or numbers of one row; none is empty."""
    inside = () if content.inside is None else (content.inside,)
    facts: dict[str, Any] = {"SPACE": (content.space,), "UNIT": ("mm",), "INSIDE": inside}
    facts["CERTIFICATE"] = content.certificate
    if content.iso_value_hu is not None:
        facts["ISO_VALUE_HU"] = np.array([content.iso_value_hu], np.float64)
    if content.affine is not None:
        facts["AFFINE_IJK_TO_LPS_MM"] = content.affine.ravel().astype(np.float64)
    facts["PART_NAMES"] = [part.name or f"object {number}" for number, part in enumerate(parts, start=1)]
    return {name: values for name, values in facts.items() if len(values)}


def verify(path: Path, content: PointContent | Assembly) -> None:
    least, content = estimate(content), _join_meshes(content)
    with path.open("rb") as stream:
        head = stream.read(8192).decode("latin-1")
        stream.seek(max(path.stat().st_size - 64, 0))
        end = stream.read()
    points = len(content.vertices)
    cells = ("NumberOfPolys", len(content.triangles)) if isinstance(content, Content) else ("NumberOfVerts", points)
    for name, count in (("NumberOfPoints", points), cells):
        match = re.search(rf'{name}="(\d+)"', head)
        if match is None or int(match[1]) != count:
            raise refuse_file(name, None if match is None else match[1], count)
    if not end.rstrip().endswith(_END):
        raise refuse_file("at the end", repr(end[-16:]), _END.decode())
    if path.stat().st_size < least:
        raise refuse_file("bytes", path.stat().st_size, f"more than {least}")


Raw = TypeVar("Raw", RawCloud, RawMesh)


def read_cloud(path: Path) -> RawCloud:
    """Read the points, the point arrays and the field arrays ``SPACE``, ``ISO_VALUE_HU`` and so on."""
    return _read_document(path, _collect_points)


def read_mesh(path: Path) -> RawMesh:
    """Read the triangles of a VTP file; those of one number in the cell array ``PART`` are a part."""
    return _read_document(path, _collect_triangles)


def _read_document(path: Path, collect: Callable[[Document, str], Raw]) -> Raw:
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            document = vtk_xml.parse_document(stream.read(), name)
        return collect(document, name)
    except (OSError, ValueError, LookupError, OverflowError, MemoryError, ElementTree.ParseError, zlib.error) as error:
        raise say_cut(name, error) from error


def has_faces(path: Path) -> bool:
    """True for a file whose XML counts polygons; its arrays are not looked at."""
    with open_regular(path) as stream:
        start = stream.read(vtk_xml.LONGEST_TEXT)
    return any(int(count) for count in re.findall(rb'NumberOfPolys="(\d{1,15})"', start))


def _collect_points(document: Document, name: str) -> RawCloud:
    points, columns = [], []
    lines = faces = 0
    normals = None
    for piece in document.root.iterfind("PolyData/Piece"):
        count = vtk_xml.read_count(piece, "NumberOfPoints")
        array = piece.find("Points/DataArray")
        if count == 0 or array is None:
            continue
        points.append(vtk_xml.read_numbers(document, array, count, 3))
        data = piece.find("PointData")
        normals = normals or (None if data is None else data.get("Normals"))
        columns.append(vtk_xml.read_arrays(document, piece, "PointData", count))
        faces += sum(vtk_xml.read_count(piece, f"NumberOf{kind}") for kind in ("Strips", "Polys"))
        lines += vtk_xml.read_count(piece, "NumberOfLines")
    if not points:
        raise RefusedInputError(f"{name} has no points")
    texts, numbers = vtk_xml.read_fields(document)
    affine, iso_value = numbers.get("AFFINE_IJK_TO_LPS_MM"), numbers.get("ISO_VALUE_HU")
    return RawCloud(
        "VTP",
        np.concatenate(points),
        _named(columns, normals),
        space=next(iter(texts.get("SPACE", ())), None),
        affine=affine.reshape(4, 4) if affine is not None and affine.size == 16 else None,
        iso_value_hu=float(iso_value[0]) if iso_value is not None and iso_value.size == 1 else None,
        certificate=texts.get("CERTIFICATE", ()),
        warnings=[f"elements left out: {lines + faces:,} lines, strips and polygons"] if lines + faces else [],
        has_faces=faces > 0,
    )


def _named(pieces: Sequence[dict[str, NDArray[Any]]], normals: str | None) -> dict[str, NDArray[Any]]:
    """Join the arrays that all pieces have; one of several components becomes as many columns."""
    columns: dict[str, NDArray[Any]] = {}
    for name, values in _common(pieces).items():
        width = values.shape[1]
        if width == 1:
            columns[name] = values[:, 0]
        elif width == 3 and name == (normals or "Normals"):
            columns |= columns_of(values, ("nx", "ny", "nz"))
        else:
            columns |= columns_of(values, [f"{name}:{place}" for place in range(width)])
    return columns


def _collect_triangles(document: Document, name: str) -> RawMesh:
    shapes, left_out = PlacedShapes(), 0
    warnings: list[str] = []
    points: list[dict[str, NDArray[Any]]] = []
    cells: list[dict[str, NDArray[Any]]] = []
    for piece in document.root.iterfind("PolyData/Piece"):
        if vtk_xml.read_count(piece, "NumberOfStrips"):
            raise RefusedInputError(f"{name} has triangle strips: only single triangles are read")
        count = vtk_xml.read_count(piece, "NumberOfPolys")
        lines = {kind: vtk_xml.read_count(piece, f"NumberOf{kind}") for kind in ("Verts", "Lines")}
        left_out += sum(lines.values())
        if count == 0:
            continue
        points.append(vtk_xml.read_arrays(document, piece, "PointData", vtk_xml.read_count(piece, "NumberOfPoints")))
        shape = _read_shape(document, piece, count, name, warnings, points[-1])
        shapes.add(shape, np.eye(4), Part("", count))
        cells.append({} if any(lines.values()) else vtk_xml.read_arrays(document, piece, "CellData", count))
    if left_out:
        warnings.append(f"elements left out: {left_out:,} points and lines")
    if not cells:
        raise RefusedInputError(f"{name} has no triangles: it is no mesh, perhaps a cloud of points")
    mesh = shapes.joined()
    texts, numbers = vtk_xml.read_fields(document)
    iso_value = numbers.get("ISO_VALUE_HU")
    at_cells, at_points = _common(cells), _common(points)
    colors = at_cells.pop("COLOR", None)
    values, face_values = (
        {own: numbers[:, 0] for own, numbers in each.items() if numbers.shape[1] == 1} for each in (at_points, at_cells)
    )
    number = face_values.pop("PART", None)
    triangles, parts = mesh.triangles, []
    if number is not None:
        # Each part's triangles are to follow one another.
        order = np.argsort(number, kind="stable")
        triangles = triangles[order]
        face_values = {own: numbers[order] for own, numbers in face_values.items()}
        parts = _parts(number[order], colors, order, texts.get("PART_NAMES", ()))
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
        values=numbers_of(values),
        face_values=numbers_of(face_values),
    )


def _read_shape(
    document: Document,
    piece: ElementTree.Element,
    count: int,
    name: str,
    warnings: list[str],
    at_points: Mapping[str, NDArray[Any]],
) -> Shape:
    points = piece.find("Points/DataArray")
    arrays = {array.get("Name"): array for array in piece.iterfind("Polys/DataArray")}
    if points is None or not {"connectivity", "offsets"} <= set(arrays):
        raise ValueError("a piece without points or polygons")
    vertices = vtk_xml.read_numbers(document, points, vtk_xml.read_count(piece, "NumberOfPoints"), 3)
    ends = vtk_xml.read_numbers(document, arrays["offsets"], count, 1).ravel().astype(np.int64)
    wrong = np.flatnonzero(np.diff(ends, prepend=0) != 3)
    if len(wrong):
        first = int(wrong[0])
        corners = int(ends[first] - (ends[first - 1] if first else 0))
        raise RefusedInputError(f"polygon {first:,} of {name} has {corners} corners: only triangles are read")
    triangles = vtk_xml.read_numbers(document, arrays["connectivity"], 3 * count, 1).astype(np.int64).reshape(-1, 3)
    data = piece.find("PointData")
    values = at_points.get("Normals" if data is None else data.get("Normals", "Normals"))
    if values is None or values.shape[1] != 3:
        return Shape(vertices, triangles)
    cloud = RawCloud("VTP", vertices, columns_of(values, ("nx", "ny", "nz")))
    normals = cloud.normals()
    warnings += cloud.warnings
    return Shape(vertices, triangles, normals)


def _parts(
    numbers: NDArray[Any], colors: NDArray[Any] | None, order: NDArray[np.int64], names: tuple[str, ...]
) -> list[Part]:
    parts = []
    for number, first, count in zip(*np.unique(numbers, return_index=True, return_counts=True), strict=True):
        color = None
        if colors is not None and colors.dtype == np.uint8 and colors.shape[1] == 3:
            red, green, blue = (colors[order[first]] / 255.0).tolist()
            color = (red, green, blue)
        parts.append(Part(names[int(number)] if 0 <= number < len(names) else "", int(count), color))
    return parts
