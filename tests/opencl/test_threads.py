"""One device serves several threads: kernels are shared, and their arguments are set one launch at a time."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.operators.surface.extract import extract_isosurface


@pytest.mark.every_device
def test_surfaces_extracted_by_several_threads_are_those_of_one_thread(device):
    """Python changes threads every microsecond: between the setting of arguments, if nothing prevents that."""
    volumes = [
        Volume(np.random.default_rng(seed).integers(0, 6, (4 + seed, 5, 20 + 7 * seed)).astype(np.int16), np.eye(4))
        for seed in range(4)
    ]
    middle = 3  # of the values 0 to 5
    expected_meshes = [extract_isosurface(volume, middle, device=device) for volume in volumes]
    repeats = 15
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            meshes = list(pool.map(lambda volume: extract_isosurface(volume, middle, device=device), repeats * volumes))
    finally:
        sys.setswitchinterval(interval)

    for mesh, expected in zip(meshes, repeats * expected_meshes, strict=True):
        assert np.array_equal(mesh.triangles, expected.triangles)
        assert np.array_equal(mesh.vertices, expected.vertices)
