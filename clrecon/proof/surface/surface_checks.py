"""Checks of iso surfaces: every way to mark samples, uneven slices, ranges, the topology of the trilinear field,
labels, and walls of bone read from their profiles.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import Level
from clrecon.labels import LabelMap, resample_labels
from clrecon.labels.label_levels import FULL, count_faces, find_boxes
from clrecon.mesh import Mesh
from clrecon.opencl import Device, Stopwatch, allocate, download, launch, upload
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cortex import CORTEX_SPREAD, SAMPLES, ProfileSampler, expected_precisions
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.extraction import keep_bricks
from clrecon.operators.surface.label_masks import extract_label_masks, prepare_label_masks, survey_labels
from clrecon.operators.surface.labels import extract_labels
from clrecon.operators.surface.seeds import AUTO, AUTO_SHARE
from clrecon.proof.checking import (
    MIRRORED,
    OBLIQUE,
    WIDE,
    Check,
    blobs,
    centre_of,
    noise,
    random_integers,
    require_close,
    require_equal,
    require_share,
    require_whole,
    stack,
    waves,
)
from clrecon.proof.surface import cortex as cortex_twin
from clrecon.proof.surface import growing as growing_twin
from clrecon.proof.surface import labels as twin
from clrecon.proof.surface.extract import Surface
from clrecon.proof.surface.extract import extract_isosurface as extract_twin

_VERTEX_TOLERANCE_VOXEL = 1e-4
"""Largest difference of device (float32) and twin (float64), in units of the smallest voxel edge."""

_NORMAL_TOLERANCE = 2e-4
"""Largest difference of unit vectors: near a saddle a gradient is a small difference of float32."""

_MARCHING = ("count_rows", "total_counts", "list_words", "list_output", "emit_vertices", "emit_triangles")
"""Kernels that every surface launches."""

LONG = (532, 2, 6)
"""Voxels (k, j, i) of more than 500 slices: one of the kernels works slice by slice."""

_LONG_THIN = (520, 7, 34)
"""Voxels (k, j, i) of an open volume of many thin slices, whose ends are a large part of it."""


def compare_mesh(volume: Volume, mesh: Mesh, expected: Surface, subject: str) -> float:
    """Refuse a mesh that is not its twin; return the largest distance of a vertex, in voxel edges."""
    vertices, normals, triangles = expected
    require_whole(mesh.report)
    require_equal(mesh.triangles, triangles, f"triangles of {subject}")
    scale = 1.0 / min(volume.spacing)
    allowed = _VERTEX_TOLERANCE_VOXEL
    away = require_close(scale * mesh.vertices, scale * vertices, allowed, f"vertices of {subject}, in voxels")
    assert mesh.normals is not None
    require_close(mesh.normals, normals, _NORMAL_TOLERANCE, f"normals of {subject}")
    return away


def _compare_surfaces(device: Device, volume: Volume, levels: tuple[Level, ...], subject: str, **options: Any) -> float:
    """Compare surfaces of a volume one after the other: from the second on, bricks of the volume are known."""
    worst = 0.0
    with DeviceVolume(volume, device=device) as resident:
        for number, level in enumerate(levels):
            if number == 1:
                keep_bricks(resident, resident.whole(Stopwatch()))
            mesh = extract_isosurface(resident, level, **options)
            words = f"{subject}, surface {number + 1}" if len(levels) > 1 else subject
            worst = max(worst, compare_mesh(volume, mesh, extract_twin(volume, level, **options), words))
    return worst


def _check_first_and_second(device: Device) -> str:
    worst = 0.0
    for dtype, affine, closed in (("int16", OBLIQUE, True), ("float32", MIRRORED, False)):
        volume = stack(waves(WIDE, dtype, -500.0, 500.0), affine)
        worst = max(worst, _compare_surfaces(device, volume, (30.5, -80.0), f"{dtype} voxels", closed=closed))
    return f"4 surfaces: triangles equal, vertices within {worst:.1e} voxel"


def _check_variant(
    device: Device, levels: tuple[Level, ...], make: Callable[[tuple[int, int, int], str], NDArray[Any]] = waves,
    shape: tuple[int, int, int] = WIDE, types: tuple[str, ...] = ("int16", "float32"), *, uneven: bool = False,
    **options: Any,
) -> str:  # fmt: skip
    worst = 0.0
    for dtype in types:
        volume = stack(make(shape, dtype), OBLIQUE, uneven=uneven)
        worst = max(worst, _compare_surfaces(device, volume, levels, f"{dtype} voxels", **options))
    return f"{len(types) * len(levels)} surfaces: triangles equal, vertices within {worst:.1e} voxel"


GROWING = (
    "find_cell_runs", "begin_cell_runs", "join_cell_runs", "find_run_roots", "sum_components", "mark_grown",
    "count_visited",
)  # fmt: skip
"""Kernels that every grown surface launches, beside those that choose components."""


class _GrownTwin:
    """Cells of components that the twin takes, and what it counts."""

    def __init__(self, marked: NDArray[Any] | None):
        self.marked = marked
        self.counts: dict[str, int] = {}
        self.components = 0

    def __call__(self, inside: NDArray[Any]) -> NDArray[Any]:
        count, numbers = growing_twin.label_cells(inside)
        self.components = count
        if self.marked is None:
            chosen = growing_twin.choose_largest(np.bincount(numbers[numbers >= 0], minlength=count), AUTO_SHARE)
        else:
            chosen = growing_twin.find_seeded(inside, self.marked, numbers, count)
        cells = chosen[numbers] & (numbers >= 0)
        active, visited = int((numbers >= 0).sum()), growing_twin.count_visited(cells)
        self.counts = {"active": active, "all": cells.size, "grown": int(cells.sum()), "visited": visited}
        return np.asarray(cells)


def _grains() -> tuple[NDArray[Any], NDArray[Any]]:
    """Return grains of a voxel and a large one, run 521 on, and a mark in the one at an edge of the volume."""
    voxels, marked = np.zeros((24, 12, 40), np.int16), np.zeros((24, 12, 40), bool)
    places = list(product((2, 5, 8, 11), (2, 5, 8), range(2, 38, 3)))
    for index in places[:130]:
        voxels[index] = 100
    voxels[14:20, 3:9, 10:16] = 100
    voxels[0, 11, 5] = 100
    marked[0, 11, 5] = True
    return voxels, marked


def _check_growing(device: Device) -> str:
    """Compare parts of surfaces that grow from the largest components, and from the voxels of a label."""
    worst = 0.0
    grains, at_edge = _grains()
    many = np.zeros((14, 12, 160), np.int16)
    many[2::3, 2:9:3, 2:156:3] = 100
    most = many > 0
    most.reshape(-1)[np.flatnonzero(most)[::10]] = False
    for voxels, closed, marked, by_point in (
        (noise(WIDE, "int16", 8), True, None, False),
        (noise(_LONG_THIN, "float32", 8), False, noise(_LONG_THIN, "uint8", 40) == 38, False),  # whose HU are 7
        (grains, False, None, False),
        (grains, False, at_edge, False),
        (many, False, most, True),
    ):
        volume = stack(voxels, OBLIQUE)
        twin = _GrownTwin(marked)
        expected = extract_twin(volume, 6.5, closed=closed, grown=twin)
        seeds: Any = AUTO
        if marked is not None:
            seeds = LabelMap(marked.astype(np.uint8), volume.affine), 1
        if by_point:
            seeds = volume.ijk_to_lps(np.argwhere(most)[:, ::-1])
        mesh = extract_isosurface(volume, 6.5, device=device, closed=closed, grow_from=seeds)
        worst = max(worst, compare_mesh(volume, mesh, expected, f"a part in {voxels.dtype} voxels"))
        require_equal([mesh.report["cells"][name] for name in twin.counts], list(twin.counts.values()), "cells")
        require_equal(mesh.report["growing"]["components"], twin.components, "components")
    return f"5 parts of surfaces: triangles and counts of cells equal, vertices within {worst:.1e} voxel"


TRILINEAR = ("count_cells", "make_room", "emit_cell_triangles", "emit_cell_vertices")

SURFACE_CHECKS = (
    Check("extract_isosurface", ("classify_samples", "classify_bricks", *_MARCHING), _check_first_and_second),
    Check(
        "types of voxels",
        ("classify_samples", "classify_bricks", *_MARCHING),
        partial(_check_variant, levels=(40.5, 61.0), shape=(130, 44, 7), types=("int8", "uint8", "uint16", "int32")),
    ),
    Check(
        "uneven slices",
        ("classify_samples", *_MARCHING),
        partial(_check_variant, levels=(30.0,), uneven=True),
        {"surface/marching_cubes.cl": ("UNEVEN",)},
    ),
    Check(
        "ranges",
        ("classify_samples", *_MARCHING),
        partial(_check_variant, levels=((30.0, 60.0),)),
        {"masks/classify.cl": ("RANGE",), "surface/marching_cubes.cl": ("RANGE",)},
    ),
    Check(
        "below a level",
        ("classify_samples", *_MARCHING),
        partial(_check_variant, levels=(30.0,), below=True),
        {"masks/classify.cl": ("BORDER_INSIDE",)},
    ),
    Check(
        "growing",
        (*_MARCHING, *GROWING, "find_largest", "choose_largest", "choose_cells", "choose_seeded"),
        _check_growing,
        {"surface/cells.cl": ("GROWN",), "surface/marching_cubes.cl": ("GROWN",)},
    ),
    Check(
        "golden sections",
        _MARCHING,
        partial(_check_variant, levels=(30.0,), types=("int16",), vertex_rule="golden"),
        {"surface/marching_cubes.cl": ("GOLDEN",)},
    ),
    Check(
        "search by golden sections",
        _MARCHING,
        partial(_check_variant, levels=(30.0,), types=("int16",), vertex_rule="golden-search"),
        {"surface/marching_cubes.cl": ("GOLDEN_SEARCH",)},
    ),
    Check(
        "trilinear topology",
        ("classify_samples", *(kernel for kernel in _MARCHING if kernel != "emit_triangles"), *TRILINEAR),
        partial(_check_variant, levels=(2.5,), make=noise, shape=LONG, topology="trilinear"),
    ),
)


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
        volume = stack(waves(WIDE, dtype), OBLIQUE, uneven=uneven)
        big = 2 if label_dtype == "uint8" else 300
        label_map = LabelMap(_blocks(label_dtype, (big, big, big, big, big, big, 0)), volume.affine)
        placed = resample_labels(label_map, volume).voxels
        inside = twin.find_solid(volume, placed, 30.0, closed=closed, solid=(big,) if solid else ())
        meshes = extract_labels(volume, label_map, 30.0, device=device, closed=closed, solid=solid)
        require_equal(list(meshes), [big], "labels that have a surface")
        expected = twin.extract_label(volume, inside, big, 30.0, closed=closed)
        worst = max(worst, compare_mesh(volume, meshes[big], expected, f"label {big} in {dtype} voxels"))
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
        mesh = extract_label_masks(LabelMap(numbers, OBLIQUE), device=device, label=[3], closed=False)[3]
        level = round(mesh.report["mask_level"] * FULL)
        expected = twin.extract_label_mask(numbers, OBLIQUE, 3, level, closed=False)
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
    six_volumes = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    expected = np.add.reduceat(six_volumes, np.arange(0, len(six_volumes), 16))
    sums = download(device, np.empty(SUMS, np.float32), sums_d)
    away = require_close(sums, expected, 0.1, "volumes below triangles, in mm3")
    return f"{SUMS} sums within {away:.1g} of {np.abs(expected).max():,.0f} mm3"


LABEL_CHECKS = (
    Check(
        "extract_labels",
        ("own_samples", "classify_label", *_MARCHING),
        _check_labels,
        {"surface/marching_cubes.cl": ("LABELS", "UNEVEN")},
    ),
    Check("survey of labels", ("clear_survey", "find_boxes", "count_faces"), _check_survey),
    Check(
        "extract_label_masks",
        ("clear_survey", "find_boxes", "count_faces", "smooth_rows", "smooth_across", "classify_mask", *_MARCHING),
        _check_masks,
        {"surface/marching_cubes.cl": ("MASKS",)},
    ),
    Check("volumes of masks", ("sum_volumes",), _check_volumes),
)


PLACES = 8_200
"""Profiles that are sampled."""

_WALLS = 8200
"""Walls that are fitted: more than 500 vectors of sixteen."""

_VALUE_TOLERANCE_HU = 0.25
"""Places in float32, 2e-5 of a voxel off, where values change by 1000 HU within a voxel or two."""

_TOLERANCES = (
    ("places", 1e-3, 0.01), ("thicknesses", 2e-3, 0.03), ("outer HU", 1.0, 0.01), ("cortex HU", 2.0, 0.03),
    ("inner HU", 2.0, 0.03), ("residuals", 0.3, 0.01), ("variances", 0.01, 0.03),
)  # fmt: skip
"""What the fit in float32 may differ from that in float64 (mm, HU), and the share of walls that may differ more: those
where two walls are as good, or whose cost hardly changes along a valley of thicker and less dense ones."""


def twin_scale(sampler: ProfileSampler) -> cortex_twin.Scale:
    return cortex_twin.Scale(sampler.scale.first_mm, sampler.scale.step_mm, sampler.scale.place_weights)


def scatter_profiles(volume: Volume, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points about the middle of a volume, some of them near its border, and unit vectors at random."""
    random = np.random.default_rng(seed)
    extent = np.ptp(volume.ijk_to_lps(np.array([(0, 0, 0), volume.shape_ijk])), axis=0)
    points = centre_of(volume) + random.uniform(-0.55, 0.55, (PLACES, 3)) * np.abs(extent)
    normals = random.normal(size=(PLACES, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return points.astype(np.float32), normals.astype(np.float32)


def _check_profiles(device: Device, dtype: str, uneven: bool, cubic: bool) -> str:
    volume = blobs((30, 34, 38), OBLIQUE, dtype, uneven=uneven)
    points, normals = scatter_profiles(volume, 31)
    with DeviceVolume(volume, device=device) as resident:
        sampler = ProfileSampler(resident, Stopwatch(), cubic=cubic)
        profiles = sampler.values(points, normals)
    expected = cortex_twin.sample_profiles(volume, points, normals, twin_scale(sampler), cubic=cubic)
    share = 0.002  # at the border a sample is in the volume or not
    worst = require_share(profiles, expected, _VALUE_TOLERANCE_HU, share, f"profiles of {dtype} voxels")
    return f"{PLACES} profiles of {dtype} voxels within {worst:.1e} HU"


def make_walls(count: int, seed: int) -> NDArray[np.float32]:
    """Return profiles (ROWS, count) of walls of all kinds with noise, some of them cut off or beside another."""
    random = np.random.default_rng(seed)
    x = 0.5 * (np.arange(SAMPLES) - 7.0)
    wall_place, thickness = random.uniform(-1.6, 0.2, count), random.uniform(0.2, 4.0, count)
    blur = random.uniform(0.5, 0.9, count)
    outer, cortex = random.choice([-1000.0, 50.0], count), random.uniform(600.0, 1400.0, count)
    inner = random.uniform(-100.0, 400.0, count)
    share = cortex_twin._normal_share
    o = share((x[:, None] - wall_place) / blur)
    i = share(-(x[:, None] - wall_place + thickness) / blur)
    values = outer * o + inner * i + cortex * (1.0 - o - i) + random.normal(0.0, 15.0, o.shape)
    is_joint = random.random(count) < 0.2
    values[-2:, is_joint] += 600.0
    values[:2, is_joint] += 500.0
    values[11:, ::17] = np.nan
    values[:, 5::31] = np.nan
    frames = random.random(count), random.choice([1.0, 2.3], count)
    series = random.uniform(-1.0, 1.0, (3, SAMPLES, count)) * np.reshape([0.16, 0.02, 0.005], (3, 1, 1))
    return np.vstack([values, *frames, *series]).astype(np.float32)


def _check_fits(device: Device) -> str:
    values = make_walls(_WALLS, 32)
    volume = blobs((8, 9, 10), np.eye(4), "int16")
    with DeviceVolume(volume, device=device) as resident:
        sampler = ProfileSampler(resident, Stopwatch())
        rows = np.stack(sampler.take(values).fit(0.66, 0.81, 980.0, 20.0, finds_place=True).rows())
    precisions = expected_precisions(980.0, 20.0, CORTEX_SPREAD)
    expected = cortex_twin.fit_profiles(
        values.astype(np.float64), twin_scale(sampler), 0.66, 0.81, 980.0, precisions, 490.0
    )
    known = np.isfinite(expected[7])
    require_close(rows[7:], expected[7:], 1e-2, "highest values and room of walls")
    for row, (subject, allowed, share) in enumerate(_TOLERANCES):
        actual, wanted = rows[row][known], expected[row][known]
        if subject == "variances":  # in units of their own
            actual, wanted = actual / wanted, np.ones_like(wanted)
        require_share(actual, wanted, allowed, share, f"{subject} of walls")
    apart = np.abs(rows[0] - expected[0])[known]
    return f"{int(known.sum())} walls, 99 % of the places within {np.percentile(apart, 99.0):.1e} mm"


CORTEX_CHECKS = (
    *(
        Check(
            f"profiles across walls, {dtype}{', uneven slices' * uneven}{', cubic' * cubic}", ("sample_profiles",),
            partial(_check_profiles, dtype=dtype, uneven=uneven, cubic=cubic),
            variants={"surface/cortex.cl": ("CUBIC",) * cubic},
        )
        for dtype, uneven, cubic in (
            ("int16", False, False), ("float32", True, False), ("int16", False, True), ("float32", True, True)
        )
    ),
    Check("walls fitted to profiles", ("fit_profiles",), _check_fits),
)  # fmt: skip
