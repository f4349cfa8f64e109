"""Wavefront OBJ of any program: vertices, their normals and colours, faces of three corners, names of objects.

Own code because common readers join vertices, drop the comments that name frame and unit, or split objects.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.exchange.clouds.raw_cloud import RawCloud, columns_of, read_remarks, say_cut
from clrecon.exchange.meshes.plain_lines import plain_lines
from clrecon.exchange.meshes.raw_mesh import Part, RawMesh
from clrecon.system.paths import open_regular
from clrecon.system.text import count_of, escape_text

_ELSE = (b"l", b"p", b"curv", b"curv2", b"surf")
"""Elements that are no faces."""
_NAMES = (b"o", b"g")


def read(path: Path) -> RawMesh:
    """Read an OBJ file; each object (``o``, else ``g``) that has faces is a part."""
    name = escape_text(path.name)
    try:
        with open_regular(path) as stream:
            text = plain_lines(stream.read()).replace(b"\\\n", b" ")
        return _collect(text.split(b"\n"), name)
    except (OSError, ValueError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error


def _collect(lines: Sequence[bytes], name: str) -> RawMesh:
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
    corners, of_normals = _corners(faces, before, len(table), name)
    said = read_remarks(comments)
    mesh = RawMesh("OBJ", table[:, :3], corners, **said)
    mesh.normals = _normals(normals, corners, of_normals, mesh, name)
    colors = table[:, -3:] if table.shape[1] >= 6 else None
    mesh.parts = _parts(begins[b"o"] or begins[b"g"], corners, colors)
    if left_out:
        mesh.warnings.append(
            f"elements left out: {count_of(left_out, 'point, line or curved surface', 'points, lines')}"
        )
    return mesh


def _table(rows: Sequence[bytes], noun: str, name: str) -> NDArray[np.float64]:
    """Return the numbers of lines that have equally many."""
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
    faces: Sequence[bytes], before: Sequence[tuple[int, int]], vertices: int, name: str
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
            of_normals = _numbers(named, before, 1)
    return _numbers(re.sub(rb"/\S*", b"", text).split(), before, 0), of_normals


def _numbers(words: Sequence[bytes], before: Sequence[tuple[int, int]], which: int) -> NDArray[np.int64]:
    """Return indices from 0; negative ones count back from what stood before their face."""
    numbers = np.array(words, dtype=np.int64).reshape(-1, 3)
    counts = np.zeros((len(numbers), 1), np.int64)
    if before:
        counts[: len(before), 0] = [each[which] for each in before]
    return np.where(numbers < 0, numbers + counts, numbers - 1)


def _normals(
    rows: Sequence[bytes],
    corners: NDArray[np.int64],
    of_normals: NDArray[np.int64] | None,
    mesh: RawMesh,
    name: str,
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
    """Return the colour that all these corners have."""
    if colors is None or not _are_within(corners, len(colors)):
        return None
    found = colors[corners.ravel()]
    if not ((found == found[0]).all() and ((found[0] >= 0.0) & (found[0] <= 1.0)).all()):
        return None
    red, green, blue = found[0].tolist()
    return red, green, blue
