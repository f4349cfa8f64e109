"""Checks of voxels of a band: masks, clusters on even and uneven stacks, what neighbouring slices have in common,
points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.opencl import Device, download
from clrecon.operators.masks.voxel_mask import VoxelMask, mark_band, mark_voxels
from clrecon.operators.points.point_extraction import extract_points
from clrecon.operators.points.slice_overlap import count_overlaps
from clrecon.operators.points.voxel_clusters import ClusterSearch, pad_for
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points.cloud import VoxelNumbers
from clrecon.points.stencil import Lattice, make_stencil
from clrecon.proof.checking import (
    OBLIQUE,
    WIDE,
    Check,
    noise,
    random_integers,
    require_close,
    require_equal,
    require_whole,
    stack,
)
from clrecon.proof.points import clusters as twin

SHAPE = (26, 41, 70)
"""Voxels (k, j, i): more than 1,000 rows, and three words in each."""

_MANY_PARTS = 64
"""Parts of the rows for each core: more than 500 work-items join runs."""


def _volume(uneven: bool) -> Volume:
    """Return noise of which a third of the slices is dense, and the last ones sparse."""
    voxels = noise(SHAPE, "int16", 100)
    voxels[: SHAPE[0] // 3] += 30
    voxels[-4:] -= 25
    return stack(voxels, OBLIQUE, uneven=uneven)


def _bits(device: Device, mask: VoxelMask) -> NDArray[np.bool_]:
    ni, nj, nk = mask.shape_ijk
    words = download(device, np.empty((nk, nj, mask.words), "<u4"), mask.mask_d)
    return np.unpackbits(words.view(np.uint8), axis=2, bitorder="little").astype(bool)[..., :ni]


def _check_masks(device: Device) -> str:
    volume = _volume(False)
    inside = (volume.voxels >= 75) & (volume.voxels <= 110)
    inside[:, 7] = False
    ijk = np.argwhere(inside)[:, ::-1].astype(np.int32)
    mixed = np.random.default_rng(4).permutation(len(ijk))
    numbers = VoxelNumbers(np.flatnonzero(inside)[mixed].astype(np.uint32), volume.shape_ijk)
    numbered = mark_voxels(device, numbers, volume.shape_ijk, pad=1)
    require_equal(_bits(device, numbered), inside, "the mask of a list of voxels by number")
    listed = mark_voxels(device, ijk[mixed], volume.shape_ijk, pad=1)
    require_equal(_bits(device, listed), inside, "the mask of a list of voxels")
    extents = download(device, np.empty((*SHAPE[:2], 2), np.uint16), listed.row_extents_d)
    columns = inside.reshape(*SHAPE[:2], -1)
    any_set = columns.any(axis=2)
    first = np.where(any_set, columns.argmax(axis=2) // 32, 0)
    last = np.where(any_set, (SHAPE[2] - 1 - columns[..., ::-1].argmax(axis=2)) // 32 + 1, 0)
    require_equal(extents, np.stack([first, last], axis=2), "the extents of its rows")
    return f"{len(ijk):,} voxels equal"


def _check_clusters(device: Device) -> str:
    counts = []
    for uneven, eps, samples in ((False, 1.2, 6), (True, 1.1, 4), (False, 0.75, 1), (True, 0.45, 2)):
        volume = _volume(uneven)
        stencil = make_stencil(Lattice.of(volume), eps)
        with DeviceVolume(volume, device=device) as resident:
            mask = mark_band(resident, (75.0, 110.0), pad=pad_for(stencil))
            search = ClusterSearch(device, mask, stencil, samples, parts_per_core=_MANY_PARTS)
            labels, cores = search.label(), search.flag_cores()
        ijk = np.argwhere((volume.voxels >= 75) & (volume.voxels <= 110))[:, ::-1]
        count, expected, expected_cores = twin.cluster_points(volume.ijk_to_lps(ijk), eps, samples)
        subject = f"at eps {eps} mm and min_samples {samples}"
        require_equal(search.count, count, f"the number of clusters {subject}")
        require_equal(cores, expected_cores, f"core points {subject}")
        require_equal(labels, expected, f"labels {subject}")
        counts.append(count)
    return f"{', '.join(map(str, counts))} clusters equal"


def _check_overlaps(device: Device) -> str:
    volume = _volume(False)
    with DeviceVolume(volume, device=device) as resident:
        counts = count_overlaps(device, mark_band(resident, (75.0, 110.0)))
    inside = (volume.voxels >= 75) & (volume.voxels <= 110)
    require_equal(counts, twin.count_overlaps(inside), "voxels that neighbouring slices have in common")
    return f"{len(inside)} slices equal"


BAND_CHECKS = (
    Check("masks of voxels", ("clear_words", "set_bits", "set_numbered_bits", "find_extents"), _check_masks),
    Check(
        "clusters of voxels",
        (
            "classify_samples", "find_cores", "count_row_runs", "list_row_runs", "join_runs", "count_links",
            "list_links", "label_points", "flag_cores",
        ),
        _check_clusters,
        {"masks/classify.cl": ("RANGE",)},
    ),
    Check("overlap of slices", ("count_overlaps",), _check_overlaps),
)  # fmt: skip


PLACE_TOLERANCE_MM = 1.6e-5
"""Half a step of float32 below 512 mm."""

BAND = (20.0, 70.0)


def _compare_points(device: Device, dtype: str, uneven: bool, kind: Any, labels: str | None) -> float:
    volume = stack(noise(WIDE, dtype, 100), OBLIQUE, uneven=uneven)
    chosen = None if labels is None else random_integers(WIDE, labels, 3)
    label_map = None if chosen is None else LabelMap(chosen, OBLIQUE)
    number = 2 if labels == "uint8" else 0
    cloud = extract_points(volume, kind=kind, hu=BAND, labels=label_map, label=number or None, device=device)
    points, hu, ijk = twin.extract_voxels(volume, *BAND, shell=kind == "shell", labels=chosen, label=number)
    subject = f"{kind} of {dtype} voxels{'' if labels is None else f' with labels of {labels}'}"
    require_whole(cloud.report)
    require_equal(cloud.ijk if cloud.ijk is not None else (), ijk, f"indices of {subject}")
    require_equal(cloud.hu if cloud.hu is not None else (), hu, f"HU of {subject}")
    return require_close(cloud.points, points, PLACE_TOLERANCE_MM, f"places of {subject}, mm")


def _check_voxels(device: Device) -> str:
    worst = max(
        _compare_points(device, dtype, uneven, kind, labels)
        for dtype, uneven, kind, labels in (
            ("int16", False, "voxels", None),
            ("float32", True, "voxels", None),
            ("uint8", False, "shell", None),
            ("int16", False, "voxels", "uint8"),
            ("int16", False, "shell", "uint16"),
        )
    )
    return f"5 clouds: voxels equal, places within {worst:.1e} mm"


POINT_CHECKS = (
    Check(
        "points of voxels",
        ("classify_samples", "restrict_mask", "find_shell", "count_points", "emit_points"),
        _check_voxels,
        {"masks/classify.cl": ("RANGE",)},
    ),
)
