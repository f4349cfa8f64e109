"""A third opinion on pictures: VTK's fixed-point mapper with the same camera, transfer function, light and ray step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from variants import daily

import clrecon
from clrecon.geometry import Volume
from clrecon.rendering.looks.lighting import UNSHADED
from clrecon.rendering.looks.presets import find_preset
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

pytest.importorskip("vtkmodules.vtkRenderingVolumeOpenGL2")

from peers.vtk_fixed_point import FixedPointPeer
from peers.vtk_stage import scene_of
from raycast import likeness

pytestmark = pytest.mark.opencl

SIZE = (200, 200)
BONE = find_preset("bone")
STEPS = np.array([0.9, 0.8, 1.1])
TURN = rotation((20.0, -35.0, 50.0))
AXES = {"straight": np.eye(3), "oblique": TURN, "mirrored": TURN @ np.diag([1.0, 1.0, -1.0])}


def blobs(axes: str) -> Volume:
    """Smooth bodies of 3 to 7 mm that melt into each other, some cut off by the border."""
    affine = np.eye(4)
    affine[:3, :3] = AXES[axes] * STEPS
    affine[:3, 3] = (-20.0, 30.0, -400.0)
    empty = Volume(np.zeros((58, 72, 66), np.int16), affine)
    k, j, i = np.indices(empty.voxels.shape).reshape(3, -1)
    points = empty.ijk_to_lps(np.stack([i, j, k], axis=1))
    points -= points.mean(axis=0)
    random, field = np.random.default_rng(7), np.full(len(points), -300.0)
    for _ in range(14):
        center, width = random.uniform(-19.0, 19.0, 3), random.uniform(3.0, 7.0)
        field += 1500.0 * np.exp(-np.square(points - center).sum(axis=1) / (2.0 * width**2))
    return empty.with_voxels(np.clip(field, -1024, 1400).reshape(empty.voxels.shape).astype(np.int16))


def spine() -> Volume:
    """The spine phantom in 60 slices 1.2 mm apart."""
    from clrecon.proof.phantom import PhantomSettings, make_phantom

    settings = PhantomSettings(kind="spine", size=(160, 160), slices=60, spacing=(0.8, 0.8, 1.2))
    voxels, affine, _ = make_phantom(settings)
    return Volume(voxels, affine)


def what_vtk_sees(volume: Volume) -> Clip:
    """Its rays end at the centres of the outermost voxels."""
    last = np.array(volume.shape_ijk) - 1.0
    inverse = np.linalg.inv(volume.affine)
    planes = []
    for axis in range(3):
        normal, offset = inverse[axis, :3], inverse[axis, 3]  # the index along an axis is normal . p + offset
        planes += [[*normal, -offset], [*-normal, offset - last[axis]]]
    return Clip(np.array(planes) / np.linalg.norm(np.array(planes)[:, :3], axis=1, keepdims=True))


def draw_by_clrecon_and_vtk(
    volume: Volume, camera: Camera, device: Any, *, shaded: bool
) -> tuple[np.ndarray, np.ndarray]:
    function, step = BONE.transfer_function, 0.5 * min(volume.spacing)
    phong = replace(BONE.lighting, soft_gradient=0.0)  # VTK has no other
    lighting = phong if shaded else UNSHADED
    ours = clrecon.render(
        volume, transfer_function=function, camera=camera, size=SIZE, ray_step=step, device=device,
        lighting=lighting, smooth_light=0.0, clip=what_vtk_sees(volume), background="black",
    )  # fmt: skip
    scene = scene_of(volume, camera, function, phong, size=SIZE, ray_step=step, shade=shaded)
    peer = FixedPointPeer(volume.voxels, scene, threads=1)
    peer.first_frame()
    return ours.image, peer.picture()


@pytest.mark.parametrize("view_angle", daily(1, [None, 30.0]))
@pytest.mark.parametrize("shaded", daily(1, [True, False]))
@pytest.mark.parametrize("axes", AXES)
def test_smooth_bodies_look_as_vtk_draws_them(device, axes, shaded, view_angle):
    volume = blobs(axes)
    camera = Camera.fit(volume, view=(30, 20), zoom=1.5, view_angle=view_angle, size=SIZE)
    ours, theirs = draw_by_clrecon_and_vtk(volume, camera, device, shaded=shaded)
    assert (theirs.max(axis=2) > 20).mean() > 0.1  # measured 0.31 on
    assert likeness(ours, theirs) >= tolerances.VTK_LIKENESS_SMOOTH
    assert likeness(np.roll(ours, 2, axis=1), theirs) < tolerances.VTK_LIKENESS_SMOOTH  # so small a shift is seen


@pytest.mark.release
@pytest.mark.parametrize(
    ("shaded", "bar"),
    [(True, tolerances.VTK_LIKENESS_SPINE), (False, tolerances.VTK_LIKENESS_SPINE_UNSHADED)],
    ids=["shaded", "unshaded"],
)
def test_a_spine_looks_as_vtk_draws_it(device, shaded, bar):
    volume = spine()
    camera = Camera.fit(volume, (30, 20), size=SIZE)
    ours, theirs = draw_by_clrecon_and_vtk(volume, camera, device, shaded=shaded)
    assert likeness(ours, theirs) >= bar
