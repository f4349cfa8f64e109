"""Checks of what is done with whole volumes: primitives, bricks, masks, filters, slices."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceError
from clrecon.opencl import Device, Stopwatch, download, upload
from clrecon.operators.filters.bilateral import SlicesThere, list_mixed_groups, row_words, run_bilateral
from clrecon.operators.filters.means import MeansSettings, run_means
from clrecon.operators.filters.settings import BilateralSettings
from clrecon.operators.masks.mask import Mask
from clrecon.operators.primitives.scan import compact, exclusive_scan, radix_sort
from clrecon.operators.primitives.union_find import label_components, label_fans
from clrecon.operators.reformat.sheets import sample_sheet
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import compare_bricks, measure_bricks
from clrecon.proof.checking import (
    OBLIQUE,
    VOXEL_TYPES,
    Check,
    noise,
    random_integers,
    require_close,
    require_equal,
    require_whole,
    stack,
)
from clrecon.proof.volumes import volume_twins as twin
from clrecon.rendering.views.reformation import find_plane, plane_sheet, slab_samples
from clrecon.system.progress import ignore_progress


def _check_scan(device: Device) -> str:
    for n in (1, 63, 64, 65, 1023, 1024, 1025, 70_001):
        counts = random_integers((n,), "uint32", 9) + np.uint32(1)
        expected, total = twin.exclusive_scan(counts)
        scanned = exclusive_scan(device, upload(device, counts), n)
        offsets = download(device, np.empty(n, dtype=np.uint32), scanned.offsets_d)
        require_equal(scanned.total, total, f"the sum of {n:,} elements")
        require_equal(offsets, expected, f"sums of {n:,} elements")
    return "8 sizes from 1 to 70,001 equal"


def _check_compaction(device: Device) -> str:
    for words in (1, 7, 8, 9, 513, 7001):
        mask = random_integers((words,), "uint32", 2**32) & random_integers((words,), "uint32", 2**31)
        expected = twin.compact(mask)
        compacted = compact(device, upload(device, mask), words)
        require_equal(compacted.count, len(expected), f"the number of bits in a mask of {words:,} words")
        positions = download(device, np.empty(compacted.count, dtype=np.uint32), compacted.positions_d)
        require_equal(positions, expected, f"positions in a mask of {words:,} words")
    return "6 masks from 1 to 7,001 words equal"


def _check_sort(device: Device) -> str:
    for n, bits in ((1, 32), (4097, 11), (70_001, 9), (70_001, 32)):
        keys = random_integers((n,), "uint32", 2**bits)
        sorted_on_device = radix_sort(device, upload(device, keys), n, bits=bits)
        expected, order = twin.radix_sort(keys)
        values = download(device, np.empty(n, np.uint32), sorted_on_device.values_d)
        require_equal(values, order, f"order of {n:,} keys of {bits} bits")
        sorted_keys = download(device, np.empty(n, np.uint32), sorted_on_device.keys_d)
        require_equal(sorted_keys, expected, f"{n:,} sorted keys of {bits} bits")
    return "4 arrays from 1 to 70,001 keys equal"


def _check_components(device: Device) -> str:
    """Compare components of random triangles, and of a strip in random order: its labels take many passes."""
    for vertices, triangles in ((64, 30), (60_000, 25_000), (40_000, 45_000)):
        mesh = random_integers((triangles, 3), "uint32", vertices)
        _require_components(device, mesh, vertices, *twin.label_components(mesh, vertices))
    order = np.random.default_rng(3).permutation(40_000).astype(np.uint32)
    strip = order[np.arange(39_998)[:, None] + np.arange(3)]
    _require_components(device, strip, 40_000, 1, np.zeros(40_000, np.int64))
    return "4 meshes from 30 to 45,000 triangles equal"


def _require_components(
    device: Device, mesh: NDArray[np.uint32], vertices: int, count: int, labels: NDArray[np.int64]
) -> None:
    component_count, numbers = label_components(device, mesh, vertices)
    require_equal(component_count, count, f"the number of components of {len(mesh):,} triangles")
    require_equal(numbers, labels, f"components of {len(mesh):,} triangles")


def _check_fans(device: Device) -> str:
    """Compare fans of random triangles, and of a torus in random order that has gaps and triangles turned round."""
    nj, ni = 130, 140
    j, i = np.indices((nj, ni)).reshape(2, -1)
    here, right = j * ni + i, j * ni + (i + 1) % ni
    above, beyond = (j + 1) % nj * ni + i, (j + 1) % nj * ni + (i + 1) % ni
    torus = np.concatenate([np.stack([here, right, beyond], 1), np.stack([here, beyond, above], 1)])
    rng = np.random.default_rng(5)
    torus = rng.permutation(nj * ni)[torus][rng.permutation(len(torus))[:-9]].astype(np.uint32)
    torus[::999] = torus[::999, ::-1]
    cones = [_make_cones(rim, nj * ni + 40 * rim) for rim in (2, 3, 16, 17)]
    vertices = nj * ni + 40 * 18
    for mesh in (np.concatenate([torus, *cones]), random_integers((6_000, 3), "uint32", vertices)):
        labelled, irregular = label_fans(device, mesh, vertices)
        count, labels = twin.label_components(mesh, vertices)
        require_equal(labelled[1], labels, f"components of {len(mesh):,} triangles")
        require_equal(labelled[0], count, "number of components")
        require_equal(irregular, np.array(twin.find_irregular(mesh, vertices)), "irregular vertices")
    return "2 meshes of 6,000 and 36,467 triangles equal"


def _make_cones(rim: int, first: int) -> NDArray[np.uint32]:
    """Return a closed surface of two cones, whose tips are in `rim` triangles each."""
    around = np.arange(rim)
    ahead = (around + 1) % rim
    tips = np.stack([np.full(rim, rim), around, ahead], 1), np.stack([np.full(rim, rim + 1), ahead, around], 1)
    return (first + np.concatenate(tips)).astype(np.uint32)


PRIMITIVE_CHECKS = (
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
    Check("label_fans", ("link_corners", "follow_fans"), _check_fans),
)  # fmt: skip


_BRICK_SHAPE = (221, 196, 21)
"""Voxels (k, j, i) of 28 x 25 x 3 bricks: 700 rows."""


def _check_bricks(device: Device) -> str:
    for dtype in VOXEL_TYPES:
        voxels = noise(_BRICK_SHAPE, dtype, 120)
        rows = np.arange(-(-_BRICK_SHAPE[0] // 8) * -(-_BRICK_SHAPE[1] // 8)).reshape(-(-_BRICK_SHAPE[0] // 8), -1)
        # Some rows are all outside.
        shift = (rows % 5).repeat(8, 0).repeat(8, 1)[: _BRICK_SHAPE[0], : _BRICK_SHAPE[1], None]
        voxels = np.where(shift == 4, 0, voxels // 4 + 20 * shift).astype(dtype)
        measured = measure_bricks(device, upload(device, voxels), _BRICK_SHAPE[::-1], voxels.dtype)
        ranges = download(device, np.empty((*measured.shape[::-1], 2), voxels.dtype), measured.ranges_d)
        expected = twin.measure_bricks(voxels)
        require_equal(ranges, expected, f"ranges of bricks of {dtype} voxels")
        level = voxels.dtype.type(45)
        compared = compare_bricks(device, measured, level, _BRICK_SHAPE[2], 1)
        states, extents = twin.compare_bricks(expected, float(level), _BRICK_SHAPE[2], 1)
        downloaded = download(device, np.empty_like(states), compared.states_d)
        require_equal(downloaded, states, f"states of bricks of {dtype} voxels")
        downloaded = download(device, np.empty_like(extents), compared.extents_d)
        require_equal(downloaded, extents, f"extents of bricks of {dtype} voxels")
    return "2,100 bricks of 6 types of voxels equal"


BRICK_CHECKS = (Check("bricks", ("measure_bricks", "compare_bricks"), _check_bricks),)


_MASK_SHAPE = (26, 41, 70)
"""Voxels (k, j, i): more than 1,000 rows, and three words in each."""


def _check_logic(device: Device) -> str:
    volume = stack(noise(_MASK_SHAPE, "int16", 100), OBLIQUE)
    a, b = volume.voxels > 40, volume.voxels % 3 == 0
    with DeviceVolume(volume, device=device) as resident:
        first, second = Mask.from_array(resident, a), Mask.from_array(resident, b)
        for mask, expected, name in (
            (first & second, a & b, "and"), (first | second, a | b, "or"), (first ^ second, a ^ b, "exclusive or"),
            (first - second, a & ~b, "and not"), (~first, ~a, "not"),
        ):  # fmt: skip
            require_equal(mask.to_numpy(), expected, f"{name} of masks")
            require_equal(mask.count, expected.sum(), f"the number of voxels in {name} of masks")
        applied = first.apply(resident).volume.voxels
    require_equal(applied, np.where(a, volume.voxels, -1024), "a volume of what a mask chooses")
    return f"{a.size:,} voxels equal"


def _check_regions(device: Device) -> str:
    voxel_count = 0
    for uneven in (False, True):
        volume = stack(noise(_MASK_SHAPE, "int16", 100), OBLIQUE, uneven=uneven)
        places = twin.find_places(volume)
        low, high = places[2, 3, 4], places[-4, -5, -6]
        sides = np.stack([np.minimum(low, high), np.maximum(low, high)], axis=1)
        line = places[[1, 9, 20], [5, 30, 12], [60, 20, 40]]
        with DeviceVolume(volume, device=device) as resident:
            box, tube = Mask.from_box(resident, sides.ravel().tolist()), Mask.from_tube(resident, line, 6.0)
        require_equal(box.to_numpy(), twin.find_in_box(volume, sides), "the voxels in a box")
        require_equal(tube.to_numpy(), twin.find_in_tube(volume, line, 6.0), "the voxels in a tube")
        voxel_count += box.count + tube.count
    return f"{voxel_count:,} voxels equal"


def _check_balls(device: Device) -> str:
    voxel_count = 0
    for uneven, columns in ((False, 70), (True, 70), (False, 530)):
        shape = (*_MASK_SHAPE[:2], columns) if columns == _MASK_SHAPE[2] else (9, 60, columns)
        affine = OBLIQUE if columns == _MASK_SHAPE[2] else np.diag((0.6, 0.6, 1.5, 1.0))
        volume = stack(noise(shape, "int16", 100), affine, uneven=uneven)
        few, many = volume.voxels > 97, volume.voxels > 2
        with DeviceVolume(volume, device=device) as resident:
            first, second = Mask.from_array(resident, few), Mask.from_array(resident, many)
            for mask, expected, operation in (
                (first.dilate(1.3), twin.dilate(volume, few, 1.3), "dilation"),
                (second.erode(1.3), twin.erode(volume, many, 1.3), "erosion"),
                (first.close(1.3), twin.close(volume, few, 1.3), "closing"),
            ):
                require_equal(mask.to_numpy(), expected, f"{operation} by a ball, rows of {columns} voxels")
        voxel_count += 3 * few.size
    return f"{voxel_count:,} voxels equal"


def _check_mask_components(device: Device) -> str:
    volume = stack(noise(_MASK_SHAPE, "int16", 100), OBLIQUE)
    chosen = volume.voxels > 42
    with DeviceVolume(volume, device=device) as resident:
        mask = Mask.from_array(resident, chosen)
        filled, flat = mask.fill_holes(), mask.fill_holes(by_slice=True)
        lone = Mask.from_array(resident, volume.voxels > 70)
        seeds = np.argwhere(volume.voxels > 70)[::9]
        grown = lone.grow(volume.ijk_to_lps(seeds[:, ::-1]))
    require_equal(filled.to_numpy(), twin.fill_holes(chosen), "filled holes")
    require_equal(flat.to_numpy(), twin.fill_holes(chosen, by_slice=True), "filled holes of slices")
    require_equal(grown.to_numpy(), twin.grow(volume.voxels > 70, seeds), "components grown from points")
    return f"{len(seeds):,} points, {filled.count - mask.count:,} voxels of holes equal"


MASK_CHECKS = (
    Check("balls", ("spread_ball",), _check_balls),
    Check("holes and growing", ("mark_border_runs", "mark_voxel_runs", "write_runs"), _check_mask_components),
    Check("logic of masks", ("combine_masks", "invert_mask", "count_row_bits", "replace_outside"), _check_logic),
    Check("boxes and tubes", ("write_runs",), _check_regions),
)


_FILTER_SHAPE = (9, 31, 53)
"""Rows of four groups: 1,116 of them, and 558 strips for the ends of the rows."""

_ROUNDED_HU = 0.501
"""Largest difference of a whole number from the mean that it is rounded from."""

_FLOAT_HU = 2e-3
"""Largest difference of a float: sums of 100 weights in float32, each within 4e-6."""


def _check_bilateral(device: Device, types: tuple[str, ...], uneven: bool) -> str:
    worst = 0.0
    for dtype in types:
        volume = stack(random_integers(_FILTER_SHAPE, dtype, 120), OBLIQUE, uneven=uneven)
        for dimensions, taps in ((3, 120), (2, 13)):
            settings = BilateralSettings.checked(volume, 0.8, 40.0, dimensions, None, False, taps)
            filtered = run_bilateral(DeviceVolume(volume, device=device), settings)
            require_whole({"slabs": filtered.slabs, "warnings": ()})
            offsets = settings.window.offsets
            expected = twin.filter_bilateral(
                volume.voxels, offsets, twin.spatial_weights(volume, offsets, settings.sigma_mm), settings.sigma_hu
            )
            allowed = _FLOAT_HU if volume.voxels.dtype.kind == "f" else _ROUNDED_HU
            worst = max(worst, require_close(filtered.voxels, expected, allowed, f"filtered {dtype} voxels, in HU"))
    return f"{2 * len(types)} volumes within {worst:.2g} HU"


def _check_means(device: Device) -> str:
    """Compare non-local means of a ball in noise with float64; one case has more than 500 tiles, one an odd side."""
    rng, worst = np.random.default_rng(15), 0.0
    for patch, reach, shape in ((5, 6, (2, 37, 83)), (4, 2, (2, 37, 83)), (3, 1, (9, 240, 260))):
        _, j, i = np.indices(shape)
        values = np.where((j - 15.0) ** 2 + (i - 40.0) ** 2 < 150.0, 300.0, 40.0) + rng.normal(0.0, 20.0, shape)
        volume, settings = stack(values.astype(np.float32), OBLIQUE), MeansSettings(patch, reach, 20.0)
        means = run_means(DeviceVolume(volume, device=device), settings, [], ignore_progress)
        layers = [twin.average_patches(layer, settings.side, reach, *settings.scale()) for layer in volume.voxels]
        worst = max(worst, require_close(means, np.stack(layers), _FLOAT_HU, "non-local means, in HU"))
    return f"13 slices within {worst:.2g} HU"


def _check_near_level(device: Device) -> str:
    """Compare the listed groups with the twin's, and a filter of them alone with that of all."""
    k, j, i = np.indices((30, 40, 1100))
    values = 100.0 + 60.0 * np.sin(0.12 * j + 0.2 * k + 0.004 * i)
    volume = stack(np.rint(values).astype(np.int16), np.diag((0.9, 1.0, 1.1, 1.0)))
    ni, nj, nk = volume.shape_ijk
    for reach in ((3, 1, 2), (16, 4, 1)):
        resident = DeviceVolume(volume, device=device)
        there = SlicesThere(resident.whole(Stopwatch()), ni, nj, 0, nk, 0, nk)
        listed = list_mixed_groups(device, there, volume.voxels.dtype, np.int16(99), reach)
        numbers = download(device, np.empty(listed.count, np.uint32), listed.positions_d)
        rows, groups = numbers // (32 * row_words(ni)), numbers % (32 * row_words(ni))
        marked = np.zeros((nk * nj, -(-ni // twin.GROUP)), np.bool_)
        if groups.size and groups.max() >= marked.shape[1]:
            raise DeviceError("groups near a level: some lie beyond their row")
        marked[rows, groups] = True
        expected = twin.mark_mixed_groups(volume.voxels, 99.0, reach)
        require_equal(marked.reshape(expected.shape), expected, "groups near a level")
    settings = BilateralSettings.checked(volume, 0.8, 20.0, 2, 99.0, False, 13)
    near = run_bilateral(DeviceVolume(volume, device=device), settings)
    everywhere = BilateralSettings.checked(volume, 0.8, 20.0, 2, None, False, 13)
    whole = run_bilateral(DeviceVolume(volume, device=device), everywhere)
    require_equal(near.voxels >= 99, whole.voxels >= 99, "sides of the level")
    return f"{int(expected.sum()):,} of {expected.size:,} groups"


FILTER_CHECKS = (
    Check(
        "bilateral filter",
        ("copy_row_ends", "filter_bilateral"),
        partial(_check_bilateral, types=VOXEL_TYPES, uneven=False),
    ),
    Check(
        "bilateral filter of uneven stacks",
        ("copy_row_ends", "filter_bilateral"),
        partial(_check_bilateral, types=("int16",), uneven=True),
    ),
    Check("non-local means", ("average_patches", "finish_means"), _check_means),
    Check("filter near a level", ("classify_groups", "spread_groups", "mark_mixed_groups"), _check_near_level),
)


SIZE = (41, 37)
"""Pixels, a work-item each."""

VALUE_HU = 1e-4
"""Largest difference: float32 interpolation of values up to 100 HU, and sums of some tens."""

PLANES = (("axial", 0.0, "mean"), ((20.0, 30.0), 2.3, "max"), ("sagittal", 4.0, "mean"), ((-75.0, 10.0), 3.0, "min"))


def _check_sheets(device: Device, types: tuple[str, ...], uneven: bool) -> str:
    worst = 0.0
    for dtype in types:
        volume = stack(random_integers((12, 17, 15), dtype, 100), OBLIQUE, uneven=uneven)
        for view, thickness, combine in PLANES:
            sheet, _ = plane_sheet(find_plane(volume, view, SIZE), SIZE, 0.1)
            samples = slab_samples(volume, thickness)
            cut = sample_sheet(DeviceVolume(volume, device=device), sheet, samples, combine)
            require_whole({"slabs": cut.slabs, "warnings": ()})
            expected = twin.reformat_sheet(volume, sheet, samples, combine)
            worst = max(worst, require_close(cut.values, expected, VALUE_HU, f"slices of {dtype} voxels, in HU"))
    return f"{len(types) * len(PLANES)} slices of {SIZE[0]} x {SIZE[1]} pixels within {worst:.1e} HU"


SHEET_CHECKS = (
    Check("slices", ("reformat_rows",), partial(_check_sheets, types=VOXEL_TYPES, uneven=False)),
    Check(
        "slices of uneven stacks",
        ("reformat_rows",),
        partial(_check_sheets, types=("int16", "float32"), uneven=True),
        {"reformat/sample.cl": ("UNEVEN",)},
    ),
)
