"""Surface meshes in patient millimetres: the `Mesh` itself, measures of it, and selection of its parts.

Smoothing and decimation (`clrecon.mesh.refine`) and distances and gates (`clrecon.mesh.compare`) are imported by those
who use them; files are in `clrecon.exchange`.  Vertices are (n, 3) in LPS mm, triangles (m, 3) numbers of vertices.
"""

from clrecon.mesh.components import select_components, split_components
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.quality import measure_quality

__all__ = ["Mesh", "measure_quality", "select_components", "split_components"]
