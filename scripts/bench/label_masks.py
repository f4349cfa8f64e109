"""Case of labels' own surfaces, beside VTK's surface nets with the usual number of smoothing rounds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from measure import time_in_turns
from registry import Job, case

ROUNDS = 16
AIR_HU = -400


@case("label-masks", "labels' own surfaces with their volumes, against surface nets with 16 rounds of smoothing")
def measure_label_masks(job: Job) -> dict[str, Any]:
    """Time meshes of a label map, from host memory to host memory, for one large label and for several that touch.

    The large label is the largest body of air within the patient, such as the lungs; the others are layers of all that
    is near dense voxels.  The peer makes one mesh of all labels; each triangle has the two labels at its sides.
    """
    from clrecon.labels import LabelMap
    from clrecon.operators.surface.label_masks import extract_label_masks

    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "labels": {}}
    for name, voxels in _make_maps(job).items():
        labels = LabelMap(voxels, job.input.volume().affine)
        peer = _peer(labels, job.peer_threads)
        meshes = extract_label_masks(labels, device=job.device)
        theirs = _volumes_ml(labels, *peer())
        figures["labels"][name] = [
            {
                "label_ml": mesh.report["label_ml"],
                "mesh_ml": mesh.quality()["volume_ml"],
                "peer_ml": theirs[number],
                "triangles": mesh.triangle_count,
                "mask_level": mesh.report["mask_level"],
            }
            for number, mesh in meshes.items()
        ]
        figures["sides"][name] = time_in_turns(
            partial(extract_label_masks, labels, device=job.device), peer, job.pairs, job.limit_s / 2
        )
        figures["ratios"][name] = figures["sides"][name]["ratio"]
        figures[f"seconds_by_kernel_{name}"] = _by_kernel(meshes)
    return figures


def _make_maps(job: Job) -> dict[str, Any]:
    import numpy as np
    from scipy.ndimage import binary_fill_holes, binary_opening, label, maximum_filter

    voxels = job.input.volume().voxels
    air = np.zeros(voxels.shape, dtype=bool)
    for k, plane in enumerate(voxels):
        air[k] = (plane < AIR_HU) & binary_fill_holes(binary_opening(plane > AIR_HU + 100, iterations=2))
    bodies, _ = label(air)
    sizes = np.bincount(bodies.ravel())
    sizes[0] = 0
    nk = len(voxels)
    layer = (1 + np.arange(nk) * 8 // nk).astype(np.uint8)
    return {
        "air": (bodies == int(sizes.argmax())).astype(np.uint8),
        "layers": np.where(maximum_filter(voxels >= job.hu, 3), layer[:, None, None], 0).astype(np.uint8),
    }


def _peer(labels: Any, threads: int) -> Callable[[], tuple[Any, Any, Any]]:
    """Make the function of the peer's mesh: points, triangles, and the two labels beside each triangle."""
    import numpy as np
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkSMPTools
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkSurfaceNets3D

    vtkSMPTools.SetBackend("STDThread")
    vtkSMPTools.Initialize(threads)

    padded = np.pad(labels.voxels, 1)  # else the nets are open at the border of the map

    def run() -> tuple[Any, Any, Any]:
        image = vtkImageData()
        image.SetDimensions(*padded.shape[::-1])
        image.SetSpacing(*labels.spacing)
        image.GetPointData().SetScalars(numpy_to_vtk(padded.ravel()))
        nets = vtkSurfaceNets3D()
        nets.SetInputData(image)
        for place, number in enumerate(labels.numbers):
            nets.SetValue(place, number)
        nets.SetNumberOfIterations(ROUNDS)
        nets.SmoothingOn()
        nets.SetOutputMeshTypeToTriangles()
        nets.Update()
        mesh = nets.GetOutput()
        corners = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3)
        beside = vtk_to_numpy(mesh.GetCellData().GetArray("BoundaryLabels"))
        return vtk_to_numpy(mesh.GetPoints().GetData()), corners, beside

    return run


def _volumes_ml(labels: Any, points: Any, triangles: Any, beside: Any) -> dict[int, float]:
    """The volume of each label in the peer's mesh: its triangles, turned so that it lies behind all of them."""
    import numpy as np

    from clrecon.mesh.triangles import enclosed_ml

    volumes = {}
    for number in labels.numbers:
        own = np.concatenate([triangles[beside[:, 0] == number], triangles[beside[:, 1] == number][:, ::-1]])
        volumes[number] = abs(enclosed_ml(points, own.astype(np.uint32)))
    return volumes


def _by_kernel(meshes: Any) -> dict[str, float]:
    seconds: dict[str, float] = {}
    for mesh in meshes.values():
        for kernel, spent in mesh.report["kernel_seconds"].items():
            seconds[kernel] = seconds.get(kernel, 0.0) + spent
    return seconds
