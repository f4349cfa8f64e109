"""Case of smoothing, decimation and quality, beside VTK, which has no bound in mm and measures less."""

from __future__ import annotations

from typing import Any

from measure import seconds_of, time_in_turns
from registry import Job, case

SHARE = 0.9
"""Share of the triangles to remove."""


@case("refine", "smoothing, decimation and quality of the surface, against VTK's filters, which have no bound")
def measure_refinement(job: Job) -> dict[str, Any]:
    """Time `smooth_mesh`, `decimate_mesh` and `Mesh.quality` on one surface beside their peers.

    The peers are vtkWindowedSincPolyDataFilter (the same filter without a bound), vtkQuadricDecimation to the share
    of triangles that clrecon reaches, and vtkFeatureEdges with vtkPolyDataConnectivityFilter and vtkMassProperties.
    """
    import clrecon

    mesh = clrecon.extract_isosurface(job.input.volume(), job.hu, device=job.device)
    small = clrecon.decimate_mesh(mesh, SHARE, device=job.device)
    reached = small.report["refinement"]["decimate"]["reached"]
    peer_small = _decimate(mesh, reached)
    how = job.pairs, job.limit_s
    times = {
        "smooth": time_in_turns(lambda: clrecon.smooth_mesh(mesh, device=job.device), lambda: _smooth(mesh), *how),
        "decimate": time_in_turns(
            lambda: clrecon.decimate_mesh(mesh, SHARE, device=job.device), lambda: _decimate(mesh, reached), *how
        ),
        "quality": time_in_turns(mesh.quality, lambda: _measure(mesh), *how),
    }
    return {
        "ratios": {name: found["ratio"] for name, found in times.items()},
        "triangles": mesh.triangle_count,
        **times,
        "compare_s": seconds_of(lambda: clrecon.compare_meshes(small, mesh)),
        "results": {
            "clrecon": {"reached": reached, **_judge(small, mesh)},
            "peer": {"reached": 1.0 - peer_small.triangle_count / mesh.triangle_count, **_judge(peer_small, mesh)},
        },
    }


def _judge(small: Any, mesh: Any) -> dict[str, Any]:
    import clrecon

    quality, deviation = small.quality(), clrecon.compare_meshes(small, mesh)
    facts = {name: quality[name] for name in ("closed", "manifold", "components", "nonmanifold_edges")}
    return {**facts, **{name: deviation[name] for name in ("hd95_mm", "assd_mm", "max_mm", "volume_change_percent")}}


def _smooth(mesh: Any) -> None:
    import vtk

    smoother = vtk.vtkWindowedSincPolyDataFilter()
    smoother.SetInputData(mesh.to_pyvista())
    smoother.NormalizeCoordinatesOn()
    smoother.Update()


def _decimate(mesh: Any, share: float) -> Any:
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    import clrecon

    decimation = vtk.vtkQuadricDecimation()
    decimation.SetInputData(mesh.to_pyvista())
    decimation.SetTargetReduction(share)
    decimation.Update()
    result = decimation.GetOutput()
    triangles = vtk_to_numpy(result.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return clrecon.Mesh(vtk_to_numpy(result.GetPoints().GetData()), triangles)


def _measure(mesh: Any) -> None:
    import vtk

    data = mesh.to_pyvista()
    edges = vtk.vtkFeatureEdges()
    edges.SetInputData(data)
    edges.FeatureEdgesOff()
    edges.Update()
    connectivity = vtk.vtkPolyDataConnectivityFilter()
    connectivity.SetInputData(data)
    connectivity.SetExtractionModeToAllRegions()
    connectivity.Update()
    measures = vtk.vtkMassProperties()
    measures.SetInputData(data)
    measures.Update()
