"""On a GPU each work-item writes one vertex or one triangle, on a CPU all of eight words: the meshes have the same
bytes."""

from __future__ import annotations

import numpy as np
import pytest
from device_work import label_boxes
from surface_volumes import MIRRORED, random_volume, smooth_volume
from uneven_volume import uneven
from variants import daily_rows

import clrecon
from clrecon.geometry import Volume
from clrecon.operators.surface.extract import extract_isosurface


def two_labels(volume: Volume) -> clrecon.LabelMap:
    return label_boxes(volume, np.s_[3:12, 4:20, 5:30], np.s_[12:20, 4:20, 5:30])


SMOOTH = smooth_volume((22, 26, 45))
SURFACES = {
    "rows of a word and a sample": lambda device: [extract_isosurface(random_volume((6, 7, 33)), 3, device=device)],
    "grown": lambda device: [extract_isosurface(SMOOTH, 100, grow_from="auto", device=device)],
    "mirrored": lambda device: [extract_isosurface(smooth_volume((5, 6, 70), affine=MIRRORED), 50, device=device)],
    "open": lambda device: [extract_isosurface(SMOOTH, 100, closed=False, device=device)],
    "trilinear": lambda device: [extract_isosurface(SMOOTH, 100, topology="trilinear", device=device)],
    "range": lambda device: [extract_isosurface(SMOOTH, (-50, 120), device=device)],
    "below": lambda device: [extract_isosurface(SMOOTH, -50, below=True, device=device)],
    "uneven": lambda device: [extract_isosurface(uneven(SMOOTH.voxels[:6]), 100, device=device)],
    "slabs": lambda device: [extract_isosurface(SMOOTH, 100, memory=150_000, device=device)],
    "labels": lambda device: clrecon.extract_labels(SMOOTH, two_labels(SMOOTH), 100, device=device).values(),
    "masks of labels": lambda device: clrecon.extract_label_masks(two_labels(SMOOTH), device=device).values(),
}


@pytest.mark.parametrize("name", daily_rows(2, [(name,) for name in SURFACES]))
def test_mesh_by_items_of_a_vertex_or_triangle_has_the_bytes_of_that_by_items_of_words(device, monkeypatch, name):
    meshes = []
    for lanes in ("8", "1"):
        variants = {**device.kernel_variants, "LANES": lanes, "WORDS_PER_ITEM": lanes}
        monkeypatch.setattr(device, "kernel_variants", variants)
        meshes.append(list(SURFACES[name](device)))
    for by_words, by_items in zip(*meshes, strict=True):
        assert len(by_items.triangles) > 100
        for array in ("vertices", "normals", "triangles"):
            assert getattr(by_items, array).tobytes() == getattr(by_words, array).tobytes()
