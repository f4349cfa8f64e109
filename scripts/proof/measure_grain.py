#!/usr/bin/env python3
"""Measure what smoothing the light takes from the grain of bone: SSIM with pictures that have the true normals.

    python scripts/proof/measure_grain.py [DEVICE]

For spines made by `clrecon phantom`, by voxel and noise: SSIM (grey values of 8 bits, mean over the pixels of bone, two
views, presets bone and spine) of the picture without smoothing, with the default one, and with the one that is most
like the picture lit by the gradients of the distance to the true surface of the bone.  It needs scikit-image.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import clrecon  # noqa: E402
from clrecon.anatomy.noise import choose_smoothing  # noqa: E402
from clrecon.opencl import upload  # noqa: E402
from clrecon.operators.rays import ray_slabs  # noqa: E402
from clrecon.proof.phantom import PhantomSettings, make_phantom  # noqa: E402
from clrecon.rendering.views.camera import Camera  # noqa: E402

SIZE = (384, 384)
VIEWS: tuple[Any, ...] = ("anterior", (40.0, 20.0))
PRESETS = ("bone", "spine")
PHANTOMS = (((128, 128), 60, (1.0, 1.0, 1.25)), ((128, 128), 30, (1.0, 1.0, 2.5)), ((160, 160), 60, (0.7, 0.7, 1.0)))
NOISES = (0.0, 15.0, 40.0, 80.0)
SIGMAS = (0.5, 0.7, 1.0, 1.3, 1.6, 2.0, 2.5)
NEAR_VOXELS = 2.5
SHOWN_MM = 6.0
"""Distance from the bone up to which the scan is kept: the truth knows vertebrae alone."""

HU_PER_MM = 200.0
"""Slope of the field with the true normals: as steep as edges of bone."""


def find_distances(settings: PhantomSettings, volume: Any) -> np.ndarray:
    """Signed distance of each voxel to the surface of the vertebrae, mm, negative inside; exact near it."""
    from scipy.ndimage import distance_transform_edt

    truth = clrecon.phantom_truth(settings)
    inside = truth.label_map() > 0
    steps = volume.spacing[::-1]
    distances = distance_transform_edt(~inside, sampling=steps) - distance_transform_edt(inside, sampling=steps)
    k, j, i = np.nonzero(np.abs(distances) < NEAR_VOXELS * max(steps))
    distances[k, j, i] = truth.signed_distance(volume.ijk_to_lps(np.stack([i, j, k], axis=1).astype(np.float64)))
    return np.asarray(distances)


def compare(picture: Any, truth: Any) -> float:
    from skimage.metrics import structural_similarity

    grey = [np.rint(each.image[..., :3] @ (0.2126, 0.7152, 0.0722)) for each in (picture, truth)]
    _, local = structural_similarity(*grey, data_range=255.0, full=True)
    return float(local[np.isfinite(truth.depth)].mean())


def render_truth(renderer: Any, distances: np.ndarray, **look: Any) -> Any:
    """A picture whose light has the true normals."""
    field = np.clip(-HU_PER_MM * distances, -2400.0, 2400.0).astype(np.int16)
    with mock.patch.object(ray_slabs, "slab_smoothed", lambda resident, *_: upload(resident.device, field)):
        return renderer.render(**look)


def measure(size: tuple[int, int], slices: int, spacing: tuple[float, float, float], device: str | None) -> None:
    """Print a line for each noise of a phantom."""
    distances: np.ndarray | None = None
    for noise in NOISES:
        settings = PhantomSettings(kind="spine", size=size, slices=slices, spacing=spacing, noise=noise)
        affine = clrecon.phantom_truth(settings).affine
        volume = clrecon.Volume(make_phantom(settings)[0], affine)
        distances = find_distances(settings, volume) if distances is None else distances
        default = choose_smoothing(volume)
        shown = clrecon.Volume(np.where(distances > SHOWN_MM, np.int16(-1000), volume.voxels), affine)
        found = []
        with clrecon.VolumeRenderer(shown, device=device) as renderer:
            for view in VIEWS:
                look: dict[str, Any] = {"camera": Camera.fit(shown, view, size=SIZE), "size": SIZE}
                for preset in PRESETS:
                    truth = render_truth(renderer, distances, preset=preset, **look)
                    looks = [{**look, "preset": preset, "smooth_light": mm} for mm in (0.0, default, *SIGMAS)]
                    found.append([compare(renderer.render(**each), truth) for each in looks])
        without, smoothed, *others = np.mean(found, axis=0)
        best = int(np.argmax(others))
        voxels = " x ".join(f"{step:g}" for step in spacing)
        print(
            f"| {voxels} | {noise:g} | {without:.3f} | {smoothed:.3f} at {default:.2f} mm |"
            f" most {others[best]:.3f} at {SIGMAS[best]:g} mm",
            flush=True,
        )


def main() -> None:
    """Print the SSIM of all phantoms."""
    if len(sys.argv) > 2:
        raise SystemExit(__doc__)
    for size, slices, spacing in PHANTOMS:
        measure(size, slices, spacing, sys.argv[1] if len(sys.argv) == 2 else None)


if __name__ == "__main__":
    main()
