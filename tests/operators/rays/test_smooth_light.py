"""Light of volume rendering from smoothed gradients: less grain, with the colours and opacities of the scan itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import clrecon
from clrecon.anatomy.noise import choose_smoothing, gaussian_weights
from clrecon.geometry import Volume
from clrecon.proof.rays.render import cast_rays
from clrecon.rendering import Rendering, TransferFunction
from clrecon.rendering.pictures.styles import VolumeLook
from clrecon.rendering.views.camera import Camera

BONE = TransferFunction([(-1000, 1, 1, 1, 0), (150, 1, 1, 1, 0), (350, 1, 1, 1, 0.9), (3000, 1, 1, 1, 0.9)])
SIZE = (64, 64)
RADIUS_MM = 12.0


def distances_from_ball() -> tuple[np.ndarray, np.ndarray]:
    """Distances of voxels to a ball of 12 mm, positive inside, mm, and the affine: voxels of 1 x 1 x 1.25 mm."""
    k, j, i = np.mgrid[:28, :32, :32]
    outside = np.sqrt((i - 15.5) ** 2 + (j - 15.5) ** 2 + (1.25 * (k - 13.5)) ** 2)
    return RADIUS_MM - outside, np.diag([1.0, 1.0, 1.25, 1.0])


def noisy_ball(*, noise_hu: float = 40.0) -> Volume:
    """The ball as a scanner shows it: 40 HU outside, 600 inside, an edge of two voxels, and noise."""
    distances, affine = distances_from_ball()
    noise = np.random.default_rng(7).normal(0.0, noise_hu, distances.shape)
    return Volume((40.0 + 560.0 * np.clip(0.5 * distances + 0.5, 0.0, 1.0) + noise).astype(np.int16), affine)


def camera_of(volume: Volume) -> Camera:
    return Camera.fit(volume, (20, 10), size=SIZE)


def render(volume: Volume, device: Any, **look: Any) -> Rendering:
    return clrecon.render(volume, VolumeLook(BONE, **look), camera=camera_of(volume), size=SIZE, device=device)


def error_of_light(picture: Rendering, true_image: np.ndarray) -> float:
    """Mean difference to the picture with true normals, of 255, where the ball is seen."""
    shown = np.isfinite(picture.depth)
    return float(np.abs(picture.image[..., 0].astype(float) - true_image[..., 0])[shown].mean())


def test_smoothed_light_is_nearer_to_that_of_true_normals(device: Any) -> None:
    volume = noisy_ball()
    distances, _ = distances_from_ball()
    true_field = (200.0 * distances).astype(np.int16)  # its gradients are the normals of the ball
    truth = cast_rays(volume, VolumeLook(BONE), camera_of(volume), SIZE, lit=true_field).image()

    smoothed = error_of_light(render(volume, device), truth)
    plain = error_of_light(render(volume, device, smooth_light=0.0), truth)

    assert smoothed < 0.75 * plain  # measured 5.1 and 8.9 of 255


def test_smoothing_of_light_leaves_depths_as_they_are(device: Any) -> None:
    volume = noisy_ball()

    smoothed, plain = render(volume, device, smooth_light=2.0), render(volume, device, smooth_light=0.0)

    np.testing.assert_array_equal(smoothed.depth, plain.depth)


@pytest.mark.parametrize(("asked", "reported"), [(1.7, 1.7), (0.0, 0.0), (0.1, 0.0)])
def test_report_has_the_smoothing_that_was_used(device: Any, asked: float, reported: float) -> None:
    """Less than a quarter of a voxel changes nothing."""
    assert render(noisy_ball(), device, smooth_light=asked).report["smooth_light_mm"] == reported


def test_default_smoothing_is_a_voxel_without_noise() -> None:
    side_of_a_cube_of_a_voxel = (1.0 * 1.0 * 1.25) ** (1.0 / 3.0)
    assert choose_smoothing(noisy_ball(noise_hu=0.0)) == pytest.approx(side_of_a_cube_of_a_voxel)


def test_default_smoothing_grows_with_noise() -> None:
    """White noise of n HU leaves 3 HU per mm in the gradients at (n sqrt(v) / (3 * 9.44)) ^ 0.4 mm, v the voxel."""
    noise_hu = 60.0
    voxels = np.random.default_rng(3).normal(40.0, noise_hu, (24, 96, 96))
    volume = Volume(voxels.astype(np.int16), np.eye(4))

    assert choose_smoothing(volume) == pytest.approx((noise_hu / (3.0 * 9.44)) ** 0.4, rel=0.03)  # noise by blocks


@pytest.mark.parametrize("sigma", [0.3, 1.0, 2.7])
def test_weights_of_a_gaussian_add_up_to_one(sigma: float) -> None:
    weights = gaussian_weights(sigma).astype(np.float64)

    assert weights[0] + 2.0 * weights[1:].sum() == pytest.approx(1.0, abs=1e-6)  # float32
