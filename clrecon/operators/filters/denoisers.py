"""Filters under one name: of SimpleITK and scipy on the computer's processor, and non-local means."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import metadata
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.noise import measure_noise
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.resample import shear_degrees
from clrecon.opencl import Device
from clrecon.operators.filters.means import MeansSettings, run_means
from clrecon.operators.filters.settings import checked_length, report_filter
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.system.arguments import FilterName, explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.packages import import_package, package_of
from clrecon.system.progress import Progress, ignore_progress

VolumeKind = TypeVar("VolumeKind", Volume, DeviceVolume)

_SHEARED_DEGREES = 0.1
"""Angle of shear below which distances along the axes are those in the patient, to a part in 500,000."""

ITK_TIME_STEP = 0.0625
"""Largest stable time step of curvature flow in three dimensions, for steps of 1 mm and more."""


@dataclass(frozen=True)
class _Denoiser:
    """A filter: `run` returns voxels as floats and its facts.

    package: Module that `run` is given; None for a filter that runs on a device, on grids of any kind.
    """

    package: str | None
    defaults: dict[str, Any]
    run: Callable[..., tuple[NDArray[Any], dict[str, Any]]]


@explains_arguments
def filter_volume(
    volume: VolumeKind,
    name: FilterName,
    *,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
    **parameters: float | None,
) -> VolumeKind:
    """Filter a volume by a filter of SimpleITK or scipy on the computer's processor, or by non-local means.

    For `clrecon.filter_bilateral`, which runs on the device, see there.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        A `DeviceVolume` gets the result uploaded when it is first needed.
    name : {"median", "gaussian", "curvature-flow", "non-local-means"}
        median: SimpleITK, of a box of ``radius_mm`` (default one voxel along each axis) in whole voxels.
        gaussian: scipy, with ``sigma_mm`` (default 0.7).
        curvature-flow: SimpleITK, in mm, with ``iterations`` (default 5) of ``time_step`` (default 0.0625 for voxels of
        1 mm and more, less for smaller ones).
        non-local-means: on the device, slice by slice, with ``sigma_hu`` (default the noise that
        `clrecon.measure_noise` finds), patches of ``patch`` voxels (default 5; of even numbers the next one) and
        ``reach`` (default 6) voxels around.
    device : Device, str or int, optional
        Of non-local-means, see `clrecon.device`; None is the best of the machine.  A `DeviceVolume` has its own.
    memory : int, optional
        Most bytes that non-local-means takes on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("filter", slices done, all slices)``.
    **parameters
        Those of the filter.

    Returns
    -------
    Volume or DeviceVolume
        As it was given, in the type of the voxels, whole numbers rounded; ``report["filtered"]["steps"]`` says the
        name, the parameters and the package, if it is another one's.

    Raises
    ------
    UsageError
        The name or a parameter is unknown or out of range; the package is not installed; float voxels hold NaN; the
        slices are unevenly spaced, or sheared by more than 0.1 degrees, which only non-local-means takes; ``device`` or
        ``memory`` is given to another filter.
    DeviceError
        Non-local-means: no device, no room for a slice, or the device fails.
    """
    resident = volume if isinstance(volume, DeviceVolume) else None
    source = resident.volume if resident is not None else volume
    if not isinstance(source, Volume):
        raise UsageError(f"a filter needs a Volume, not {type(volume).__name__}: clrecon.Volume(voxels, affine)")
    denoiser = DENOISERS.get(name)
    if denoiser is None:
        raise UsageError(f"there is no filter {name!r}: it is one of {', '.join(DENOISERS)}, or filter_bilateral")
    unknown = sorted(parameters.keys() - denoiser.defaults.keys())
    if unknown:
        raise UsageError(f"{name} has no parameter {unknown[0]}: it has {', '.join(denoiser.defaults)}")
    _check_volume(source, name, denoiser)
    asked = {**denoiser.defaults, **parameters}
    tell = progress or ignore_progress
    warnings: list[str] = []
    nk = source.shape_ijk[2]
    tell("filter", 0, nk)
    if denoiser.package is None:
        with open_volume(volume, device, memory, "a filter") as opened:
            for attempt in opened.with_fallback():
                with attempt as (_, warnings):
                    voxels, facts = denoiser.run(opened, asked, warnings, tell)
    else:
        if device is not None or memory is not None:
            raise UsageError(f"{name} runs on the computer's processor: leave out device and memory")
        voxels, facts = denoiser.run(import_package(denoiser.package, f"the filter {name}"), source, asked)
        top = denoiser.package.split(".")[0]
        facts["package"] = f"{top} {metadata.version(package_of(top))}"
    tell("filter", nk, nk)
    filtered = report_filter(source, _as_voxels(voxels, source), {"filter": name, **facts}, warnings)
    return filtered if resident is None else resident.follow(filtered)  # type: ignore[return-value]


def _check_volume(volume: Volume, name: str, denoiser: _Denoiser) -> None:
    if volume.voxels.dtype.kind == "f" and not np.isfinite(volume.voxels).all():
        raise UsageError(
            f"the voxels hold NaN or infinite values, which {name} spreads: filter_bilateral leaves them out"
        )
    if denoiser.package is None:
        return
    why = ""
    if volume.uneven:
        why = "the slices are unevenly spaced"
    elif (angle := shear_degrees(volume.affine)) > _SHEARED_DEGREES:
        why = f"the slices are sheared by {angle:.2g} degrees"
    if why:
        raise UsageError(
            f"{why}, and {name} takes them for even steps at right angles: filter_bilateral and non-local-means do not"
        )


def _as_voxels(result: NDArray[Any], volume: Volume) -> NDArray[Any]:
    """Return values in the type of the voxels, whole numbers rounded."""
    dtype = volume.voxels.dtype
    if dtype.kind == "f" or result.dtype == dtype:
        return np.ascontiguousarray(result, dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(result), limits.min, limits.max).astype(dtype)


def _whole(name: str, value: Any, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not least <= value <= most:
        raise UsageError(f"{name} is a whole number from {least} to {most}, not {value!r}")
    return int(value)


def _check_number(name: str, value: Any, most: float) -> float:
    is_number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not is_number or not 0.0 < value <= most:
        raise UsageError(f"{name} is a number above 0, at most {most:g}, not {value!r}")
    return float(value)


def _image(sitk: Any, volume: Volume) -> Any:
    image = sitk.GetImageFromArray(volume.voxels)
    image.SetSpacing(volume.spacing)
    return image


def _run_median(sitk: Any, volume: Volume, asked: dict[str, Any]) -> tuple[NDArray[Any], dict[str, Any]]:
    if asked["radius_mm"] is None:
        radius, used = [1, 1, 1], {}
    else:
        length = checked_length("radius_mm", asked["radius_mm"], volume)
        radius, used = [math.floor(length / step + 0.5) for step in volume.spacing], {"radius_mm": length}
        if not any(radius):
            raise UsageError(f"radius_mm={length:g} is less than half a voxel along each axis: nothing would change")
    result = sitk.GetArrayFromImage(sitk.Median(_image(sitk, volume), radius))
    return result, {**used, "window": [2 * n + 1 for n in radius]}


def _run_gaussian(ndimage: Any, volume: Volume, asked: dict[str, Any]) -> tuple[NDArray[Any], dict[str, Any]]:
    sigma = checked_length("sigma_mm", asked["sigma_mm"], volume)
    steps = [sigma / step for step in reversed(volume.spacing)]
    result = ndimage.gaussian_filter(volume.voxels.astype(np.float32), steps, mode="nearest")
    return result, {"sigma_mm": sigma}


def _run_curvature_flow(sitk: Any, volume: Volume, asked: dict[str, Any]) -> tuple[NDArray[Any], dict[str, Any]]:
    iterations = _whole("iterations", asked["iterations"], 1, 1000)
    stable = ITK_TIME_STEP * min(1.0, min(volume.spacing)) ** 2
    step = stable if asked["time_step"] is None else _check_number("time_step", asked["time_step"], 1.0)
    image = sitk.Cast(_image(sitk, volume), sitk.sitkFloat32)
    result = sitk.GetArrayFromImage(sitk.CurvatureFlow(image, step, iterations))
    return result, {"iterations": iterations, "time_step": step}


def _run_non_local_means(
    resident: DeviceVolume, asked: dict[str, Any], warnings: list[str], tell: Progress
) -> tuple[NDArray[Any], dict[str, Any]]:
    volume, sigma = resident.volume, asked["sigma_hu"]
    patch, reach = _whole("patch", asked["patch"], 3, 31), _whole("reach", asked["reach"], 1, 31)
    noise = measure_noise(volume).hu if sigma is None else _check_number("sigma_hu", sigma, 1e6)
    settings = MeansSettings(patch | 1, reach, noise)
    facts = {"sigma_hu": noise, "patch": settings.patch, "reach": reach, "dimensions": 2}
    return run_means(resident, settings, warnings, tell), facts


DENOISERS = {
    "median": _Denoiser("SimpleITK", {"radius_mm": None}, _run_median),
    "gaussian": _Denoiser("scipy.ndimage", {"sigma_mm": 0.7}, _run_gaussian),
    "curvature-flow": _Denoiser("SimpleITK", {"iterations": 5, "time_step": None}, _run_curvature_flow),
    "non-local-means": _Denoiser(None, {"sigma_hu": None, "patch": 5, "reach": 6}, _run_non_local_means),
}
"""The filters by name."""
