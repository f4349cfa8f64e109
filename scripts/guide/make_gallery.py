#!/usr/bin/env python3
"""Make the pictures of README and docs/rendering.md again, from a phantom.

    clrecon phantom SPINE --kind spine --size 512x512 --slices 149 --spacing 0.7 0.7 1.0
    clrecon phantom CHEST --levels T4-L5 --size 512 --spacing 0.7 0.7 1.0 --scoliosis 12 --seed 3
    python scripts/guide/make_gallery.py SPINE CHEST docs/images

The picture beside VTK's also needs scikit-image; the likeness of the two is printed.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts" / "bench")]

import clrecon  # noqa: E402
from clrecon.rendering.looks.presets import find_preset  # noqa: E402

TILE = (330, 230)
BESIDE = (495, 300)


def draw_modes(renderer: clrecon.VolumeRenderer, ray_step: float) -> np.ndarray:
    """Draw six modes, each with its name in a corner; (h, w, 3) uint8."""
    light = clrecon.Lighting(direction=(-0.3, -1.0, 0.6))
    pictures: dict[str, dict[str, Any]] = {
        "dvr, preset spine": {"preset": "spine", "view": (35, 15), "ray_step": ray_step, "zoom": 1.25},
        "surface, shadows": {"mode": "surface", "view": (20, 10), "shadows": True, "lighting": light, "zoom": 1.25},
        "mip": {"mode": "mip", "view": (35, 15), "zoom": 1.25},
        "drr, preset x-ray": {"preset": "x-ray"},
        "slices": {"mode": "slices", "slices": 10, "view": (40, 25), "zoom": 1.25},
        "slice, 5 mm thick": {"mode": "slice", "view": "sagittal", "thickness": 5.0, "zoom": 1.3},
    }
    tiles = [
        renderer.render(size=TILE, **options).annotated(caption=name).image[..., :3]
        for name, options in pictures.items()
    ]
    return np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])


def draw_beside_vtk(renderer: clrecon.VolumeRenderer) -> np.ndarray:
    """Draw clrecon's picture, and that of VTK's fixed-point mapper with the same camera and functions."""
    from peers.vtk_fixed_point import FixedPointPeer
    from peers.vtk_stage import scene_of
    from skimage.metrics import structural_similarity

    volume, bone = renderer.volume, find_preset("bone")
    camera = clrecon.Camera.fit(volume, (25, 10), 1.2, size=BESIDE)
    step = 0.5 * min(volume.spacing)
    light = replace(bone.lighting, soft_gradient=0.0)  # as VTK does
    look = clrecon.VolumeLook("bone", ray_step=step, lighting=light, smooth_light=0.0)
    ours = renderer.render(look, camera=camera, size=BESIDE).image[..., :3]
    scene = scene_of(volume, camera, bone.transfer_function, light, size=BESIDE, ray_step=step)
    peer = FixedPointPeer(volume.voxels, scene, threads=1)
    peer.first_frame()
    theirs = peer.picture()[..., :3]
    grey = [picture @ (0.299, 0.587, 0.114) for picture in (ours, theirs)]
    print(f"SSIM {structural_similarity(*grey, data_range=255):.3f}")
    return np.hstack([ours, theirs])


def draw_chest(renderer: clrecon.VolumeRenderer) -> np.ndarray:
    """Draw spine and ribs from the front and from behind, in one picture; (h, w, 3) uint8."""
    look = clrecon.VolumeLook("bone", ray_step=0.35 * min(renderer.volume.spacing))
    front = renderer.render(look, view=(25, 10), size=(520, 620), zoom=1.12)
    behind = renderer.render(look, view=(150, 12), size=(480, 620), zoom=1.12)
    return np.hstack([front.image[..., :3], behind.annotated(scale_bar=True).image[..., :3]])


def draw_occlusion(renderer: clrecon.VolumeRenderer) -> np.ndarray:
    """Draw some vertebrae from behind, without and with ambient occlusion; (h, w, 3) uint8."""
    plain = clrecon.SurfaceLook(225.0)
    looks = (plain, replace(plain, ambient_occlusion=1.0))
    pictures = [renderer.render(look, view=(150, 25), size=BESIDE, zoom=4.5).image[..., :3] for look in looks]
    return np.hstack(pictures)


def main() -> None:
    """Read the phantoms and write the pictures."""
    from clrecon.rendering.pictures.pillow import load_pillow

    if len(sys.argv) != 4:
        raise SystemExit(__doc__)
    folder = Path(sys.argv[3])
    load_pillow()
    from PIL import Image

    with clrecon.VolumeRenderer(clrecon.read_volume(sys.argv[2])) as renderer:
        for name, draw in (("hero.png", draw_chest), ("render-occlusion.png", draw_occlusion)):
            chest = Image.fromarray(draw(renderer))
            chest.convert("P", palette=Image.Palette.ADAPTIVE, colors=255).save(folder / name, optimize=True)
    volume = clrecon.read_volume(sys.argv[1])
    fine = 0.25 * min(volume.spacing)
    with clrecon.VolumeRenderer(volume) as renderer:
        modes = Image.fromarray(draw_modes(renderer, fine))
        modes.convert("P", palette=Image.Palette.ADAPTIVE, colors=255).save(folder / "render-modes.png", optimize=True)
        Image.fromarray(draw_beside_vtk(renderer)).save(folder / "render-vtk.png")


if __name__ == "__main__":
    main()
