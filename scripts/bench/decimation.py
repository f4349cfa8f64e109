"""Case of the ways to fewer triangles: S-MC and G-MC of clrecon beside fast-simplification alone, VTK and MeshLib."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from measure import busy_seconds, time_in_turns
from registry import Job, case

SHARE = 0.9
"""Share of the triangles to remove."""


@case("decimation", "decimate_mesh and collapse_quadric: time, deviation and topology, against three libraries")
def measure_decimation(job: Job) -> dict[str, Any]:
    """Time `decimate_mesh` and its peers in turn, and judge what each makes of the surface.

    fast-simplification and MeshLib are asked for as many triangles as clrecon reaches within its bound;
    vtkDecimatePro keeps the topology and may stop earlier.  MeshLib runs where it is installed: its licence is no free
    one.  `collapse_quadric` is clrecon's own row without a bound; it measures its result as well.
    """
    import clrecon

    mesh = clrecon.extract_isosurface(job.input.volume(), job.hu, device=job.device)
    small = clrecon.decimate_mesh(mesh, SHARE, device=job.device)
    reached = small.report["refinement"]["decimate"]["reached"]
    peers: dict[str, Callable[[], Any]] = {
        "collapse_quadric": lambda: clrecon.collapse_quadric(mesh, reached),
        "fast_simplification": lambda: _fast_simplification(mesh, reached),
        "vtkDecimatePro": lambda: _decimate_pro(mesh, reached),
    }
    if find_spec("meshlib") is not None:
        peers["meshlib"] = lambda: _meshlib(mesh, reached)
    times = {
        name: time_in_turns(lambda: clrecon.decimate_mesh(mesh, SHARE, device=job.device), peer, job.pairs, job.limit_s)
        for name, peer in peers.items()
    }
    results = {"decimate_mesh": small, **{name: peer() for name, peer in peers.items()}}
    return {
        "ratios": {name: found["ratio"] for name, found in times.items()},
        "triangles": mesh.triangle_count,
        "euler_number": mesh.quality()["euler_number"],
        "bound_mm": small.report["refinement"]["decimate"]["max_deviation_mm"],
        **times,
        "busy_s": {"decimate_mesh": _busy(lambda: clrecon.decimate_mesh(mesh, SHARE, device=job.device))}
        | {name: _busy(peer) for name, peer in peers.items()},
        "results": {name: _judge(result, mesh) for name, result in results.items()},
    }


def _judge(small: Any, mesh: Any) -> dict[str, Any]:
    """Return the triangles left, the topology and the distances; the farthest also from every vertex of small parts."""
    import clrecon
    from clrecon.mesh.refine.quadric import measure_farthest

    quality, deviation = small.quality(), clrecon.compare_meshes(small, mesh)
    names = ("triangles", "closed", "manifold", "components", "euler_number", "boundary_edges", "nonmanifold_edges")
    return {
        **{name: quality[name] for name in names},
        **{name: deviation[name] for name in ("hd95_mm", "assd_mm", "volume_change_percent")},
        "farthest_mm": measure_farthest(mesh, small.vertices, small.triangles),
    }


def _busy(run: Callable[[], object]) -> float:
    """Return the seconds of all cores that a function takes."""
    start = busy_seconds()
    run()
    return busy_seconds() - start


def _fast_simplification(mesh: Any, share: float) -> Any:
    import numpy as np
    from fast_simplification import simplify

    import clrecon

    points, triangles = simplify(mesh.vertices, mesh.triangles.view(np.int32), target_reduction=share)
    return clrecon.Mesh(points, triangles)


def _decimate_pro(mesh: Any, share: float) -> Any:
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    import clrecon

    decimation = vtk.vtkDecimatePro()
    decimation.SetInputData(mesh.to_pyvista())
    decimation.SetTargetReduction(share)
    decimation.PreserveTopologyOn()
    decimation.Update()
    result = decimation.GetOutput()
    triangles = vtk_to_numpy(result.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return clrecon.Mesh(vtk_to_numpy(result.GetPoints().GetData()), triangles)


def _meshlib(mesh: Any, share: float) -> Any:
    import numpy as np

    import clrecon

    arrays, library = import_module("meshlib.mrmeshnumpy"), import_module("meshlib.mrmeshpy")
    surface = arrays.meshFromFacesVerts(mesh.triangles.astype(np.int32), mesh.vertices.astype(np.float64))
    settings = library.DecimateSettings()
    settings.maxDeletedFaces = int(share * mesh.triangle_count)
    settings.maxError = 1e6
    settings.packMesh = True
    library.decimateMesh(surface, settings)
    return clrecon.Mesh(arrays.getNumpyVerts(surface), arrays.getNumpyFaces(surface.topology))
