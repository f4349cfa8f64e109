"""A mesh as a page of HTML that shows it: one file, which asks for nothing from outside.

The page turns, clips, hides, colours and measures in parallel projection.  Its Content-Security-Policy names its own
script and style by their hashes and allows nothing else, so a browser loads and sends nothing.  Besides the surface it
holds the names of the parts, the iso value, the certificate's lines, and how far it rounds the vertices.

Own code, because exported pages of libraries are three times as large, ask other servers for icons, and lose the
parallel projection.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from clrecon.errors import UsageError
from clrecon.exchange.content import BONE_COLOR, Assembly, Content, parts_of, refuse_file
from clrecon.exchange.page_coding import CodedSurface, decode_surface, encode_surface
from clrecon.version import package_version

MOST_TRIANGLES = 10_000_000
"""About 70 MB of page and 200 MB on the graphics card; more is slow to turn on most computers."""

_LEAST_BYTES_A_TRIANGLE = 0.5
"""Of the surface: a regular one packs to 0.7, those of scans to 5 to 8."""

_BLOCK = re.compile(r'<script id="(facts|surface)" type="[a-z/]+">([^<]*)</script>')


def estimate(content: Content | Assembly) -> int:
    """Return the least bytes of the file."""
    own = len(read_page_code("page.html")) + len(read_page_code("page.css")) + len(_script())
    return own + int(_LEAST_BYTES_A_TRIANGLE * sum(len(part.triangles) for part in parts_of(content)))


def write(stream: BinaryIO, content: Content | Assembly) -> None:
    """Write the page."""
    stream.write(compose_page(content))


def compose_page(content: Content | Assembly) -> bytes:
    """Return the page of one or several meshes."""
    meshes = parts_of(content)
    count = sum(len(mesh.triangles) for mesh in meshes)
    if count > MOST_TRIANGLES:
        raise UsageError(
            f"{count:,} triangles are too many for a page, at most {MOST_TRIANGLES:,} are shown: keep the largest parts"
            " only, or decimate the mesh, or write .glb or .ply"
        )
    coded, parts = _join_parts(meshes)
    facts = {
        "vertices": coded.vertices,
        "triangles": coded.triangles,
        "low": coded.low_mm,
        "step": coded.step_mm,
        "half_step_mm": coded.half_step_mm,
        "space": meshes[0].space,
        "parts": parts,
        "about": _describe(meshes, coded),
    }
    # "<" would end the block: in JSON it can stand as an escape.
    text = json.dumps(facts, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    style, script = read_page_code("page.css"), _script()
    policy = (
        f"default-src 'none'; script-src '{hash_code(script)}'; style-src '{hash_code(style)}'; base-uri 'none';"
        " form-action 'none'"
    )
    filled = {"POLICY": policy, "STYLE": style, "SCRIPT": script, "FACTS": text}
    before, after = (
        re.sub("@([A-Z]+)@", lambda place: filled[place[1]], half)  # at once: what is filled in is not looked at again
        for half in (read_page_code("page.html") + "\n").split("@SURFACE@")
    )
    return before.encode() + base64.b64encode(coded.data) + after.encode()


def parse_page(page: bytes) -> tuple[dict[str, Any], CodedSurface]:
    """Return the facts and the surface that a page of `compose_page` holds."""
    blocks = dict(_BLOCK.findall(page.decode("utf-8")))
    if set(blocks) != {"facts", "surface"} or not page.endswith(b"</html>\n"):
        raise ValueError("this is no page of a surface")
    facts = json.loads(blocks["facts"])
    data = base64.b64decode(blocks["surface"], validate=True)
    return facts, CodedSurface(
        facts["vertices"], facts["triangles"], tuple(facts["low"]), tuple(facts["step"]), data
    )  # fmt: skip


def read_facts(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the facts of a page that was written: counts, parts, steps."""
    return parse_page(Path(path).read_bytes())[0]


def verify(path: Path, content: Content | Assembly) -> None:
    """Unpack a finished file, whose gzip has a checksum, and count what is in it."""
    try:
        _, coded = parse_page(path.read_bytes())
        _, _, triangles = decode_surface(coded)
    except ValueError as error:
        raise refuse_file(f"({error})", "no page", "a page") from error
    expected = sum(len(part.triangles) for part in parts_of(content))
    if len(triangles) != expected:
        raise refuse_file("triangles", len(triangles), expected)


def _join_parts(meshes: Sequence[Content]) -> tuple[CodedSurface, list[dict[str, Any]]]:
    """Code all meshes as one surface whose triangles are sorted by part, and list the parts."""
    vertices, normals, triangles, parts = [], [], [], []
    before, first = 0, 0
    for number, mesh in enumerate(meshes, start=1):
        assert mesh.normals is not None
        vertices.append(mesh.vertices @ mesh.to_lps.T)
        normals.append(mesh.normals @ mesh.to_lps.T.astype(np.float32))
        own = mesh.triangles.astype(np.int64) + before
        pieces = mesh.pieces
        triangles.append(own if pieces is None else own[np.argsort(pieces.of_triangle, kind="stable")])
        before += len(mesh.vertices)
        for name, count, ml in _pieces(mesh):
            named = " ".join(filter(None, (mesh.name or (f"surface {number}" if len(meshes) > 1 else ""), name)))
            color = _hexadecimal(BONE_COLOR if mesh.color is None else mesh.color)
            parts.append({"name": named or "surface", "color": color, "ml": ml, "first": first, "count": count})
            first += count
    coded = encode_surface(np.concatenate(vertices), np.concatenate(normals), np.concatenate(triangles))
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


def _describe(meshes: Sequence[Content], coded: CodedSurface) -> list[str]:
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
        lines.append("No certificate: nothing vouches for where the voxels lay.")
    return [*lines, f"clrecon {package_version()}. Not a medical device."]


def _inside(mesh: Content) -> str | None:
    if mesh.inside is not None:
        return mesh.inside
    return None if mesh.iso_value_hu is None else f"iso value {mesh.iso_value_hu:g} HU"


def _hexadecimal(color: Sequence[float]) -> str:
    return "#" + "".join(f"{round(255 * min(max(value, 0.0), 1.0)):02x}" for value in color)


def _script() -> str:
    return "\n".join((read_page_code("page_shared.js"), read_page_code("page.js")))


def hash_code(text: str) -> str:
    """Return the hash by which a Content-Security-Policy names an inline script or style."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


@cache
def read_page_code(name: str) -> str:
    """Return a file of the page: ``page.html``, ``page.css``, ``page.js``, ``page_shared.js``."""
    return (files(__package__) / name).read_text(encoding="utf-8").strip()
