"""Surface meshes: the `Mesh` itself, vertices (n, 3) in LPS mm and triangles (m, 3), measures, and its parts."""

from clrecon.mesh.components import select_components, split_components
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.quality import measure_quality

__all__ = ["Mesh", "measure_quality", "select_components", "split_components"]
