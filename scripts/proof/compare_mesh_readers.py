#!/usr/bin/env python3
"""The matrix of meshes: where clrecon and other readers put the corners of meshes in files with known places.

    python scripts/proof/compare_mesh_readers.py [--write]

Prints the table; with --write it goes into docs/calibration.md.  The files are those of tests/support/mesh_matrix.py.
Readers that are not installed are left out: pip install trimesh lxml networkx pyvista open3d-cpu meshio.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support"), str(ROOT / "scripts"), str(ROOT / "scripts" / "guide")]

from marked_tables import markdown_table, put_table  # noqa: E402
from mesh_matrix import CASES, MeshCase, Read, judge, read_with_clrecon  # type: ignore[import-not-found]  # noqa: E402

PAGE = ROOT / "docs" / "calibration.md"


def read_trimesh(path: Path) -> Read:
    """Read with trimesh, its scene's transforms applied; names are those of its geometries."""
    import trimesh

    scene = trimesh.load_scene(path)
    if scene.units is not None and path.suffix == ".3mf":
        scene = scene.convert_units("millimeter")
    names, colors, meshes = [], [], []
    for node in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[node]
        mesh = scene.geometry[geometry].copy().apply_transform(matrix)
        meshes.append(mesh)
        names.append(mesh.metadata.get("name") or geometry)
        colors.append(_color_of(mesh))
    return _join(
        [(mesh.vertices, mesh.faces) for mesh in meshes], names, [color for color in colors if color is not None]
    )


def _color_of(mesh: Any) -> tuple[float, float, float] | None:
    visual = mesh.visual
    if visual.kind == "texture":
        factor = getattr(visual.material, "baseColorFactor", None)
        if factor is None:
            return None
        linear = np.array(factor[:3]) / 255.0
        curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return tuple(curved.tolist())
    if visual.kind in ("vertex", "face"):
        return tuple((np.asarray(visual.main_color)[:3] / 255.0).tolist())
    return None


def _join(meshes: list[tuple[Any, Any]], names: list[str] | None = None, colors: list[Any] | None = None) -> Read:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    return Read(
        np.concatenate([np.asarray(vertices, np.float64) for vertices, _ in meshes]),
        np.concatenate([np.asarray(faces) + start for (_, faces), start in zip(meshes, starts, strict=False)]),
        tuple(names or ()),
        tuple(colors or ()),
    )


def read_vtk(path: Path) -> Read:
    """Read with VTK, through PyVista."""
    import pyvista

    found = pyvista.read(path)
    blocks = [found]
    if isinstance(found, pyvista.MultiBlock):
        blocks = list(found.recursive_iterator(skip_none=True))
    meshes = [
        block.extract_surface(algorithm=None) if not isinstance(block, pyvista.PolyData) else block for block in blocks
    ]
    colors = []
    for mesh in meshes:
        rgb = mesh.point_data.get("RGB", mesh.point_data.get("RGBA"))
        cells = mesh.cell_data.get("COLOR")
        if rgb is not None:
            colors.append(tuple((np.asarray(rgb)[0, :3] / 255.0).tolist()))
        elif cells is not None:
            rows = np.unique(np.asarray(cells), axis=0)
            colors += [tuple((row / 255.0).tolist()) for row in rows]
    names = [str(name) for mesh in meshes for name in mesh.field_data.get("PART_NAMES", ())]
    return _join([(mesh.points, mesh.regular_faces) for mesh in meshes], names, colors)


def read_open3d(path: Path) -> Read:
    """Read with Open3D."""
    import open3d

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    mesh = open3d.io.read_triangle_mesh(path)
    colors = np.asarray(mesh.vertex_colors)
    return Read(
        np.asarray(mesh.vertices), np.asarray(mesh.triangles).reshape(-1, 3), (),
        tuple(tuple(row) for row in np.unique(colors, axis=0).tolist()) if len(colors) else (),
    )  # fmt: skip


def read_meshio(path: Path) -> Read:
    """Read with meshio."""
    mesh = importlib.import_module("meshio").read(path)
    return Read(mesh.points, mesh.cells_dict["triangle"])


PEERS: dict[str, tuple[str, Callable[[Path], Read], tuple[str, ...]]] = {
    "trimesh": ("trimesh", read_trimesh, (".stl", ".ply", ".obj", ".glb", ".3mf")),
    "VTK": ("vtk", read_vtk, (".stl", ".ply", ".obj", ".glb", ".vtp")),
    "Open3D": ("open3d-cpu", read_open3d, (".stl", ".ply", ".obj", ".glb")),
    "meshio": ("meshio", read_meshio, (".stl", ".ply", ".obj")),
}


def judge_peer(case: MeshCase, path: Path, read: Callable[[Path], Read], kinds: tuple[str, ...]) -> str:
    """Return the cell of another reader."""
    if case.extension not in kinds:
        return "-"
    try:
        return str(judge(case, read(path), case.numbers))
    except Exception as error:
        print(f"{case.name}: {type(error).__name__}: {error}", file=sys.stderr)
        return "R"


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--write", action="store_true", help="put the table into docs/calibration.md")
    options = parser.parse_args()
    peers = {name: peer for name, peer in PEERS.items() if find_version(peer[0])}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number, case in enumerate(CASES):
            path = Path(folder) / f"{number}{case.extension}"
            case.write(path)
            cells = [judge_peer(case, path, read, kinds) for _, read, kinds in peers.values()]
            rows.append([case.name, read_with_clrecon(path, case), *cells])
    table = markdown_table(["case", "clrecon", *peers], rows)
    print(table)
    print(", ".join(f"{name} {find_version(peer[0])}" for name, peer in peers.items()))
    if options.write:
        PAGE.write_text(put_table(PAGE.read_text(encoding="utf-8"), "meshes", table), encoding="utf-8")


def find_version(package: str) -> str:
    """Return the version of a package that is installed, else ""."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


if __name__ == "__main__":
    main()
