"""Case of the field around a cloud: signed distances on a grid of nodes, beside vtkSignedDistance."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from measure import spread
from registry import Job, case

SPACINGS_MM = (0.65, 1.0)
BRIDGE = 1.5
"""B = R in spacings: enough for vertices of a surface in voxels of that size."""


@case("point-field", "signed distance around the surface's points on a grid, against vtkSignedDistance")
def measure_fields(job: Job) -> dict[str, Any]:
    """Time the nodes from points and normals in host memory to a volume in host memory.

    Both sides use the same radius.  VTK leaves nodes beyond it without a sign; ours has the signs of all nodes.
    """
    import numpy as np
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints, vtkSMPTools
    from vtkmodules.vtkCommonDataModel import vtkPolyData
    from vtkmodules.vtkFiltersPoints import vtkSignedDistance

    from clrecon.operators.points.field import FieldSettings, NodeField, decide_signs
    from clrecon.operators.surface.extract import extract_isosurface

    mesh = extract_isosurface(job.input.volume(), job.hu, device=job.device)
    points, normals = mesh.vertices, mesh.normals
    assert normals is not None
    vtkSMPTools.Initialize(job.peer_threads)
    low, high = points.min(axis=0).astype(float), points.max(axis=0).astype(float)

    def ours(settings: FieldSettings) -> Any:
        field = NodeField(job.device, points, normals, settings)
        field.release_points()
        return field.fill(decide_signs(field.masks, field.limits, settings.rounds))

    def theirs(settings: FieldSettings) -> Any:
        h, margin = settings.spacing, settings.bridge + settings.spacing
        cloud, places = vtkPolyData(), vtkPoints()
        places.SetData(numpy_to_vtk(points))
        cloud.SetPoints(places)
        cloud.GetPointData().SetNormals(numpy_to_vtk(normals))
        counts = np.ceil((high - low + 2 * margin) / h).astype(int) + 1
        first, last = low - margin, low - margin + h * (counts - 1)
        distance = vtkSignedDistance()
        distance.SetInputData(cloud)
        distance.SetRadius(settings.reach)
        distance.SetDimensions(*map(int, counts))
        distance.SetBounds(*(float(end[axis]) for axis in range(3) for end in (first, last)))
        distance.Update()
        return distance.GetOutput()

    figures: dict[str, Any] = {"points": len(points), "ratios": {}, "sides": {}}
    for h in SPACINGS_MM:
        settings = FieldSettings(h, BRIDGE * h, 0.1 * h, BRIDGE * h)
        ours(settings), theirs(settings)
        pairs = [(_times(ours, settings), _times(theirs, settings)) for _ in range(job.pairs)]
        for which, clock in enumerate(("wall", "cpu")):
            sides = [[side[which] for side in pair] for pair in pairs]
            figures["ratios"][f"{clock}_{h:g}mm"] = spread([peer / own for own, peer in sides])
            figures["sides"][f"{clock}_{h:g}mm"] = {
                "clrecon_s": spread([own for own, _ in sides]),
                "peer_s": spread([peer for _, peer in sides]),
            }
    return figures


def _times(run: Callable[[Any], Any], settings: Any) -> tuple[float, float]:
    """Wall and CPU seconds of a run; its result is freed after that."""
    wall, cpu = time.perf_counter(), time.process_time()
    made = run(settings)
    times = time.perf_counter() - wall, time.process_time() - cpu
    del made
    return times
