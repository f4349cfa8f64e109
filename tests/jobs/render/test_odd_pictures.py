"""Odd bodies through the presets of pictures: from the front each shows what it is for, and as large as it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from odd_bodies import BODIES, OddBodies
from scipy import ndimage
from variants import but_seldom, daily

from clrecon.anatomy.body import remove_table
from clrecon.geometry import Volume
from clrecon.jobs.render.job import find_emptiness
from clrecon.operators.rays.render import VolumeRenderer
from clrecon.rendering import PRESETS, Rendering
from clrecon.rendering.views.camera import Camera

DENSE = {"bone": 250.0, "vessels": 120.0, "metal": 250.0}
"""Presets for what is hard or filled, and from how many HU on they show it; in that for metal bone is glass."""
SOLID = {"spine": -450.0, "skin": -450.0, "lung": -850.0, "muscle": -20.0}
"""Presets that show soft tissue too, or its edge, and from how many HU on."""
EVERY_DAY = {"skull-prone", "contrast", "water", "empty"}
"""Bodies, each the only one of its kind for a preset; what others show is for a release."""
ALIKE = 0.25
"""Area of what is drawn against that of the voxels, from the front: rims of voxels of up to 5 mm."""
RAILS_ALIKE = 0.6
"""The same of the rails of a table, which are one or two such voxels wide."""


def draw(volume: Volume, device: Any) -> dict[str, Rendering]:
    """A small picture from the front with each preset, all of them with the whole volume in view."""
    size = (64, 64)
    camera = Camera.fit(volume, "anterior", size=size)
    with VolumeRenderer(volume, device=device) as renderer:
        return {name: renderer.render(preset=name, camera=camera, size=size) for name in PRESETS}


def place_points(volume: Volume, picture: Rendering) -> np.ndarray:
    """Voxels (k, j, i) of the points that a picture has a depth for."""
    if not np.isfinite(picture.depth).any():
        return np.empty((3, 0), dtype=int)
    ijk = np.rint(volume.lps_to_ijk(np.asarray(picture.to_pyvista("points").points))).astype(int)
    return np.clip(ijk, 0, np.array(volume.shape_ijk) - 1).T[::-1]


def area_cm2(volume: Volume, mask: np.ndarray) -> float:
    """Area of a mask seen along j, the way from the front."""
    return float(mask.any(axis=1).sum() * volume.spacing[0] * volume.spacing[2] / 100.0)


def check_area(volume: Volume, picture: Rendering, mask: np.ndarray, alike: float) -> None:
    """What is drawn lies within a voxel of the mask and covers it."""
    k, j, i = place_points(volume, picture)
    assert ndimage.binary_dilation(mask, np.ones((3, 3, 3)))[k, j, i].mean() > 0.9
    assert picture.pixel_mm is not None
    assert len(k) * picture.pixel_mm**2 / 100.0 == pytest.approx(area_cm2(volume, mask), rel=alike)


@pytest.mark.parametrize("name", daily(2, but_seldom(BODIES, BODIES.keys() - EVERY_DAY)))
def test_each_preset_shows_what_it_is_for(odd: OddBodies, device: Any, name: str) -> None:
    body = odd[name]
    own = ("table",) if name == "empty" else ("tissue", "bone", "contrast", "metal", "water")
    volume = body.volume if name == "empty" else remove_table(body.volume)
    pictures = draw(volume, device)
    assert DENSE.keys() | SOLID.keys() | {"x-ray", "mip", "minip"} == set(PRESETS)

    alike = RAILS_ALIKE if name == "empty" else ALIKE
    for preset, level in SOLID.items():
        check_area(volume, pictures[preset], volume.voxels > level, alike)
    for preset, level in DENSE.items():
        if name == "water":  # a shell of 150 HU and noise
            few = np.isfinite(pictures[preset].depth).sum()
            assert few < 0.1 * np.isfinite(pictures["skin"].depth).sum()
        else:
            check_area(volume, pictures[preset], body.of(*own) & (volume.voxels > level), alike)

    inside = volume.voxels[body.of(*own)]
    values = {preset: pictures[preset].values for preset in ("x-ray", "mip", "minip")}
    assert 0.75 * inside.max() < np.nanmax(values["mip"]) <= inside.max()
    assert np.nanmin(values["minip"]) >= volume.voxels.min()
    # along a ray of d mm through voxels of mean HU m there are d (m + 1000) / 1000 mm of water; pixels miss thin peaks
    along = (volume.voxels.astype(float) + 1000.0).sum(axis=1) * volume.spacing[1] / 1000.0
    assert 0.7 * along.max() < np.nanmax(values["x-ray"]) < 1.05 * along.max()

    # only water has nothing for a preset, and the darkest along a ray is the air round any body
    said = {preset: find_emptiness(picture) for preset, picture in pictures.items() if preset != "minip"}
    empty = {preset for preset, text in said.items() if text}
    assert empty == ({"metal"} if name == "water" else set())
    assert all("nothing of the volume shows" in str(said[preset]) for preset in empty)
