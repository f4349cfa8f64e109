"""Meshes that are written part by part as they are made, and never lie whole in memory."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import replace
from itertools import starmap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.exchange.formats import check_in_pieces, stage_pieces
from clrecon.mesh.mesh import Mesh

if TYPE_CHECKING:
    from clrecon.exchange.content import Content
    from clrecon.system.files import StagedFile

Part = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]
"""Vertices in LPS mm, normals, and triangles whose indices are those of the whole."""


class PartsFile:
    """The file of a mesh in `space`, with the bytes of `clrecon.exchange.formats.stage_mesh`; see `Mesh.save`."""

    def __init__(self, path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False):
        check_in_pieces(path)
        self._path = path
        self._space, self._keep_ids = space, keep_ids

    def stage(
        self, parts: Iterable[Part], counts: tuple[int, int], report: dict[str, Any]
    ) -> AbstractContextManager[StagedFile]:
        """Write all parts under a temporary name.

        counts: Vertices and triangles of all parts together.
        report: That of the mesh, as far as files have it.
        """

        def describe_part(*part: Any) -> Content:
            vertices, normals, triangles = part
            mesh = Mesh(vertices, triangles, normals, report, trusted=True)
            return mesh.describe(self._space, keep_ids=self._keep_ids)

        points = np.broadcast_to(np.float32(0), (counts[0], 3))  # takes no memory
        corners = np.broadcast_to(np.uint32(0), (counts[1], 3))
        nothing = describe_part(points[:0], points[:0], corners[:0])
        whole = replace(nothing, vertices=points, normals=points, triangles=corners)
        return stage_pieces(whole, starmap(describe_part, parts), self._path)
