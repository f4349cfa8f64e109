"""What happens to a scan before anything is made of it: masking, the region of interest, and preprocessing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from functools import reduce
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, RefusedInputError, UsageError
from clrecon.geometry import Volume, frame_from_lps
from clrecon.geometry.blocks import describe_extent
from clrecon.geometry.certificate import amend
from clrecon.geometry.grid import AIR_HU
from clrecon.jobs import options
from clrecon.jobs.inputs import crop_scan
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress
from clrecon.system.text import format_digits

if TYPE_CHECKING:
    from clrecon.opencl import Device
    from clrecon.operators.masks.mask import Mask
    from clrecon.operators.resident.device_volume import DeviceVolume


def mask_volume(volume: Volume, settings: options.InputSettings, progress: Progress) -> Volume:
    """Return the volume with air outside the field of view and the body, as the settings ask for it."""
    if settings.field_of_view is None and not settings.remove_table:
        return volume
    from clrecon.anatomy.body import describe_pieces, mask_field_of_view, remove_table

    warnings = list(volume.report.get("warnings", ()))
    if settings.field_of_view is not None:
        radius = settings.field_of_view
        volume = mask_field_of_view(volume, None if isinstance(radius, str) else radius, progress=progress)
        facts = volume.report["field_of_view"]
        warnings.append(
            f"outside of {format_digits(facts['radius_mm'], 4)} mm around the centre of the slices is air now:"
            f" {100.0 * facts['removed_share']:.3g} % of the voxels, {facts['dense_voxels_removed']:,} of them dense"
            + _describe_bone_cut(facts)
        )
    if settings.remove_table:
        volume = remove_table(volume, allow_bone_loss=settings.allow_bone_loss, progress=progress)
        facts = volume.report["remove_table"]
        warnings.append(
            f"outside of the body is air now: {100.0 * facts['removed_share']:.3g} % of the voxels,"
            f" {facts['dense_voxels_removed']:,} of them dense (table, blankets);{_describe_bone_left(facts)}"
            " look whether the body is whole"
        )
        if facts["kept_without_bone"]:
            warnings.append(
                f"kept beside the body: pieces without bone, {describe_pieces(facts['kept_without_bone'])}; they may be"
                " equipment as thick as a limb, such as paddles of a fixation mask"
            )
    volume.report = amend(volume.report, warnings=warnings)
    return volume


def _describe_bone_left(facts: dict[str, Any]) -> str:
    from clrecon.anatomy.body import describe_pieces

    if facts["bone_kept"] is None:
        return " no bone above 300 HU;"
    bone = "the dry bone" if facts["specimen"] else "the bone"
    removed = f"{facts['bone_voxels_removed']:,} voxels removed"
    if facts["bone_removed"]:
        removed += f": {describe_pieces(facts['bone_removed'])}"
    return f" of {bone} {100.0 * facts['bone_kept']:.4g} % stay ({removed});"


def _describe_bone_cut(facts: dict[str, Any]) -> str:
    """Describe the bone that a circle has cut off; no text if it has cut off none."""
    lost = facts["bone_voxels_removed"]
    if not lost:
        return ""
    apart = facts["bone_voxels_apart"]
    whole = f", {apart:,} of them in pieces that lie outside whole" if apart else ""
    return f"; it cuts bone off: {100.0 * (1.0 - facts['bone_kept']):.3g} %, {lost:,} voxels above 300 HU{whole}"


Band = tuple[float, float]
"""Lowest and highest HU that are inside of what the job makes; infinite where it has no end."""


def restrict_volume(
    volume: Volume, settings: options.InputSettings, device: Device, bands: Sequence[Band], progress: Progress
) -> Volume:
    """Crop the volume and, if asked here, make what is outside of the region air that is in none of the `bands`."""
    volume = crop_scan(volume, settings.crop, settings.space_of_points, margin=settings.crop_margin)
    if not settings.region or settings.region_later:
        return volume
    from clrecon.operators.resident.device_volume import DeviceVolume

    with DeviceVolume(volume, device=device, memory=settings.memory) as resident:
        restricted = apply_region(resident, settings, bands, progress)
        with restricted:
            return restricted.volume


def apply_region(
    resident: DeviceVolume, settings: options.InputSettings, bands: Sequence[Band], progress: Progress
) -> DeviceVolume:
    """Return the volume with air outside of the region of interest; ``report["region"]`` has its figures."""
    rules = options.parse_region_rules(settings.region or ())
    progress("region", 0, 0)
    volume = resident.volume
    mask, facts, warnings = _find_region(resident, rules, settings.space_of_points, settings.follow_links)
    stay, cells = mask.count, _count_cells(mask.to_numpy())
    every, all_cells = math.prod(volume.shape_ijk), math.prod(n - 1 for n in volume.shape_ijk)
    outside = value_outside(bands, volume.voxels.dtype)
    restricted = mask.apply(resident, outside)
    facts = {
        "rules": [str(rule) for rule in rules],
        "voxels": stay,
        "voxels_all": every,
        "cells": cells,
        "cells_all": all_cells,
        "outside_hu": float(outside),
        **facts,
    }
    now = "is air now" if outside == value_outside((), volume.voxels.dtype) else "is left out"
    warning = (
        f"outside of the region {' and '.join(facts['rules'])} {now}:"
        f" {stay:,} of {every:,} voxels stay ({100.0 * stay / every:.3g} %), {cells:,} of {all_cells:,} cells"
    )
    report = carry_report(volume, restricted.volume)
    restricted.volume.report = amend(report, region=facts, warnings=[*report.get("warnings", ()), *warnings, warning])
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
    resident: DeviceVolume, rules: Sequence[options.RegionRule], space: str, follow_links: bool
) -> tuple[Mask, dict[str, Any], list[str]]:
    """Return the region's voxels, facts and warnings: rules of one kind are united, different kinds intersected."""
    facts: dict[str, Any] = {}
    warnings: list[str] = []
    by_kind: dict[str, Mask] = {}
    for rule in rules:
        if rule.kind == "seed":
            continue
        part = _mask_of(resident, rule, space, facts, warnings, follow_links)
        if not part.count:
            raise UsageError(f"the region {rule} holds no voxel: {describe_extent(resident.volume, space)}")
        by_kind[rule.kind] = by_kind[rule.kind] | part if rule.kind in by_kind else part
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


def _mask_of(
    resident: DeviceVolume,
    rule: options.RegionRule,
    space: str,
    facts: dict[str, Any],
    warnings: list[str],
    follow_links: bool,
) -> Mask:
    from clrecon.operators.masks.mask import Mask

    if rule.kind == "box":
        turned = np.sort(_to_lps(np.asarray(rule.numbers).reshape(3, 2).T, space), axis=0)
        return Mask.from_box(resident, turned.T.reshape(-1).tolist())
    if rule.kind == "hu":
        return Mask.from_band(resident, (rule.numbers[0], rule.numbers[1]))
    if rule.kind == "tube":
        return Mask.from_tube(resident, _line_of(resident.volume, rule, facts), rule.numbers[0])
    from clrecon.labels import read_labels

    assert rule.path is not None
    names = None if rule.name is None else [rule.name]
    labels = read_labels(rule.path, names, volume=resident.volume, follow_links=follow_links)
    warnings += labels.warnings
    return Mask.from_labels(resident, labels, names)


def _line_of(volume: Volume, rule: options.RegionRule, facts: dict[str, Any]) -> Any:
    from clrecon.anatomy.spine_line import find_spine_line

    if rule.path is not None:
        from clrecon.rendering.views.centre_line import read_curve_points

        return read_curve_points(rule.path)
    try:
        line = find_spine_line(volume)
    except RefusedInputError as error:
        raise RefusedInputError(f"the region {rule} goes along the spinal canal: {error}") from None
    facts["spine_mm"] = round(line.height_mm, 1)
    return line.points


def _to_lps(points: Any, space: str) -> Any:
    return np.asarray(points, dtype=np.float64) * np.diag(frame_from_lps(space))


_MOST_TAKEN = 0.5
"""Largest share of the voxels at the level and above that the steps may take unless that is allowed."""


def preprocess_volume(
    volume: Volume, settings: options.InputSettings, device: Device, bands: Sequence[Band], progress: Progress
) -> Volume:
    """Run the steps of preprocessing in their order, one after the other on the device.

    Voxels that morphology takes get the HU as far below the level as the mean of all voxels at the level and above lies
    above it, voxels that it adds get that mean: the surface then runs half way between what stays and what went.

    bands: What the job takes as inside; morphology works on the only one, or on that of a step ``level:HU``.
    """
    if settings.preprocess is None:
        return volume
    from clrecon.operators.resident.device_volume import DeviceVolume

    steps = options.parse_preprocess(settings.preprocess)
    with ExitStack() as stack:
        resident = stack.enter_context(DeviceVolume(volume, device=device, memory=settings.memory))
        run = _StepRun(settings, bands, progress)
        for step in steps:
            progress("preprocess", len(run.said), len(steps))
            before, resident = resident, run.take(resident, step)
            if resident is not before:
                stack.enter_context(resident)
                before.close()
        progress("preprocess", len(steps), len(steps))
        done = resident.volume
        done.report = amend(
            done.report, preprocess=run.said, warnings=[*done.report.get("warnings", ()), *run.warnings]
        )
        return done


class _StepRun:
    def __init__(self, settings: options.InputSettings, bands: Sequence[Band], progress: Progress):
        self._settings, self._bands = settings, bands
        self._progress = progress
        self._level: float | None = None
        self.said: list[dict[str, Any]] = []
        self.warnings: list[str] = []

    def take(self, resident: DeviceVolume, step: options.PreprocessStep) -> DeviceVolume:
        """Run a step; the volume is the same object where the step changes nothing."""
        began = perf_counter()
        facts: dict[str, Any] = {}
        if step.name == "level":
            self._level = step.numbers[0]
        elif step.name == "region":
            resident = apply_region(resident, self._settings, self._bands, self._progress)
        elif step.name in options.MORPHOLOGY:
            resident, facts = self._change_shape(resident, step)
        else:
            resident, facts = self._filter(resident, step)
        self.said.append({"step": str(step), **facts, "seconds": round(perf_counter() - began, 4)})
        return resident

    @property
    def _band(self) -> Band:
        """The voxels that morphology changes: those of the band of the job, or of a level that was given."""
        if self._level is not None:
            return self._level, math.inf
        if len(self._bands) != 1:
            many = "has several levels" if self._bands else "has no level"
            raise UsageError(
                f"morphology works on the voxels at one level and above, and this job {many}: name it before the step,"
                f" as in {name_parameter('preprocess', 'level:200,open:1.5')}"
            )
        return self._bands[0]

    def _filter(self, resident: DeviceVolume, step: options.PreprocessStep) -> tuple[DeviceVolume, dict[str, Any]]:
        from clrecon.operators.filters.bilateral import filter_bilateral
        from clrecon.operators.filters.denoisers import filter_volume

        given: dict[str, Any] = dict(zip(options.FILTERS[step.name], step.numbers, strict=False))
        if step.name.startswith("bilateral"):
            near = None
            if step.name == "bilateral-near":
                low, high = self._band
                if math.isfinite(high) == math.isfinite(low):
                    raise UsageError("bilateral-near is exact at one level, and this job looks for a range")
                near = low if math.isfinite(low) else high
            done = filter_bilateral(
                resident, dimensions=2 if step.name == "bilateral-2d" else 3, near=near, normals=near is not None,
                progress=self._progress, **given,
            )  # fmt: skip
        else:
            done = filter_volume(resident, step.name, progress=self._progress, **given)  # type: ignore[arg-type]
        return done, dict(done.volume.report["filtered"]["steps"][-1])

    def _change_shape(
        self, resident: DeviceVolume, step: options.PreprocessStep
    ) -> tuple[DeviceVolume, dict[str, Any]]:
        from clrecon.operators.masks.mask import Mask

        low, high = band = self._band
        mask = Mask.from_band(resident, band)
        before = mask.count
        if not before:
            raise NoSurfaceError(f"{step} finds nothing to work on: no voxel lies from {low:g} to {high:g} HU")
        changed = _apply_morphology(mask, step)
        removed, added = mask - changed, changed - mask
        facts = {
            "band_hu": [_finite_or_none(low), _finite_or_none(high)],
            "voxels": before,
            "taken": removed.count,
            "added": added.count,
        }
        self._check_loss(step, facts)
        inside, outside = _mean_values(resident.volume, mask, band)
        facts |= {"inside_hu": inside, "outside_hu": outside}
        volume = resident.volume
        for voxels, value in ((removed, outside), (added, inside)):
            if voxels.count:
                resident = (~voxels).apply(resident, value)
        resident.volume.report = carry_report(volume, resident.volume)
        self.warnings.append(
            f"{step} took {removed.count:,} of {before:,} voxels of {_describe_band(band)} and added {added.count:,}"
        )
        return resident, facts

    def _check_loss(self, step: options.PreprocessStep, facts: dict[str, Any]) -> None:
        share = facts["taken"] / facts["voxels"]
        if share == 1.0:
            raise NoSurfaceError(f"{step} takes all {facts['voxels']:,} voxels: choose a smaller radius")
        if share > _MOST_TAKEN and not self._settings.allow_bone_loss:
            raise RefusedInputError(
                f"{step} takes {facts['taken']:,} of {facts['voxels']:,} voxels ({100.0 * share:.0f} %, over"
                f" {100.0 * _MOST_TAKEN:.0f}): choose a smaller radius, or go on with"
                f" {name_parameter('allow_bone_loss', True)}"
            )


def _apply_morphology(mask: Mask, step: options.PreprocessStep) -> Mask:
    if step.name.startswith("fill"):
        return mask.fill_holes(by_slice=step.name == "fill-slices")
    change = {"erode": mask.erode, "dilate": mask.dilate, "open": mask.open, "close": mask.close}[step.name]
    return change(step.numbers[0])


def _mean_values(volume: Volume, mask: Mask, band: Band) -> tuple[float, float]:
    """Return the HU of voxels that are added and of those that are taken: the mean inside, and its mirror image."""
    low, high = band
    marked = mask.to_numpy()
    total = sum(float(layer[own].sum(dtype=np.float64)) for layer, own in zip(volume.voxels, marked, strict=True))
    mean = total / mask.count
    level = low if math.isfinite(low) and (not math.isfinite(high) or mean - low < high - mean) else high
    away = max(abs(mean - level), 1.0)
    outside = level - away if level == low else level + away
    dtype = volume.voxels.dtype
    if dtype.kind == "f":
        return mean, outside
    limits = np.iinfo(dtype)
    return float(np.clip(round(mean), limits.min, limits.max)), float(np.clip(round(outside), limits.min, limits.max))


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _describe_band(band: Band) -> str:
    low, high = band
    if not math.isfinite(high):
        return f"{low:g} HU and above"
    return f"{low:g} to {high:g} HU" if math.isfinite(low) else f"{high:g} HU and below"
