"""What a reader found in a file of a mesh or a cloud, in the file's own frame, and what readers share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import SPACES, frame_from_lps
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.text import escape_text, join_names

_HU_NAMES = ("hu", "scalar_hu", "ct", "scalar", "intensity", "scalar_intensity")
_LABEL_NAMES = ("label", "labels", "scalar_label", "cluster", "scalar_cluster", "classification")
_NORMAL_NAMES = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"))
_UNIT_TOLERANCE = 1e-3
"""Largest difference of a normal's length from 1 that rounding in text files explains."""


@dataclass
class RawCloud:
    """A file's points (n, 3) of any real type, perhaps not finite, mm in its own frame, and its named columns (n,)."""

    kind: str
    points: NDArray[Any]
    columns: dict[str, NDArray[Any]]
    space: str | None = None
    affine: NDArray[Any] | None = None
    iso_value_hu: float | None = None
    certificate: Sequence[str] = ()
    warnings: list[str] = field(default_factory=list)
    has_faces: bool = False

    def __post_init__(self) -> None:
        if self.has_faces:
            self.warnings.append(f"clrecon render draws the faces of this file with {name_parameter('mode', 'mesh')}")
        self._by_name = {name.strip().lower(): name for name in reversed(self.columns)}
        self._used: set[str] = set()

    def _take(self, names: Iterable[str]) -> list[NDArray[Any]] | None:
        """Return the columns of these names, or None unless all are there."""
        columns = [self._by_name.get(name) for name in names]
        if None in columns:
            return None
        self._used |= set(columns)  # type: ignore[arg-type]
        return [self.columns[name] for name in columns if name is not None]

    def normals(self) -> NDArray[np.float32] | None:
        """Return unit normals, shape (n, 3), or None where the file has none that can be used."""
        three_columns = next((columns for names in _NORMAL_NAMES if (columns := self._take(names))), None)
        if three_columns is None:
            return None
        with np.errstate(all="ignore"):  # harmed bits
            normals = np.stack(three_columns, axis=1).astype(np.float64)
        wrong = int((~np.isfinite(normals).all(axis=1)).sum())
        if wrong:
            self.warnings.append(f"{wrong:,} normals are not finite: the normals are left out")
            return None
        length = np.linalg.norm(normals, axis=1)
        off = (np.abs(length - 1.0) > _UNIT_TOLERANCE) & (length > 0)
        if off.any():
            self.warnings.append(f"{int(off.sum()):,} normals are not of length 1: they are scaled")
            normals[off] /= length[off, None]
        if none := int((length == 0).sum()):
            self.warnings.append(f"{none:,} normals are zero: these points have none")
        return normals.astype(np.float32)

    def hu(self) -> NDArray[np.float32] | None:
        for rank, name in enumerate(_HU_NAMES):
            columns = self._take([name])
            if columns is not None:
                if rank >= _HU_NAMES.index("scalar"):
                    self.warnings.append(f"HU is taken from the column '{escape_text(self._by_name[name])}'")
                with np.errstate(all="ignore"):
                    return columns[0].astype(np.float32)
        return None

    def labels(self) -> NDArray[np.int32] | None:
        """Return the labels, shape (n,), or None where there are none or they are no whole numbers of 32 bits."""
        for name in _LABEL_NAMES:
            columns = self._take([name])
            if columns is not None:
                values = columns[0]
                whole = np.isfinite(values) & (np.abs(values.astype(np.float64)) < 2**31)
                if not (whole.all() and (values == np.rint(values)).all()):
                    self.warnings.append(
                        f"the column '{escape_text(self._by_name[name])}' has values that are no labels: left out"
                    )
                    return None
                return values.astype(np.int32)
        return None

    def ijk(self) -> NDArray[np.int32] | None:
        """Return voxel indices, shape (n, 3), or None; only our own NPZ has them."""
        columns = self._take(("i", "j", "k")) if self.kind == "NPZ" else None
        return None if columns is None else np.stack(columns, axis=1).astype(np.int32)

    def values(self) -> dict[str, NDArray[np.float32]]:
        """Return the numbers in mm at the points, shape (n,) each: columns ``NAME_mm`` or ``scalar_NAME_mm``."""
        named = {name.removeprefix("scalar_"): name for name in self.columns if name.endswith("_mm")}
        numbers = numbers_of({name: self.columns[own] for name, own in named.items()})
        self._used |= {named[name] for name in numbers}
        return numbers

    def unused(self) -> list[str]:
        """Return the warning about columns that were not taken, if there are any."""
        others = [escape_text(name) for name in self.columns if name not in self._used]
        return [f"columns left out: {join_names(others)}"] if others else []


def columns_of(values: NDArray[Any], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return the columns of an array of shape (n, k) by their names."""
    return {name: values[:, place] for place, name in enumerate(names)}


def numbers_of(columns: Mapping[str, Any]) -> dict[str, NDArray[np.float32]]:
    """Return the columns of one number each that can be `values` of a mesh, copied: named by letters, digits and _."""
    arrays = {name: np.asarray(column) for name, column in columns.items() if name.isascii() and name.isidentifier()}
    with np.errstate(all="ignore"):  # harmed bits
        return {
            name: each.astype(np.float32)
            for name, each in arrays.items()
            if each.ndim == 1 and each.dtype.kind in "biuf"
        }


def join_numbers(parts: Sequence[tuple[Mapping[str, NDArray[np.floating]], int]]) -> dict[str, NDArray[np.floating]]:
    """Join numbers by name, of so many vertices or triangles each; NaN where a part has none."""
    names = dict.fromkeys(chain(*(names for names, _ in parts)))
    return {
        name: np.concatenate([own.get(name, np.full(count, np.nan, np.float32)) for own, count in parts])
        for name in names
    }


def read_remarks(lines: Iterable[str]) -> dict[str, Any]:
    """Return what comments say: ``space``, ``iso_value_hu`` and ``certificate``, as entries of a `RawCloud`."""
    remarks: dict[str, Any] = {"certificate": []}
    for line in lines:
        text = line.strip()
        if text.startswith("SPACE=") and "space" not in remarks:
            remarks["space"] = text.removeprefix("SPACE=").strip()
        elif text.startswith("ISO_VALUE_HU="):
            try:
                remarks["iso_value_hu"] = float(text.removeprefix("ISO_VALUE_HU="))
            except ValueError:
                continue
        elif text.startswith("CERTIFICATE "):
            remarks["certificate"].append(text.removeprefix("CERTIFICATE "))
    return remarks


def say_cut(name: str, error: object) -> RefusedInputError:
    """Return the error for a file that ends early or holds what its format forbids; numpy's of tables in our words."""
    text = str(error) or type(error).__name__
    if match := _COLUMNS.match(text):
        before, now, row = match.groups()
        text = f"row {row} of its table has {now} numbers, those before have {before}"
    elif match := _NO_NUMBER.match(text):
        word, row, column = match.groups()
        text = f"{word} stands in place of a number in row {int(row) + 1} of its table, column {column}"
    return RefusedInputError(f"{name} is cut or corrupt: {escape_text(text, 120)}")


_COLUMNS = re.compile(r"the number of columns changed from (\d+) to (\d+) at row (\d+)")
_NO_NUMBER = re.compile(r"could not convert string (.*) to \w+ at row (\d+), column (\d+)")


@dataclass(frozen=True)
class Part:
    """An object of a file, perhaps unnamed: its triangles follow those before; red, green, blue, 0 to 1, sRGB."""

    name: str
    triangles: int
    color: tuple[float, float, float] | None = None


@dataclass
class RawMesh:
    """A file's triangles, perhaps of absent vertices; these, in `unit`, of any real type, may not be finite."""

    kind: str
    vertices: NDArray[Any]
    triangles: NDArray[Any]
    normals: NDArray[np.float32] | None = None
    space: str | None = None
    iso_value_hu: float | None = None
    certificate: Sequence[str] = ()
    warnings: list[str] = field(default_factory=list)
    unit: str = "mm"
    parts: Sequence[Part] = ()
    values: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    face_values: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)


def frame_of_file(raw: RawCloud | RawMesh, asked: str | None, name: str) -> tuple[str, str]:
    """Return the frame of a file's coordinates, LPS or RAS, and where it is known from: file, argument or assumed."""
    named = None if raw.space is None else raw.space.upper()
    if named is not None and named.lower() not in SPACES:
        raw.warnings.append(f"{name} names the frame '{escape_text(named)}', which is not known")
        named = None
    if asked is not None and named is not None and asked.upper() != named:
        raise UsageError(
            f"{name} says that its coordinates are {named}, {asked.upper()} was asked for: leave the space out"
        )
    if named:
        return named, "file"
    return (asked.upper(), "argument") if asked else ("LPS", "assumed")


def turn_to_lps(
    frame: str, points: NDArray[Any], normals: NDArray[np.float32] | None
) -> tuple[NDArray[Any], NDArray[np.float32] | None]:
    """Return points (n, 3) and normals (n, 3) of a frame in LPS, or those of LPS in that frame."""
    signs = np.diag(frame_from_lps(frame))
    if (signs > 0.0).all():
        return points, normals
    # Adding 0 turns -0 into 0; text formats would show -0.
    points = points * signs.astype(points.dtype if points.dtype.kind == "f" else np.float64) + points.dtype.type(0)
    return points, None if normals is None else normals * signs.astype(np.float32) + np.float32(0)


MOST_LEVELS = 32
"""Most levels of objects within objects; more are refused, as is an object within itself."""

_MOST_SHAPES = 10_000
"""Most shapes of a file: a few lines of objects within objects can ask for any number."""

_MOST_CORNERS = 1 << 30
"""Most corners of triangles: as for `_MOST_SHAPES`."""

_SNAP = 1e-12
"""Numbers of a rotation this close to a whole one are that: two matrices that undo each other change no vertex."""


@dataclass(frozen=True)
class Shape:
    """Triangles (m, 3) in a frame of their own, perhaps of vertices that are not there."""

    vertices: NDArray[np.floating]
    triangles: NDArray[np.integer]
    normals: NDArray[np.float32] | None = None
    values: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)


@dataclass
class PlacedShapes:
    parts: list[Part] = field(default_factory=list)
    _vertices: list[NDArray[np.floating]] = field(default_factory=list)
    _triangles: list[NDArray[np.int64]] = field(default_factory=list)
    _normals: list[NDArray[np.float32] | None] = field(default_factory=list)
    _values: list[tuple[Mapping[str, NDArray[np.float32]], int]] = field(default_factory=list)
    _count: int = 0
    _corners: int = 0
    _steps: int = 0

    def count_step(self) -> None:
        """Count an object that was looked at; ValueError where that does not end."""
        self._steps += 1
        if self._steps > 10 * _MOST_SHAPES:
            raise ValueError(f"more than {10 * _MOST_SHAPES:,} objects within objects")

    def add(self, shape: Shape, matrix: NDArray[np.float64], part: Part) -> None:
        """Add a shape that `matrix`, shape (4, 4), places; a mirror turns its triangles round."""
        self._corners += max(shape.triangles.size, shape.vertices.size)
        if len(self.parts) == _MOST_SHAPES or self._corners > _MOST_CORNERS:
            raise ValueError(f"more than {_MOST_SHAPES:,} shapes or {_MOST_CORNERS:,} corners")
        if not np.isfinite(matrix).all() or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            raise ValueError("a transform that is no affine of finite numbers")
        turn = matrix[:3, :3]
        whole = np.rint(turn)
        turn = np.where(np.abs(turn - whole) <= _SNAP * max(1.0, float(np.abs(turn).max())), whole, turn)
        determinant = np.linalg.det(turn)
        if determinant == 0.0:
            raise ValueError("a transform that makes everything flat")
        is_moved = not (np.array_equal(turn, np.eye(3)) and not matrix[:3, 3].any())
        vertices = shape.vertices @ turn.T + matrix[:3, 3] if is_moved else shape.vertices
        triangles = shape.triangles if determinant > 0.0 else shape.triangles[:, ::-1]
        self._vertices.append(vertices)
        # A number that no vertex has must not become one of the next shape.
        wrong = (triangles < 0) | (triangles >= len(vertices))
        if wrong.any():
            raise ValueError(f"a triangle refers to vertex {int(triangles[wrong][0]):,} of {len(vertices):,}")
        self._triangles.append(triangles.astype(np.int64) + self._count)
        self._values.append((shape.values, len(vertices)))
        self._normals.append(_turned(shape.normals, np.linalg.inv(turn).T if is_moved else None))
        self._count += len(vertices)
        self.parts.append(part)

    def joined(self) -> Shape:
        """Return all shapes as one; with normals where each of them has some."""
        if not self.parts:
            return Shape(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
        normals = [each for each in self._normals if each is not None]
        return Shape(
            np.concatenate(self._vertices),
            np.concatenate(self._triangles),
            np.concatenate(normals) if len(normals) == len(self._normals) else None,
            join_numbers(self._values),
        )


def _turned(normals: NDArray[np.float32] | None, turn: NDArray[np.float64] | None) -> NDArray[np.float32] | None:
    if normals is None or turn is None:
        return normals
    turned = normals @ turn.T
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    return np.divide(turned, length, out=np.zeros_like(turned), where=length > 0).astype(np.float32)


MARK = b"\xef\xbb\xbf"
"""Byte order mark of UTF-8."""


def plain_lines(data: bytes) -> bytes:
    """Return a text without its byte order mark, with a line feed at the end of each line."""
    return data.removeprefix(MARK).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
