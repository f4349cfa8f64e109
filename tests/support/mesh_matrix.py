"""Files of meshes with known places: those that clrecon writes, and forms in which other programs write them."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clrecon import Mesh
from clrecon.exchange.formats import ASSEMBLIES, FORMATS, stage_assembly

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
CORNERS = np.array([(10.5, -20.25, -450.75), (31.0, -19.5, -448.0), (12.25, 24.0, -449.5), (13.0, -17.0, -401.25)])
"""Of a body whose sides all differ, so that no turn or mirror of it is the same."""
FACES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])
COLOR = (1.0, 128 / 255, 64 / 255)
NAME = "L3 <left>"
FAR = 1e5 + 0.123
"""mm; in steps of float32 that lies between two."""
GLTF_FROM_LPS = 0.001 * np.array([(1, 0, 0), (0, 0, 1), (0, -1, 0)])
RAS = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class MeshCase:
    """A file and its truth.

    write: Writes the file.
    vertices, faces: LPS mm; the faces turn counter-clockwise seen from outside.
    numbers: LPS mm to the numbers that a reader without frames returns: RAS, or the scene of glTF.
    names, colors: Those that the file holds.
    refused: What clrecon says, where it refuses.
    tolerance: mm by which the format or the float32 of others rounds.
    """

    name: str
    extension: str
    write: Callable[[Path], Any]
    vertices: np.ndarray
    faces: np.ndarray
    numbers: np.ndarray
    names: tuple[str, ...] = ()
    colors: tuple[tuple[float, float, float], ...] = ()
    refused: str = ""
    tolerance: float = 0.0


def _ours() -> list[MeshCase]:
    cases = []
    for extension in FORMATS:
        if extension == ".html":
            continue
        kind = extension[1:].upper()
        for words, space, shift, looks in (
            ("plain", "lps", 0.0, False),
            ("RAS", "ras", 0.0, False),
            ("100 m away", "lps", FAR, False),
            ("100 m away, RAS", "ras", FAR, False),
            ("name and colour", "lps", 0.0, True),
        ):
            if looks and extension in (".stl", ".vtp"):  # they hold neither
                continue
            vertices = CORNERS + shift
            report = {"part_name": NAME, "color": COLOR} if looks else {}
            mesh = Mesh(vertices, FACES, None, report)
            cases.append(
                MeshCase(
                    f"{kind}, {words}",
                    extension,
                    lambda path, mesh=mesh, space=space: mesh.save(path, space),  # type: ignore[misc]
                    vertices,
                    FACES,
                    _numbers(extension, space),
                    (NAME,) if looks and extension in (".glb", ".3mf") else (),
                    (COLOR,) if looks else (),
                    tolerance=_step(extension) if shift else 0.0,
                )
            )
    for extension in sorted(ASSEMBLIES, key=lambda own: own not in (".glb", ".3mf")):  # as the page has them
        for space in ("lps", "ras"):
            if extension != ".html":
                cases.append(_three(extension, space))
    return cases


def _step(extension: str) -> float:
    """Return by how much a format rounds 100 m away: float32, float32 from the centre, or not at all."""
    return {".stl": 0.005, ".glb": 1e-5}.get(extension, 0.0)


def _numbers(extension: str, space: str) -> np.ndarray:
    if extension == ".glb":
        return GLTF_FROM_LPS
    return RAS if space == "ras" else np.eye(3)


def _three(extension: str, space: str) -> MeshCase:
    names = ("L1", "L2", "L3")
    colors = tuple((1.0, number / 5, 0.0) for number in (0, 1, 2))
    shifts = [np.array((0.0, 0.0, 60.0 * number)) for number in range(3)]

    def write(path: Path) -> None:
        meshes = [
            Mesh(CORNERS + shift, FACES, None, {"part_name": name, "color": color})
            for shift, name, color in zip(shifts, names, colors, strict=True)
        ]
        with stage_assembly(meshes, path, space) as staged:
            staged.commit()

    return MeshCase(
        f"{extension[1:].upper()}, three objects{', RAS' if space == 'ras' else ''}",
        extension,
        write,
        np.concatenate([CORNERS + shift for shift in shifts]),
        np.concatenate([FACES + 4 * number for number in range(3)]),
        _numbers(extension, space),
        names,
        colors,
    )


def _stl(path: Path, change: Callable[[str], str]) -> None:
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x!r} {y!r} {z!r}\n" for x, y, z in CORNERS[face].tolist())
        + "endloop\nendfacet\n"
        for face in FACES
    )
    path.write_bytes(change(f"solid body\n{facets}endsolid body\n").encode("utf-8"))


def _binary_stl(path: Path) -> None:
    row = np.zeros(len(FACES), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    row["corners"] = CORNERS[FACES]
    path.write_bytes(b"solid of a program".ljust(80) + struct.pack("<I", len(FACES)) + row.tobytes())


def _ply(path: Path, order: str) -> None:
    head = (
        f"ply\nformat {order} 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
        "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if order == "ascii":
        lines = [" ".join(map(repr, row)) for row in CORNERS.tolist()] + [f"3 {a} {b} {c}" for a, b, c in FACES]
        path.write_bytes(head + ("\n".join(lines) + "\n").encode())
        return
    rows = np.zeros(len(FACES), [("count", "u1"), ("corners", ">i4", 3)])
    rows["count"], rows["corners"] = 3, FACES
    path.write_bytes(head + CORNERS.astype(">f8").tobytes() + rows.tobytes())


def _obj(path: Path, faces: str, *, end: str = "\n") -> None:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in CORNERS.tolist()] + faces.split("\n")
    path.write_bytes((end.join(lines) + end).encode())


PLAIN_FACES = "\n".join(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES)
BACKWARD_FACES = "\n".join(f"f {a - 4}/-1/-1 {b - 4}/-1/-1 {c - 4}/-1/-1" for a, b, c in FACES)


def _threemf(path: Path, unit: str, *, scale: float, move: np.ndarray | None = None, nested: bool = False) -> None:
    """Write the body in a unit; with `move`, shape (4, 4), so that a transform brings it to its place."""
    corners, faces = CORNERS * scale, FACES
    transform = ""
    if move is not None:
        corners = (corners - move[:3, 3]) @ np.linalg.inv(move[:3, :3]).T
        faces = FACES[:, ::-1] if np.linalg.det(move[:3, :3]) < 0 else FACES
        transform = f' transform="{" ".join(map(repr, move[:3].T.ravel().tolist()))}"'
    vertices = "".join(f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in corners.tolist())
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces)
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>"
    objects = f'<object id="1" name="body">{mesh}</object>'
    build = f'<item objectid="1"{transform}/>'
    if nested:
        objects += f'<object id="2"><components><component objectid="1"{transform}/></components></object>'
        build = '<item objectid="2"/>'
    model = f'<model unit="{unit}" xmlns="{CORE}"><resources>{objects}</resources><build>{build}</build></model>'
    relation = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as package:
        package.writestr(
            "_rels/.rels",
            '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships"><Relationship'
            f' Target="/3D/3dmodel.model" Id="r" Type="{relation}"/></Relationships>',
        )
        package.writestr("3D/3dmodel.model", model)


def _glb(path: Path, nodes: list[dict[str, Any]], inverse: np.ndarray, *, soup: bool = False) -> None:
    """Write the body as others do; `inverse` takes the scene, metres, to the numbers of the buffer."""
    scene = np.c_[CORNERS @ GLTF_FROM_LPS.T, np.ones(4)]
    corners = ((scene @ inverse.T)[:, :3]).astype("<f4")
    faces = FACES[:, ::-1] if np.linalg.det(inverse[:3, :3]) < 0 else FACES
    if soup:
        corners, faces = corners[faces.ravel()], np.arange(12).reshape(-1, 3)
    indices = faces.astype("<u2").tobytes()
    binary = corners.tobytes() + indices
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": corners.nbytes},
            {"buffer": 0, "byteOffset": corners.nbytes, "byteLength": len(indices)},
        ],
        "accessors": [
            {
                "bufferView": 0, "componentType": 5126, "type": "VEC3", "count": len(corners),
                "min": corners.min(axis=0).tolist(), "max": corners.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": faces.size},
        ],
    }  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _vtp(path: Path, mode: str) -> None:
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(Mesh(CORNERS, FACES).to_pyvista())
    writer.SetFileName(str(path))
    {"text": writer.SetDataModeToAscii, "base64": writer.SetDataModeToBinary}.get(mode, writer.SetDataModeToAppended)()
    writer.SetEncodeAppendedData(False)
    if mode != "packed":
        writer.SetCompressorTypeToNone()
    assert writer.Write() == 1


TURN = np.array([(0.0, -1.0, 0.0, 5.0), (1.0, 0.0, 0.0, -7.0), (0.0, 0.0, 1.0, 11.0), (0.0, 0.0, 0.0, 1.0)])
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
NODE_TURN = [0.0, 0.0, 0.5**0.5, 0.5**0.5]
"""A quarter turn from x to y."""


def _foreign() -> list[MeshCase]:
    moved = np.eye(4)
    moved[:3, 3] = 0.25, -0.5, 0.125
    scaled = np.diag([2.0, 2.0, 2.0, 1.0])
    turned = np.array([(0.0, -1, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)])
    inverse = np.linalg.inv
    odd: list[tuple[str, str, Callable[[Path], Any]]] = [
        ("STL text, upper case", ".stl", lambda path: _stl(path, str.upper)),
        ("STL text, carriage returns", ".stl", lambda path: _stl(path, lambda text: text.replace("\n", "\r"))),
        ("STL text, byte order mark", ".stl", lambda path: _stl(path, lambda text: "\ufeff" + text)),
        ("STL binary that begins with solid", ".stl", _binary_stl),
        ("PLY text", ".ply", lambda path: _ply(path, "ascii")),
        ("PLY big-endian, double", ".ply", lambda path: _ply(path, "binary_big_endian")),
        ("OBJ, carriage returns", ".obj", lambda path: _obj(path, PLAIN_FACES, end="\r\n")),
        ("OBJ, negative (relative) indices", ".obj", lambda path: _obj(path, "vt 0 0\nvn 0 0 1\n" + BACKWARD_FACES)),
        ("3MF, inches", ".3mf", lambda path: _threemf(path, "inch", scale=1 / 25.4)),
        ("3MF, microns", ".3mf", lambda path: _threemf(path, "micron", scale=1000.0)),
        ("3MF, metres, moved by its build", ".3mf", lambda path: _threemf(path, "meter", scale=0.001, move=TURN)),
        ("3MF, an object within an object", ".3mf",
         lambda path: _threemf(path, "millimeter", scale=1.0, move=TURN, nested=True)),
        ("3MF, mirrored by its build", ".3mf", lambda path: _threemf(path, "millimeter", scale=1.0, move=MIRROR)),
        ("GLB of another program", ".glb", lambda path: _glb(path, [{"mesh": 0}], np.eye(4))),
        ("GLB, a vertex for each corner", ".glb", lambda path: _glb(path, [{"mesh": 0}], np.eye(4), soup=True)),
        (
            "GLB, nodes that move, turn and scale", ".glb",
            lambda path: _glb(
                path,
                [
                    {"children": [1], "translation": moved[:3, 3].tolist()},
                    {"mesh": 0, "rotation": NODE_TURN, "scale": [2, 2, 2]},
                ],
                inverse(moved @ turned @ scaled),
            ),
        ),
        ("GLB, mirrored by its node", ".glb", lambda path: _glb(path, [{"mesh": 0, "scale": [-1, 1, 1]}], MIRROR)),
        *(
            (f"VTP, {mode}", ".vtp", lambda path, mode=mode: _vtp(path, mode))  # type: ignore[misc]
            for mode in ("text", "base64", "raw", "packed")
        ),
    ]  # fmt: skip
    cases = [
        MeshCase(
            name, extension, write, CORNERS, FACES, _numbers(extension, "lps"),
            ("body",) if extension == ".3mf" else (), tolerance=2e-4 if extension in (".glb", ".3mf") else 0.0,
        )
        for name, extension, write in odd
    ]  # fmt: skip
    return [
        *cases,
        MeshCase(
            "OBJ, a face of four corners", ".obj", lambda path: _obj(path, "f 1 2 3 4"), CORNERS,
            np.array([(0, 1, 2), (0, 2, 3)]), np.eye(3),
            refused="only triangles are read",
        ),
    ]  # fmt: skip


CASES = [*_ours(), *_foreign()]


@dataclass(frozen=True)
class Read:
    """What a reader made of a file: numbers as it returns them."""

    vertices: np.ndarray
    faces: np.ndarray
    names: tuple[str, ...] = ()
    colors: tuple[tuple[float, float, float], ...] = ()


def judge(case: MeshCase, read: Read, numbers: np.ndarray) -> str:
    """Return a cell of the table: the largest distance in mm of a corner from its place, and what is lost."""
    back = read.vertices.astype(np.float64) @ np.linalg.inv(numbers).T
    if len(read.faces) == 0:
        return "**nothing read**"
    used = back[np.unique(read.faces)]
    pairs = np.linalg.norm(used[:, None] - case.vertices[None], axis=2)
    error = max(pairs.min(axis=0).max(), pairs.min(axis=1).max())
    words = [f"{error:.1g}" if error > 1e-9 else "0"]
    if error > max(0.01, case.tolerance):
        words = [f"**{error:.3g}**"]
    volume, true = (_volume(*each) for each in ((back, read.faces), (case.vertices, case.faces)))
    if volume < 0.0 < true:
        words.append("**inside out**")
    if case.names and sorted(read.names) != sorted(case.names):
        words.append("no names")
    if case.colors and not _same_colors(read.colors, case.colors):
        words.append("no colours")
    return ", ".join(words)


def _same_colors(found: tuple[tuple[float, float, float], ...], true: tuple[tuple[float, float, float], ...]) -> bool:
    return len(found) == len(true) and bool(np.allclose(sorted(found), sorted(true), atol=0.003))


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[corner] - vertices.mean(axis=0) for corner in faces.T)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def read_with_clrecon(path: Path, case: MeshCase) -> str:
    """Return the cell of clrecon, which returns LPS mm."""
    from clrecon import read_mesh
    from clrecon.errors import RefusedInputError

    try:
        mesh = read_mesh(path)
    except RefusedInputError:
        return "R"
    parts = mesh.report["file"]["parts"]
    return judge(
        case,
        Read(
            mesh.vertices,
            mesh.triangles,
            tuple(part["name"] for part in parts if part["name"]),
            tuple(part["color"] for part in parts if part["color"]),
        ),
        np.eye(3),
    )
