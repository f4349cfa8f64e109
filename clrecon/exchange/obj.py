"""Wavefront OBJ, text, with the frame, the unit, the iso value and the certificate in comments.

Own code because vtkOBJWriter has no comments and reports success on a full disk, and trimesh builds the text in memory.
Coordinates have nine digits, enough to get back the same float32, and fifteen far from the origin; normals have six.

The reader takes vertices, their normals and colours, faces of three corners and names of objects of any program: common
readers join vertices, drop the comments that name frame and unit, or split objects.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.content import Assembly, Content, check_same, parts_of, refuse_file, write_lines
from clrecon.exchange.raw_content import Part, RawCloud, RawMesh, columns_of, plain_lines, read_remarks, say_cut
from clrecon.system.paths import open_regular
from clrecon.system.pieces import chunks
from clrecon.system.text import count_of, escape_text

_CHUNK = 1 << 14
_PIECE = 1 << 22


def _header(content: Content | Assembly) -> bytes:
    remarks = parts_of(content)[0].remarks
    return "".join(f"# {remark}\n" for remark in remarks).encode("ascii")


def estimate(content: Content | Assembly) -> int:
    parts = parts_of(content)
    digits = len(str(sum(len(part.vertices) for part in parts)))
    return len(_header(content)) + sum(_estimate_part(part, digits) for part in parts)


def _estimate_part(content: Content, digits: int) -> int:
    color = 0 if content.color is None else 18
    if content.normals is None:
        return (30 + color) * len(content.vertices) + (3 * digits + 5) * len(content.triangles)
    return (58 + color) * len(content.vertices) + (6 * digits + 11) * len(content.triangles)


def write(stream: BinaryIO, content: Content | Assembly) -> None:
    """Write vertices, normals (if there are any) and faces; indices count from 1 and go on from object to object.

    Colours stand behind the coordinates of vertices, as MeshLab, Blender and others read and write them: a file of
    materials would be a second file.
    """
    stream.write(_header(content))
    before = normals_before = 1
    for number, part in enumerate(parts_of(content), start=1):
        if isinstance(content, Assembly):
            stream.write(f"o {_name_object(part, number)}\n".encode("ascii"))
        _write_part(stream, part, before, normals_before)
        before += len(part.vertices)
        normals_before += 0 if part.normals is None else len(part.normals)


def _name_object(part: Content, number: int) -> str:
    """Return the name of an object: one word of ASCII, as some readers take no more."""
    words = (part.name or f"object {number}").encode("ascii", "replace").decode("ascii").split()
    return "_".join(words) or f"object_{number}"


def _write_part(stream: BinaryIO, part: Content, before: int, normals_before: int) -> None:
    color = "" if part.color is None else " " + " ".join(f"{value:.4f}" for value in part.color)
    write_lines(stream, f"v {part.number} {part.number} {part.number}{color}\n", part.vertices)
    face = "f %d %d %d\n"
    if part.normals is not None:
        face = "f %d//%d %d//%d %d//%d\n"
        write_lines(stream, "vn %.6f %.6f %.6f\n", part.normals)
    for piece in chunks(len(part.triangles), _CHUNK):
        corners = part.triangles[piece].astype(np.int64) + before
        if part.normals is not None:
            corners = np.stack((corners, corners - before + normals_before), axis=2)
        write_lines(stream, face, corners)


def verify(path: Path, content: Content | Assembly) -> None:
    parts = parts_of(content)
    expected = {
        "vertices": (b"\nv ", sum(len(part.vertices) for part in parts)),
        "normals": (b"\nvn ", sum(0 if part.normals is None else len(part.normals) for part in parts)),
        "triangles": (b"\nf ", sum(len(part.triangles) for part in parts)),
        "objects": (b"\no ", len(parts) if isinstance(content, Assembly) else 0),
    }
    counts = dict.fromkeys(expected, 0)
    header = _header(content)
    with path.open("rb") as stream:
        check_same("in the header", stream.read(len(header)), header)
        tail = b"\n"
        while piece := stream.read(_PIECE):
            for words, (mark, _) in expected.items():
                # A pattern may cross the border of two pieces: all of its bytes but one are carried over, so it is
                # counted once.
                counts[words] += (tail[-(len(mark) - 1) :] + piece).count(mark)
            tail = piece[-3:]
    for words, (_, count) in expected.items():
        check_same(words, counts[words], count)
    if tail[-1:] != b"\n":
        raise refuse_file("at the end", repr(tail), "a line end")


_ELSE = (b"l", b"p", b"curv", b"curv2", b"surf")
"""Elements that are no faces."""
_NAMES = (b"o", b"g")


def read_mesh(path: Path) -> RawMesh:
    """Read an OBJ file; each object (``o``, else ``g``) that has faces is a part."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            text = plain_lines(stream.read()).replace(b"\\\n", b" ")
        return _collect_mesh(text.split(b"\n"), name)
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error


def _collect_mesh(lines: Sequence[bytes], name: str) -> RawMesh:
    vertices: list[bytes] = []
    normals: list[bytes] = []
    faces: list[bytes] = []
    before: list[tuple[int, int]] = []  # vertices and normals that a face with negative numbers counts back from
    begins: dict[bytes, list[tuple[int, bytes]]] = {kind: [] for kind in _NAMES}
    comments: list[str] = []
    left_out = 0
    for line in lines:
        kind, _, rest = line.strip().replace(b"\t", b" ").partition(b" ")
        if kind == b"v":
            vertices.append(rest)
        elif kind == b"f":
            faces.append(rest)
            if b"-" in rest:
                before.extend([(0, 0)] * (len(faces) - 1 - len(before)))
                before.append((len(vertices), len(normals)))
        elif kind == b"vn":
            normals.append(rest)
        elif kind in begins:
            begins[kind].append((len(faces), rest.strip()))
        elif kind == b"#":
            comments.append(rest.decode("latin-1"))
        else:
            left_out += kind in _ELSE
    table = _table(vertices, "vertices", name)
    if table.shape[1] not in (3, 4, 6, 7):
        raise RefusedInputError(f"{name} is corrupt: its vertices have {table.shape[1]} numbers")
    corners, of_normals = _corners(faces, before, name)
    mesh = RawMesh("OBJ", table[:, :3], corners, **read_remarks(comments))
    mesh.normals = _normals(normals, corners, of_normals, mesh, name)
    colors = table[:, -3:] if table.shape[1] >= 6 else None
    mesh.parts = _parts(begins[b"o"] or begins[b"g"], corners, colors)
    if left_out:
        mesh.warnings.append(
            f"elements left out: {count_of(left_out, 'point, line or curved surface', 'points, lines')}"
        )
    return mesh


def _table(rows: Sequence[bytes], noun: str, name: str) -> NDArray[np.float64]:
    widths = {row.count(b" ") for row in rows}
    split = [row.split() for row in rows] if len(widths) > 1 or any(b"  " in row for row in rows[:1]) else None
    width = len(rows[0].split()) if rows else 3
    if split is not None and any(len(row) != width for row in split):
        raise RefusedInputError(f"{name} is corrupt: its {noun} have unequally many numbers")
    numbers = b" ".join(rows).split()
    if len(numbers) != width * len(rows):
        raise RefusedInputError(f"{name} is corrupt: its {noun} have unequally many numbers")
    return np.array(numbers, dtype=np.float64).reshape(-1, width)


def _corners(
    faces: Sequence[bytes], before: Sequence[tuple[int, int]], name: str
) -> tuple[NDArray[np.int64], NDArray[np.int64] | None]:
    """Return the vertices of the faces, and their normals where each corner names one."""
    wrong = next((face for face in faces if len(face.split()) != 3), None)
    if wrong is not None:
        raise RefusedInputError(
            f"a face of {name} has {len(wrong.split())} corners ('f {escape_text(wrong.decode('latin-1'))}'): only"
            " triangles are read"
        )
    text = b" ".join(faces)
    of_normals = None
    if text.count(b"/") == 6 * len(faces) and faces:
        named = re.sub(rb"(?:^|(?<= ))[^/ ]*/[^/ ]*/", b"", text).split()
        if len(named) == 3 * len(faces):
            of_normals = _parse_indices(named, before, 1)
    return _parse_indices(re.sub(rb"/\S*", b"", text).split(), before, 0), of_normals


def _parse_indices(words: Sequence[bytes], before: Sequence[tuple[int, int]], which: int) -> NDArray[np.int64]:
    """Return indices from 0; negative ones count back from what stood before their face."""
    numbers = np.array(words, dtype=np.int64).reshape(-1, 3)
    counts = np.zeros((len(numbers), 1), np.int64)
    if before:
        counts[: len(before), 0] = [each[which] for each in before]
    return np.where(numbers < 0, numbers + counts, numbers - 1)


def _normals(
    rows: Sequence[bytes], corners: NDArray[np.int64], of_normals: NDArray[np.int64] | None, mesh: RawMesh, name: str
) -> NDArray[np.float32] | None:
    """Return normals of vertices; None where a vertex has none, or several."""
    if of_normals is None or not rows:
        return None
    table = _table(rows, "normals", name)
    count = len(mesh.vertices)
    if table.shape[1] != 3 or not _are_within(corners, count) or not _are_within(of_normals, len(table)):
        raise RefusedInputError(f"{name} is corrupt: a face refers to a vertex or normal that is not there")
    chosen = np.full(count, -1, np.int64)
    chosen[corners.ravel()] = of_normals.ravel()
    if (chosen < 0).any() or not np.array_equal(table[chosen[corners]], table[of_normals]):
        return None
    cloud = RawCloud("OBJ", mesh.vertices, columns_of(table[chosen], ("nx", "ny", "nz")))
    normals = cloud.normals()
    mesh.warnings += cloud.warnings
    return normals


def _are_within(numbers: NDArray[np.int64], count: int) -> bool:
    return bool(((numbers >= 0) & (numbers < count)).all())


def _parts(
    begins: Sequence[tuple[int, bytes]], corners: NDArray[np.int64], colors: NDArray[np.float64] | None
) -> list[Part]:
    starts = [(0, b""), *begins]
    ends = [*(start for start, _ in begins), len(corners)]
    named = [(start, end, text.decode("utf-8", "replace")) for (start, text), end in zip(starts, ends, strict=True)]
    return [
        Part(text, end - start, _one_color(corners[start:end], colors)) for start, end, text in named if end > start
    ]


def _one_color(corners: NDArray[np.int64], colors: NDArray[np.float64] | None) -> tuple[float, float, float] | None:
    if colors is None or not _are_within(corners, len(colors)):
        return None
    rows = colors[corners.ravel()]
    if not ((rows == rows[0]).all() and ((rows[0] >= 0.0) & (rows[0] <= 1.0)).all()):
        return None
    red, green, blue = rows[0].tolist()
    return red, green, blue
