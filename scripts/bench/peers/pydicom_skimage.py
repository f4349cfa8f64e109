#!/usr/bin/env python3
"""Peer of `clrecon mesh`: a loop with pydicom, marching cubes of scikit-image, and trimesh, as in tutorials.

Usage: pydicom_skimage.py CT_FOLDER OUTPUT.stl HU.  The slices are sorted along z, and their distance is that of the
first two; origin and orientation of the scan are not used.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pydicom
import pydicom.misc
import trimesh
from skimage.measure import marching_cubes


def main(folder: str, output: str, iso_value: float) -> None:
    paths = filter(pydicom.misc.is_dicom, Path(folder).iterdir())
    slices = sorted(map(pydicom.dcmread, paths), key=lambda one: one.ImagePositionPatient[2])
    voxels = np.stack([one.pixel_array * one.RescaleSlope + one.RescaleIntercept for one in slices])
    step = slices[1].ImagePositionPatient[2] - slices[0].ImagePositionPatient[2]
    spacing = (step, *slices[0].PixelSpacing)
    vertices, triangles, _, _ = marching_cubes(voxels.transpose(2, 1, 0), iso_value, spacing=spacing[::-1])
    trimesh.Trimesh(vertices, triangles, process=False).export(output)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
