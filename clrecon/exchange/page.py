"""A mesh as a page of HTML that shows it: one file, which asks for nothing from outside.

The page turns, clips, hides, colours and measures in parallel projection.  Its Content-Security-Policy names its own
script and style by their hashes and allows nothing else, so a browser loads and sends nothing.  Besides the surface it
holds the names of the parts, the iso value, the certificate's lines, and how far it rounds the vertices.  Exported
pages of libraries are three times as large, ask other servers for icons, and lose the parallel projection.

The surface is coded as bytes; decoding is the twin of what ``page.js`` does.  Vertices are numbered in the order of
their first use.  An index is told by its difference from one of the 24 indices before it, or from the next vertex that
none has used: by how far back, and by the difference.  Positions are 16-bit steps within the bounding box, normals
places on an octahedron that is unfolded onto a square.  Differences of neighbours are small; signs are folded into the
lowest bit (zigzag), and bytes of equal weight stand together (byte planes), which deflate packs best: planes of x, y, z
of the positions (low bytes, then high bytes), two of the normals, one of how far back each index looks, four of the
differences, and two of each number in mm at the vertices.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import zlib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.exchange.content import BONE_COLOR, Assembly, Content, check_same, parts_of, refuse_file
from clrecon.exchange.page_slices import PackedSlices, describe_slices
from clrecon.exchange.raw_content import join_numbers
from clrecon.system.color_scale import ColorScale
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import find_bounds, in_threads, side_by_side
from clrecon.system.text import to_hexadecimal
from clrecon.version import package_version

STEPS = 65_535
"""Steps of a coordinate along a side of the bounding box; of a number at a vertex this one means that none is known."""

NORMAL_SCALE = 127
"""Steps from the middle of the square of normals to its side."""

_LOOKED_BACK = 24
"""Indices that one is compared with: with 16 pages are 0.5 % larger."""

_LEVEL = 6
"""Of zlib: 5 makes pages 2.5 % larger, 7 takes a third longer for 1 %; ISA-L is faster and makes them 13 % larger."""

_GZIP = 16 + zlib.MAX_WBITS


@dataclass(frozen=True, eq=False)
class CodedSurface:
    """A surface as a page holds it: counts, lowest corner and steps of coordinates, mm, gzip of the byte planes."""

    vertices: int
    triangles: int
    low_mm: tuple[float, ...]
    step_mm: tuple[float, ...]
    data: bytes
    columns: int = 0

    @property
    def half_step_mm(self) -> float:
        """Largest distance along an axis that the page moves a vertex."""
        return 0.5 * max(self.step_mm)


def encode_surface(
    vertices: NDArray[np.floating],
    normals: NDArray[np.float32],
    triangles: NDArray[np.integer],
    numbers: NDArray[np.uint16] | None = None,
) -> CodedSurface:
    """Code a surface of one triangle or more, in their order; unit normals (n, 3), `numbers` in steps (n, k)."""
    order, corners = _renumber(triangles, len(vertices))
    places = vertices[order].astype(np.float64)
    low, high = find_bounds(places)
    step = (high - low) / STEPS
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, _GZIP, zlib.DEF_MEM_LEVEL, zlib.Z_FILTERED)

    def pack_vertices() -> bytes:
        scaled = (places - low) / np.where(step > 0.0, step, 1.0)
        positions = np.clip(np.rint(scaled), 0, STEPS).astype(np.uint16)
        turned = _unfold_octahedron(normals[order])
        folded = _fold(positions, np.uint16, np.int16), _fold(turned.view(np.uint8), np.uint8, np.int8)
        return b"".join(packer.compress(_split_planes(values)) for values in folded)

    packed, codes = side_by_side(pack_vertices, lambda: _code_corners(corners))
    numbers = np.empty((len(vertices), 0), np.uint16) if numbers is None else numbers
    data = packed + packer.compress(codes) + packer.compress(_split_planes(_fold(numbers[order], np.uint16, np.int16)))
    corner, sides = tuple(low.tolist()), tuple(step.tolist())
    return CodedSurface(len(order), len(triangles), corner, sides, data + packer.flush(), numbers.shape[1])


def unpack_planes(coded: CodedSurface) -> NDArray[np.uint8]:
    try:
        data = np.frombuffer(isal_zlib.decompress(coded.data, _GZIP), np.uint8)
    except isal_zlib.error as error:  # type: ignore[misc]
        raise ValueError(f"the data of the surface cannot be unpacked: {error}") from error
    expected = (8 + 2 * coded.columns) * coded.vertices + 15 * coded.triangles
    if len(data) != expected:
        raise ValueError(f"the surface has {len(data):,} bytes, {expected:,} expected")
    return data


def _renumber(triangles: NDArray[np.integer], count: int) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Return the used vertices in the order of their first use, and the corners as numbers in that order."""
    corners = triangles.reshape(-1)
    first = np.full(count, -1, dtype=np.int32)
    first[corners[::-1]] = np.arange(len(corners) - 1, -1, -1, dtype=np.int32)  # of equal indices the last one stays
    is_first = np.zeros(len(corners), dtype=bool)
    is_first[first[first >= 0]] = True
    order = corners[is_first].astype(np.intp)
    first[order] = np.arange(len(order), dtype=np.int32)
    return order, first[corners]


def _code_corners(corners: NDArray[np.int32]) -> bytes:
    """Return for each corner how far back the nearest one is, 0 for the next new vertex, and planes of differences."""
    codes = corners.copy()
    codes[1:] -= np.maximum.accumulate(corners)[:-1] + 1
    lags = np.zeros(len(corners), np.uint8)

    def look_back(block: slice) -> None:
        for lag in range(1, _LOOKED_BACK + 1):
            first = max(block.start, lag)
            changes = corners[first : block.stop] - corners[first - lag : max(block.stop - lag, 0)]
            nearer = np.abs(changes) < np.abs(codes[first : block.stop])
            np.copyto(codes[first : block.stop], changes, where=nearer)
            np.copyto(lags[first : block.stop], np.uint8(lag), where=nearer)

    in_threads(look_back, len(corners))
    return lags.tobytes() + _split_planes(((codes << 1) ^ (codes >> 31)).view(np.uint32)[:, None])


def _unfold_octahedron(normals: NDArray[np.float32]) -> NDArray[np.int8]:
    """Return unit vectors (n, 3) as places (n, 2) of a square, those of negative z outside of its diamond."""
    x, y, z = (normals / np.maximum(np.abs(normals).sum(axis=1, keepdims=True), np.float32(1e-9))).T
    beyond = np.copysign(1.0 - np.abs(y), x), np.copysign(1.0 - np.abs(x), y)
    places = np.where(z < 0.0, beyond, (x, y)).T
    return np.rint(NORMAL_SCALE * np.clip(places, -1.0, 1.0)).astype(np.int8)


def _fold(values: NDArray[Any], unsigned: type[np.integer[Any]], signed: type[np.integer[Any]]) -> NDArray[Any]:
    """Return differences of neighbouring rows with the sign in the lowest bit."""
    first = np.zeros((1, values.shape[1]), dtype=unsigned)
    changes = np.diff(values, axis=0, prepend=first).view(signed)
    return ((changes << 1) ^ (changes >> (8 * changes.itemsize - 1))).view(unsigned)


def _split_planes(values: NDArray[Any]) -> bytes:
    """Return the bytes of unsigned numbers (n, k) as planes: the lowest byte of each column in turn, then the next."""
    size = values.dtype.itemsize
    little = values.astype(f"<u{size}", copy=False)
    return little.view(np.uint8).reshape(*values.shape, size).transpose(2, 1, 0).tobytes()


MOST_TRIANGLES = 10_000_000
"""About 50 MB of page and 200 MB on the graphics card; more is slow to turn on most computers."""

_LEAST_BYTES_A_TRIANGLE = 0.04
"""Of the surface: a flat grid packs to 0.05, a sphere to 2.8, those of scans to 3 to 5."""

BLOCK = re.compile(r'<script id="(facts|surface|slices)" type="[a-z/]+">([^<]*)</script>')


def estimate(content: Content | Assembly) -> int:
    code_bytes = len(read_page_code("page.html")) + len(read_page_code("page.css")) + len(_script(None))
    return code_bytes + int(_LEAST_BYTES_A_TRIANGLE * sum(len(part.triangles) for part in parts_of(content)))


def write(stream: BinaryIO, content: Content | Assembly) -> None:
    stream.write(compose_page(content))


def compose_page(content: Content | Assembly) -> bytes:
    meshes = parts_of(content)
    count = sum(len(mesh.triangles) for mesh in meshes)
    if count > MOST_TRIANGLES:
        raise UsageError(
            f"{count:,} triangles are too many for a page, at most {MOST_TRIANGLES:,} are shown: keep the largest parts"
            " only, or decimate the mesh, or write .glb or .ply"
        )
    columns, numbers = _code_values(meshes)
    coded, parts = _join_parts(meshes, numbers)
    slices = next((mesh.slices for mesh in meshes if mesh.slices is not None), None)
    facts: dict[str, Any] = {
        "vertices": coded.vertices,
        "triangles": coded.triangles,
        "low": coded.low_mm,
        "step": coded.step_mm,
        "half_step_mm": coded.half_step_mm,
        "space": meshes[0].space,
        "parts": parts,
        "about": _describe_meshes(meshes, coded),
    }
    if columns:
        facts["values"] = columns
    if slices is not None:
        facts |= {"slices": slices.facts, "about": [describe_slices(slices.facts), *facts["about"]]}
    # "<" would end the block: in JSON it can stand as an escape.
    text = json.dumps(facts, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    style, script = _style(slices), _script(slices)
    policy = (
        f"default-src 'none'; script-src '{hash_code(script)}'; style-src '{hash_code(style)}'; base-uri 'none';"
        " form-action 'none'"
    )
    packed = "" if slices is None else base64.b64encode(slices.data).decode("ascii")
    block = f'<script id="slices" type="text/plain">{packed}</script>\n' if packed else ""
    planes = f"{read_page_code('page_slices.html')}\n" if packed else ""
    filled = {"POLICY": policy, "STYLE": style, "SCRIPT": script, "FACTS": text, "PLANES": planes, "SLICES": block}
    before, after = (
        re.sub("@([A-Z]+)@", lambda place: filled[place[1]], half)  # at once: what is filled in is not looked at again
        for half in (read_page_code("page.html") + "\n").split("@SURFACE@")
    )
    return before.encode() + base64.b64encode(coded.data) + after.encode()


def parse_page(page: bytes) -> tuple[dict[str, Any], CodedSurface]:
    """Return the facts and the surface that a page of `compose_page` holds."""
    blocks = dict(BLOCK.findall(page.decode("utf-8")))
    if set(blocks) - {"slices"} != {"facts", "surface"} or not page.endswith(b"</html>\n"):
        raise ValueError("this is no page of a surface")
    facts = json.loads(blocks["facts"])
    data = base64.b64decode(blocks["surface"], validate=True)
    corner, sides = tuple(facts["low"]), tuple(facts["step"])
    columns = len(facts.get("values", ()))
    return facts, CodedSurface(facts["vertices"], facts["triangles"], corner, sides, data, columns)


def read_facts(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the facts of a page that was written: counts, parts, steps."""
    return parse_page(Path(path).read_bytes())[0]


def verify(path: Path, content: Content | Assembly) -> None:
    """Unpack a finished file, whose gzip has a checksum, and count what is in it."""
    try:
        _, coded = parse_page(path.read_bytes())
        unpack_planes(coded)
    except ValueError as error:
        raise refuse_file(f"({error})", "no page", "a page") from error
    check_same("triangles", coded.triangles, sum(len(part.triangles) for part in parts_of(content)))


def _code_values(meshes: Sequence[Content]) -> tuple[list[dict[str, Any]], NDArray[np.uint16]]:
    """Return names, steps and scales of the numbers in mm at vertices, and these (n, k) in steps, unknown `STEPS`."""
    joined = join_numbers([(mesh.values, len(mesh.vertices)) for mesh in meshes])
    columns: list[dict[str, Any]] = []
    codes = [np.empty((sum(len(mesh.vertices) for mesh in meshes), 0), np.uint16)]
    for name, values in joined.items():
        scale = ColorScale.spanning(values) if name.endswith("_mm") else None
        if scale is None:
            continue
        known = np.isfinite(values)
        low, high = float(values[known].min()), float(values[known].max())
        step = (high - low) / (STEPS - 1) or 1.0
        places = np.rint((np.where(known, values, low).astype(np.float64) - low) / step)
        codes.append(np.where(known, places, STEPS).astype(np.uint16)[:, None])
        colors = [to_hexadecimal(color / 255.0) for color in scale.table]
        columns.append({"name": name, "low": low, "step": step, "ticks": scale.ticks, "colors": colors})
    return columns, np.concatenate(codes, axis=1)


def _join_parts(meshes: Sequence[Content], numbers: NDArray[np.uint16]) -> tuple[CodedSurface, list[dict[str, Any]]]:
    """Code all meshes as one surface whose triangles are sorted by part, and list the parts."""
    vertices, normals = [], []
    triangles, parts = [], []
    before, first = 0, 0
    for number, mesh in enumerate(meshes, start=1):
        assert mesh.normals is not None
        vertices.append(mesh.vertices @ mesh.to_lps.T)
        normals.append(mesh.normals @ mesh.to_lps.T.astype(np.float32))
        corners = mesh.triangles + np.uint32(before)
        if mesh.pieces is not None:
            few_bits = np.min_scalar_type(len(mesh.pieces.names))  # are sorted in a third of the time
            corners = corners[np.argsort(mesh.pieces.of_triangle.astype(few_bits), kind="stable")]
        triangles.append(corners)
        before += len(mesh.vertices)
        called = mesh.title or mesh.name or (f"surface {number}" if len(meshes) > 1 else "")
        color = to_hexadecimal(BONE_COLOR if mesh.color is None else mesh.color)
        for name, count, ml in _pieces(mesh):
            named = " ".join(filter(None, (called, name)))
            parts.append({"name": named or "surface", "color": color, "ml": ml, "first": first, "count": count})
            first += count
    coded = encode_surface(np.concatenate(vertices), np.concatenate(normals), np.concatenate(triangles), numbers)
    return coded, parts


def _pieces(mesh: Content) -> list[tuple[str, int, float | None]]:
    """Return name, number of triangles and ml of each part of a mesh."""
    pieces = mesh.pieces
    if pieces is None:
        return [("", len(mesh.triangles), None)]
    counts = np.bincount(pieces.of_triangle, minlength=len(pieces.names))
    return [
        (name, int(count), None if ml is None else float(f"{ml:.6g}"))
        for name, count, ml in zip(pieces.names, counts, pieces.volumes_ml, strict=True)
    ]


def _describe_meshes(meshes: Sequence[Content], coded: CodedSurface) -> list[str]:
    """Return the lines below the parts: what is shown, how exactly, and where it comes from."""
    insides = list(dict.fromkeys(inside for mesh in meshes if (inside := _inside(mesh))))
    certificates = list(dict.fromkeys(mesh.certificate for mesh in meshes if mesh.certificate))
    lines = [f"Surface: {'; '.join(insides)}."] if insides else []
    lines.append(
        f"{coded.triangles:,} triangles in patient mm ({meshes[0].space}), vertices moved by at most"
        f" {coded.half_step_mm:.2g} mm along an axis. Parallel projection."
    )
    for number, certificate in enumerate(certificates, start=1):
        which = f" {number}" if len(certificates) > 1 else ""
        lines.append(f"Certificate{which}: {'; '.join(certificate)}.")
    if not certificates:
        lines.append("No certificate: the positions of the voxels were not verified.")
    return [*lines, f"clrecon {package_version()}. Not a medical device."]


def _inside(mesh: Content) -> str | None:
    if mesh.inside is not None:
        return mesh.inside
    return None if mesh.iso_value_hu is None else f"iso value {mesh.iso_value_hu:g} HU"


def _script(slices: PackedSlices | None) -> str:
    parts = ("page_shared.js", "page.js") if slices is None else ("page_shared.js", "page_slices.js", "page.js")
    return "\n".join(map(read_page_code, parts))


def _style(slices: PackedSlices | None) -> str:
    parts = ("page.css",) if slices is None else ("page.css", "page_slices.css")
    return "\n".join(map(read_page_code, parts))


def hash_code(text: str) -> str:
    """Return the hash by which a Content-Security-Policy names an inline script or style."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


@cache
def read_page_code(name: str, package: str = __package__) -> str:
    """Return a file of a page: ``page.html``, ``page.css``, ``page.js``, ``page_shared.js``."""
    return (files(package) / name).read_text(encoding="utf-8").strip()
