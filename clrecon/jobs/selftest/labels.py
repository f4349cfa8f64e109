"""Checks of surfaces of labels: by HU within a label, and of the labels' own masks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceError
from clrecon.jobs.selftest.check import Check, require_close, require_equal
from clrecon.jobs.selftest.scenes import OBLIQUE, WIDE, noise, random_integers, stack, waves
from clrecon.jobs.selftest.surface import MARCHING, compare_mesh
from clrecon.labels import LabelMap, resample_labels
from clrecon.labels.enclosed import count_faces
from clrecon.labels.occupancy import FULL
from clrecon.labels.solid import find_boxes
from clrecon.opencl import Device, Stopwatch, allocate, download, launch, upload
from clrecon.operators.surface.label_masks import extract_label_masks, prepare_label_masks, survey_labels
from clrecon.operators.surface.labels import extract_labels
from clrecon.reference.surface import label_masks as mask_twin
from clrecon.reference.surface import labels as label_twin

SUMS = 700
"""Sums of volumes that are compared, with 16 triangles each."""


def _blocks(dtype: str, numbers: tuple[int, ...]) -> NDArray[Any]:
    """Return a map of blocks of labels in every word of a row, with voxels of none between them."""
    coarse = np.random.default_rng(22).choice(np.array(numbers), [-(-n // 5) for n in WIDE])
    blocks = coarse.repeat(5, 0).repeat(5, 1).repeat(5, 2)[: WIDE[0], : WIDE[1], : WIDE[2]]
    return np.asarray(blocks.astype(dtype))


def _check_labels(device: Device) -> str:
    """Compare one label that fills most of the volume, and one that grows into what has none."""
    worst = 0.0
    for dtype, label_dtype, uneven, closed, solid in (
        ("int16", "uint8", False, True, True),
        ("float32", "uint16", True, False, False),
    ):
        volume = stack(waves(WIDE, dtype), OBLIQUE, uneven)
        big = 2 if label_dtype == "uint8" else 300
        numbers = _blocks(label_dtype, (big, big, big, big, big, big, 0))
        label_map = LabelMap(numbers, volume.affine)
        taken = resample_labels(label_map, volume).voxels
        inside = label_twin.find_solid(volume, taken, 30.0, closed=closed, solid=(big,) if solid else ())
        made = extract_labels(volume, label_map, 30.0, device=device, closed=closed, solid=solid)
        if list(made) != [big]:
            raise DeviceError(f"labels {list(made)} have a surface in place of [{big}]")
        expected = label_twin.extract_label(volume, inside, big, 30.0, closed=closed)
        worst = max(worst, compare_mesh(volume, made[big], expected, f"label {big} in {dtype} voxels"))
    return f"2 labels: triangles equal, vertices within {worst:.1e} voxel"


def _check_survey(device: Device) -> str:
    for dtype, high in (("uint8", 256), ("uint16", 720)):
        numbers = np.pad(random_integers((25, 28, 33), dtype, high).repeat(2, axis=2), 3)  # no box begins at 0
        boxes, faces = survey_labels(LabelMap(numbers, np.eye(4)), device, None, Stopwatch())
        present = tuple(int(number) for number in np.unique(numbers) if number)
        expected = find_boxes(numbers, present, (0, 0, 0))
        wrong = [number for number in present if boxes.get(number) != expected[number]]
        if wrong or len(boxes) != len(present):
            raise DeviceError(f"boxes of labels: {len(wrong)} of {len(present)} differ, label {wrong[0]} first")
        require_equal(faces, count_faces(numbers), f"faces of labels of type {dtype}")
    return "boxes and faces of 974 labels equal"


def _check_masks(device: Device) -> str:
    """Compare the surface of a label's own mask at one level: open, so that the level is not sought."""
    worst = 0.0
    for dtype in ("uint8", "uint16"):
        wave = waves(WIDE, "float32") > 40.0
        numbers = np.where(wave, 3, np.where(noise(WIDE, "uint8", 9) == 0, 5, 0)).astype(dtype)
        mesh = extract_label_masks(LabelMap(numbers, OBLIQUE), device=device, numbers=[3], closed=False)[3]
        level = round(mesh.report["mask_level"] * FULL)
        expected = mask_twin.extract_label_mask(numbers, OBLIQUE, 3, level, closed=False)
        worst = max(worst, compare_mesh(stack(numbers, OBLIQUE), mesh, expected, f"a mask of type {dtype}"))
    return f"2 masks: triangles equal, vertices within {worst:.1e} voxel"


def _check_volumes(device: Device) -> str:
    rng = np.random.default_rng(23)
    positions = rng.uniform(-20.0, 20.0, (900, 3)).astype(np.float32)
    triangles = rng.integers(0, 900, (16 * SUMS - 5, 3)).astype(np.uint32)
    sums_d, centre = allocate(device, 4 * SUMS), np.array([1.0, -2.0, 3.0, 0.0], np.float32)
    launch(
        device, prepare_label_masks(device)[0]["sum_volumes"], SUMS,
        positions=upload(device, positions), triangles=upload(device, triangles), sums=sums_d, centre=centre,
        triangle_count=len(triangles), triangles_per_sum=16,
    )  # fmt: skip
    corners = (positions.astype(np.float64) - centre[:3])[triangles]
    each = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    expected = np.add.reduceat(each, np.arange(0, len(each), 16))
    found = download(device, np.empty(SUMS, np.float32), sums_d)
    away = require_close(found, expected, 0.1, "volumes below triangles, in mm3")
    return f"{SUMS} sums within {away:.1g} of {np.abs(expected).max():,.0f} mm3"


CHECKS = (
    Check(
        "extract_labels",
        ("own_samples", "classify_label", *MARCHING),
        _check_labels,
        {"surface/marching_cubes.cl": ("LABELS", "UNEVEN")},
    ),
    Check("survey of labels", ("clear_survey", "find_boxes", "count_faces"), _check_survey),
    Check(
        "extract_label_masks",
        ("clear_survey", "find_boxes", "count_faces", "smooth_rows", "smooth_across", "classify_mask", *MARCHING),
        _check_masks,
        {"surface/marching_cubes.cl": ("MASKS",)},
    ),
    Check("volumes of masks", ("sum_volumes",), _check_volumes),
)  # fmt: skip
