"""Surfaces by VTK, placed by the scan's geometry: the peers of the page."""

from __future__ import annotations

import os
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume, is_left_handed
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.mesh import Mesh
from clrecon.mesh.triangles import vertex_normals

FILTERS = {"vtk-mc": "vtkMarchingCubes", "vtk-fe": "vtkFlyingEdges3D"}


def extract_by_vtk(volume: Volume, iso_value: float, name: str, closed: bool) -> Mesh:
    """Extract a surface by one of VTK's filters, with its own normals on, on all cores where it can.

    iso_value: HU.
    name: {"vtk-mc", "vtk-fe"}
    closed: As `clrecon.extract_isosurface`: a layer of air lies around the volume.

    Returns: In LPS mm; its report has ``cells`` and ``seconds`` {extract, place}.
    """
    from vtkmodules import vtkFiltersCore
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkSMPTools
    from vtkmodules.vtkCommonDataModel import vtkImageData

    rule = choose_iso_rule(volume, iso_value, closed)
    start = perf_counter()
    voxels = volume.voxels
    if rule.closed:
        voxels = np.pad(voxels, 1, constant_values=voxels.dtype.type(rule.outside))
    nk, nj, ni = voxels.shape
    grid: Any = vtkImageData()
    grid.SetDimensions(ni, nj, nk)
    grid.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(voxels).reshape(-1)))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    vtkSMPTools.SetBackend("STDThread" if cores > 1 else "Sequential")
    vtkSMPTools.Initialize(cores)
    contour: Any = getattr(vtkFiltersCore, FILTERS[name])()
    contour.SetInputData(grid)
    contour.SetValue(0, rule.iso_level)
    contour.ComputeNormalsOn()
    contour.ComputeScalarsOff()
    contour.ComputeGradientsOff()
    contour.Update()
    made = contour.GetOutput()
    if not made.GetNumberOfPolys():
        raise NoSurfaceError(f"no surface {rule.phrase()}")
    extracted = perf_counter()
    found: NDArray[np.float64] = vtk_to_numpy(made.GetPoints().GetData()).astype(np.float64)
    faces = vtk_to_numpy(made.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    places = volume.ijk_to_lps(found - rule.border).astype(np.float32)
    # In (i, j, k) its triangles are counter-clockwise as seen from lower values.
    triangles = faces[:, ::-1] if is_left_handed(volume.affine) else faces
    triangles = np.ascontiguousarray(triangles, np.uint32)
    report: dict[str, Any] = {
        "cells": {"visited": (ni - 1) * (nj - 1) * (nk - 1), "all": (ni - 1) * (nj - 1) * (nk - 1)},
        "seconds": {"extract": extracted - start, "place": perf_counter() - extracted},
        "growing": None,
        "warnings": [],
    }
    return Mesh(places, triangles, vertex_normals(places, triangles), report)
