"""The region of interest of a job: what lies outside of it becomes air before anything is made of the scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.base import AIR_HU
from clrecon.geometry.certificate import amend
from clrecon.geometry.crop import describe_extent
from clrecon.jobs.shared.cropping import crop_scan
from clrecon.jobs.shared.region_rules import RegionRule, parse_region_rules
from clrecon.jobs.shared.settings import InputSettings
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.opencl import Device
    from clrecon.operators.masks.mask import Mask
    from clrecon.operators.resident.device_volume import DeviceVolume

Band = tuple[float, float]
"""Lowest and highest HU that are inside of what the job makes; infinite where it has no end."""


def restrict_volume(
    volume: Volume, settings: InputSettings, device: Device, bands: Sequence[Band], progress: Progress
) -> Volume:
    """Crop the volume, and turn what lies outside of the region of interest into air where that is asked for here.

    bands: What the job will take as inside, so that what lies outside of the region never is.
    """
    volume = crop_scan(volume, settings.crop, settings.space_of_points, margin=settings.crop_margin)
    if not settings.region or settings.region_later:
        return volume
    from clrecon.operators.resident.device_volume import DeviceVolume

    with DeviceVolume(volume, device=device, memory=settings.memory) as resident:
        restricted = apply_region(resident, settings, bands, progress)
        with restricted:
            return restricted.volume


def apply_region(
    resident: DeviceVolume, settings: InputSettings, bands: Sequence[Band], progress: Progress
) -> DeviceVolume:
    """Return the volume with air outside of the region of interest; ``report["region"]`` has its figures."""
    rules = parse_region_rules(settings.region or ())
    progress("region", 0, 0)
    volume = resident.volume
    mask, facts, warnings = _find_region(resident, rules, settings.space_of_points)
    kept, cells = mask.count, _count_cells(mask.to_numpy())
    every, all_cells = math.prod(volume.shape_ijk), math.prod(n - 1 for n in volume.shape_ijk)
    outside = value_outside(bands, volume.voxels.dtype)
    restricted = mask.apply(resident, outside)
    facts = {
        "rules": [str(rule) for rule in rules],
        "voxels": kept,
        "voxels_all": every,
        "cells": cells,
        "cells_all": all_cells,
        "outside_hu": float(outside),
        **facts,
    }
    now = "is air now" if outside == value_outside((), volume.voxels.dtype) else "is left out"
    said = (
        f"outside of the region {' and '.join(facts['rules'])} {now}:"
        f" {kept:,} of {every:,} voxels stay ({100.0 * kept / every:.3g} %), {cells:,} of {all_cells:,} cells"
    )
    report = carry_report(volume, restricted.volume)
    restricted.volume.report = amend(report, region=facts, warnings=[*report.get("warnings", ()), *warnings, said])
    return restricted


def carry_report(before: Volume, after: Volume) -> dict[str, Any]:
    """Return the report of a volume for another with some voxels changed: only the range of its HU is another."""
    if before.report.get("hu_range") is None:
        return before.report
    return amend(before.report, hu_range=after.report["hu_range"])


def value_outside(bands: Sequence[Band], dtype: np.dtype[Any]) -> float:
    """Return the HU outside of a region: air, or where air is inside of a band, a value beyond the bands."""
    air = float(AIR_HU) if dtype.kind == "f" else float(max(AIR_HU, np.iinfo(dtype).min))
    if not any(low <= air <= high for low, high in bands):
        return air
    highest = max(high for _, high in bands)
    value = highest + max(highest - AIR_HU, 1.0)
    most = float(np.finfo(dtype).max) if dtype.kind == "f" else float(np.iinfo(dtype).max)
    value = min(float(math.ceil(value)) if math.isfinite(value) else value, most)
    if not value > highest:
        raise UsageError("a region needs a value of HU outside of what is looked for, and there is none")
    return value


def _find_region(
    resident: DeviceVolume, rules: Sequence[RegionRule], space: str
) -> tuple[Mask, dict[str, Any], list[str]]:
    """Return the voxels of the region, facts, and warnings of label files.

    Rules of one kind are united, those of different kinds intersected.
    """
    facts: dict[str, Any] = {}
    warnings: list[str] = []
    by_kind: dict[str, Mask] = {}
    for rule in rules:
        if rule.kind == "seed":
            continue
        own = _mask_of(resident, rule, space, facts, warnings)
        if not own.count:
            raise UsageError(f"the region {rule} holds no voxel: {describe_extent(resident.volume, space)}")
        by_kind[rule.kind] = by_kind[rule.kind] | own if rule.kind in by_kind else own
    mask = reduce(lambda one, other: one & other, by_kind.values())
    if not mask.count:
        kinds = " and ".join(str(rule) for rule in rules if rule.kind != "seed")
        raise UsageError(f"the region is empty: no voxel lies in {kinds}; {describe_extent(resident.volume, space)}")
    seeds = [rule.numbers for rule in rules if rule.kind == "seed"]
    return (mask.grow(_to_lps(seeds, space)) if seeds else mask), facts, warnings


def _count_cells(marked: NDArray[np.bool_]) -> int:
    """Count the cells of eight neighbouring voxels, shape (nk, nj, ni), that are all marked."""
    within = [layer[:-1] & layer[1:] for layer in marked]
    rows = [layer[:, :-1] & layer[:, 1:] for layer in within]
    return sum(int(np.count_nonzero(low & high)) for low, high in zip(rows, rows[1:], strict=False))


def _mask_of(resident: DeviceVolume, rule: RegionRule, space: str, facts: dict[str, Any], warnings: list[str]) -> Mask:
    from clrecon.operators.masks.mask import Mask

    if rule.kind == "box":
        corners = np.asarray(rule.numbers).reshape(3, 2)
        turned = np.sort(_to_lps(corners.T, space), axis=0)
        return Mask.from_box(resident, turned.T.reshape(-1).tolist())
    if rule.kind == "hu":
        return Mask.from_band(resident, (rule.numbers[0], rule.numbers[1]))
    if rule.kind == "tube":
        return Mask.from_tube(resident, _line_of(resident.volume, rule, facts), rule.numbers[0])
    from clrecon.labels import read_labels

    assert rule.path is not None
    names = None if rule.name is None else [rule.name]
    labels = read_labels(rule.path, names, volume=resident.volume)
    warnings += labels.warnings
    return Mask.from_labels(resident, labels, names)


def _line_of(volume: Volume, rule: RegionRule, facts: dict[str, Any]) -> Any:
    """Return the centre line of a tube, LPS mm."""
    if rule.path is not None:
        from clrecon.rendering.views.centre_line_files import read_curve_points

        return read_curve_points(rule.path)
    from clrecon.anatomy.spine_line import find_spine_line

    try:
        line = find_spine_line(volume)
    except RefusedInputError as error:
        raise RefusedInputError(f"the region {rule} goes along the spinal canal: {error}") from None
    facts["spine_mm"] = round(line.height_mm, 1)
    return line.points


def _to_lps(points: Any, space: str) -> Any:
    from clrecon.geometry import frame_from_lps

    return np.asarray(points, dtype=np.float64) * np.diag(frame_from_lps(space))
