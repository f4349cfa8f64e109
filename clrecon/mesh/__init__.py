"""Surface meshes in patient millimetres: measure them, select their parts, write them to files.

Smoothing and decimation (`clrecon.mesh.refinement`), distances (`clrecon.mesh.distances`) and gates
(`clrecon.mesh.gates`) are imported by those who use them.
"""

from clrecon.mesh.components import select_components, split_components
from clrecon.mesh.mesh import Mesh
from clrecon.mesh.quality import measure_quality
from clrecon.mesh.writers import FORMATS, check_format, stage_mesh, write_mesh

__all__ = [
    "FORMATS",
    "Mesh",
    "check_format",
    "measure_quality",
    "select_components",
    "split_components",
    "stage_mesh",
    "write_mesh",
]
