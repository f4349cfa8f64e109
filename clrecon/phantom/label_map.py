"""Write a label map as NRRD, header and packed voxels in one file.

Source: the NRRD format definition (teem.sourceforge.net/nrrd/format.html).
"""

from __future__ import annotations

import gzip
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_label_map(
    path: Path, labels: NDArray[np.uint8], affine: NDArray[np.float64], names: Mapping[int, str] | None = None
) -> None:
    """Write labels that lie where `affine` says, oblique and sheared ones included.

    labels: ndarray, shape (nk, nj, ni), uint8
    affine: ndarray, shape (4, 4). Index (i, j, k) to LPS mm.
    names: Names of labels, in ASCII; they are written as segments, as 3D Slicer does.
    """

    def vector(values: NDArray[np.float64]) -> str:
        return "(" + ",".join(repr(float(value)) for value in values) + ")"

    nk, nj, ni = labels.shape
    header = (
        "NRRD0004\ntype: uint8\ndimension: 3\nspace: left-posterior-superior\n"
        f"sizes: {ni} {nj} {nk}\nspace directions: {' '.join(vector(affine[:3, axis]) for axis in range(3))}\n"
        f"kinds: domain domain domain\nencoding: gzip\nspace origin: {vector(affine[:3, 3])}\n"
    )
    for n, (number, name) in enumerate((names or {}).items()):
        header += f"Segment{n}_ID:={name}\nSegment{n}_Name:={name}\nSegment{n}_LabelValue:={number}\n"
        header += f"Segment{n}_Layer:=0\n"
    header += "\n"
    # no clock: phantoms made twice are equal byte for byte
    path.write_bytes(header.encode("ascii") + gzip.compress(labels.tobytes(), compresslevel=6, mtime=0))
