"""Case of one mesh per label, beside VTK's ways: from the mask, or from HU with air outside of the label."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from measure import time_in_turns
from registry import Job, case

LABELS = 8


@case(
    "labels", "one mesh a label, against surface nets and discrete flying edges on the mask, flying edges on blanked HU"
)
def measure_labels(job: Job) -> dict[str, Any]:
    """Time meshes of labels, from host memory to host memory, resampling of the labels included.

    The label map is synthetic: layers of all that is near dense voxels, on the grid of the volume.  Peers get labels on
    that grid.  Surface nets and discrete flying edges contour the mask and make its steps; the third peer gives
    air to all voxels of a label's box that do not carry it, and contours HU: borders lie where the mask ends.
    """
    import numpy as np
    from scipy.ndimage import maximum_filter

    from clrecon.labels import LabelMap
    from clrecon.operators.surface.labels import extract_labels

    volume = job.input.volume()
    nk = volume.voxels.shape[0]
    layer = (1 + np.arange(nk) * LABELS // nk).astype(np.uint8)
    labels = np.where(maximum_filter(volume.voxels >= job.hu, 3), layer[:, None, None], 0).astype(np.uint8)
    label_map = LabelMap(labels, volume.affine)
    peers = _peers(volume, labels, job.hu, job.peer_threads)
    meshes = extract_labels(volume, label_map, job.hu, device=job.device)
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "peer_triangles": {}}
    figures["triangles"] = sum(len(mesh.triangles) for mesh in meshes.values())
    for name, peer in peers.items():
        figures["peer_triangles"][name] = peer()
        figures["sides"][name] = time_in_turns(
            lambda: extract_labels(volume, label_map, job.hu, device=job.device),
            peer,
            job.pairs,
            job.limit_s / len(peers),
        )
        figures["ratios"][name] = figures["sides"][name]["ratio"]
    reports = [mesh.report for mesh in meshes.values()]
    figures["seconds_by_part"] = {
        part: sum(report["seconds"][part] for report in reports) for part in reports[0]["seconds"]
    }
    return {**figures, "labels": len(meshes), "vertices_by_hu_share": [r["vertices_by_hu_share"] for r in reports]}


def _peers(volume: Any, labels: Any, hu: float, threads: int) -> dict[str, Callable[[], int]]:
    """Return the peers: each makes the meshes of all labels and returns their triangles."""
    import numpy as np
    from scipy.ndimage import find_objects
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkSMPTools
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D, vtkSurfaceNets3D
    from vtkmodules.vtkFiltersGeneral import vtkDiscreteFlyingEdges3D

    vtkSMPTools.SetBackend("STDThread")
    vtkSMPTools.Initialize(threads)
    numbers = [int(number) for number in np.unique(labels) if number]
    boxes = find_objects(labels)

    def image_of(array: Any) -> Any:
        grid = vtkImageData()
        grid.SetDimensions(*array.shape[::-1])
        grid.SetSpacing(*volume.spacing)
        grid.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(array).ravel()))
        return grid

    def contour_mask(kind: Any) -> int:
        contour = kind()
        contour.SetInputData(image_of(labels))
        for place, number in enumerate(numbers):
            contour.SetValue(place, number)
        contour.Update()
        return int(contour.GetOutput().GetNumberOfCells())

    def contour_blanked() -> int:
        triangles = 0
        for number in numbers:
            box = tuple(slice(max(0, part.start - 1), part.stop + 1) for part in boxes[number - 1])
            contour = vtkFlyingEdges3D()
            contour.SetInputData(image_of(np.where(labels[box] == number, volume.voxels[box], np.int16(-1024))))
            contour.SetValue(0, hu - 0.5)
            contour.ComputeNormalsOn()
            contour.ComputeScalarsOff()
            contour.Update()
            triangles += contour.GetOutput().GetNumberOfCells()
        return triangles

    return {
        "surface_nets": lambda: contour_mask(vtkSurfaceNets3D),
        "discrete_flying_edges": lambda: contour_mask(vtkDiscreteFlyingEdges3D),
        "flying_edges_on_blanked_hu": contour_blanked,
    }
