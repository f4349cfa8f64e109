"""VTP, the XML PolyData of VTK, written by VTK: raw binary data after the XML, with 64-bit headers.

VTK writes to a string, which is then written to our stream: VTK itself leaves a truncated file on a full disk.  The
field arrays ``SPACE``, ``UNIT``, ``ISO_VALUE_HU``, ``AFFINE_IJK_TO_LPS_MM`` (16 numbers, row by row) and
``CERTIFICATE`` (one text for each fact) tell what the coordinates are; 3D Slicer reads ``SPACE``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError
from clrecon.exchange.content import BONE_COLOR, Assembly, Content, PointContent, refuse_file
from clrecon.exchange.vtk import make_polydata

_END = b"</VTKFile>"


def _join(content: PointContent | Assembly) -> PointContent:
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
    )


def estimate(content: PointContent | Assembly) -> int:
    """Return the size of the data in bytes, without the XML: the indices and an offset for each triangle or point."""
    if isinstance(content, Assembly):
        return sum(estimate(part) + 7 * len(part.triangles) for part in content.parts)
    arrays = (content.vertices, content.normals, content.hu, content.labels)
    cells = 16 * len(content.triangles) if isinstance(content, Content) else 8 * len(content.vertices)
    return sum(array.nbytes for array in arrays if array is not None) + cells


def write(stream: BinaryIO, content: PointContent | Assembly) -> None:
    """Write the surface or cloud with its field arrays; each triangle of several meshes has the number of its mesh.

    The numbers are the cell array ``PART``, from 0 on, the colours the cell array ``COLOR``; the field array
    ``PART_NAMES`` has the names in this order.
    """
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    assembly, content = content, _join(content)
    polydata = make_polydata(content.vertices, _triangles(content), content.normals, content.hu, content.labels)
    for array in _field_arrays(content):
        polydata.GetFieldData().AddArray(array)
    if isinstance(assembly, Assembly):
        _add_parts(polydata, assembly.parts)
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(polydata)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    writer.SetCompressorTypeToNone()
    writer.SetHeaderTypeToUInt64()
    writer.SetByteOrderToLittleEndian()
    writer.WriteToOutputStringOn()
    if writer.Write() != 1:
        raise OutputError(f"VTK could not write the file, its error code is {writer.GetErrorCode()}")
    text = writer.GetOutputString()
    # VTK's Python returns str if the bytes happen to be UTF-8, else bytes.
    stream.write(text.encode("utf-8") if isinstance(text, str) else text)


def _add_parts(polydata: Any, parts: Sequence[Content]) -> None:
    from vtkmodules.util.numpy_support import numpy_to_vtk

    counts = [len(part.triangles) for part in parts]
    colors = np.array([BONE_COLOR if part.color is None else part.color for part in parts])
    arrays = {
        "PART": np.repeat(np.arange(len(parts), dtype=np.int32), counts),
        "COLOR": np.repeat(np.rint(255.0 * colors).astype(np.uint8), counts, axis=0),
    }
    for name, values in arrays.items():
        array = numpy_to_vtk(values, deep=True)
        array.SetName(name)
        polydata.GetCellData().AddArray(array)
    names = [part.name or f"object {number}" for number, part in enumerate(parts, start=1)]
    polydata.GetFieldData().AddArray(_strings("PART_NAMES", names))


def _strings(name: str, texts: Sequence[str]) -> Any:
    from vtkmodules.vtkCommonCore import vtkStringArray

    strings = vtkStringArray()
    strings.SetName(name)
    for text in texts:
        strings.InsertNextValue(text)
    return strings


def _triangles(content: PointContent) -> NDArray[np.uint32] | None:
    return content.triangles if isinstance(content, Content) else None


def _field_arrays(content: PointContent) -> list[Any]:
    from vtkmodules.vtkCommonCore import vtkDoubleArray

    arrays: list[Any] = []
    inside = () if content.inside is None else (content.inside,)
    texts_by_name = {"SPACE": (content.space,), "UNIT": ("mm",), "INSIDE": inside, "CERTIFICATE": content.certificate}
    for name, texts in texts_by_name.items():
        if texts:
            arrays.append(_strings(name, texts))
    numbers: list[tuple[str, list[float]]] = []
    if content.iso_value_hu is not None:
        numbers.append(("ISO_VALUE_HU", [content.iso_value_hu]))
    if content.affine is not None:
        numbers.append(("AFFINE_IJK_TO_LPS_MM", content.affine.ravel().tolist()))
    for name, values in numbers:
        doubles = vtkDoubleArray()
        doubles.SetName(name)
        doubles.SetNumberOfComponents(len(values))
        doubles.InsertNextTuple(values)
        arrays.append(doubles)
    return arrays


def verify(path: Path, content: PointContent | Assembly) -> None:
    """Check the counts in the XML and the end of a finished file."""
    least, content = estimate(content), _join(content)
    with path.open("rb") as stream:
        head = stream.read(8192).decode("latin-1")
        stream.seek(max(path.stat().st_size - 64, 0))
        end = stream.read()
    points, triangles = len(content.vertices), _triangles(content)
    cells = ("NumberOfVerts", points) if triangles is None else ("NumberOfPolys", len(triangles))
    for name, count in (("NumberOfPoints", points), cells):
        match = re.search(rf'{name}="(\d+)"', head)
        if match is None or int(match[1]) != count:
            raise refuse_file(name, None if match is None else match[1], count)
    if not end.rstrip().endswith(_END):
        raise refuse_file("at the end", repr(end[-16:]), _END.decode())
    if path.stat().st_size < least:
        raise refuse_file("bytes", path.stat().st_size, f"more than {least}")
