"""The peer of surfaces: VTK's flying edges, with its fastest settings.

References
----------
Schroeder, Maynard and Geveci 2015 (10.1109/LDAV.2015.7348069); vtkFlyingEdges3D.
"""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from clrecon.geometry import Volume


class PeerRun(NamedTuple):
    """One run: wall seconds of ``Update()``, and its output."""

    seconds: float
    vertices: int
    triangles: int


class FlyingEdges:
    """vtkFlyingEdges3D on the voxels of a volume, shared without a copy.

    Normals are on, scalars and gradients off, as in clrecon's surfaces.  VTK's wheels run sequentially by
    default.  Spacing and origin of the grid are set, its direction is not: VTK would turn an oblique surface in a
    second pass, while clrecon does so in the same pass.

    threads: 1: VTK's backend "Sequential"; more: "STDThread" with so many threads.
    """

    def __init__(self, volume: Volume, threads: int):
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonDataModel import vtkImageData

        self.threads = threads
        self._grid = vtkImageData()
        self._grid.SetDimensions(*volume.shape_ijk)
        self._grid.SetSpacing(*volume.spacing)
        self._grid.SetOrigin(*(float(value) for value in volume.affine[:3, 3]))
        self._grid.GetPointData().SetScalars(numpy_to_vtk(volume.voxels.reshape(-1)))

    @property
    def version(self) -> str:
        """VTK's version."""
        from vtkmodules.vtkCommonCore import vtkVersion

        return str(vtkVersion.GetVTKVersion())

    def run(self, level: float, keep: list[Any] | None = None) -> PeerRun:
        """Contour at `level`, the HU of the surface between voxels, with a new filter.

        The output is freed before the return, unless a list is given to `keep` it.
        """
        contour = self._make_filter(level)
        start = perf_counter()
        contour.Update()
        seconds = perf_counter() - start
        output = contour.GetOutput()
        if keep is not None:
            keep.append(output)
        return PeerRun(seconds, output.GetNumberOfPoints(), output.GetNumberOfCells())

    def _make_filter(self, level: float) -> Any:
        from vtkmodules.vtkCommonCore import vtkSMPTools
        from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

        vtkSMPTools.SetBackend("STDThread" if self.threads > 1 else "Sequential")
        vtkSMPTools.Initialize(self.threads)
        contour = vtkFlyingEdges3D()
        contour.SetInputData(self._grid)
        contour.SetValue(0, level)
        contour.ComputeNormalsOn()
        contour.ComputeScalarsOff()
        contour.ComputeGradientsOff()
        return contour
