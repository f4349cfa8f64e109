#!/usr/bin/env python3
"""Peer of `clrecon mesh`: read, contour and write with MeshLib, in millimetres and moved as its reader says.

Usage: meshlib_mesh.py CT_FOLDER OUTPUT.stl HU THREADS, with a Python that has `meshlib`.
"""

from __future__ import annotations

import sys


def main(folder: str, output: str, iso_value: float, threads: int) -> None:
    from meshlib import mrmeshpy as mm

    dicom = mm.VoxelsLoad.loadDicomFolder(folder, threads)
    settings = mm.MarchingCubesParams()
    settings.iso = iso_value
    mesh = mm.marchingCubes(dicom.vol, settings)
    mesh.transform(mm.AffineXf3f.linear(mm.Matrix3f.scale(1000.0)))  # it works in metres
    mesh.transform(dicom.xf)
    mm.saveMesh(mesh, output)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), int(sys.argv[4]))
