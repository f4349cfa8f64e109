#!/usr/bin/env python3
"""Peer of `clrecon mesh`: read with SimpleITK, contour with vtkFlyingEdges3D on all threads, write STL with VTK.

Usage: simpleitk_vtk.py CT_FOLDER OUTPUT.stl HU THREADS.  Prints its seconds by part as JSON.
"""

from __future__ import annotations

import json
import sys
import time


def main(folder: str, output: str, iso_value: float, threads: int) -> None:
    start = time.perf_counter()
    import SimpleITK as sitk
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkSMPTools
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D
    from vtkmodules.vtkIOGeometry import vtkSTLWriter

    imported = time.perf_counter()
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(folder))
    image = reader.Execute()
    voxels = sitk.GetArrayViewFromImage(image)
    read = time.perf_counter()

    vtkSMPTools.SetBackend("STDThread")
    vtkSMPTools.Initialize(threads)
    grid = vtkImageData()
    grid.SetDimensions(*image.GetSize())
    grid.SetSpacing(*image.GetSpacing())
    grid.SetOrigin(*image.GetOrigin())
    grid.SetDirectionMatrix(*image.GetDirection())
    grid.GetPointData().SetScalars(numpy_to_vtk(voxels.ravel()))
    contour = vtkFlyingEdges3D()
    contour.SetInputData(grid)
    contour.SetValue(0, iso_value)
    contour.ComputeNormalsOn()
    contour.ComputeScalarsOff()
    contour.Update()
    contoured = time.perf_counter()

    writer = vtkSTLWriter()
    writer.SetFileTypeToBinary()
    writer.SetFileName(output)
    writer.SetInputConnection(contour.GetOutputPort())
    writer.Write()
    written = time.perf_counter()
    seconds = {
        "import": imported - start,
        "read": read - imported,
        "kernels": contoured - read,
        "write": written - contoured,
        "total": written - start,
    }
    print(json.dumps({"triangles": contour.GetOutput().GetNumberOfCells(), "seconds": seconds}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), int(sys.argv[4]))
