"""Case of connected components: the surface on the device, beside scipy and cc3d on the mesh and on the mask."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from measure import time_in_turns
from registry import Job, case


@case("components", "components of the surface on the device, against scipy and cc3d")
def measure_components(job: Job) -> dict[str, Any]:
    """Time the numbering of all vertices by component, from host memory to host memory.

    Peers: scipy.sparse.csgraph on the same mesh, with the same result; scipy.ndimage.label and cc3d on the mask of the
    voxels inside (neighbours by faces, and by faces to corners).  The last two find solids, not surfaces: a cavity is
    not a component there.  The time to make the mask is not counted.
    """
    import cc3d
    import numpy as np
    from scipy import ndimage

    from clrecon.mesh import connectivity
    from clrecon.opencl import Stopwatch
    from clrecon.operators.primitives.union_find import label_components
    from clrecon.operators.surface.extract import extract_isosurface

    volume = job.input.volume()
    mesh = extract_isosurface(volume, job.hu, device=job.device)
    triangles, vertices = mesh.triangles, mesh.vertex_count
    mask = volume.voxels >= job.hu
    corners = ndimage.generate_binary_structure(3, 3)
    peers: dict[str, Callable[[], Any]] = {
        "csgraph": lambda: connectivity.label_components(triangles, vertices),
        "ndimage_6": lambda: ndimage.label(mask)[::-1],
        "ndimage_26": lambda: ndimage.label(mask, corners)[::-1],
        "cc3d_6": lambda: cc3d.connected_components(mask, connectivity=6, return_N=True)[::-1],
        "cc3d_26": lambda: cc3d.connected_components(mask, connectivity=26, return_N=True)[::-1],
    }
    components = {"clrecon": label_components(job.device, triangles, vertices)}
    figures: dict[str, Any] = {"ratios": {}, "sides": {}}
    for name, peer in peers.items():
        components[name] = peer()
        figures["sides"][name] = time_in_turns(
            lambda: label_components(job.device, triangles, vertices), peer, job.pairs, job.limit_s / len(peers)
        )
        figures["ratios"][name] = figures["sides"][name]["ratio"]
    stopwatch = Stopwatch()
    with stopwatch.running(job.device):
        label_components(job.device, triangles, vertices)
    return {
        **figures,
        "vertices": vertices,
        "triangles": len(triangles),
        "components": {name: int(found[0]) for name, found in components.items()},
        "equal_to_csgraph": bool(np.array_equal(components["clrecon"][1], components["csgraph"][1])),
        "kernel_seconds": dict(stopwatch.by_kernel),
    }
