"""Meshes of the corridor job: the vertebra, and a cylinder for each corridor and given screw."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh import Mesh
from clrecon.spine.corridors import VertebraCorridors

if TYPE_CHECKING:
    from clrecon.spine.measures import Screw

FACES = 48
"""Sides of a cylinder: its walls lie at most 0.2 % of the radius inside of the true one."""


def cylinder_mesh(first: NDArray[np.float64], last: NDArray[np.float64], radius: float) -> Mesh:
    """Return a closed cylinder between two points, LPS mm, with its normals outwards."""
    way = np.asarray(last, dtype=np.float64) - first
    unit = way / np.linalg.norm(way)
    across = np.cross(unit, np.eye(3)[int(np.abs(unit).argmin())])
    across /= np.linalg.norm(across)
    turns = np.linspace(0.0, 2.0 * np.pi, FACES, endpoint=False)
    ring = radius * (np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * np.cross(unit, across))
    vertices = np.concatenate((first + ring, last + ring, [first, last]))
    here = np.arange(FACES)
    after = (here + 1) % FACES
    below, above = np.full(FACES, 2 * FACES), np.full(FACES, 2 * FACES + 1)
    triangles = np.concatenate(
        [
            np.stack(corners, axis=1)
            for corners in (
                (here, after, after + FACES),
                (here, after + FACES, here + FACES),
                (below, after, here),
                (above, here + FACES, after + FACES),
            )
        ]
    )
    return Mesh(vertices, triangles)


def cylinder_meshes(found: VertebraCorridors, screws: list[Screw]) -> dict[str, Mesh]:
    """Return the cylinders of a vertebra by name: ``left``, ``right``, ``screw_1`` and so on."""
    meshes = {}
    for corridor in found.corridors:
        if corridor.radius is not None and corridor.entry is not None and corridor.tip is not None:
            meshes[corridor.side] = cylinder_mesh(corridor.entry, corridor.tip, corridor.radius)
    for number, screw in enumerate(screws, start=1):
        meshes[f"screw_{number}"] = cylinder_mesh(screw.entry, screw.tip, screw.diameter / 2.0)
    return meshes
