"""One device serves several threads: kernels are shared, and their arguments are set one launch at a time."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from clrecon.geometry import Volume
from clrecon.operators.surface.extract import extract_isosurface


@pytest.mark.every_device
def test_threads_do_not_mix_their_arguments(device):
    volumes = [
        Volume(np.random.default_rng(seed).integers(0, 6, (4 + seed, 5, 20 + 7 * seed)).astype(np.int16), np.eye(4))
        for seed in range(4)
    ]
    expected = [extract_isosurface(volume, 3, device=device) for volume in volumes]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda n: (n, extract_isosurface(volumes[n % 4], 3, device=device)), range(60)))
    finally:
        sys.setswitchinterval(interval)
    for n, mesh in found:
        assert np.array_equal(mesh.triangles, expected[n % 4].triangles)
        assert np.array_equal(mesh.vertices, expected[n % 4].vertices)
