"""Phantoms for `measure_levels.py`: bodies and ways of scanning them, their true bone, and profiles across its surface.

The truth is the outer surface of bone: of a spine that of its vertebrae, of a scene that of all parts of bone where
they do not touch metal.  Profiles run along the true normal, so that the place where a level is crossed is a signed
distance from the truth.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from thin_walls import SHAPES, draw_shape

from clrecon.geometry import Volume
from clrecon.proof.phantom import (
    MATERIALS,
    PhantomSettings,
    add_noise,
    apply_point_spread,
    label_materials,
    make_phantom,
    write_phantom,
)
from clrecon.proof.phantom import spine as spine_hu
from clrecon.proof.phantom import spine as tissue_hu
from clrecon.proof.phantom.scene_plans import plan_scene
from clrecon.proof.phantom.series import place_slices
from clrecon.proof.phantom.settings import CENTRE_LPS_MM, KINDS
from clrecon.proof.phantom.spine import label_levels, plan_spine
from clrecon.proof.phantom.vertebra import local_bounds, vertebra_distance
from clrecon.reading import read_volume

Points = NDArray[np.float64]
IsBone = Callable[[Points], NDArray[np.bool_]]
BONE, METAL = MATERIALS.index("bone"), MATERIALS.index("metal")

REACH_MM, STEP_MM = 3.0, 0.05
"""Profiles run this far on both sides; a wall whose level is not crossed there is lost."""
FINE_MM = 0.6
POINTS = 6000
_DIRECTIONS, _PROBE_MM = 96, 0.4
"""The normal at a place is the mean direction to what is no bone, at so many directions and this distance."""


@dataclass(frozen=True)
class Phantom:
    """A body and the way it is scanned; `bone_hu` and `tissue_hu` are what somebody would give as the two materials."""

    name: str
    group: str
    settings: dict[str, Any]
    bone_hu: float = 950.0
    tissue_hu: float = 50.0
    density: float = 1.0
    vessels_hu: float | None = None
    enhance: float = 0.0
    shape: str | None = None

    @property
    def scale(self) -> float:
        """What lengths are multiplied by that fit voxels of 0.6 mm and more: finer ones have smaller bones."""
        if self.group == THIN:  # walls and gaps of millimetres, however fine the voxels
            return 1.0
        finest = min(PhantomSettings(**self.settings).spacing)
        return 1.0 if finest >= FINE_MM else finest / 0.8


TRUNK: dict[str, Any] = {"size": (240, 240), "slices": 96, "spacing": (1.0, 1.0, 1.25)}
"""240 x 240 x 120 mm: the same body, however it is scanned."""


def _trunk(**changes: Any) -> dict[str, Any]:
    return {**TRUNK, **changes}


SCANNING, BODIES, DRY, NOTHING, KINDS_OF_SCAN, THIN = (
    "one body, scanned in ten ways",
    "other bodies",
    "dry specimens",
    "no bone",
    "other kinds of scan",
    "thin walls and narrow joints",
)

NOT_IN_TISSUE = (DRY, NOTHING, KINDS_OF_SCAN, THIN)

KINDS_MATERIALS = {
    "jaw": (1470.0, 390.0),
    "longbone": (1040.0, 0.0),
    "hand": (1250.0, 60.0),
    "pair": (1400.0, 55.0),
    "hip": (1350.0, 60.0),
    "mouse": (1300.0, 40.0),
}
"""Compact bone and tissue of each kind in the units of its values, as they go in."""

PHANTOMS = (
    Phantom("1 mm, slices 1.25 mm", SCANNING, _trunk()),
    Phantom("0.6 mm, slices 0.8 mm", SCANNING, _trunk(size=(400, 400), slices=150, spacing=(0.6, 0.6, 0.8))),
    Phantom("slices 2 mm", SCANNING, _trunk(slices=60, spacing=(1.0, 1.0, 2.0))),
    Phantom("slices 3 mm", SCANNING, _trunk(slices=40, spacing=(1.0, 1.0, 3.0))),
    Phantom("slices 4 mm", SCANNING, _trunk(slices=30, spacing=(1.0, 1.0, 4.0))),
    Phantom("noise 50 HU", SCANNING, _trunk(noise=50.0)),
    Phantom("smooth kernel, 1 mm", SCANNING, _trunk(point_spread_mm=1.0)),
    Phantom("sharp kernel that enhances edges", SCANNING, _trunk(point_spread_mm=0.4, noise=40.0), enhance=1.0),
    Phantom("80 kV: bone x 1.35", SCANNING, _trunk(), bone_hu=1280.0, density=1.35),
    Phantom("contrast medium, 300 HU", SCANNING, _trunk(), vessels_hu=300.0),
    Phantom("poor bone: x 0.6", BODIES, _trunk(), bone_hu=570.0, density=0.6),
    Phantom("dense bone: x 1.3", BODIES, _trunk(seed=4), bone_hu=1235.0, density=1.3),
    Phantom("scoliosis 40 degrees", BODIES, _trunk(levels="T9-L4", scoliosis_deg=40.0, slices=None)),
    Phantom("neck", BODIES, _trunk(levels="C2-T1", slices=None)),
    Phantom("tilted gantry, 12 degrees", BODIES, _trunk(tilt=12.0, seed=5)),
    Phantom("head", BODIES, {"kind": "head"}, bone_hu=1350.0),
    Phantom("lower leg", BODIES, {"kind": "limb", "slices": 60}, bone_hu=1400.0),
    Phantom("pelvis with metal", BODIES, {"kind": "pelvis"}, bone_hu=900.0),
    Phantom("trunk full of contrast medium", BODIES, {"kind": "contrast"}),
    Phantom("dry skull", DRY, {"kind": "skull"}, bone_hu=1350.0, tissue_hu=-1000.0),
    Phantom("dry skull on a head rest", DRY, {"kind": "skull", "table": "headrest"}, 1350.0, -1000.0),
    Phantom("dry bones", DRY, {"kind": "bones"}, bone_hu=950.0, tissue_hu=-1000.0),
    Phantom("water", NOTHING, {"kind": "water", "slices": 60}),
    Phantom("empty table", NOTHING, {"kind": "empty", "slices": 60}),
    *(Phantom(kind, KINDS_OF_SCAN, {"kind": kind}, *materials) for kind, materials in KINDS_MATERIALS.items()),
    *(Phantom(name, THIN, {}, shape.bone_hu, shape.tissue_hu, shape=name) for name, shape in SHAPES.items()),
    Phantom("osteoporotic: x 0.4", THIN, _trunk(), bone_hu=380.0, density=0.4),
    Phantom(
        "cone beam, 0.3 mm", THIN,
        {"levels": "L3", "size": (300, 300), "slices": 160, "spacing": (0.3, 0.3, 0.3), "point_spread_mm": 0.35,
         "noise": 60.0},
    ),
)  # fmt: skip


@dataclass
class Profiles:
    """HU along the true normals, shape (n, steps), outwards, and the way along them in mm, at even steps.

    points, normals: shape (n, 3). Places of the true surface, LPS mm, and unit vectors outwards.
    """

    values: NDArray[np.float32]
    points: Points = field(default_factory=lambda: np.zeros((0, 3)))
    normals: Points = field(default_factory=lambda: np.zeros((0, 3)))
    way_mm: NDArray[np.float32] = field(
        default_factory=lambda: np.arange(-REACH_MM, REACH_MM + STEP_MM / 2, STEP_MM, dtype=np.float32)
    )

    def errors(self, level: float) -> NDArray[np.float32]:
        """Return the signed distance in mm to the nearest place where values fall below the level, outside positive;
        NaN where there is none.
        """
        inside = self.values >= level
        falls = inside[:, :-1] & ~inside[:, 1:]
        high, low = self.values[:, :-1], self.values[:, 1:]
        share = np.where(falls, (high - level) / np.where(falls, high - low, 1.0), 0.0)
        at = np.where(falls, self.way_mm[:-1] + (self.way_mm[1] - self.way_mm[0]) * share, np.inf)
        nearest = np.abs(at).argmin(axis=1)
        found = at[np.arange(len(at)), nearest]
        return np.where(np.isfinite(found), found, np.nan).astype(np.float32)


def find_on_mesh(
    profiles: Profiles, vertices: NDArray[np.floating], triangles: NDArray[np.uint32]
) -> tuple[Points, NDArray[np.int64]]:
    """Return where a mesh crosses each true normal nearest to the truth, as `Profiles.errors`, and the triangle there.

    Only crossings whose triangle faces outwards count; -1 where there is none.
    """
    from scipy.spatial import cKDTree

    a, b, c = (vertices[triangles[:, corner]].astype(np.float64) for corner in range(3))
    middles = (a + b + c) / 3.0
    reach = float(profiles.way_mm[-1])
    radius = float(np.percentile(np.linalg.norm(a - middles, axis=1), 99.9)) + reach / 60.0
    tree = cKDTree(middles)
    steps = np.arange(-reach, reach + radius, radius)
    found, rows = np.full(len(profiles.points), np.inf), np.full(len(profiles.points), -1)
    for begin in range(0, len(profiles.points), 500):
        where = slice(begin, begin + 500)
        line = profiles.points[where, None] + steps[:, None] * profiles.normals[where, None]
        near = tree.query_ball_point(line.reshape(-1, 3), 1.2 * radius)
        of_line = np.repeat(np.arange(len(near)) // len(steps), [len(one) for one in near])
        of_face = np.concatenate([np.asarray(one, dtype=np.int64) for one in near])
        pairs = np.unique(np.column_stack([of_line, of_face]), axis=0)
        line_of, face = pairs[:, 0] + begin, pairs[:, 1]
        p, n = profiles.points[line_of], profiles.normals[line_of]
        one, two = b[face] - a[face], c[face] - a[face]
        across = np.cross(n, two)
        size = np.einsum("ij,ij->i", one, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ij,ij->i", p - a[face], across) / size
            turned = np.cross(p - a[face], one)
            v = np.einsum("ij,ij->i", n, turned) / size
            way = np.einsum("ij,ij->i", two, turned) / size
        faces_out = np.einsum("ij,ij->i", np.cross(one, two), n) > 0.0
        hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & faces_out & (np.abs(way) <= reach)
        for each in np.flatnonzero(hit)[np.argsort(-np.abs(way[hit]))]:  # the nearest comes last
            found[line_of[each]], rows[line_of[each]] = way[each], face[each]
    return np.where(np.isfinite(found), found, np.nan), rows


def draw_phantom(phantom: Phantom) -> Volume:
    """Draw the body with its bones' density, its vessels and the enhancement of edges."""
    if phantom.shape is not None:
        return draw_shape(SHAPES[phantom.shape], phantom.settings.get("seed", 1))
    settings = PhantomSettings(**phantom.settings)
    if phantom.group == KINDS_OF_SCAN:  # auto asks what its certificate says of the scale
        with tempfile.TemporaryDirectory() as folder:
            write_phantom(Path(folder) / "scan", settings)
            return read_volume(Path(folder) / "scan")
    bones = ("CORTEX_HU", "BODY_CORTEX_HU", "TRABECULAR_HU", "ARCH_MARROW_HU", "RIB_MARROW_HU")
    denser = {name: phantom.density * getattr(spine_hu, name) for name in bones}
    vessels = {} if phantom.vessels_hu is None else {"BLOOD_HU": phantom.vessels_hu}
    with mock.patch.dict(vars(spine_hu), {**denser, **vessels}), mock.patch.dict(vars(tissue_hu), vessels):
        if phantom.enhance:
            quiet = PhantomSettings(**{**phantom.settings, "noise": 0.0})
            voxels, affine, _ = make_phantom(quiet)
            sharp = voxels.astype(np.float32)
            sharp += phantom.enhance * (sharp - apply_point_spread(sharp.copy(), affine, 1.0))
            add_noise(sharp, settings.noise, settings.seed)
            return Volume(np.rint(np.clip(sharp, -1024, 3071)).astype(np.int16), affine)
        voxels, affine, _ = make_phantom(settings)
    return Volume(voxels, affine)


def _truth_of(phantom: Phantom, volume: Volume) -> tuple[IsBone, IsBone, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return what tells of points (LPS mm) whether they are in bone and in metal, and both for the voxels."""
    if phantom.shape is not None:
        shape = SHAPES[phantom.shape]
        k, j, i = (index.reshape(-1) for index in np.indices(volume.shape))
        x, y, z = volume.affine[:3, :3] @ np.stack([i, j, k]) + volume.affine[:3, 3:]
        bone = shape.is_bone(x, y, z).reshape(volume.shape)
        return (
            (lambda p: shape.is_bone(*p.T)), (lambda p: np.zeros(len(p), dtype=bool)), bone, np.zeros_like(bone)
        )  # fmt: skip
    settings = PhantomSettings(**phantom.settings)
    affine = place_slices(settings).affine
    if KINDS[settings.kind].is_scene:
        parts = plan_scene(settings)
        labels = label_materials(settings)

        def material(points: Points) -> NDArray[np.uint8]:
            found = np.zeros(len(points), dtype=np.uint8)
            centred = (points - CENTRE_LPS_MM).astype(np.float32)
            for part in parts:
                local = (centred - np.asarray(part.center, dtype=np.float32)) @ part.axes.T.astype(np.float32)
                near = np.flatnonzero(((local >= part.low) & (local <= part.high)).all(axis=1))
                inside = part.distance_at(*centred[near].T) >= 0.0
                found[near[inside]] = MATERIALS.index(part.material)
            return found

        return (lambda p: material(p) == BONE), (lambda p: material(p) == METAL), labels == BONE, labels == METAL
    anatomy = plan_spine(settings, affine)[0]

    def is_bone(points: Points) -> NDArray[np.bool_]:
        found = np.zeros(len(points), dtype=bool)
        for vertebra in anatomy.vertebrae:
            local = (points - CENTRE_LPS_MM - vertebra.center) @ vertebra.axes.T
            low, high = local_bounds(vertebra)
            near = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
            x, y, z = local[near].astype(np.float32).T
            found[near] |= vertebra_distance(vertebra, x, y, z) >= 0.0
        return found

    bone = label_levels(settings, affine) > 0
    return is_bone, (lambda p: np.zeros(len(p), dtype=bool)), bone, np.zeros_like(bone)


def sample_profiles(phantom: Phantom, volume: Volume, seed: int = 1) -> Profiles:
    """Sample the volume across the true surface, at places where edges of the grid cross it."""
    is_bone, is_metal, bone, metal = _truth_of(phantom, volume)
    affine = volume.affine
    generator = np.random.default_rng(seed)
    starts, ends = [], []
    for axis in range(3):
        one, other = (np.moveaxis(bone, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        at = np.moveaxis(np.argwhere(one != other), 1, 0)
        back = [at[0], *at[1:]]
        index = np.stack([*back[1 : axis + 1], back[0], *back[axis + 1 :]], axis=1)
        starts.append(index)
        step = np.zeros(3, dtype=int)
        step[axis] = 1
        ends.append(index + step)
    start, end = np.concatenate(starts), np.concatenate(ends)
    free = ~(metal[tuple(start.T)] | metal[tuple(end.T)])
    start, end = start[free], end[free]
    chosen = generator.choice(len(start), min(POINTS, len(start)), replace=False)

    def place(kji: NDArray[np.integer]) -> Points:
        return np.asarray(kji[:, ::-1] @ affine[:3, :3].T + affine[:3, 3], dtype=np.float64)

    inner, outer = place(start[chosen]), place(end[chosen])
    turned = ~bone[tuple(start[chosen].T)]
    inner[turned], outer[turned] = outer[turned], inner[turned].copy()
    for _ in range(16):
        middle = (inner + outer) / 2.0
        within = is_bone(middle)
        inner[within], outer[~within] = middle[within], middle[~within]
    points = (inner + outer) / 2.0

    sphere = generator.normal(size=(_DIRECTIONS // 2, 3))
    sphere = np.concatenate((sphere, -sphere)) / np.linalg.norm(np.concatenate((sphere, -sphere)), axis=1)[:, None]
    around = (points[:, None] + _PROBE_MM * phantom.scale * sphere).reshape(-1, 3)
    outside = ~is_bone(around).reshape(len(points), -1)
    normals = outside.astype(np.float64) @ sphere
    length = np.linalg.norm(normals, axis=1)
    clear = length > 0.15 * _DIRECTIONS  # less at corners and in walls thinner than the probe
    points, normals = points[clear], normals[clear] / length[clear, None]

    way = np.arange(-REACH_MM, REACH_MM + STEP_MM / 2, STEP_MM) * phantom.scale
    far = points[:, None] + phantom.scale * np.array((-2.5, -1.25, 1.25, 2.5))[None, :, None] * normals[:, None]
    clean = ~is_metal(far.reshape(-1, 3)).reshape(len(points), -1).any(axis=1)
    points, normals = points[clean], normals[clean]
    values = sample_along(volume, points, normals, way)
    whole = np.isfinite(values).all(axis=1)
    return Profiles(values[whole], points[whole], normals[whole], way.astype(np.float32))


def sample_along(volume: Volume, points: Points, normals: Points, way: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the HU at ways in mm along the normals from points, shape (n, ways); NaN beyond the outermost voxels."""
    from scipy.ndimage import map_coordinates

    along = points[:, None] + way[None, :, None] * normals[:, None]
    inverse = np.linalg.inv(volume.affine)
    ijk = along.reshape(-1, 3) @ inverse[:3, :3].T + inverse[:3, 3]
    is_within = ((ijk >= 0) & (ijk <= np.array(volume.voxels.shape[::-1]) - 1)).all(axis=1)
    values = np.full(len(ijk), np.nan, np.float32)
    values[is_within] = map_coordinates(volume.voxels.astype(np.float32), ijk[is_within, ::-1].T, order=1)
    return values.reshape(len(points), -1)
