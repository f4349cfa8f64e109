"""Checks of the primitives: scans, compaction, sorting, components."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceError
from clrecon.opencl import Device, download, upload
from clrecon.operators.primitives.scan import compact, exclusive_scan, radix_sort
from clrecon.operators.primitives.union_find import label_components
from clrecon.proof.checking.check import Check, require_equal
from clrecon.proof.checking.scenes import random_integers
from clrecon.proof.primitives import primitive_twins as compact_twin
from clrecon.proof.primitives import primitive_twins as components_twin
from clrecon.proof.primitives import primitive_twins as scan_twin
from clrecon.proof.primitives import primitive_twins as sort_twin


def _check_scan(device: Device) -> str:
    for n in (1, 63, 64, 65, 1023, 1024, 1025, 70_001):
        counts = random_integers((n,), "uint32", 9) + np.uint32(1)
        expected, total = scan_twin.exclusive_scan(counts)
        scanned = exclusive_scan(device, upload(device, counts), n)
        offsets = download(device, np.empty(n, dtype=np.uint32), scanned.offsets_d)
        if scanned.total != total:
            raise DeviceError(f"the sum of {n:,} elements: {scanned.total:,} in place of {total:,}")
        require_equal(offsets, expected, f"sums of {n:,} elements")
    return "8 sizes from 1 to 70,001 equal"


def _check_compaction(device: Device) -> str:
    for words in (1, 7, 8, 9, 513, 7001):
        mask = random_integers((words,), "uint32", 2**32) & random_integers((words,), "uint32", 2**31)
        expected = compact_twin.compact(mask)
        compacted = compact(device, upload(device, mask), words)
        if compacted.count != len(expected):
            raise DeviceError(f"a mask of {words:,} words: {compacted.count:,} bits in place of {len(expected):,}")
        positions = download(device, np.empty(compacted.count, dtype=np.uint32), compacted.positions_d)
        require_equal(positions, expected, f"positions in a mask of {words:,} words")
    return "6 masks from 1 to 7,001 words equal"


def _check_sort(device: Device) -> str:
    for n, bits in ((1, 32), (4097, 11), (70_001, 9), (70_001, 32)):
        keys = random_integers((n,), "uint32", 2**bits)
        found = radix_sort(device, upload(device, keys), n, bits=bits)
        expected, order = sort_twin.radix_sort(keys)
        values = download(device, np.empty(n, np.uint32), found.values_d)
        require_equal(values, order, f"order of {n:,} keys of {bits} bits")
        sorted_keys = download(device, np.empty(n, np.uint32), found.keys_d)
        require_equal(sorted_keys, expected, f"{n:,} sorted keys of {bits} bits")
    return "4 arrays from 1 to 70,001 keys equal"


def _check_components(device: Device) -> str:
    """Compare components of random triangles, and of a strip in random order: its labels take many passes."""
    for vertices, triangles in ((64, 30), (60_000, 25_000), (40_000, 45_000)):
        mesh = random_integers((triangles, 3), "uint32", vertices)
        _require_components(device, mesh, vertices, *components_twin.label_components(mesh, vertices))
    order = np.random.default_rng(3).permutation(40_000).astype(np.uint32)
    strip = order[np.arange(39_998)[:, None] + np.arange(3)]
    _require_components(device, strip, 40_000, 1, np.zeros(40_000, np.int64))
    return "4 meshes from 30 to 45,000 triangles equal"


def _require_components(
    device: Device, mesh: NDArray[np.uint32], vertices: int, count: int, labels: NDArray[np.int64]
) -> None:
    found, numbers = label_components(device, mesh, vertices)
    if found != count:
        raise DeviceError(f"{found:,} components of {len(mesh):,} triangles in place of {count:,}")
    require_equal(numbers, labels, f"components of {len(mesh):,} triangles")


CHECKS = (
    Check("exclusive_scan", ("sum_blocks", "scan_block_sums", "scan_blocks"), _check_scan),
    Check("compact", ("count_set_bits", "list_set_bits"), _check_compaction),
    Check("radix_sort", ("count_digits", "scatter_by_digit"), _check_sort),
    Check(
        "label_components",
        (
            "clear_labels", "hook_corners", "jump_labels", "mark_mixed", "mark_roots", "gather_roots", "hook_roots",
            "jump_roots", "copy_roots", "flag_roots", "number_components",
        ),
        _check_components,
    ),
)  # fmt: skip
