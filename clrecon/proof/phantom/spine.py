"""Draw the spine phantom in HU, slice by slice; interfaces are ramps, bone is averaged from thin sub-slices."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import column_spacing
from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom.fields import Field, capsule, coverage, ellipse, ellipsoid, waves_at
from clrecon.proof.phantom.scenes import Part, PlacedPiece, Plan, Window, lay_under, paint, plan_subslices
from clrecon.proof.phantom.settings import CENTRE_LPS_MM, PhantomSettings
from clrecon.proof.phantom.spine_parts import Anatomy, Vertebra, level_number
from clrecon.proof.phantom.spine_plan import plan_anatomy
from clrecon.proof.phantom.vertebra import local_bounds, vertebra_distance
from clrecon.system.progress import Progress

AIR_HU = -1000.0
SKIN_HU = 25.0
FAT_HU = -105.0
MUSCLE_HU = 54.0
LUNG_HU = -860.0
LIVER_HU = 62.0
_SPLEEN_HU = 52.0
KIDNEY_HU = 36.0
BLOOD_HU = 44.0
_CALCIUM_HU = 520.0
_BOWEL_HU = 22.0
_GAS_HU = -850.0
_FLUID_HU = 14.0
_CORD_HU = 38.0
_TABLE_SHELL_HU = 130.0
_TABLE_CORE_HU = -930.0


@dataclass(frozen=True)
class _Painter:
    """What draws one slice, or a band of its rows, onto ``canvas``; interfaces are `ramp` mm wide."""

    canvas: Field
    ramp: float
    seed: int
    blood_hu: float

    def fill(self, distance: Field, hu: float, share: float | Field = 1.0) -> None:
        """Give the inside of a shape, where its distance is positive, a share of its HU."""
        part = share * coverage(distance, self.ramp)
        np.add(self.canvas, part * (np.float32(hu) - self.canvas), out=self.canvas)


def _draw_couch(painter: _Painter, anatomy: Anatomy, x: Field, y: Field) -> None:
    """Draw a curved carbon couch under the back: a thin shell around foam, endless along z; `y` runs downwards."""
    top = y - np.float32(anatomy.half_depth + 2.0)
    bowed = top + np.float32(0.16 / anatomy.half_width) * x * x
    shell = np.minimum(np.minimum(bowed, 32.0 - top), np.float32(0.95 * anatomy.half_width) - np.abs(x))
    painter.fill(shell, _TABLE_SHELL_HU)
    painter.fill(shell - np.float32(1.6), _TABLE_CORE_HU)


def _draw_wall(painter: _Painter, half_width: float | Field, half_depth: float | Field, x: Field, y: Field) -> Field:
    """Draw skin, fat and muscle; return the distance into the body cavity."""
    skin = ellipse(x, y, half_width, half_depth)
    painter.fill(skin, SKIN_HU)
    painter.fill(skin - np.float32(1.8), FAT_HU)
    # The flanks and the belly have more fat than the ribs of the back.
    fat = np.float32(11.0) - np.float32(3.0) * np.clip(y / np.asarray(half_depth, dtype=np.float32), -1.0, 1.0)
    muscle = skin - fat
    painter.fill(muscle, MUSCLE_HU)
    return muscle - np.float32(13.0)


def _draw_organs(painter: _Painter, anatomy: Anatomy, cavity: Field, x: Field, y: Field, z: Field) -> Field:
    """Draw organs and lungs at x, y from the middle of the trunk; return the distance into the lungs."""
    wide, deep = anatomy.half_width - 28.0, anatomy.half_depth - 28.0
    low = np.float32(anatomy.level_z("L1"))
    painter.fill(cavity, FAT_HU + 8.0)
    # The domes of the diaphragm are highest over the middle of each half of the chest.
    half = np.abs(x) - np.float32(0.5 * wide)
    dome = low + np.float32(62.0) * np.maximum(
        1.0 - (half / np.float32(0.62 * wide)) ** 2 - (y / np.float32(1.05 * deep)) ** 2, -0.2
    )
    above = (z - dome) * np.float32(0.75)
    abdomen = np.minimum(cavity, -above)

    lowest, highest = float(z.min()), float(z.max())

    def organ(center: tuple[float, float, float], half_axes: tuple[float, float, float], hu: float) -> None:
        reach = half_axes[2] + 2.0 * painter.ramp
        if lowest > center[2] + reach or highest < center[2] - reach:
            return
        shape = ellipsoid(x - np.float32(center[0]), y - np.float32(center[1]), z - np.float32(center[2]), half_axes)
        painter.fill(np.minimum(shape, abdomen), hu)

    mid, kidney = anatomy.level_z("T12"), anatomy.level_z("L2")
    generator = np.random.default_rng((painter.seed, 13))
    for n in range(9):
        spot = (generator.uniform(-0.6, 0.7) * wide, generator.uniform(-0.75, -0.1) * deep, kidney - 22.0 * n + 25.0)
        size = tuple(generator.uniform(14.0, 26.0, 3))
        organ(spot, (size[0], size[1], size[2]), _BOWEL_HU)
        if n % 3 == 0:
            organ((spot[0], spot[1] - 0.35 * size[1], spot[2]), (0.6 * size[0], 0.5 * size[1], 0.6 * size[2]), _GAS_HU)
    organ((-0.48 * wide, -0.10 * deep, mid - 8.0), (0.62 * wide, 0.80 * deep, 74.0), LIVER_HU)
    organ((0.20 * wide, -0.45 * deep, mid), (0.34 * wide, 0.36 * deep, 34.0), _BOWEL_HU + 8.0)
    organ((0.70 * wide, 0.22 * deep, mid - 4.0), (0.24 * wide, 0.42 * deep, 44.0), _SPLEEN_HU)
    spine_y = anatomy.centres["L2"][1]
    if anatomy.outline is not None:
        spine_y = spine_y - float(anatomy.outline.at(np.array([kidney]))[1][0])
    for side in (1.0, -1.0):
        # The right kidney lies lower, under the liver.
        organ((side * 56.0, spine_y + 8.0, kidney + 8.0 * side), (23.0, 19.0, 50.0), KIDNEY_HU)

    mediastinum = ellipse(x - np.float32(6.0), y + np.float32(0.25 * deep), 0.34 * wide + 6.0, 0.85 * deep)
    # Heart and great vessels are one piece, in a rim of fat.
    painter.fill(np.minimum(np.minimum(mediastinum - np.float32(4.0), above), cavity), painter.blood_hu)
    return np.minimum(np.minimum(cavity + np.float32(9.0), above), -mediastinum)


_BAND = 24000
"""Pixels drawn at once: temporaries stay in the cache, and below the size at which the system maps memory anew."""


def _draw_tissue(
    painter: _Painter, anatomy: Anatomy, x: Field, y: Field, z: Field, table: Sequence[Part] | None, prone: bool
) -> None:
    """Draw one slice without bone, in bands of rows, at x, y, z in mm of the plan, onto air.

    Without a table the body lies on a couch of its own, if prone under the front.
    """
    rows = max(1, _BAND // x.shape[1])
    for start in range(0, x.shape[0], rows):
        band = slice(start, start + rows)
        part_painter = replace(painter, canvas=painter.canvas[band])
        if table is None:
            _draw_couch(part_painter, anatomy, x[band], -y[band] if prone else y[band])
        for part in table or ():
            part_painter.fill(part.distance_at(x[band], y[band], z[band]), part.hu)
        _draw_band(part_painter, anatomy, x[band], y[band], z[band])


def _draw_band(painter: _Painter, anatomy: Anatomy, x: Field, y: Field, z: Field) -> None:
    """Draw onto a canvas that already holds air and the couch."""
    neck: float | Field = 0.0
    if anatomy.outline is None:
        cavity = _draw_wall(painter, anatomy.half_width, anatomy.half_depth, x, y)
        lung = _draw_organs(painter, anatomy, cavity, x, y, z)
    else:
        middle_x, middle_y, half_width, half_depth, neck = anatomy.outline.at(z)
        body_x, body_y = x - middle_x, y - middle_y
        cavity = _draw_wall(painter, half_width, half_depth, body_x, body_y)
        lung = _draw_organs(painter, anatomy, cavity, body_x, body_y, z)
        lung = np.minimum(lung, np.float32(60.0) * (np.float32(0.2) - neck))  # no lungs in the neck

    height = np.clip(z, *anatomy.curve_z) * np.float32(0.01)
    spine_x, spine_y = (
        np.asarray(np.polyval(curve.astype(np.float32), height), dtype=np.float32)
        for curve in (anatomy.curve_x, anatomy.curve_y)
    )
    from_x, from_y = x - spine_x, y - spine_y
    # muscle round the column, before the lungs, so that they do not reach into it
    column = ellipse(from_x, from_y - np.float32(34.0), 66.0, 37.0)
    front = ellipse(from_x, from_y, 29.0, 27.0)
    lung = np.minimum(lung, -np.maximum(column, front))
    painter.fill(np.minimum(column, cavity + np.float32(13.0)), MUSCLE_HU)
    painter.fill(lung, LUNG_HU)
    # Planes of fat: under the skin between the muscle bellies, and beside the transverse processes.
    cleft = np.minimum(3.0 - np.abs(from_x), from_y - 56.0)
    painter.fill(np.minimum(cleft, cavity + np.float32(13.0)), FAT_HU)
    belly = np.abs(ellipse(np.abs(from_x) - np.float32(27.0), from_y - np.float32(42.0), 25.0, 17.0))
    painter.fill(np.float32(0.7) - belly, FAT_HU, np.float32(0.6))

    top, bottom = anatomy.level_z("T12"), anatomy.level_z("L5")
    lean = float(np.polyval(anatomy.curve_y, bottom / 100.0))
    start = float(np.polyval(anatomy.curve_y, top / 100.0))
    psoas = capsule((np.abs(from_x), y, z), (24.0, start + 6.0, top - 12.0), (44.0, lean - 6.0, bottom), 3.0, 21.0)
    painter.fill(psoas, MUSCLE_HU + 4.0)
    fat_round = ellipse(from_x - np.float32(2.0), from_y + np.float32(29.0), 34.0, 14.0)
    painter.fill(np.minimum(fat_round, -lung), FAT_HU + 20.0)
    _draw_vessels(painter, from_x, from_y, z, neck)
    # The canal lies nearer to the middle of the small bodies of the neck.
    behind = np.float32(9.5) * neck
    canal = ellipse(from_x, from_y - np.float32(24.3) + behind, 11.5, 8.3)
    painter.fill(canal, FAT_HU + 40.0)
    sac = ellipse(from_x, from_y - np.float32(24.0) + behind, 8.5, 6.6)
    painter.fill(sac, _FLUID_HU)
    painter.fill(np.minimum(sac - np.float32(3.0), z - np.float32(anatomy.level_z("L1"))), _CORD_HU)


def _draw_vessels(painter: _Painter, from_x: Field, from_y: Field, z: Field, neck: float | Field) -> None:
    """Draw aorta and vena cava in front of the spine, and in the neck the windpipe."""
    trunk = np.float32(1.0) - neck
    aorta = ellipse(from_x - np.float32(13.0), from_y + np.float32(29.0), 10.0, 10.0)
    # Plaques: spots of the left and rear wall, at intervals along the vessel.
    along = np.cos(z * np.float32(0.23) + np.float32(painter.seed % 7))
    spots = 0.84 - along * np.cos((from_x - from_y) * np.float32(0.25))
    plaque = 1.1 - np.abs(aorta - np.float32(1.0)) - np.float32(3.0) * np.maximum(spots, 0.0)
    painter.fill(aorta, painter.blood_hu, trunk)
    painter.fill(np.minimum(plaque, from_x - np.float32(13.0)), _CALCIUM_HU, trunk)
    vein = ellipse(from_x + np.float32(16.0), from_y + np.float32(27.0), 12.5, 8.5)
    painter.fill(vein, painter.blood_hu, trunk)
    if not isinstance(neck, float):
        windpipe = ellipse(from_x, from_y + np.float32(27.0), 8.0, 8.0)
        painter.fill(np.minimum(windpipe, np.float32(60.0) * (neck - np.float32(0.5))), AIR_HU)


Float32Array = NDArray[np.float32]

CORTEX_HU = 1050.0
BODY_CORTEX_HU = 850.0
TRABECULAR_HU = 190.0
_TRABECULAR_TEXTURE_HU = 45.0
ARCH_MARROW_HU = 330.0
RIB_MARROW_HU = 140.0
_DISC_HU = 92.0
_VEIN_HU = 60.0
_MARKER_HU = 2200.0


class _Scene:
    """All bone parts of a spine plan, placed on one grid."""

    def __init__(self, anatomy: Anatomy, affine: Float64Array, shape_kji: tuple[int, int, int], ramp_mm: float):
        self.anatomy, self.ramp = anatomy, ramp_mm
        margin = np.full(3, 2.0 * ramp_mm + float(np.linalg.norm(affine[:3, :3], axis=0).max()))

        def place_piece(center: Float64Array, axes: Float64Array, low: Float64Array, high: Float64Array) -> PlacedPiece:
            return PlacedPiece(center, axes, low - margin, high + margin, affine, shape_kji)

        self.discs = []
        for disc in anatomy.discs:
            half = np.array((disc.half_width, disc.half_depth, disc.half_length))
            self.discs.append((disc, place_piece(disc.center, disc.axes, -half, half)))
        self.vertebrae = []
        for vertebra in anatomy.vertebrae:
            low, high = (np.array(corner) for corner in local_bounds(vertebra))
            self.vertebrae.append((vertebra, place_piece(vertebra.center, vertebra.axes, low, high)))
        self.rib_rods = []
        for rib in anatomy.ribs:
            for a, b in itertools.pairwise(rib.points):
                reach = np.array((4.5, 4.5, 8.0))
                low, high = np.minimum(a, b) - reach, np.maximum(a, b) + reach
                self.rib_rods.append((a, b, place_piece(np.zeros(3), np.eye(3), low, high)))
        reach = np.full(3, anatomy.marker_radius)
        self.marker = place_piece(anatomy.marker, np.eye(3), -reach, reach)

    def draw(self, canvas: Field, scratch: Field, slice_k: int, k: float) -> None:
        """Draw all bone of (sub-)slice `k`, which belongs to slice `slice_k`, onto `canvas`."""
        for disc, placed in self.discs:
            if placed.meets(slice_k):
                window = placed.window(k)
                wall = ellipse(window.x, window.y, disc.half_width, disc.half_depth)
                inside = np.minimum(wall, np.float32(disc.half_length) - np.abs(window.z))
                # The fibrous ring is a little denser than the nucleus.
                ring = np.float32(_DISC_HU) + np.float32(14.0) * coverage(8.0 - wall, 8.0)
                paint(canvas, placed.region, coverage(inside, self.ramp), ring)
        self._draw_ribs(canvas, scratch, slice_k, k)
        for vertebra, placed in self.vertebrae:
            if placed.meets(slice_k):
                self._draw_vertebra(canvas, vertebra, placed.window(k))
        if self.marker.meets(slice_k):
            window = self.marker.window(k)
            ball = np.float32(self.anatomy.marker_radius) - np.sqrt(window.x**2 + window.y**2 + window.z**2)
            paint(canvas, window.region, coverage(ball, self.ramp), _MARKER_HU)

    def _draw_ribs(self, canvas: Field, scratch: Field, slice_k: int, k: float) -> None:
        """Draw all ribs as one union, so that the joints of the rods do not show."""
        active = [(a, b, placed) for a, b, placed in self.rib_rods if placed.meets(slice_k)]
        if not active:
            return
        for _, _, placed in active:
            scratch[placed.region] = -1e3
        for a, b, placed in active:
            window = placed.window(k)
            rod = capsule((window.x, window.y, window.z), tuple(a), tuple(b), 3.5, 3.5, 0.55)
            view = scratch[placed.region]
            np.maximum(view, rod, out=view)
        rows = slice(min(p.region[0].start for *_, p in active), max(p.region[0].stop for *_, p in active))
        columns = slice(min(p.region[1].start for *_, p in active), max(p.region[1].stop for *_, p in active))
        rib = scratch[rows, columns]
        paint(canvas, (rows, columns), coverage(rib, self.ramp), CORTEX_HU)
        paint(canvas, (rows, columns), coverage(rib - np.float32(1.0), self.ramp), RIB_MARROW_HU)
        rib[...] = -1e3

    def _draw_vertebra(self, canvas: Field, vertebra: Vertebra, window: Window) -> None:
        bone = vertebra_distance(vertebra, window.x, window.y, window.z)
        if bone.max() <= -self.ramp:
            return
        # 0 in the body, 1 in the arch: thicker cortex and denser marrow behind the body
        arch = coverage(window.y - np.float32(vertebra.depth / 2.0 + 1.0), 6.0)
        cortex = np.float32(0.75) + np.float32(0.65) * arch
        marrow = waves_at(window.x, window.y, window.z, vertebra.waves) * np.float32(_TRABECULAR_TEXTURE_HU)
        marrow += np.float32(TRABECULAR_HU) + np.float32(ARCH_MARROW_HU - TRABECULAR_HU) * arch
        # basivertebral vein, from the middle of the back wall into the body
        vein = capsule((window.x, window.y, window.z), (0.0, vertebra.depth / 2.0, 0.0), (0.0, 2.0, 0.0), 2.4, 1.0, 1.0)
        marrow += coverage(vein, 1.5) * (np.float32(_VEIN_HU) - marrow)
        shell = np.float32(BODY_CORTEX_HU) + np.float32(CORTEX_HU - BODY_CORTEX_HU) * arch
        paint(canvas, window.region, coverage(bone, self.ramp), shell)
        paint(canvas, window.region, coverage(bone - cortex, self.ramp), marrow)


def plan_spine(settings: PhantomSettings, affine: Float64Array) -> tuple[Anatomy, Float64Array]:
    """Plan the spine of a phantom, in mm about `CENTRE_LPS_MM`, and return the affine from index to mm of the plan."""
    # The plan's origin is the centre of the volume.
    grid = affine.copy()
    grid[:3, 3] -= CENTRE_LPS_MM
    extents = np.array(settings.shape_kji[::-1]) * column_spacing(affine)
    width, depth, length = (float(extent) for extent in extents)
    return plan_anatomy((width, depth, length), grid[:3, :3], settings.seed, settings.spine_choice), grid


def label_levels(settings: PhantomSettings, affine: Float64Array) -> NDArray[np.uint8]:
    """Label each voxel with the `level_number` of the vertebra that holds its centre; 0 where none is."""
    anatomy, grid = plan_spine(settings, affine)
    labels = np.zeros(settings.shape_kji, dtype=np.uint8)
    for vertebra in anatomy.vertebrae:
        low, high = (np.array(corner) for corner in local_bounds(vertebra))
        placed = PlacedPiece(vertebra.center, vertebra.axes, low, high, grid, settings.shape_kji)
        for k in range(settings.slices):
            if placed.meets(k):
                window = placed.window(float(k))
                labels[k][window.region][vertebra_distance(vertebra, window.x, window.y, window.z) >= 0.0] = (
                    level_number(vertebra.name)
                )
    return labels


def draw_spine(
    settings: PhantomSettings,
    affine: Float64Array,
    progress: Progress | None = None,
    *,
    places: Float64Array | None = None,
    blood_hu: float = BLOOD_HU,
) -> tuple[Float32Array, Anatomy]:
    """Draw the spine in HU at `places` k; return its plan about `CENTRE_LPS_MM` too; `blood_hu` are of vessels."""
    shape = settings.shape_kji
    offsets, ramp = plan_subslices(affine)
    anatomy, grid = plan_spine(settings, affine)
    scene = _Scene(anatomy, grid, shape, ramp)
    body = Plan([], front=-anatomy.half_depth, back=anatomy.half_depth)
    is_own = settings.table_used == "own"
    table = None if is_own else lay_under(body, settings.table_used, settings.table_gap_mm, settings.prone)
    voxels = np.empty(shape, dtype=np.float32)

    def draw_slice(k: int, slice_place: float) -> None:
        full = Window((slice(0, shape[1]), slice(0, shape[2])), grid, slice_place)
        tissue = np.full(shape[1:], AIR_HU, dtype=np.float32)
        painter = _Painter(tissue, ramp, settings.seed, blood_hu)
        _draw_tissue(painter, anatomy, full.x, full.y, full.z, table, settings.prone)
        scratch = np.full(shape[1:], -1e3, dtype=np.float32)
        voxels[k] = 0.0
        for offset in offsets:
            canvas = tissue.copy() if len(offsets) > 1 else tissue
            scene.draw(canvas, scratch, k, slice_place + offset)
            voxels[k] += canvas
        if len(offsets) > 1:
            voxels[k] /= np.float32(len(offsets))

    # One thread: the pieces are small, and threads lose more time to the interpreter lock than they gain.
    for k in range(shape[0]):
        draw_slice(k, float(k if places is None else places[k]))
        if progress is not None:
            progress("draw", k + 1, shape[0])
    return voxels, anatomy
