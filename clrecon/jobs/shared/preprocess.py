"""Preprocessing of a scan on the device: filters of HU, and morphology of what lies at the level and above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import NoSurfaceError, RefusedInputError, UsageError
from clrecon.geometry.certificate import amend
from clrecon.jobs.shared.preprocess_steps import FILTERS, MORPHOLOGY, PreprocessStep, parse_preprocess
from clrecon.jobs.shared.region import Band, apply_region, carry_report
from clrecon.jobs.shared.settings import InputSettings
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.opencl import Device
    from clrecon.operators.masks.mask import Mask
    from clrecon.operators.resident.device_volume import DeviceVolume

MOST_TAKEN = 0.5
"""Largest share of the voxels at the level and above that the steps may take unless that is allowed."""


def preprocess_volume(
    volume: Volume, settings: InputSettings, device: Device, bands: Sequence[Band], progress: Progress
) -> Volume:
    """Run the steps of preprocessing in their order, one after the other on the device.

    Voxels that morphology takes get the HU as far below the level as the mean of all voxels at the level and above lies
    above it, voxels that it adds get that mean: the surface then runs half way between what stays and what went.

    bands: What the job takes as inside; morphology works on the only one, or on that of a step ``level:HU``.

    Returns: With ``report["preprocess"]``, an entry a step: its name, parameters, what it took and added, seconds.
    """
    if settings.preprocess is None:
        return volume
    from clrecon.operators.resident.device_volume import DeviceVolume

    steps = parse_preprocess(settings.preprocess)
    with ExitStack() as stack:
        resident = stack.enter_context(DeviceVolume(volume, device=device, memory=settings.memory))
        run = _Run(settings, bands, progress)
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


class _Run:
    """The steps of one job, with what they say."""

    def __init__(self, settings: InputSettings, bands: Sequence[Band], progress: Progress):
        self._settings, self._bands, self._progress = settings, bands, progress
        self._level: float | None = None
        self.said: list[dict[str, Any]] = []
        self.warnings: list[str] = []

    def take(self, resident: DeviceVolume, step: PreprocessStep) -> DeviceVolume:
        """Run a step; the volume is the same object where the step changes nothing."""
        began = perf_counter()
        facts: dict[str, Any] = {}
        if step.name == "level":
            self._level = step.numbers[0]
        elif step.name == "region":
            resident = apply_region(resident, self._settings, self._bands, self._progress)
        elif step.name in MORPHOLOGY:
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

    def _filter(self, resident: DeviceVolume, step: PreprocessStep) -> tuple[DeviceVolume, dict[str, Any]]:
        from clrecon.operators.filters.bilateral import filter_bilateral
        from clrecon.operators.filters.denoisers import filter_volume

        given: dict[str, Any] = dict(zip(FILTERS[step.name], step.numbers, strict=False))
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
            done = filter_volume(resident, step.name, progress=self._progress, **given)
        return done, dict(done.volume.report["filtered"]["steps"][-1])

    def _change_shape(self, resident: DeviceVolume, step: PreprocessStep) -> tuple[DeviceVolume, dict[str, Any]]:
        from clrecon.operators.masks.mask import Mask

        low, high = band = self._band
        mask = Mask.from_band(resident, band)
        before = mask.count
        if not before:
            raise NoSurfaceError(f"{step} finds nothing to work on: no voxel lies from {low:g} to {high:g} HU")
        changed = _apply(mask, step)
        taken, added = mask - changed, changed - mask
        facts = {"band_hu": [_finite(low), _finite(high)], "voxels": before, "taken": taken.count, "added": added.count}
        self._check_loss(step, facts)
        inside, outside = _values(resident.volume, mask, band)
        facts |= {"inside_hu": inside, "outside_hu": outside}
        volume = resident.volume
        for voxels, value in ((taken, outside), (added, inside)):
            if voxels.count:
                resident = (~voxels).apply(resident, value)
        resident.volume.report = carry_report(volume, resident.volume)
        self.warnings.append(
            f"{step} took {taken.count:,} of {before:,} voxels of {_describe(band)} and added {added.count:,}"
        )
        return resident, facts

    def _check_loss(self, step: PreprocessStep, facts: dict[str, Any]) -> None:
        share = facts["taken"] / facts["voxels"]
        if share == 1.0:
            raise NoSurfaceError(f"{step} takes all {facts['voxels']:,} voxels: choose a smaller radius")
        if share > MOST_TAKEN and not self._settings.allow_bone_loss:
            raise RefusedInputError(
                f"{step} takes {facts['taken']:,} of {facts['voxels']:,} voxels ({100.0 * share:.0f} %, over"
                f" {100.0 * MOST_TAKEN:.0f}): choose a smaller radius, or go on with"
                f" {name_parameter('allow_bone_loss', True)}"
            )


def _apply(mask: Mask, step: PreprocessStep) -> Mask:
    if step.name.startswith("fill"):
        return mask.fill_holes(by_slice=step.name == "fill-slices")
    change = {"erode": mask.erode, "dilate": mask.dilate, "open": mask.open, "close": mask.close}[step.name]
    return change(step.numbers[0])


def _values(volume: Volume, mask: Mask, band: Band) -> tuple[float, float]:
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


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _describe(band: Band) -> str:
    low, high = band
    if not math.isfinite(high):
        return f"{low:g} HU and above"
    return f"{low:g} to {high:g} HU" if math.isfinite(low) else f"{high:g} HU and below"
