"""Draw the spine phantom: soft tissue, discs, ribs, vertebrae, marker and table, slice by slice, in HU.

Every interface is a linear ramp of about one voxel (partial volume), not a threshold.  Bone is drawn on thin
sub-slices and averaged, so that thick slices blur endplates as a scanner does.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import column_spacing
from clrecon.phantom.fields import Field, capsule, coverage, ellipse, waves_at
from clrecon.phantom.levels import level_number
from clrecon.phantom.parts import Anatomy, Vertebra
from clrecon.phantom.placing import Piece, PlacedPiece, Window, paint
from clrecon.phantom.plan import plan_anatomy
from clrecon.phantom.scenes import Plan
from clrecon.phantom.settings import CENTRE_LPS_MM, PhantomSettings
from clrecon.phantom.tables import lay_under
from clrecon.phantom.tissue import BLOOD_HU, draw_tissue
from clrecon.phantom.vertebra import local_bounds, vertebra_distance
from clrecon.system.progress import Progress

Float64Array = NDArray[np.float64]
Float32Array = NDArray[np.float32]

CORTEX_HU = 1050.0
BODY_CORTEX_HU = 850.0
TRABECULAR_HU = 190.0
TRABECULAR_TEXTURE_HU = 45.0
ARCH_MARROW_HU = 330.0
RIB_MARROW_HU = 140.0
DISC_HU = 92.0
VEIN_HU = 60.0
MARKER_HU = 2200.0


class _Scene:
    """All bone parts of a spine plan, placed on one grid."""

    def __init__(self, anatomy: Anatomy, affine: Float64Array, shape_kji: tuple[int, int, int], ramp_mm: float):
        self.anatomy, self.ramp = anatomy, ramp_mm
        margin = np.full(3, 2.0 * ramp_mm + float(np.linalg.norm(affine[:3, :3], axis=0).max()))

        def place(center: Float64Array, axes: Float64Array, low: Float64Array, high: Float64Array) -> PlacedPiece:
            return PlacedPiece(Piece(center, axes, low - margin, high + margin), affine, shape_kji)

        self.discs = []
        for disc in anatomy.discs:
            half = np.array((disc.half_width, disc.half_depth, disc.half_length))
            self.discs.append((disc, place(disc.center, disc.axes, -half, half)))
        self.vertebrae = []
        for vertebra in anatomy.vertebrae:
            low, high = (np.array(corner) for corner in local_bounds(vertebra))
            self.vertebrae.append((vertebra, place(vertebra.center, vertebra.axes, low, high)))
        self.rib_rods = []
        for rib in anatomy.ribs:
            for a, b in itertools.pairwise(rib.points):
                reach = np.array((4.5, 4.5, 8.0))
                low, high = np.minimum(a, b) - reach, np.maximum(a, b) + reach
                self.rib_rods.append((a, b, place(np.zeros(3), np.eye(3), low, high)))
        reach = np.full(3, anatomy.marker_radius)
        self.marker = place(anatomy.marker, np.eye(3), -reach, reach)

    def draw(self, canvas: Field, scratch: Field, slice_k: int, k: float) -> None:
        """Draw all bone of (sub-)slice `k`, which belongs to slice `slice_k`, onto `canvas`."""
        for disc, placed in self.discs:
            if placed.meets(slice_k):
                at = placed.window(k)
                wall = ellipse(at.x, at.y, disc.half_width, disc.half_depth)
                inside = np.minimum(wall, np.float32(disc.half_length) - np.abs(at.z))
                # The fibrous ring is a little denser than the nucleus.
                ring = np.float32(DISC_HU) + np.float32(14.0) * coverage(8.0 - wall, 8.0)
                paint(canvas, placed.region, coverage(inside, self.ramp), ring)
        self._draw_ribs(canvas, scratch, slice_k, k)
        for vertebra, placed in self.vertebrae:
            if placed.meets(slice_k):
                self._draw_vertebra(canvas, vertebra, placed.window(k))
        if self.marker.meets(slice_k):
            at = self.marker.window(k)
            ball = np.float32(self.anatomy.marker_radius) - np.sqrt(at.x * at.x + at.y * at.y + at.z * at.z)
            paint(canvas, at.region, coverage(ball, self.ramp), MARKER_HU)

    def _draw_ribs(self, canvas: Field, scratch: Field, slice_k: int, k: float) -> None:
        """Draw all ribs as one union, so that the joints of the rods do not show."""
        active = [(a, b, placed) for a, b, placed in self.rib_rods if placed.meets(slice_k)]
        if not active:
            return
        for _, _, placed in active:
            scratch[placed.region] = -1e3
        for a, b, placed in active:
            at = placed.window(k)
            rod = capsule(at.x, at.y, at.z, tuple(a), tuple(b), 3.5, 3.5, 0.55)
            view = scratch[placed.region]
            np.maximum(view, rod, out=view)
        rows = slice(min(p.region[0].start for *_, p in active), max(p.region[0].stop for *_, p in active))
        columns = slice(min(p.region[1].start for *_, p in active), max(p.region[1].stop for *_, p in active))
        rib = scratch[rows, columns]
        paint(canvas, (rows, columns), coverage(rib, self.ramp), CORTEX_HU)
        paint(canvas, (rows, columns), coverage(rib - np.float32(1.0), self.ramp), RIB_MARROW_HU)
        rib[...] = -1e3

    def _draw_vertebra(self, canvas: Field, vertebra: Vertebra, at: Window) -> None:
        bone = vertebra_distance(vertebra, at.x, at.y, at.z)
        if bone.max() <= -self.ramp:
            return
        # 0 in the body, 1 in the arch: thicker cortex and denser marrow behind the body
        arch = coverage(at.y - np.float32(vertebra.depth / 2.0 + 1.0), 6.0)
        cortex = np.float32(0.75) + np.float32(0.65) * arch
        marrow = waves_at(at.x, at.y, at.z, vertebra.waves) * np.float32(TRABECULAR_TEXTURE_HU)
        marrow += np.float32(TRABECULAR_HU) + np.float32(ARCH_MARROW_HU - TRABECULAR_HU) * arch
        # basivertebral vein, from the middle of the back wall into the body
        vein = capsule(at.x, at.y, at.z, (0.0, vertebra.depth / 2.0, 0.0), (0.0, 2.0, 0.0), 2.4, 1.0, 1.0)
        marrow += coverage(vein, 1.5) * (np.float32(VEIN_HU) - marrow)
        shell = np.float32(BODY_CORTEX_HU) + np.float32(CORTEX_HU - BODY_CORTEX_HU) * arch
        paint(canvas, at.region, coverage(bone, self.ramp), shell)
        paint(canvas, at.region, coverage(bone - cortex, self.ramp), marrow)


def plan_spine(settings: PhantomSettings, affine: Float64Array) -> tuple[Anatomy, Float64Array]:
    """Plan the spine of a phantom.

    affine: ndarray, shape (4, 4). Index (i, j, k) to LPS mm.

    Returns:
    anatomy: In mm about `CENTRE_LPS_MM`.
    grid: ndarray, shape (4, 4). Index to mm of the plan.
    """
    # The plan's origin is the centre of the volume.
    grid = affine.copy()
    grid[:3, 3] -= CENTRE_LPS_MM
    extents = np.array(settings.shape_kji[::-1]) * column_spacing(affine)
    width, depth, length = (float(extent) for extent in extents)
    return plan_anatomy((width, depth, length), grid[:3, :3], settings.seed, settings.spine_choice), grid


def label_levels(settings: PhantomSettings, affine: Float64Array) -> NDArray[np.uint8]:
    """Label each voxel of a spine phantom with the number of the vertebra that holds its centre.

    affine: ndarray, shape (4, 4). Index (i, j, k) to LPS mm.

    Returns: ndarray, shape (nk, nj, ni), uint8. 0 where no vertebra is, else `clrecon.phantom.levels.level_number`.
    """
    anatomy, grid = plan_spine(settings, affine)
    labels = np.zeros(settings.shape_kji, dtype=np.uint8)
    for vertebra in anatomy.vertebrae:
        low, high = (np.array(corner) for corner in local_bounds(vertebra))
        placed = PlacedPiece(Piece(vertebra.center, vertebra.axes, low, high), grid, settings.shape_kji)
        for k in range(settings.slices):
            if placed.meets(k):
                at = placed.window(float(k))
                labels[k][at.region][vertebra_distance(vertebra, at.x, at.y, at.z) >= 0.0] = level_number(vertebra.name)
    return labels


def draw_spine(
    settings: PhantomSettings,
    affine: Float64Array,
    progress: Progress | None = None,
    *,
    places: Float64Array | None = None,
    blood_hu: float = BLOOD_HU,
) -> tuple[Float32Array, Anatomy]:
    """Draw the spine phantom without point spread and noise.

    affine: ndarray, shape (4, 4). Index (i, j, k) to LPS mm.
    progress: Called as ``progress("draw", done, slices)``.
    places: ndarray, shape (nk,). k of each slice in the affine; default: 0, 1, 2 and so on.
    blood_hu: HU of heart and vessels.

    Returns:
    voxels: ndarray, shape (nk, nj, ni), float32. HU.
    anatomy: The plan, in mm about `CENTRE_LPS_MM`.
    """
    shape = settings.shape_kji
    di, dj, dk = column_spacing(affine)
    subslices = int(np.clip(round(dk / math.sqrt(di * dj)), 1, 4))
    ramp = (di * dj * dk / subslices) ** (1.0 / 3.0)
    anatomy, grid = plan_spine(settings, affine)
    scene = _Scene(anatomy, grid, shape, ramp)
    body = Plan([], front=-anatomy.half_depth, back=anatomy.half_depth)
    own = settings.table_used == "own"
    table = None if own else lay_under(body, settings.table_used, settings.table_gap_mm, settings.prone)
    voxels = np.empty(shape, dtype=np.float32)
    offsets = (np.arange(subslices) + 0.5) / subslices - 0.5

    def draw(k: int, place: float) -> None:
        full = Window((slice(0, shape[1]), slice(0, shape[2])), grid, place)
        tissue = draw_tissue(
            anatomy, full.x, full.y, full.z, ramp, settings.seed, table, settings.prone, blood_hu=blood_hu
        )
        scratch = np.full(shape[1:], -1e3, dtype=np.float32)
        voxels[k] = 0.0
        for offset in offsets:
            canvas = tissue.copy() if subslices > 1 else tissue
            scene.draw(canvas, scratch, k, place + offset)
            voxels[k] += canvas
        if subslices > 1:
            voxels[k] /= np.float32(subslices)

    # One thread: the pieces are small, and threads lose more time to the interpreter lock than they gain.
    for k in range(shape[0]):
        draw(k, float(k if places is None else places[k]))
        if progress is not None:
            progress("draw", k + 1, shape[0])
    return voxels, anatomy
