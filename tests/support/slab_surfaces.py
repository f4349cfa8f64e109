"""Surfaces made slab by slab, and what is the same."""

from __future__ import annotations

import numpy as np

from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.operators.surface.extract import SurfaceExtractor


def extract_in_slabs(volume, iso_value, device, slices, closed=True):
    extractor = SurfaceExtractor(volume, device)
    extractor._use_smaller_slabs(choose_iso_rule(volume, iso_value, closed), slices)
    return extractor.extract(iso_value, closed=closed)


def assert_same(mesh, expected) -> None:
    assert np.array_equal(mesh.triangles, expected.triangles)
    assert np.array_equal(mesh.vertices, expected.vertices)
    assert np.array_equal(mesh.normals, expected.normals)
