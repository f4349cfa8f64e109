"""Case of the bilateral filter: in slices against OpenCV, in three dimensions against ITK and scikit-image."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from measure import alternate, busy_seconds, summarise
from registry import Job, case

PEER_SLICES = 4
"""Slices that ITK filters: its time is that of all, per voxel.  It takes half a minute for 40 million voxels."""

SKIMAGE_SLICES = 2

NOISE_FACTOR = 3.0


@case("bilateral", "bilateral filter, of slices and in three dimensions, against OpenCV, ITK and scikit-image")
def measure_bilateral(job: Job) -> dict[str, Any]:
    """Time filters with the same taps, from voxels in host memory to voxels in host memory.

    Slices: 13 taps, OpenCV's diameter 5, on float32 slices that are made before the clock runs; scikit-image's window
    of 5 x 5 on a few slices.  Three dimensions: 125 taps, ITK's radius 2 (SimpleITK), on a few slices, its time per
    voxel; ours everywhere, and near the iso value.  The volume counts as one of voxels of 1 mm, so that both have the
    same taps.  Ratios of processor time are told beside those of the wall.
    """
    import numpy as np
    import SimpleITK as sitk

    from clrecon.anatomy.noise import measure_noise
    from clrecon.geometry import Volume
    from clrecon.opencl import Stopwatch
    from clrecon.operators.filters.bilateral import run_bilateral
    from clrecon.operators.filters.settings import BilateralSettings
    from clrecon.operators.resident.device_volume import DeviceVolume

    given = job.input.volume()
    volume = Volume(given.voxels, np.eye(4))
    nk = volume.shape_ijk[2]
    sigma = NOISE_FACTOR * measure_noise(volume).hu
    asked = {
        "slices": BilateralSettings.checked(volume, 1.0, sigma, 2, None, False, 13),
        "everywhere": BilateralSettings.checked(volume, 0.8, sigma, 3, None, False, 125),
        "near": BilateralSettings.checked(volume, 0.8, sigma, 3, job.hu, False, 125),
    }
    floats = volume.voxels.astype(np.float32)
    middle = nk // 2
    part = floats[max(0, middle - PEER_SLICES // 2) :][:PEER_SLICES]
    image = sitk.GetImageFromArray(part)
    few = floats[middle : middle + SKIMAGE_SLICES]
    peers: dict[str, tuple[str, float, Callable[[], Any]]] = {
        "everywhere / ITK": ("everywhere", nk / len(part), lambda: sitk.Bilateral(image, 0.8, sigma, 100)),
        "near / ITK": ("near", nk / len(part), lambda: sitk.Bilateral(image, 0.8, sigma, 100)),
        "slices / scikit-image": ("slices", nk / len(few), lambda: _skimage(few, sigma)),
    }
    opencv = _opencv()
    if opencv is not None:
        peers["slices / OpenCV"] = ("slices", 1.0, lambda: _filter_slices(opencv, floats, sigma))
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "facts": {}, "kernel_seconds": {}}
    with DeviceVolume(volume, device=job.device) as resident:
        for name, settings in asked.items():
            run_bilateral(resident, settings)
            stopwatch = Stopwatch()
            found = run_bilateral(resident, settings, stopwatch=stopwatch)
            spent = {f"{kernel} ({name})": seconds for kernel, seconds in stopwatch.by_kernel.items()}
            figures["kernel_seconds"] |= spent
            figures["facts"][name] = {**settings.as_report(), "filtered_share": found.share}
        for name, (own, factor, peer) in peers.items():
            busy: dict[str, list[float]] = {"own": [], "peer": []}
            ours, theirs = alternate(
                lambda own=own, busy=busy: _timed(lambda: run_bilateral(resident, asked[own]), busy["own"], 1.0),  # type: ignore[misc]
                lambda peer=peer, busy=busy, factor=factor: _timed(peer, busy["peer"], factor),  # type: ignore[misc]
                job.pairs,
                limit_s=job.limit_s / len(peers),
            )
            figures["sides"][name] = summarise(ours, theirs)
            figures["ratios"][name] = figures["sides"][name]["ratio"]
            count = len(busy["own"])
            figures["sides"][name]["busy_ratio"] = float(
                np.median(np.array(busy["peer"])[:count] / busy["own"][:count])
            )
    return figures


def _timed(run: Callable[[], Any], busy: list[float], factor: float) -> float:
    """Return the wall seconds of a run, and keep its processor seconds; both times `factor`."""
    before, start = busy_seconds(), time.perf_counter()
    run()
    seconds = factor * (time.perf_counter() - start)
    busy.append(factor * (busy_seconds() - before))
    return seconds


def _opencv() -> Any:
    """Return OpenCV, or None where it is not installed."""
    try:
        import cv2
    except ImportError:
        print("OpenCV is not installed (opencv-python-headless): slices are not compared with it", file=sys.stderr)
        return None
    return cv2


def _filter_slices(opencv: Any, floats: Any, sigma: float) -> None:
    for layer in floats:
        opencv.bilateralFilter(layer, 5, sigma, 1.0, borderType=opencv.BORDER_REPLICATE)


def _skimage(floats: Any, sigma: float) -> None:
    from skimage.restoration import denoise_bilateral

    for layer in floats:
        denoise_bilateral(layer, win_size=5, sigma_color=sigma, sigma_spatial=1.0, mode="edge")
