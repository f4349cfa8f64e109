#!/usr/bin/env python3
"""Fill a closed surface with tetrahedra, by TetGen or gmsh, and print what came of it as JSON.

Usage: mesh_solid.py tetgen|gmsh SURFACE.npz, with a Python that has both packages; the file has `vertices`, mm, and
`triangles`.  Neither may add or move a point on the surface.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np


def fill_by_tetgen(vertices: Any, triangles: Any) -> tuple[Any, Any]:
    """Return points and tetrahedra."""
    import tetgen

    mesher = tetgen.TetGen(vertices, triangles)
    mesher.tetrahedralize(switches="pYQ")
    return np.asarray(mesher.node), np.asarray(mesher.elem)[:, :4]


def fill_by_gmsh(vertices: Any, triangles: Any) -> tuple[Any, Any]:
    """Return points and tetrahedra."""
    import gmsh

    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 1)
    surface = gmsh.model.addDiscreteEntity(2)
    gmsh.model.mesh.addNodes(2, surface, np.arange(1, len(vertices) + 1), vertices.ravel())
    gmsh.model.mesh.addElementsByType(surface, 2, [], triangles.ravel() + 1)
    solid = gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop([surface])])
    gmsh.model.geo.synchronize()
    gmsh.model.mesh.generate(3)
    tags, places, _ = gmsh.model.mesh.getNodes()
    _, _, corners = gmsh.model.mesh.getElements(3, solid)
    row = np.zeros(int(tags.max()) + 1, np.int64)
    row[tags] = np.arange(len(tags))
    gmsh.finalize()
    return places.reshape(-1, 3), row[corners[0].reshape(-1, 4)]


def main(mesher: str, path: str) -> None:
    surface = np.load(path)
    vertices, triangles = surface["vertices"].astype(np.float64), surface["triangles"].astype(np.int64)
    try:
        points, solids = {"tetgen": fill_by_tetgen, "gmsh": fill_by_gmsh}[mesher](vertices, triangles)
    except Exception as error:  # noqa: BLE001 - both raise what they like: what they say is the result
        print(json.dumps({"error": str(error).strip().splitlines()[-1:] or [type(error).__name__]}))
        return
    a, b, c, d = points[solids].transpose(1, 0, 2)
    volumes = np.abs(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)) / 6.0
    print(json.dumps({"tetrahedra": len(solids), "flat": int((volumes == 0.0).sum()), "mm3": float(volumes.sum())}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
